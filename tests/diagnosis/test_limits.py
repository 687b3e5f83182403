"""The limits of a diagnosis: each says what it is, and decides where it is handed in."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

import agent.diagnosis
from agent.diagnosis import limits
from agent.diagnosis.answer import Cause
from agent.diagnosis.finding import class_probability
from agent.diagnosis.limits import LIMITS, described
from agent.diagnosis.verdict import settle


@pytest.mark.parametrize("limit", described(), ids=lambda limit: limit.name)
def test_every_limit_says_what_it_is_and_is_used(limit):
    assert limit.meaning
    assert limit.sensitivity
    assert re.match("derived|tuned|chosen", limit.source)
    sources = [path for path in Path(agent.diagnosis.__file__).parent.glob("*.py") if path.name != "limits.py"]
    assert any(re.search(rf"imits\.{limit.name}\b", path.read_text(encoding="utf-8")) for path in sources)


def test_a_limit_that_is_handed_in_decides():
    cause = Cause("stribeck", ("joint_1",), 0.6, 0.9, {"rise": 1.0})
    assert settle("explained", [cause], 0.6)[0] == "unknown"
    assert settle("explained", [cause], 0.6, replace(LIMITS, explained=0.5)) == ("explained", (cause,))
    assert settle("explained", [cause], 0.6, replace(LIMITS, explained=0.5, least_share=0.7)) == ("unknown", ())
    surer = replace(LIMITS, probability=(0.0, 0.35, 0.43))
    assert class_probability(3.0, 0.9, surer) > class_probability(3.0, 0.9)


def test_what_was_measured_is_of_limits_that_exist():
    assert set(limits._SENSITIVITY) <= {limit.name for limit in described()}
