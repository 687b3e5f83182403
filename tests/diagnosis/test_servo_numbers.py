"""Causes that are numbers of a servo are named where these differ from the file's by more than their intervals."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.diagnosis.document import Cause, NamedEffect
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.simulator_file import servo_table
from agent.diagnosis.simulator_file.numbers_as_causes import likely_effects_on
from agent.diagnosis.simulator_file.parameter_groups import NumberGroup, NumberKind
from agent.diagnosis.simulator_file.position_verdict import _as_class
from agent.diagnosis.verdict import decide_by_position
from agent.simulators import KINDS, ServoNumbers

NAMES = ("lift", "elbow")
#: Of both joints, in the order of `KINDS`.
FILE = ServoNumbers(*np.repeat([[0.03], [1.0], [0.05], [20.0], [0.5], [0.02], [0.01]], 2, axis=1))
TORQUE = ServoNumbers(*np.repeat([[0.1], [1.0], [0.2], [20.0], [0.0], [0.0], [0.05]], 2, axis=1)).table


def named(monkeypatch, effect: str, joints: tuple[str, ...], told: bool = True, **intervals) -> bool:
    """Whether a cause stays, where these are low and high of the first joint over the file's, and of all else ± 10 %.

    Intervals are of numbers where gains are `told`, else of their ratios to the gain.
    """

    def given(found, over_gain=False):
        values = servo_table._over_gain(FILE.table) if over_gain else FILE.table
        low, high = 0.9 * values, 1.1 * values
        if told != over_gain:
            for kind, (least, most) in intervals.items():
                row = KINDS.index(kind)
                low[row, 0], high[row, 0] = least * values[row, 0], most * values[row, 0]
        return map(ServoNumbers.of_table, (values, low, high))

    monkeypatch.setattr(servo_table, "_intervals", given)
    monkeypatch.setattr(servo_table, "_whole_torque", lambda dataset: TORQUE)
    monkeypatch.setattr(servo_table, "doubtful_gains", lambda dataset: () if told else (0,))
    dataset = SimpleNamespace(robot=SimpleNamespace(joint_names=NAMES), servos=SimpleNamespace(file=FILE))
    cause = Cause(effect, joints, 0.5, 0.95, {})
    return servo_table.differing_causes(SimpleNamespace(dataset=dataset), [cause]) == [cause]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("effect", "intervals", "stays"),
    [
        ("torque_constant", {}, False),
        ("torque_constant", {"kp": (1.1, 1.2)}, True),
        ("torque_constant", {"kp": (1.005, 1.2)}, False),  # a right file leaves as much
        ("torque_constant", {"friction": (1.6, 2.4)}, False),
        ("friction_change", {}, False),
        ("friction_change", {"friction": (1.6, 2.4)}, True),
        ("friction_change", {"friction": (1.03, 2.4)}, False),
        ("friction_change", {"damping": (0.4, 0.6)}, True),
        ("friction_change", {"kp": (1.4, 1.6)}, False),
        ("torque_offset", {}, False),
        ("torque_offset", {"offset": (1.2, 1.6)}, True),
        ("torque_offset", {"offset": (1.04, 1.6)}, False),  # a right file leaves as much
        ("stribeck", {}, True),
        ("payload", {}, True),
    ],
)
def test_numbers_that_may_be_the_files_own_are_no_cause(monkeypatch, effect, intervals, stays):
    assert named(monkeypatch, effect, ("lift",), **intervals) == stays


@pytest.mark.parametrize(
    ("effect", "ratios", "stays"),
    [
        ("torque_constant", {}, False),
        ("torque_constant", {"friction": (1.6, 2.4)}, True),
        ("torque_constant", {"damping": (0.4, 0.6)}, True),
        ("friction_change", {}, False),
        ("friction_change", {"friction": (1.6, 2.4)}, True),
        ("friction_change", {"armature": (1.6, 2.4)}, False),
    ],
)
def test_ratios_to_a_gain_that_positions_do_not_tell_are_compared(monkeypatch, effect, ratios, stays):
    assert named(monkeypatch, effect, ("lift",), told=False, **ratios) == stays


def test_another_joint_and_the_whole_arm_are_judged_by_their_own_numbers(monkeypatch):
    assert not named(monkeypatch, "torque_constant", ("elbow",), kp=(1.4, 1.6))
    assert not named(monkeypatch, "time_delay", ())
    assert named(monkeypatch, "time_delay", (), delay=(1.2, 1.4))
    assert named(monkeypatch, "payload", ())


@pytest.mark.parametrize(("closure", "exceeds", "verdict"), [
    (0.9, True, "explained"), (0.5, True, "unknown"), (0.05, False, "no_gap"), (-0.2, True, "unknown"),
])  # fmt: skip
def test_numbers_that_close_nothing_together_are_no_cause(closure, exceeds, verdict):
    cause = Cause("friction_change", ("lift",), 0.4, 0.95, {"coulomb_change": 0.1})
    assert decide_by_position([], [cause], closure, exceeds).name == verdict


@pytest.mark.parametrize(("error", "more"), [(1e-3, False), (3e-3, True)])
def test_a_joint_errs_by_more_than_a_right_file_does_from_twice_the_expected_error(error, more):
    fit = SimpleNamespace(sigma=np.full((5, 2), 1e-3))
    assert (np.array([error, 1e-4]) >= Fit.usual_error.fget(fit)).tolist() == [more, False]


def test_an_effect_that_is_likely_next_to_friction_that_moved_may_be_all_of_it():
    hypotheses = [SimpleNamespace(effect_keys=(("stribeck", (1,)), ("backlash", (0,))))]
    selected = SimpleNamespace(hypotheses=hypotheses, causes=[])
    released = SimpleNamespace(given=SimpleNamespace(servos=object()))
    friction = NumberGroup(NumberKind.FRICTION, 1, np.zeros((9, 2)), np.ones(2))
    assert likely_effects_on(released, selected, friction) == ["stribeck"]  # type: ignore[arg-type]
    selected.causes = [SimpleNamespace(key=("stribeck", (1,)))]
    assert likely_effects_on(released, selected, friction) == []  # type: ignore[arg-type]


@given(st.floats(-5, 5), st.floats(1e-3, 5), st.floats(1e-3, 5), st.sampled_from(KINDS))
def test_an_interval_holds_its_number_is_possible_and_keeps_its_width_above_it(value, below, above, kind):
    number, low, high = servo_table._possible(kind, value, value - below, value + above)
    assert low <= number <= high
    assert high - number == pytest.approx(above)
    assert kind == "offset" or low >= 0
    if value - below > 0 or kind == "offset":
        assert (number, low) == (value, value - below)


def test_numbers_none_of_which_is_surely_wrong_are_one_class():
    """In slow motion a delay is damping; of several numbers the one that closes most leads."""
    late, rubs = Cause("time_delay", ("b",), 0.9, 0.9, {"delay": 0.01}), Cause("friction_change", ("a",), 0.2, 0.9, {})
    (leader,) = _as_class([late, rubs])
    assert (leader.effect, leader.joints) == ("time_delay", ("b",))
    assert leader.equivalent_to == (NamedEffect("friction_change", ("a",)), NamedEffect("friction_change", ("b",)))
    assert _as_class([]) == []
