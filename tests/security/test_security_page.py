"""The table of attacks in docs/security.md: long enough, and every row names a test that exists."""

import re

from tests.conftest import ROOT

ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in (ROOT / "docs" / "security.md").read_text(encoding="utf-8").partition("## Attacks")[2].splitlines()
    if "::" in line
]


def test_there_are_at_least_forty_attacks_beyond_the_fault_matrix():
    assert len(ROWS) >= 40
    assert len({row[0] for row in ROWS}) == len(ROWS)
    assert all(len(row) == 5 for row in ROWS)
    assert not any("test_matrix" in row[4] for row in ROWS)


def test_every_attack_names_a_test_that_exists():
    missing = []
    for *_, named in ROWS:
        file, _, test = named.strip("`| ").partition("::")
        path = ROOT / file
        if not path.is_file() or not re.search(rf"^def {test}\(", path.read_text(encoding="utf-8"), re.M):
            missing.append(named)
    assert missing == []
