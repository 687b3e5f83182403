"""Causes that are numbers of a servo are named where these differ from the file's by more than their intervals."""

from types import SimpleNamespace

import numpy as np
import pytest

from agent.diagnosis.document import Cause
from agent.diagnosis.simulator_file import servo_table

NAMES = ("lift", "elbow")
#: Rows of the file's numbers: gain, damping, armature, friction, delay.
FILE = np.array([[20.0, 20.0], [1.0, 1.0], [0.03, 0.03], [0.05, 0.05], [0.0, 0.0]])


def named(monkeypatch, effect: str, joints: tuple[str, ...], **intervals) -> bool:
    """Whether a cause stays, where the intervals of the first joint are these, and of all else ± 10 %."""
    table = {
        kind: [(value, 0.9 * value, 1.1 * value) for value in row]
        for kind, row in zip(servo_table.SERVO_NUMBERS, FILE, strict=True)
    }
    for kind, interval in intervals.items():
        table[kind][0] = interval
    monkeypatch.setattr(servo_table, "servo_table", lambda found: {"servo": table})
    dataset = SimpleNamespace(robot=SimpleNamespace(joint_names=NAMES), servos=SimpleNamespace(file=FILE))
    cause = Cause(effect, joints, 0.5, 0.95, {})
    return servo_table.differing(SimpleNamespace(dataset=dataset), [cause]) == [cause]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("effect", "intervals", "stays"),
    [
        ("torque_constant", {}, False),
        ("torque_constant", {"kp": (22.5, 20.5, 24.5)}, True),
        ("torque_constant", {"kp": None}, True),  # a class of which only ratios are known is judged elsewhere
        ("torque_constant", {"friction": (0.1, 0.08, 0.12)}, False),
        ("friction_change", {}, False),
        ("friction_change", {"friction": (0.1, 0.08, 0.12)}, True),
        ("friction_change", {"damping": (0.5, 0.4, 0.6)}, True),
        ("friction_change", {"kp": (30.0, 28.0, 32.0)}, False),
        ("stribeck", {}, True),
    ],
)
def test_numbers_that_may_be_the_files_own_are_no_cause(monkeypatch, effect, intervals, stays):
    assert named(monkeypatch, effect, ("lift",), **intervals) == stays


def test_another_joint_and_the_whole_arm_are_judged_by_their_own_numbers(monkeypatch):
    assert not named(monkeypatch, "torque_constant", ("elbow",), kp=(30.0, 28.0, 32.0))
    assert named(monkeypatch, "time_delay", ())
