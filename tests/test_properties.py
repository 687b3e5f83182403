"""Properties hold for all examples that their tests ask for: `make test` tries a part of them (tests/conftest.py)."""

import pytest

from tests.conftest import ROOT
from tests.reruns import hold_again


def folders() -> list[str]:
    """The folders of tests with properties."""
    tests = (path for path in (ROOT / "tests").rglob("test_*.py") if "\n@given(" in path.read_text(encoding="utf-8"))
    return sorted({path.relative_to(ROOT / "tests").parts[0] for path in tests})


@pytest.mark.verify
@pytest.mark.parametrize("folder", folders())
def test_every_property_holds_for_all_of_its_examples(folder: str, measured):
    arguments = ("--hypothesis-profile=all", "-m", "hypothesis and not verify", f"tests/{folder}")
    hold_again(measured, f"properties of {folder}, all examples", "all hold", *arguments)
