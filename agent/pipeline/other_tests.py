"""What may settle a diagnosis where no motion of the bare arm does: brakes, a known mass, a look at the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from agent.core import Console

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.excitation import LoopProblem
    from agent.experiment import Expected, OpenPair

#: A motion that makes the right answer no likelier than this, whichever of a pair is true, settles nothing.
_HELPS = 0.3
#: A mass is tried whose weight, far out, is this part of the strongest joint's nominal torque.
_TRIAL_LOAD = 0.1
BRAKES = "seconds of the arm on its brakes with the drives off, which tell an offset (--drives-off LOG)"


def helped(expected: Expected) -> bool:
    """Whether a motion makes a right answer likely that was not."""
    sides = zip(expected.before_if, expected.after_if, strict=True)
    return any(b is not None and a is not None and a > max(_HELPS, b + 0.05) for b, a in sides)


def other_test(found: Diagnosis, pairs: Sequence[OpenPair]) -> str:
    """What could still tell the most urgent pair apart, by the knowledge that its effects carry."""
    from agent.model import CATALOGUE

    sides = {side.text(): side.effect for side in (pairs[0].first, pairs[0].second) if side.effect in CATALOGUE}
    looks = "; ".join(f"for {text}, {CATALOGUE[effect].look_at}" for text, effect in sides.items())
    brakes = f"{BRAKES}, or " if brakes_tell(found, pairs[:1]) else ""
    return f"What may: {brakes}another posture, load or temperature, or a look at the arm: {looks}"


def brakes_tell(found: Diagnosis, pairs: Sequence[OpenPair]) -> bool:
    """Whether one of two that are open is an offset of a torque channel, whose zero is not known yet."""
    from agent.model import CATALOGUE

    if found.finding.zero_known:
        return False
    return any(name in CATALOGUE and CATALOGUE[name].adds_to_report for pair in pairs for name in pair.names)


def with_a_mass(
    found: Diagnosis, pairs: Sequence[OpenPair], problem: LoopProblem, seconds: float, seed: int, console: Console
) -> str:
    """Whether a known mass at the flange would make a motion tell, tried with a light one; empty where not."""
    from agent.experiment import plan_experiment
    from agent.model import payload_text
    from agent.robot import Tool, kinematics_for

    robot = problem.robot
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    postures = np.random.default_rng(0).uniform(lower, upper, (50, robot.dof))
    reach = float(np.linalg.norm(kinematics_for(robot, None).forward(postures)[:, :3, 3], axis=1).max())
    strongest = float(np.max(found.dataset.fit.reference.scale))
    load = Tool(np.eye(4), float(f"{_TRIAL_LOAD * strongest / (9.81 * max(reach, 0.1)):.1g}"), np.zeros(3))
    console.step("no motion of the bare arm would settle it; whether one with a mass would is what is asked now")
    tried = plan_experiment(found, pairs, replace(problem, load=load), seconds, seed, console.progress)
    expected = [e for e in tried.expected if helped(e)]
    if not expected:
        return ""
    best = max(expected, key=lambda e: e.after)
    return (
        f". With a known mass at the flange a motion may: {payload_text(load).split(',')[0]} would make the right "
        f"answer between {best.pair.first.text()} and {best.pair.second.text()} {best.after:.2f} likely; mount one and "
        "plan with --payload 'MASS, X, Y, Z'"
    )
