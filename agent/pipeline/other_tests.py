"""What may settle a diagnosis where no motion of the bare arm does: brakes, a known mass, a look at the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import Console

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.excitation import LoopProblem
    from agent.experiment import Deadline, Expected, Experiment, OpenPair
    from agent.robot import Tool

#: A motion that makes the right answer no likelier than this, whichever of a pair is true, settles nothing.
_HELPS = 0.3
#: A mass is tried whose weight, far out, is this part of the strongest joint's nominal torque.
_TRIAL_LOAD = 0.1
#: A person is asked for a mass beside a motion of the bare arm where that makes the right answer no likelier than the
#: first, and one with the mass by the second more.
_LIKELY, _WORTH_MOUNTING = 0.8, 0.2
DRIVES_OFF = "--drives-off"
BRAKES = f"record 1 s with the drives off ({DRIVES_OFF} LOG)"


def helped(expected: Expected) -> bool:
    """Whether a motion makes a right answer likely that was not."""
    sides = zip(expected.before_if, expected.after_if, strict=True)
    return any(b is not None and a is not None and a > max(_HELPS, b + 0.05) for b, a in sides)


def other_test(found: Diagnosis, pairs: Sequence[OpenPair]) -> str:
    """What could still distinguish the most urgent pair, by the knowledge that its effects carry."""
    from agent.model import CATALOGUE

    sides = {side.text(): side.effect for side in (pairs[0].first, pairs[0].second) if side.effect in CATALOGUE}
    looks = "; ".join(f"for {text}, {CATALOGUE[effect].look_at}" for text, effect in sides.items())
    brakes = f"First, {BRAKES}. If it stays open, try" if brakes_tell(found, pairs[:1]) else "Try"
    return f"{brakes} another posture, load or temperature, or look at the arm: {looks}"


def in_doubt(found: Diagnosis) -> str:
    """What may tell where a cause has no rival that a motion could be planned against, and is not sure all the same;
    empty where nothing is open."""
    if found.finding.verdict != "ambiguous":
        return ""
    place = found.finding.causes[0].place
    joints = ", ".join(found.dataset.robot.joint_names[joint] for joint in place[1])
    return (
        f"{place[0]}{f' on {joints}' if joints else ''} closes too little of the gap to be sure. No motion can be "
        "planned, as no alternative fits. Record a longer, more varied motion in the sub-region (agent record RECIPE)"
    )


def brakes_tell(found: Diagnosis, pairs: Sequence[OpenPair]) -> bool:
    """Whether one of two that are open is an offset of a torque channel, whose zero is not known yet."""
    from agent.model import CATALOGUE

    if found.finding.zero_known:
        return False
    return any(name in CATALOGUE and CATALOGUE[name].adds_to_report for pair in pairs for name in pair.names)


@dataclass(frozen=True)
class WithMass:
    """A known mass at the flange, a pair between which a motion with it makes the right answer this likely, and how
    likely that of the bare arm does (None: none does)."""

    load: Tool
    pair: tuple[str, str]
    after: float
    bare: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """`with_a_mass` of a further experiment: what to mount, and how likely the right answer of the pair becomes."""
        from agent.model import PAYLOAD, payload_text

        chance = {"pair": list(self.pair), "bare": self.bare, "after": self.after}
        return {PAYLOAD: payload_text(self.load), **chance, "text": self.text()}

    def text(self) -> str:
        """For people."""
        from agent.model import payload_text

        instead = "" if self.bare is None else f" instead of {self.bare:.2f}"
        mass = payload_text(self.load)
        return (
            f"With {mass.split(',')[0]} at the flange, the right answer between {self.pair[0]} and {self.pair[1]} has "
            f"probability {self.after:.2f}{instead}. Mount it and plan with --payload '{mass}', or with the mass and "
            "centre that you have"
        )


def with_a_mass(
    found: Diagnosis,
    pairs: Sequence[OpenPair],
    problem: LoopProblem,
    seconds: float,
    seed: int,
    console: Console,
    bare: Experiment | None = None,
    deadline: Deadline | None = None,
) -> WithMass | None:
    """A light known mass that would make a motion tell what none of the bare arm does, or what the motion that was
    planned for it (`bare`) tells of the named cause with much doubt; None where none would."""
    from agent.experiment import Deadline, plan_experiment, tells_apart_by_load

    doubtful = {id(e.pair): e.after for e in (bare.expected if bare else ()) if _doubted(found, e)}
    load = _trial_load(found, problem)
    if load is None or (bare is not None and not doubtful):
        return None
    if bare is not None:
        asked = [pair for pair in pairs if id(pair) in doubtful]
        motions = [piece.motion for piece in bare.pieces]
        if not tells_apart_by_load(found.dataset, found.finding.evidence, asked, motions, load):
            return None
    console.step("checking whether a known mass at the flange settles it")
    tried = plan_experiment(
        found, pairs, replace(problem, load=load), seconds, seed, deadline or Deadline(console.progress)
    )
    asked_for = [e for e in tried.expected if (id(e.pair) in doubtful if bare else helped(e))]
    better = [e for e in asked_for if e.after >= doubtful.get(id(e.pair), -np.inf) + _WORTH_MOUNTING]
    if not better:
        return None
    best = max(better, key=lambda e: e.after)
    return WithMass(load, (best.pair.first.text(), best.pair.second.text()), best.after, doubtful.get(id(best.pair)))


def _doubted(found: Diagnosis, expected: Expected) -> bool:
    """Whether the named cause is hardly told from what the verdict says equals it."""
    names, equal = found.dataset.robot.joint_names, found.finding.rivals
    places = (expected.pair.first.place(names), expected.pair.second.place(names))
    first = found.finding.causes[0].place if found.finding.causes else None
    return expected.after < _LIKELY and places[0] == first and places[1] in equal[0]


def _trial_load(found: Diagnosis, problem: LoopProblem) -> Tool | None:
    """A light mass for the arm, within what it is rated for; None where its tool is all of that."""
    from agent.robot import Tool, kinematics_for

    robot = problem.robot
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    postures = np.random.default_rng(0).uniform(lower, upper, (50, robot.dof))
    reach = float(np.linalg.norm(kinematics_for(robot, None).forward(postures)[:, :3, 3], axis=1).max())
    strongest = float(np.max(found.dataset.fit.reference.scale))
    rated, mounted = robot.rated_payload, 0.0 if problem.tool is None else problem.tool.mass
    allowed = np.inf if rated is None else rated - mounted
    mass = float(min(float(f"{_TRIAL_LOAD * strongest / (9.81 * max(reach, 0.1)):.1g}"), allowed))
    return Tool(np.eye(4), mass, np.zeros(3)) if mass > 0 else None
