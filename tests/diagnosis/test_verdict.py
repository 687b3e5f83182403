"""What a verdict promises holds whatever the procedure came to."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from agent.diagnosis.answer import Cause, Place
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.verdict import settle

closures = st.one_of(st.none(), st.floats(-1, 1), st.sampled_from([0.0, LIMITS.part, LIMITS.explained]))
causes = st.builds(
    Cause,
    effect=st.sampled_from(["stribeck", "interpolator_mismatch"]),
    joints=st.just(("joint_2",)),
    closure=closures,
    probability=st.floats(0.5, 1),
    parameters=st.dictionaries(st.sampled_from("ab"), st.sampled_from([0.0, 1.0]), max_size=2),
    equivalent_to=st.sampled_from([(), (Place("presliding", ("joint_2",)),)]),
)


@given(st.sampled_from(["no_gap", "explained", "ambiguous", "unknown"]), st.lists(causes, max_size=3), closures)
def test_a_verdict_keeps_its_promises(verdict, found, closure):
    settled, named = settle(verdict, found, closure)
    if settled in ("no_gap", "unknown"):
        assert named == ()
    else:
        assert named
        assert all(cause in found for cause in named)
        assert bool(named[0].equivalent_to) == (settled == "ambiguous")
        assert closure > 0.2, "no probability without a closure"
    if settled == "explained":
        assert closure >= 0.75
    if closure is None and verdict != "unknown":
        assert settled == "no_gap"
    for cause in named:
        assert cause.closure >= 0.03, "a cause without a size is none"
        assert any(cause.parameters.values())
    assert settle(settled, named, closure) == (settled, named), "it is settled"
