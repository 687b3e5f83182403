"""NaN is never accepted: no state, plan, sample, limit or authorisation with NaN lets an arm move."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import AgentError, InputError, SafetyError
from agent.motion.interpolator import Trajectory
from agent.robot import Box, load_robot
from agent.robot.cell import Cell
from agent.safety.authorisation import LONGEST
from agent.safety.preconditions import check_identity, check_period, check_plan, check_ready, unsafe_in_motion
from drivers.errors import DriverError
from drivers.protocol import Identity, Status
from tests.conftest import ROOT
from tests.safety.following import HOME
from tests.safety.mutation import ALWAYS_NUMBERS, MODULES

ROBOT = load_robot("comau_ns16")
NO_NUMBERS = [np.nan, np.inf, -np.inf, 5e-324, -5e-324, 1e308]

#: Comparisons that prevent motion when they are false, as they are for NaN. All other comparisons, except those of
#: values that are never NaN, are under a `not` or `~`: they state what is allowed, and fail for NaN.
FALSE_STOPS = {
    "adherence.py": {
        "self._path.distance(tool, rows) <= margin + allowed.tool": "true is near",
        "of_joint[:, None] <= fastest": "true is slow",
    },
    "first_run.py": {"peak <= FIRST_SPEED": "true is slow enough, anything else is planned again or refused"},
    "freshness.py": {"age <= self.oldest": "true goes on"},
    "preconditions.py": {"carried >= made": "true is fast enough"},
    "stopping.py": {
        "passed >= SPEED_WINDOW / 2": "true is a speed that is known",
        "self.speed < min(BRAKING * self.before, self._least + self._regained * self.before)": "true waits for the arm",
        "self.speed < min(BRAKING * self._most, self._least_since_most + self._regained * self._most)": "adds a word",
        "self.speed < self._most": "the same",
        "self._freshness.age <= MAX_SAMPLE_AGE": "true shows the arm",
        "self._clock() - self._state_at <= MAX_SAMPLE_AGE": "the same",
    },
    "watch.py": {"lasted <= self._longest": "true goes on"},
}


def ordering(module: Path) -> tuple[set[str], set[str]]:
    """Comparisons by size in a module: all, and those that stand under no negation."""
    tree = ast.parse(module.read_text(encoding="utf-8"))
    denied = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.Invert))
        for inner in ast.walk(node.operand)
    }
    sizes = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Compare) and isinstance(node.ops[0], sizes)]
    return {ast.unparse(node) for node in found}, {ast.unparse(node) for node in found if id(node) not in denied}


@pytest.mark.parametrize("module", [ROOT / module for module in MODULES], ids=lambda path: path.name)
def test_every_comparison_reports_the_allowed_range(module):
    everything, bare = ordering(module)
    numbers, stops = set(ALWAYS_NUMBERS.get(module.name, {})), set(FALSE_STOPS.get(module.name, {}))
    assert bare - numbers - stops == set(), "say what is allowed, under a `not`"
    assert numbers - everything == set(), "these are not there any more"
    assert stops - bare == set(), "these are not there any more"


def status(**changes):
    fine = Status(True, "auto", False, (), 1.0, True, False, "swing", "abc", HOME)
    return replace(fine, **changes)


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_a_nan_override_prevents_and_ends_motion(value):
    with pytest.raises(AgentError, match="override"):
        check_ready(status(override=value), "here", "swing", "abc")
    assert "override" in unsafe_in_motion(status(override=value))
    assert unsafe_in_motion(status()) is None


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_refuses_a_nan_period_or_rate(value):
    with pytest.raises((AgentError, DriverError), match=r"record\.rate|a period of"):
        check_period(Identity("comau_ns16", "1", "c", "v", ROBOT.joint_names, value), 500.0, "here")
    who = Identity("comau_ns16", "1", "c", "v", ROBOT.joint_names, 0.002)
    with pytest.raises(AgentError, match=r"record\.rate"):
        check_period(who, value, "here")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
def test_an_invalid_plan_or_position_does_not_run(program, value):
    chosen = program()
    (chain,) = chosen.chains
    for column in ("q", "qd"):
        values = getattr(chain, column).copy()
        values[7, 3] = value
        with pytest.raises(InputError):
            check_plan(replace(chosen, chains=(replace(chain, **{column: values}),)), ROBOT, HOME, "here")
    elsewhere = HOME.copy()
    elsewhere[3] = value
    with pytest.raises(AgentError, match="does not stand where its plan begins"):
        check_plan(chosen, ROBOT, elsewhere, "here")


class Unlimited:
    """A robot whose limits are no numbers."""

    def __init__(self, **changes):
        self.joint_names = ROBOT.joint_names
        self.position_limits = changes.get("position_limits", ROBOT.position_limits)
        self.max_velocity = changes.get("max_velocity", ROBOT.max_velocity)


def test_nan_limits_allow_nothing(program):
    nothing = np.full(6, np.nan)
    for limits in ((nothing, ROBOT.position_limits[1]), (ROBOT.position_limits[0], nothing)):
        with pytest.raises(InputError, match="position limits"):
            check_plan(program(), Unlimited(position_limits=limits), HOME, "here")
    with pytest.raises(InputError, match="speed limit"):
        check_plan(program(), Unlimited(max_velocity=nothing), HOME, "here")


@pytest.mark.parametrize("place", [0, 1])
def test_a_nan_tool_speed_is_not_slow(bench, program, place, authorisation):
    speeds = np.full(500, 0.1)
    speeds[17] = np.nan
    slow, none = program().chains[0], replace(program().chains[0], path_speed=speeds)
    chosen = replace(program(), chains=(none, slow) if place == 0 else (slow, none))
    assert np.isnan(chosen.speed)
    assert bench.open().needs_slow_run(chosen)
    unwatched = bench.open(yes=False, authorisation=replace(authorisation(program()), unseen=True))
    with pytest.raises(InputError, match="reaches nan m/s; with nobody there"):
        unwatched.needs_slow_run(chosen)


def test_a_nan_duration_limit_allows_no_motion(bench, program):
    with pytest.raises(SafetyError, match="has lasted"):
        bench.run(replace(program(), pauses=np.nan))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_authorisation_does_not_cover_nan(authorisation, program, value):
    facts = ("comau_ns16", "NS16-7", program().checksum)
    authorisation(program()).check(*facts, 0.1, 1.0)
    for speed, duration in ((value, 1.0), (0.1, value)):
        with pytest.raises(InputError, match="does not cover"):
            authorisation(program()).check(*facts, speed, duration)
    for limits in ({"speed": np.nan}, {"duration": np.nan}):
        with pytest.raises(InputError, match="does not cover"):
            authorisation(program(), **limits).check(*facts, 0.1, 1.0)
    assert LONGEST.days == 366


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_refuses_a_nan_cell_margin(value):
    cell = Cell(ROBOT)
    with pytest.raises(ValueError, match="margin"):
        cell.check(HOME[None], margin=value)
    with pytest.raises(ValueError, match="finite"):
        cell.check(HOME[None] * np.nan)


def test_refuses_nan_boxes_and_bodies(monkeypatch):
    table = Box("table", (0.4, -1.0, 0.0), (1.6, 1.0, 0.3))
    cell = Cell(ROBOT, None, [table])
    with pytest.raises(InputError, match="no motion can keep clear"):
        cell.check_boxes(np.nan)
    cell.check_boxes(0.0)
    Cell(ROBOT).check_boxes(5.0)  # of the arm itself nothing is so far apart
    for nothing in (replace(table, maximum=(1.6, np.nan, 0.3)), replace(table, minimum=(-np.inf, -1.0, 0.0))):
        with pytest.raises(InputError, match="table is no number"):
            Cell(ROBOT, None, [nothing])
    capsule = replace(ROBOT.bodies["link_6"][0], radius=np.nan)
    with pytest.raises(InputError, match="link_6 is no number"):
        Cell(replace(ROBOT, bodies={**ROBOT.bodies, "link_6": (capsule,)}))
    distances = cell._model.distances
    monkeypatch.setattr(cell._model, "distances", lambda *of: distances(*of) * np.nan)
    with pytest.raises(InputError, match="distance of two bodies is no number"):
        cell.check(HOME[None])


def test_any_motion_violates_a_nan_joint_range():
    joints = (replace(ROBOT.joints[0], lower=np.nan), *ROBOT.joints[1:])
    bare = replace(ROBOT, bodies={}, joints=joints)
    assert Cell(bare).check(HOME[None]).collision.first == "joint_1"


def test_a_nan_stopping_distance_is_not_clear():
    n = np.full(3, np.nan)
    q = np.tile(HOME, (3, 1))
    motion = Trajectory(np.arange(3.0), q, np.full((3, 6), np.nan), q, np.zeros((3, 4, 4)), n, np.zeros(3, int))
    with pytest.raises(ValueError, match="finite"):
        Cell(ROBOT).check_with_stopping(motion)


def test_other_joint_names_or_order_mean_another_robot():
    who = Identity("comau_ns16", "1", "c", "v", ROBOT.joint_names, 0.002)
    check_identity(who, ROBOT, "here")
    names = list(ROBOT.joint_names)
    names[1], names[2] = names[2], names[1]
    for wrong in (tuple(names), ("axis_1", *ROBOT.joint_names[1:])):
        with pytest.raises(AgentError, match="calls its joints"):
            check_identity(replace(who, joint_names=wrong), ROBOT, "here")


def test_a_position_in_degrees_is_reported_as_such(program):
    with pytest.raises(AgentError, match="fits its plan in degrees"):
        check_plan(program(), ROBOT, np.degrees(HOME), "here")
