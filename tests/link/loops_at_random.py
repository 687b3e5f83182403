"""Loops with tool, base and user frame at random on one wire: `python tests/link/loops_at_random.py WIRE FIRST LAST`.

For each seed the agent's side writes the program of a loop, plans it and checks it against boxes near its way; an
emulator with the leavings of another program runs it, by one of its interpolators, and sends its set-points over the
wire. Whether each programmed position was passed, and the boxes kept clear of, is judged by kinematics that neither
side has: the URDF by Pinocchio, frames by scipy. One JSON line a loop.
"""

import json
import sys
from collections.abc import Iterator
from contextlib import closing, nullcontext
from dataclasses import dataclass

import numpy as np
import pinocchio
from scipy.spatial.transform import RigidTransform, Rotation

from agent.motion import FlyInterpolator, FlyTrajectory, FlyType, MotionError, Pdl2Settings, stop_to_stop
from agent.motion.pdl2 import parse_program, write_loop_program
from agent.motion.program import CartesianTarget, JointTarget, LoopProgram, frame_of
from agent.robot import Box, Tool, torque_per_ampere
from agent.robot.cell import TOOL_RADIUS, Cell
from drivers.registry import create
from fake_controller.build import build_controller
from fake_controller.servers import open_server
from tests.conftest import Broker
from tests.link.by_pinocchio import DATA, MODEL, ROBOT, flange

HOME = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])
MIDDLE = np.radians([0.0, 15.0, -90.0, 0.0, 45.0, 0.0])
AROUND = np.radians([50.0, 25.0, 25.0, 60.0, 30.0, 90.0])
ALONG = 0.01  # m between two judged points of a capsule's axis


@dataclass(frozen=True, eq=False)
class Drawn:
    """A loop: its program, what it means by scipy and Pinocchio, and the plan that keeps clear of the boxes.

    `points` (K, 3): where the tool point is to pass in the robot's base [m]; `end` (4, 4): where it stops.
    """

    text: str
    points: np.ndarray
    end: np.ndarray
    tool: RigidTransform
    distance: float
    boxes: tuple[Box, ...]


def drawn(seed: int) -> Drawn:
    """The loop of a seed: the first of its draws that the planner takes, with a box near it that it keeps clear of."""
    rng = np.random.default_rng([seed, 2000])
    while True:
        tool, base, uframe = (_frame(rng, reach) for reach in (0.25, 0.6, 1.0))
        corners = MIDDLE + rng.uniform(-AROUND, AROUND) + np.radians(rng.uniform(-9, 9, (int(rng.integers(3, 7)), 6)))
        distance, speed = float(rng.choice([0.002, 0.01, 0.02, 0.05])), round(float(rng.uniform(0.1, 1.4)), 3)
        poses = [_of_pinocchio(flange(q)) * tool for q in corners]
        settings = Pdl2Settings(
            fly_type=FlyType.FLY_CART,
            fly_trajectory=FlyTrajectory.FLY_TOL,
            fly_distance=distance,
            linear_speed=speed,
            rotational_speed=2.0,
            base=frame_of(base.as_matrix()),
            tool=frame_of(tool.as_matrix()),
            uframe=frame_of(uframe.as_matrix()),
        )
        targets = [CartesianTarget((uframe.inv() * base * pose).as_matrix()) for pose in poses]
        text = write_loop_program(
            "loop", LoopProgram.of(targets, settings, 1, settings, JointTarget(corners[0])), ROBOT
        )
        try:
            plans, stand = [], HOME
            for moves in stop_to_stop(parse_program(text, "loop", ROBOT).run()):
                plans.append(FlyInterpolator(ROBOT, period=0.002).plan(moves, stand))
                stand = plans[-1].q[-1]
        except MotionError:
            continue
        points = np.array([pose.translation for pose in poses])
        for boxes in _boxes(rng, points):
            cell = Cell(ROBOT, Tool(frame=tool.as_matrix()), boxes)
            if all(cell.check_with_stopping(plan, margin=distance).collision is None for plan in plans):
                return Drawn(text, points, poses[0].as_matrix(), tool, distance, boxes)


