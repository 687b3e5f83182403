"""Tests of ours that a test runs again, under other conditions."""

import os
import re
import subprocess
import sys
from collections.abc import Callable

from tests.conftest import ROOT


def hold_again(measured: Callable[..., None], what: str, target: str, *arguments: str, **environment: str) -> None:
    """Run pytest with these arguments, `environment` added to ours; note how many passed, and fail if any does."""
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "--no-header", "--tb=short", *arguments],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    passed = re.search(r"(\d+) passed", run.stdout)
    ended = f"{passed[1] if passed else 0} passed, exit {run.returncode}"
    measured(what, ended, "", target, run.returncode == 0)
    assert run.returncode == 0, run.stdout[-3000:]
