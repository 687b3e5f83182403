"""The picture of the README is what a diagnosis of a hose on joint 4 prints."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.conftest import loaded

DOCS = Path(__file__).resolve().parents[2] / "docs"
NAMED = ("agent diagnose", "explained", "joint_4", "A hose or cable pulls", "Look at hoses")


@pytest.fixture
def maker():
    return loaded(DOCS / "make_picture.py")


def _text(svg: str) -> str:
    return " ".join(ElementTree.fromstring(svg).itertext()).replace("\N{NO-BREAK SPACE}", " ")


def test_the_picture_names_joint_cause_and_next_step():
    text = _text((DOCS / "diagnosis.svg").read_text(encoding="utf-8"))
    assert [named for named in NAMED if named not in text] == []


def test_a_screen_is_drawn_up_to_the_next_step(maker):
    text = _text(maker.drawn(f"$ agent\nWhat  <{'long ' * 40}>\nNext  look\n      and more\n\njoint_1"))
    assert "<long" in text
    assert text.split()[-1] == "look"


@pytest.mark.verify
def test_the_diagnosis_prints_what_the_picture_shows(maker, tmp_path: Path):
    screen = " ".join(maker.screen_of(tmp_path).split())
    assert [named for named in NAMED if named not in screen] == []
