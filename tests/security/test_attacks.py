"""Every attack of docs/security.md ten times at least: those with few tries are tried again, differently.

A row with (d) is run in nine more draws, each with other postures, motions, moments, wires or loops (`drawn` of
tests/conftest.py); a repeat of the same would prove nothing.
"""

import re

import pytest

from tests.conftest import ROOT
from tests.reruns import hold_again

DRAWS = range(1, 10)


def drawn_attacks() -> list[str]:
    """The tests of the rows with (d)."""
    table = (ROOT / "docs" / "security.md").read_text(encoding="utf-8").partition("## Attacks")[2]
    rows = [line for line in table.splitlines() if line.startswith("|") and "(d)" in line]
    return list(dict.fromkeys(test for row in rows for test in re.findall(r"`(tests/\S+::\w+)`", row)))


@pytest.mark.verify
@pytest.mark.parametrize("folder", sorted({test.split("/")[1] for test in drawn_attacks()}))
@pytest.mark.parametrize("draw", DRAWS)
def test_attacks_hold_with_another_random_draw(draw: int, folder: str, measured):
    tests = [test for test in drawn_attacks() if test.split("/")[1] == folder]
    arguments = ("-n", "0", "-m", "verify or not verify", *tests)
    hold_again(measured, f"attacks of {folder} in draw {draw}", "all held", *arguments, CALIBRATION_DRAW=str(draw))
