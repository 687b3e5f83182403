"""No check of the safety layer can be taken away unnoticed."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT, environment


@pytest.mark.verify
def test_every_mutated_safety_check_fails_a_test(measured):
    run = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("mutation.py"))],
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    last = run.stdout.strip().splitlines()[-1]
    measured("safety layer: changes noticed by its tests", last, "", "all", run.returncode == 0)
    assert run.returncode == 0, run.stdout
