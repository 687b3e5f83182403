"""Distances and the bounds on how fast they change, against independent mathematics."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.optimize import lsq_linear

from agent.robot import Body, Box, Capsule, CollisionModel, Dynamics, load_robot

ROBOT = load_robot("comau_ns16")
BOXES = (Box("table", (0.4, -1.0, 0.0), (1.6, 1.0, 0.3)), Box("post", (-0.2, 0.7, 0.0), (0.2, 0.9, 1.8)))
TWO = {**ROBOT.bodies, "link_4": (*ROBOT.bodies["link_4"], Capsule((0.1, 0.0, 0.2), (0.2, 0.0, 0.2), 0.05))}
BODIES = [Body(link, link, capsules) for link, capsules in TWO.items()]
MODEL = CollisionModel(ROBOT, BODIES, BOXES)
#: Distances are iterated, so exact to micrometres at worst [m].
ACCURACY = 2e-5
LOWER, UPPER = (np.clip(limit, -np.pi, np.pi) for limit in ROBOT.position_limits)


def postures(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, ROBOT.dof))


def segment(dynamics: Dynamics, q: np.ndarray, link: str, capsule: Capsule) -> np.ndarray:
    pose = dynamics.link_poses(q[None], link)[0]
    return np.array([capsule.start, capsule.end]) @ pose[:3, :3].T + pose[:3, 3]


def distance_between_segments(a: np.ndarray, b: np.ndarray) -> float:
    matrix = np.column_stack([a[1] - a[0], -(b[1] - b[0])])
    return float(np.sqrt(2 * lsq_linear(matrix, b[0] - a[0], (0, 1), tol=1e-14).cost))


def distance_to_box(a: np.ndarray, box: Box) -> float:
    matrix = np.column_stack([a[1] - a[0], -np.eye(3)])
    bounds = ([0.0, *box.minimum], [1.0, *box.maximum])
    return float(np.sqrt(2 * lsq_linear(matrix, -a[0], bounds, tol=1e-14).cost))


def test_distances_between_capsules_and_boxes_are_exact():
    dynamics = Dynamics(ROBOT)
    boxes = {f"keep-out {box.name}": box for box in BOXES}
    q = postures(1, 40)
    found = MODEL.distances(q)
    for k, pair in enumerate(MODEL.pairs):
        for s in range(len(q)):
            options = []
            for first in TWO[pair.first]:
                a = segment(dynamics, q[s], pair.first, first)
                if pair.second in boxes:
                    between = distance_to_box(a, boxes[pair.second])
                    options.append(between - first.radius if between > 1e-3 else np.nan)
                    continue
                for second in TWO[pair.second]:
                    b = segment(dynamics, q[s], pair.second, second)
                    options.append(distance_between_segments(a, b) - first.radius - second.radius)
            if not np.isnan(options).any():  # a capsule's axis inside a box: another measure of depth
                assert found[s, k] == pytest.approx(min(options), abs=ACCURACY), pair


def test_a_capsule_axis_inside_a_box_is_deeper_than_its_radius():
    inside = Box("all around", (-3, -3, -3), (3, 3, 3))
    model = CollisionModel(ROBOT, BODIES, [inside])
    boxed = np.array([pair.second == "keep-out all around" for pair in model.pairs])
    assert (model.distances(postures(2, 20))[:, boxed] < -0.5).all()


def test_neighbours_and_fixed_bodies_are_not_paired():
    names = {(pair.first, pair.second) for pair in MODEL.pairs}
    assert ("link_2", "link_3") not in names
    assert ("base_link", "link_1") not in names
    assert ("base_link", "keep-out table") not in names
    assert {("link_2", "link_4"), ("base_link", "link_2"), ("link_1", "keep-out table")} <= names
    assert len(names) == len(MODEL.pairs) == 15 + 2 * 6


def test_unwanted_pairs_are_not_measured():
    wanted = np.zeros(len(MODEL.pairs), dtype=bool)
    wanted[[3, 20]] = True
    q = postures(3, 5)
    found, everything = MODEL.distances(q, wanted), MODEL.distances(q)
    np.testing.assert_array_equal(found[:, wanted], everything[:, wanted])
    assert np.isinf(found[:, ~wanted]).all()


def check_reach(robot, model, q, change):
    reach = np.array([pair.reach for pair in model.pairs])
    before, after = model.distances(np.array([q, q + change]))
    assert (np.abs(after - before) <= reach @ np.abs(change) + ACCURACY).all()


UNIT = st.lists(st.floats(0, 1), min_size=6, max_size=6).map(np.array)


@given(UNIT, UNIT, st.sampled_from([0.001, 0.05, 0.5, 2.0]))
@settings(max_examples=200, deadline=None)
def test_the_reach_bounds_the_change_of_every_distance(q, direction, size):
    check_reach(ROBOT, MODEL, LOWER + q * (UPPER - LOWER), size * (2 * direction - 1))


@given(UNIT, st.integers(0, 5), st.floats(-1, 1))
@settings(max_examples=200, deadline=None)
def test_the_reach_bounds_the_change_by_a_single_joint(q, joint, size):
    change = np.zeros(6)
    change[joint] = size
    check_reach(ROBOT, MODEL, LOWER + q * (UPPER - LOWER), change)


SLIDER = """<robot name="slider">
<link name="base"/><link name="rail"/><link name="arm"/><link name="hand"/><link name="tip"/>
<joint name="slide" type="prismatic"><parent link="base"/><child link="rail"/><origin xyz="0 0 0.5"/>
  <axis xyz="1 0 0"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
<joint name="swing" type="continuous"><parent link="rail"/><child link="arm"/><origin xyz="0 0.1 0" rpy="0.3 0 0"/>
  <axis xyz="0 0 2"/></joint>
<joint name="reach" type="prismatic"><parent link="arm"/><child link="hand"/><origin xyz="0.5 0 0"/>
  <axis xyz="1 0 0"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
<joint name="tip" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0.3 0 0"/></joint></robot>"""


@given(st.tuples(st.floats(-2, 2), st.floats(-4, 4), st.floats(0, 1)), st.integers(0, 2), st.floats(-0.5, 0.5))
@settings(max_examples=100, deadline=None)
def test_the_reach_bound_holds_with_prismatic_joints(q, joint, size):
    joints = tuple(
        replace(ROBOT.joints[0], name=name, prismatic=name != "swing", lower=lower, upper=upper)
        for name, lower, upper in (("slide", -2.0, 2.0), ("swing", -np.inf, np.inf), ("reach", 0.0, 1.0))
    )
    robot = replace(ROBOT, name="slider", urdf=SLIDER, tip_frame="tip", joints=joints, motor_coupling=(), bodies={})
    capsules = {
        "base": Capsule((0, 0, 0), (0, 0, 0.2), 0.1),
        "rail": Capsule((0, 0, 0), (0, 0, 0.2), 0.1),
        "arm": Capsule((0, 0, 0), (0.5, 0, 0), 0.05),
        "hand": Capsule((0, 0, 0), (0.3, 0, 0), 0.03),
    }
    model = CollisionModel(robot, [Body(link, link, (c,)) for link, c in capsules.items()], BOXES)
    change = np.zeros(3)
    change[joint] = size
    if joint == 2:
        change[2] = np.clip(q[2] + size, 0, 1) - q[2]
    check_reach(robot, model, np.array(q), change)
