"""A program as via-points: what its moves say, no more and no less."""

from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.motion import FlyTrajectory, FlyType, Pdl2Settings, create_interpolator
from agent.motion.pdl2 import parse_program, write_loop_program, write_program
from agent.motion.pdl2.via_points import JOINT_STEP, JOINT_TOLERANCE, via_points
from agent.motion.program import CartesianTarget, JointTarget, LoopProgram, Move, MoveType, stop_to_stop
from agent.robot import kinematics_for, load_robot
from agent.safety.planned_program import PlannedProgram

ROBOT = load_robot("comau_ns16")
START = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])
CORNERS = np.radians(
    [[10.0, 0.0, -90.0, 0.0, 40.0, 0.0], [20.0, 5.0, -95.0, 0.0, 45.0, 0.0], [5.0, 8.0, -85.0, 5.0, 50.0, 0.0]]
)
FLY = Pdl2Settings(fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02, linear_speed=0.4)


def planned(text, start=START):
    interpolator = create_interpolator("fly", ROBOT, None)
    chains, statements = [], tuple(parse_program(text, "p", ROBOT).run())
    for moves in stop_to_stop(statements):
        chain = interpolator.plan(tuple(moves), start)
        if np.ptp(chain.q, axis=0).any():
            chains.append(chain)
            start = chain.q[-1]
    return PlannedProgram("p", text, tuple(chains), statements=statements)


def points_of(program):
    return via_points(program.name, program.statements, program.chains, ROBOT, None)


@pytest.fixture(scope="module", params=["joints", "poses"])
def loop(request):
    kinematics = kinematics_for(ROBOT, None)
    targets = [JointTarget(corner) for corner in CORNERS]
    if request.param == "poses":
        targets = [
            CartesianTarget(kinematics.forward(corner[None])[0], kinematics.configuration_text(corner))
            for corner in CORNERS
        ]
    return planned(write_loop_program("p", LoopProgram.of(targets, FLY, 2), ROBOT))


def test_a_loop_blends_at_its_points_and_stops_after_each_cycle(loop):
    points = points_of(loop)
    first_stop = next(k for k, point in enumerate(points) if point.fly_tolerance == 0)
    np.testing.assert_allclose(points[first_stop].position, CORNERS[0], atol=1e-6)
    cycle = points[first_stop + 1 : first_stop + 4]
    assert len(points) == first_stop + 1 + 6
    np.testing.assert_allclose([p.position for p in cycle], CORNERS[[1, 2, 0]], atol=1e-6)
    assert [p.fly_tolerance for p in cycle] == [0.02, 0.02, 0.0]
    assert [p.linear_speed for p in cycle] == [0.4, 0.4, 0.4]
    np.testing.assert_array_equal([p.position for p in points[-3:]], [p.position for p in cycle])


def test_a_joint_move_becomes_short_lines(loop):
    chain, points = loop.chains[0], points_of(loop)
    approach = points[: next(k for k, point in enumerate(points) if point.fly_tolerance == 0) + 1]
    way = np.array([START, *[point.position for point in approach]])
    assert np.abs(np.diff(way, axis=0)).max() <= JOINT_STEP * 1.01
    for position in way[1:]:
        assert np.abs(chain.q - position).max(axis=1).min() == 0.0
    assert {point.fly_tolerance for point in approach[:-1]} == {JOINT_TOLERANCE}
    assert max(point.linear_speed for point in approach) <= max(0.01, chain.path_speed.max())


def test_an_arm_at_the_first_point_needs_no_approach(loop):
    there = planned(loop.text, loop.chains[0].q[-1])
    assert len(there.chains) == 2
    assert len(points_of(there)) == 6


def test_a_slower_program_gives_a_slower_motion():
    text = write_program("p", [Move(MoveType.LINEAR, JointTarget(CORNERS[1]), FLY.changed(speed_override=0.5))], ROBOT)
    (point,) = points_of(planned(text, CORNERS[0]))
    assert point.linear_speed == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("kind", "changed", "said"),
    [
        (MoveType.JOINT, {}, "only MOVE LINEAR"),
        (MoveType.LINEAR, {"fly_type": FlyType.FLY_NORM}, "FLY_CART"),
        (MoveType.LINEAR, {"fly_trajectory": FlyTrajectory.FLY_AUTO}, "FLY_TOL"),
    ],
)
def test_refuses_moves_without_a_via_point_form_and_names_the_line(kind, changed, said):
    flown = Move(kind, JointTarget(CORNERS[1]), FLY.changed(**changed), fly=True)
    text = write_program("p", [flown, Move(MoveType.LINEAR, JointTarget(CORNERS[2]), FLY)], ROBOT)
    with pytest.raises(InputError, match=said) as refused:
        points_of(planned(text, CORNERS[0]))
    assert "line" in str(refused.value)


def test_a_plan_of_another_program_is_refused(loop):
    other = write_program("p", [Move(MoveType.LINEAR, JointTarget(CORNERS[2]), FLY)], ROBOT)
    with pytest.raises(InputError, match="do not belong together"):
        points_of(replace(loop, statements=tuple(parse_program(other, "p", ROBOT).run())))
