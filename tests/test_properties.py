"""Properties hold for all examples that their tests ask for: `make test` tries a part of them (tests/conftest.py)."""

import os
import re
import subprocess
import sys

import pytest

from tests.conftest import ROOT


def folders() -> list[str]:
    """The folders of tests with properties."""
    tests = (path for path in (ROOT / "tests").rglob("test_*.py") if "\n@given(" in path.read_text(encoding="utf-8"))
    return sorted({path.relative_to(ROOT / "tests").parts[0] for path in tests})


@pytest.mark.verify
@pytest.mark.parametrize("folder", folders())
def test_every_property_holds_for_all_of_its_examples(folder: str, measured):
    command = [sys.executable, "-m", "pytest", "--hypothesis-profile=all", "--no-header", "--tb=short"]
    run = subprocess.run(
        [*command, "-m", "hypothesis and not verify", f"tests/{folder}"],
        cwd=ROOT,
        env=dict(os.environ),
        capture_output=True,
        text=True,
        check=False,
    )
    tried = re.search(r"(\d+) passed", run.stdout)
    ended = f"{tried[1] if tried else 0} properties, exit {run.returncode}"
    measured(f"properties of {folder}, all examples", ended, "", "all hold", run.returncode == 0)
    assert run.returncode == 0, run.stdout[-3000:]
