"""The check finds every collision of a motion."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.robot import Box, Capsule, Cell, CellReport, Dynamics, Tool, load_robot

ROBOT = load_robot("comau_ns16")
REACHING = np.radians([0.0, 20.0, -90.0, 0.0, 70.0, 0.0])
#: From there the second joint alone takes the tool from 0.96 m down to 0.23 m, into the table.
DOWN = REACHING + np.radians([0.0, 45.0, 0.0, 0.0, 0.0, 0.0])
TABLE = Box("table", (0.4, -1.0, 0.0), (1.6, 1.0, 0.3))


def tool(length: float = 0.12) -> Tool:
    frame = np.eye(4)
    frame[2, 3] = length
    return Tool(frame, mass=2.0)


def brute_force(cell: Cell, q: np.ndarray, fine: int = 4) -> np.ndarray:
    """(S, pairs) all distances on a grid finer than the samples."""
    u = np.linspace(0, len(q) - 1, fine * (len(q) - 1) + 1)
    dense = np.column_stack([np.interp(u, np.arange(len(q)), joint) for joint in q.T])
    return cell._model.distances(dense)


def smallest(report: CellReport) -> float:
    return min(report.clearances.values())


def test_reports_the_clearance_of_a_clear_motion(trajectory_through):
    cell = Cell(ROBOT, tool(), [TABLE])
    motion = trajectory_through([REACHING, REACHING + 0.2, REACHING - [0.5, 0, 0, 0, 0.3, 0]])
    report = cell.check(motion, margin=0.02)
    assert report.collision is None
    assert report.depth == 0
    assert cell.is_clear(motion, margin=0.02)
    assert not cell.is_clear(trajectory_through([REACHING, DOWN, REACHING]))
    everything = brute_force(cell, motion.q)
    assert smallest(report) == pytest.approx(everything.min(), abs=1e-3)
    for clearance, column in zip(report.clearances.values(), everything.T, strict=True):
        assert column.min() - 1e-5 <= clearance
        assert clearance <= column.min() + max(0.001, 0.25 * abs(clearance - 0.02)) + 1e-5


@pytest.mark.parametrize("distance", [-0.01, np.nan])
def test_a_clearance_check_stops_at_the_first_collision(trajectory_through, distance, monkeypatch):
    cell, looks = Cell(ROBOT, tool(), [TABLE]), []

    def found(postures: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        looks.append(len(postures))
        return np.full((len(postures), len(wanted)), distance)

    monkeypatch.setattr(cell._model, "distances", found)
    assert not cell.is_clear(trajectory_through([REACHING, REACHING + 0.2]))
    assert len(looks) == 1


def test_non_finite_positions_are_not_clear(trajectory_through):
    motion = trajectory_through([REACHING, REACHING + 0.2])
    lost = replace(motion, q=np.where(motion.t[:, None] > motion.t[-1] / 2, np.nan, motion.q))
    bodiless = Cell(ROBOT)
    bodiless._model.leave_out(bodiless._model.pairs)
    assert bodiless.is_clear(motion)
    assert not bodiless.is_clear(lost)


def test_the_first_collision_is_named_with_its_time_and_depth(trajectory_through):
    """The arm bends down onto a table that it has already reached past."""
    cell = Cell(ROBOT, tool(), [TABLE])
    motion = trajectory_through([REACHING, DOWN, REACHING])
    report = cell.check(motion)
    distances = brute_force(cell, motion.q, fine=1)
    first = int(np.argmax(distances.min(axis=1) < 0))
    assert (report.collision.first, report.collision.second) == ("tool", "keep-out table")
    assert report.collision.index == pytest.approx(first, abs=5)
    assert report.collision.time == pytest.approx(motion.t[first], abs=0.01)
    assert report.depth == pytest.approx(-distances.min(), abs=0.25 * report.depth)
    assert not report.collision.stopping
    text = str(report.collision)
    assert "tool and keep-out table are in collision" in text
    assert f"{1000 * report.collision.depth:.1f} mm deep" in text
    at_once = cell.check(trajectory_through([DOWN, REACHING])).collision
    assert (at_once.index, at_once.time) == (0, 0.0)


def test_joint_positions_alone_are_a_motion_without_times():
    report = Cell(ROBOT, tool(), [TABLE]).check(np.array([REACHING, DOWN]))
    assert report.collision.time is None
    assert report.collision.index == 0
    assert "at sample 0 tool" in str(report.collision)


def test_a_collision_between_two_samples_is_found():
    """Both samples are clear, on either side of a thin wall."""
    wall = Box("wall", (0.5, -0.01, 0.0), (2.0, 0.01, 2.0))
    cell = Cell(ROBOT, None, [wall])
    q = np.array([REACHING - [1.2, 0, 0, 0, 0, 0], REACHING + [1.2, 0, 0, 0, 0, 0]])
    assert cell.check(q[:1]).collision is None
    assert cell.check(q[1:]).collision is None
    assert cell.check(q).collision.second == "keep-out wall"


def test_penetration_depth_grows_with_the_box(trajectory_through):
    motion = trajectory_through([REACHING, REACHING + np.radians([10, 25, 0, 0, 0, 0])])
    depths = [
        Cell(ROBOT, tool(), [Box("t", (0.4, -1.0, 0.0), (1.6, 1.0, top))]).check(motion).depth
        for top in (0.3, 0.6, 0.65, 0.7, 0.75)
    ]
    assert depths[0] == 0
    assert depths[-1] > 0.1
    assert np.all(np.diff(depths[1:]) > 0.01)


def test_the_safety_margin_is_added(trajectory_through):
    motion = trajectory_through([REACHING, REACHING + np.radians([0, 10, 0, 0, 0, 0])])
    cell = Cell(ROBOT, tool(), [TABLE])
    gap = cell.check(motion).clearances["tool", "keep-out table"]
    table_only = Cell(replace(ROBOT, bodies={"link_6": ROBOT.bodies["link_6"]}), tool(), [TABLE])
    assert table_only.check(motion, margin=0.8 * gap).collision is None
    report = table_only.check(motion, margin=gap + 0.03)
    assert report.depth == pytest.approx(0.03, abs=0.012)
    assert "nearer than the margin" in str(report.collision)


def test_detects_self_collision():
    """Folded back, the hand meets the upper arm."""
    cell = Cell(ROBOT, tool(0.3))
    folded = np.radians([0, 0, 105, 0, 100, 0])
    report = cell.check(np.linspace(REACHING, folded, 50))
    assert report.collision is not None
    assert not report.collision.second.startswith("keep-out")


def test_includes_the_stopping_distance(trajectory_through):
    """A motion that turns round just before a wall: fast, it could not stop before it, slow it could."""
    out = REACHING - np.radians([40, 0, 0, 0, 0, 0])
    dynamics = Dynamics(ROBOT, tool())
    reached = dynamics.tcp_pose(out[None])[0, 1, 3]
    wall = Box("wall", (-0.5, reached + 0.12, 0.0), (2.0, reached + 1.0, 2.0))
    cell = Cell(ROBOT, tool(), [wall])
    fast = trajectory_through([REACHING + np.radians([40, 0, 0, 0, 0, 0]), out], duration=1.0)
    slow = trajectory_through([REACHING + np.radians([40, 0, 0, 0, 0, 0]), out], duration=8.0)
    assert cell.check(fast).collision is None
    assert cell.check_with_stopping(slow).collision is None
    report = cell.check_with_stopping(fast)
    assert report.collision.stopping
    assert report.collision.second == "keep-out wall"
    assert "on the way to a stop from 0." in str(report.collision)
    assert fast.t[0] < report.collision.time < fast.t[-1]
    brakes = tuple(replace(joint, max_acceleration=100 * joint.max_acceleration) for joint in ROBOT.joints)
    assert Cell(replace(ROBOT, joints=brakes), tool(), [wall]).check_with_stopping(fast).collision is None


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.03]))
@settings(max_examples=20, deadline=None)
def test_misses_no_collision_deeper_than_the_tolerance(trajectory_through, seed, margin):
    rng = np.random.default_rng(seed)
    endless = tuple(replace(joint, lower=-np.inf, upper=np.inf) for joint in ROBOT.joints)
    robot = replace(ROBOT, joints=endless)
    knots = REACHING + rng.uniform(-0.8, 0.8, (4, 6))
    motion = trajectory_through(knots, duration=2.0)
    corner = rng.uniform([0.3, -1.0, 0.0], [1.5, 1.0, 1.5])
    cell = Cell(robot, tool(), [Box("box", tuple(corner), tuple(corner + rng.uniform(0.02, 0.4, 3)))])
    report = cell.check(motion, margin)
    check_against(report, brute_force(cell, motion.q, fine=2), margin, fine=2)
    assert not (cell.is_clear(motion, margin) and report.collision is not None)
    stopping = cell.check_with_stopping(motion, margin)
    stop = motion.qd * np.abs(motion.qd) / (2 * ROBOT.max_acceleration)
    swept = np.array([cell._model.distances(motion.q + part * stop) for part in np.linspace(0, 1, 7)]).min(axis=0)
    check_against(stopping, swept, margin, fine=1)


def check_against(report, distances, margin, fine):
    violated = distances < margin - 0.001
    if violated.any():
        assert report.collision is not None
        assert report.collision.index <= np.argmax(violated.any(axis=1)) / fine + 1
    if report.collision is not None:
        assert smallest(report) < margin + 1e-9
        assert report.depth == pytest.approx(margin - smallest(report))
    for clearance, column in zip(report.clearances.values(), distances.T, strict=True):
        assert clearance <= column.min() + max(0.001, 0.25 * abs(clearance - margin)) + 2e-5


def test_applies_narrower_joint_ranges_of_the_recipe(trajectory_through):
    motion = trajectory_through([REACHING, REACHING + [0, 0, 0, 3.0, 0, 0]])
    cable = {"joint_4": (-2.5, 2.5), "joint_6": (-3.0, 3.0)}
    cell = Cell(ROBOT, joint_ranges=cable)
    assert not cell.is_clear(motion)
    report = cell.check(motion)
    assert (report.collision.first, report.collision.second) == ("joint_4", "")
    assert report.collision.index == int(np.argmax(motion.q[:, 3] > 2.5))
    assert report.depth == pytest.approx(0.5)
    assert "joint_4 leaves its range, by 0.5" in str(report.collision)
    assert Cell(ROBOT).check(motion).collision is None


def test_the_stopping_motion_stays_in_range(trajectory_through):
    motion = trajectory_through([REACHING, REACHING + [2.9, 0, 0, 0, 0, 0]], duration=1.5)
    cell = Cell(ROBOT)
    assert cell.check(motion).collision is None
    report = cell.check_with_stopping(motion)
    assert report.collision.stopping
    assert report.collision.first == "joint_1"


@pytest.mark.parametrize("ends", [(1, -1), (1.0, 1.0), (np.nan, 1.0), (0.0, np.nan)])
def test_impossible_joint_ranges_are_refused(ends):
    with pytest.raises(InputError, match="joint range of joint_7"):
        Cell(ROBOT, joint_ranges={"joint_7": ends})
    with pytest.raises(InputError, match="nothing is left"):
        Cell(ROBOT, joint_ranges={"joint_4": ends})


def test_a_wide_margin_applies_to_the_cell_but_not_between_neighbours(trajectory_through):
    motion = trajectory_through([REACHING, REACHING + np.radians([20, 0, 0, 0, 0, 0])])
    both = Cell(ROBOT, tool(), [TABLE])
    assert smallest(both.check(motion)) < 0.1  # neighbours but one in the arm are always as near as that
    assert Cell(ROBOT, tool()).check(motion, 0.2).collision is None
    above = min(far for (_, box), far in both.check(motion).clearances.items() if box == "keep-out table")
    higher = Box("table", TABLE.minimum, (*TABLE.maximum[:2], TABLE.maximum[2] + above - 0.15))
    report = Cell(ROBOT, tool(), [higher]).check(motion, 0.2)
    assert (report.collision.second, report.collision.margin) == ("keep-out table", 0.2)
    assert report.depth == pytest.approx(0.05, abs=0.01)


def test_always_touching_bodies_are_left_out_and_named():
    fat = (Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 1.0),)
    cell = Cell(replace(ROBOT, bodies={**ROBOT.bodies, "link_3": fat}))
    assert ("link_3", "link_5") in cell.left_out
    assert ("link_3", "link_5") not in cell.pairs
    assert Cell(ROBOT).left_out == ()
    assert Cell(ROBOT).check(np.zeros((1, 6))).collision is None


def test_an_arm_without_bodies_is_checked_against_boxes_by_its_skeleton():
    bare = replace(ROBOT, bodies={})
    assert Cell(bare).pairs == ()
    assert Cell(bare).check(REACHING[None]).clearances == {}
    cell = Cell(bare, tool(), [TABLE])
    assert all(second == "keep-out table" for _, second in cell.pairs)
    assert {"link of joint_4", "tool"} <= {first for first, _ in cell.pairs}
    assert cell.check(REACHING[None]).collision is None
    assert cell.check(DOWN[None]).collision is not None


def test_cost_depends_on_clearance_not_on_the_number_of_samples(trajectory_through, monkeypatch):
    """Counted in postures looked at, which is what the time goes into."""
    cell = Cell(ROBOT, tool(), [TABLE])
    looked_at = []
    distances = cell._model.distances

    def counting(q, *wanted):
        looked_at.append(len(q))
        return distances(q, *wanted)

    monkeypatch.setattr(cell._model, "distances", counting)
    knots = REACHING + np.random.default_rng(0).uniform(-0.25, 0.25, (6, 6))
    cell.check(trajectory_through(knots, duration=10.0), margin=0.02)
    coarse = sum(looked_at)
    looked_at.clear()
    motion = trajectory_through(knots, duration=10.0)
    cell.check(replace(motion, q=np.repeat(motion.q, 4, axis=0), t=np.arange(4.0 * len(motion.t))), margin=0.02)
    assert coarse < 800
    assert sum(looked_at) < 1.2 * coarse


@pytest.mark.verify
def test_cpu_time_of_checking_a_loop(measured):
    import time

    from agent.motion import FlyInterpolator, FlyTrajectory, FlyType, Pdl2Settings, ViaRegions, loop_moves
    from agent.motion.interpolator import MotionError
    from agent.robot import KinematicsError, kinematics_for

    regions = ViaRegions.from_box(6, (1.0, 0.0, 0.8), (0.5, 0.6, 0.4), (0.0, np.pi, 0.0), np.radians(30))
    kind = {"fly_type": FlyType.FLY_CART, "fly_trajectory": FlyTrajectory.FLY_TOL}
    fly = Pdl2Settings(**kind, fly_distance=0.02, linear_speed=0.5)
    interpolator, kinematics = FlyInterpolator(ROBOT, tool()), kinematics_for(ROBOT, tool())
    rng = np.random.default_rng(1)
    boxes = {"clear": [TABLE], "in collision": [TABLE, Box("post", (0.9, -0.1, 0.0), (1.1, 0.1, 0.8))]}
    seconds = {(kind, name): [] for kind in ("loop", "loop and stops") for name in boxes}
    samples = []
    cells = {name: Cell(ROBOT, tool(), boxes[name]) for name in boxes}
    while len(samples) < 40:
        poses = regions.poses(rng.uniform(size=36))
        try:
            start = kinematics.solve(poses[0], REACHING)
            motion = interpolator.plan(loop_moves(poses, fly), start)
        except (MotionError, KinematicsError):
            continue
        samples.append(len(motion.t))
        for name, cell in cells.items():
            for kind, check in (("loop", cell.check), ("loop and stops", cell.check_with_stopping)):
                before = time.process_time()
                check(motion, margin=0.02)
                seconds[kind, name].append(time.process_time() - before)
    measured("samples of a random loop, median of 40", float(np.median(samples)))
    for (kind, name), spent in seconds.items():
        figure = 1000 * float(np.median(spent)) * 5000 / np.median(samples)
        ok = kind != "loop" or figure <= 50
        measured(f"cell check of a {kind}, {name}, for 5000 samples, median", figure, "ms CPU", "at most 50 (loop)", ok)
        assert ok