def run(wire: str, seed: int, broker: Broker | None) -> dict[str, object]:
    """One loop: the worst distance at which a position was passed beyond $FLY_DIST, and the least clearance [mm]."""
    loop = drawn(seed)
    kind = "ours" if seed % 2 else "second"
    controller = build_controller("comau_ns16", seed, "fast", interpolator=kind)
    where, patient = ({}, {"watchdog": 5.0}) if broker is None else ({"broker": broker.address}, {})
    ended = ""
    with (
        closing(open_server(wire, controller, watchdog=5.0, waits=True, **where)) as server,
        closing(create(wire, server.address, **patient)) as driver,
    ):
        driver.torque_per_ampere = torque_per_ampere(ROBOT)
        driver.connect()
        try:
            driver.start("loop", driver.upload("loop", loop.text))
            blocks = list(driver.samples())
        except Exception as error:  # any error: the loop was not run, and the judge counts it
            ended, blocks = f"{type(error).__name__}: {error}", []
    result = {"wire": wire, "seed": seed, "interpolator": kind, "ended": ended, "mm": 1000 * loop.distance}
    if not blocks:
        return result
    told = np.concatenate([block.reference_position for block in blocks])
    done = np.concatenate([block.position for block in blocks])
    places = np.array([flange(q).act(loop.tool.translation) for q in told])
    off = np.array([_distance(places, point) for point in loop.points])
    end = (_of_pinocchio(flange(told[-1])) * loop.tool).as_matrix()
    return result | {
        "beyond_mm": round(float(1000 * (off[1:] - loop.distance).max()), 4),
        "start_off_mm": round(float(1000 * off[0]), 4),
        "end_off": float(np.abs(end - loop.end).max()),
        "clear_mm": round(1000 * min(_clearance(way[::4], loop) for way in (told, done)), 2),
    }


def _frame(rng: np.random.Generator, reach: float) -> RigidTransform:
    return RigidTransform.from_components(rng.uniform(-reach, reach, 3), Rotation.random(rng=rng))


def _of_pinocchio(place: pinocchio.SE3) -> RigidTransform:
    return RigidTransform.from_matrix(place.homogeneous)


def _boxes(rng: np.random.Generator, points: np.ndarray) -> Iterator[tuple[Box, ...]]:
    """Boxes from near the way to farther off."""
    for away in np.linspace(0.15, 0.8, 8):
        size = rng.uniform(0.1, 0.5, 3)
        direction = rng.normal(size=3)
        middle = points[rng.integers(len(points))] + (away + size.max() / 2) * direction / np.linalg.norm(direction)
        yield (Box("near", middle - size / 2, middle + size / 2),)
    yield ()


def _distance(way: np.ndarray, point: np.ndarray) -> float:
    """[m] of a point from a polyline (S, 3)."""
    start, step = way[:-1], np.diff(way, axis=0)
    part = np.einsum("ij,ij->i", point - start, step) / np.maximum(np.einsum("ij,ij->i", step, step), 1e-30)
    return float(np.linalg.norm(start + np.clip(part, 0, 1)[:, None] * step - point, axis=1).min())


def _clearance(way: np.ndarray, loop: Drawn) -> float:
    """[m] between the boxes and the arm with its tool, at joints (S, n); a metre where there is no box."""
    tool = [(ROBOT.tip_frame, np.zeros(3), np.asarray(loop.tool.translation), TOOL_RADIUS)]
    capsules = [(link, np.array(c.start), np.array(c.end), c.radius) for link, cs in ROBOT.bodies.items() for c in cs]
    axes = []
    for link, start, end, radius in capsules + tool:
        parts = np.linspace(0, 1, max(2, int(np.linalg.norm(end - start) / ALONG)))[:, None]
        axes.append((MODEL.getFrameId(link), start + parts * (end - start), radius))
    least = 1.0
    for q in way:
        pinocchio.framesForwardKinematics(MODEL, DATA, q)
        for frame, axis, radius in axes:
            there = axis @ DATA.oMf[frame].rotation.T + DATA.oMf[frame].translation
            for box in loop.boxes:
                outside = np.maximum(np.maximum(box.minimum - there, there - box.maximum), 0)
                least = min(least, float(np.linalg.norm(outside, axis=1).min()) - radius)
    return least


def main(wire: str, first: int, last: int) -> None:
    """Print a line a loop."""
    with closing(Broker()) if wire == "cnr_comau" else nullcontext() as broker:
        for seed in range(first, last + 1):
            print(json.dumps(run(wire, seed, broker)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
