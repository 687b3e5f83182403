"""The set-points of some loops and the loops of two seeds, as they were before the interpolator was made faster.

`same_loop.json` was written by `python tests/excitation/test_same_loop.py` at commit 4d9f4fb; what is written anew
there changes what stored seeds mean, and has to be said in the commit.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.core import InProcess
from agent.excitation import LoopProblem, search
from agent.motion import CartesianTarget, FlyInterpolator, Move, MoveType, Pdl2Settings, ViaRegions, loop_moves
from agent.motion.path_settings import FlyTrajectory, FlyType, OrientationType, SpeedOption
from agent.robot import kinematics_for, load_robot

STORED = Path(__file__).with_name("same_loop.json")
CART = Pdl2Settings(
    fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02, linear_speed=1.0
)
STYLES = {
    "tolerance": CART,
    "slow": CART.changed(linear_speed=0.1),
    "pass": CART.changed(fly_trajectory=FlyTrajectory.FLY_PASS, fly_distance=0.05),
    "overlap": Pdl2Settings(linear_speed=0.5, stress_percent=80.0),
    "from, Euler": CART.changed(fly_trajectory=FlyTrajectory.FLY_FROM, orientation=OrientationType.EUL_WORLD),
    "joints": CART.changed(speed_option=SpeedOption.SPD_JNT, speed_override=0.5),
    "arc and joint move": CART.changed(linear_speed=0.5),
}


def regions() -> ViaRegions:
    return ViaRegions.from_box(6, [1.0, 0.0, 0.8], [0.5, 0.6, 0.4], [0.0, math.pi, 0.0], math.radians(30))


def set_points(style: str) -> dict[str, Any]:
    """Number of samples, and positions, velocities and accelerations at nine of them."""
    robot = load_robot("comau_ns16")
    poses = regions().poses(np.random.default_rng(list(STYLES).index(style)).random(36))
    moves = list(loop_moves(poses, STYLES[style]))
    if style == "arc and joint move":
        moves[1] = Move(MoveType.CIRCULAR, moves[1].target, moves[1].settings, True, CartesianTarget(poses[4]))
        moves[3] = Move(MoveType.JOINT, moves[3].target, moves[3].settings, True)
    start = kinematics_for(robot).solve(poses[0], np.array([0.0, 0.0, -np.pi / 2, 0.0, np.pi / 3, 0.0]))
    trajectory = FlyInterpolator(robot).plan(moves, start)
    at = np.linspace(0, len(trajectory.t) - 1, 9).round().astype(int)
    return {
        "samples": len(trajectory.t),
        "q": trajectory.q[at].tolist(),
        "qd": trajectory.qd[at].tolist(),
        "qdd": trajectory.qdd[at].tolist(),
        "bound by": sorted({limit.limit for limit in trajectory.binding}),
    }


def found(seed: int) -> dict[str, Any]:
    """What a small search ends with."""
    problem = LoopProblem(load_robot("comau_ns16"), regions(), CART)
    result = search(problem, population=8, generations=4, seed=seed, engine=InProcess())
    best = [generation.best for generation in result.generations]
    return {"genome": result.loop.genome.tolist(), "fitness": result.fitness, "best": best}


@pytest.mark.parametrize("style", STYLES)
def test_set_points_match_the_stored_reference(style: str) -> None:
    stored, now = json.loads(STORED.read_text())["set_points"][style], set_points(style)
    assert (now["samples"], now["bound by"]) == (stored["samples"], stored["bound by"])
    # the last digits are the processor's: one with other vector instructions adds in another order
    for name, digits in (("q", 1e-9), ("qd", 1e-8), ("qdd", 1e-6)):
        np.testing.assert_allclose(now[name], stored[name], rtol=0, atol=digits)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_seed_finds_the_stored_reference_loop(seed: int) -> None:
    stored, now = json.loads(STORED.read_text())["search"][str(seed)], found(seed)
    assert now["genome"] == stored["genome"]
    np.testing.assert_allclose([now["fitness"], *now["best"]], [stored["fitness"], *stored["best"]], rtol=1e-8)


if __name__ == "__main__":
    content = {
        "set_points": {style: set_points(style) for style in STYLES},
        "search": {seed: found(seed) for seed in (1, 2)},
    }
    STORED.write_text(json.dumps(content))
