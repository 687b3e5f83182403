"""Programs of a loop, and logs of what an interpolator makes of them."""

from pathlib import Path

import numpy as np

from agent.motion import FlyTrajectory, FlyType, Interpolator, Pdl2Settings
from agent.motion.pdl2 import parse_program, write_loop_program
from agent.motion.program import NO_FRAME, CartesianTarget, JointTarget, LoopProgram, Move
from agent.recording import LogWriter
from agent.robot import RobotDescription, kinematics_for
from drivers.protocol import SampleBlock

START = np.radians([0.0, 20.0, -90.0, 0.0, 60.0, 0.0])
REST = 0.08  # s at each stop


def loop_program(
    robot: RobotDescription, seed: int, cycles: int = 2, speed: float = 1.0, spread: float = 0.2, turn: float = 0.4
) -> str:
    """PDL2 text of a loop over four poses up to `spread` [m] and `turn` [rad] from `START`, as the agent writes it."""
    rng = np.random.default_rng(seed)
    kinematics = kinematics_for(robot)
    middle = kinematics.forward(START[None])[0]
    poses = np.tile(middle, (4, 1, 1))
    poses[:, :3, 3] += rng.uniform(-spread, spread, (4, 3))
    turns = [_turn(rng.normal(size=3), rng.uniform(0, turn)) for _ in poses]
    poses[:, :3, :3] = [turn @ middle[:3, :3] for turn in turns]
    settings = Pdl2Settings(
        fly_type=FlyType.FLY_CART,
        fly_trajectory=FlyTrajectory.FLY_TOL,
        fly_distance=0.02,
        linear_speed=speed,
        rotational_speed=2.0,
        base=NO_FRAME,
        tool=NO_FRAME,
        uframe=NO_FRAME,
    )
    joints = [kinematics.solve(pose, START) for pose in poses]
    points = [CartesianTarget(p, kinematics.configuration_text(q)) for p, q in zip(poses, joints, strict=True)]
    approach = settings.changed(speed_override=0.1)
    return write_loop_program("loop", LoopProgram.of(points, settings, cycles, approach, JointTarget(joints[0])), robot)


def record(
    log: Path,
    robot: RobotDescription,
    text: str,
    interpolator: Interpolator,
    program: str | None = None,
    change: str = "",
    period: float = 0.004,
    rest: float = REST,
) -> Path:
    """A log of a program with `program` (or the same) stored next to it, and with one change."""
    q, stand, moves = [np.tile(START, (round(rest / period), 1))], START, []
    for statement in parse_program(text, "", robot).run():
        assert isinstance(statement, Move)
        moves.append(statement)
        if not statement.fly:
            planned = interpolator.plan(moves, stand)
            q += [planned.q, np.tile(planned.q[-1], (round(rest / period), 1))]
            stand, moves = planned.q[-1], []
    positions = np.concatenate(q)
    if change == "standstill":
        positions = np.tile(START, (500, 1))
    count = len(positions)
    block = SampleBlock(
        np.arange(count),
        np.arange(count) * period,
        positions,
        None,
        np.zeros_like(positions),
        None if change == "no references" else positions,
        None,
    )
    name = "somebody" if change == "another robot" else robot.name
    facts = {"tool": "none"}
    with LogWriter(log, robot.joint_names, robot=name, motion="loop", sample_rate=1.0 / period, facts=facts) as writer:
        writer.write(block)
    if change != "no program":
        log.with_suffix(".pdl").write_text(program or text, encoding="utf-8")
    return log


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
