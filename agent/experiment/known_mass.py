"""A known mass at the flange, with which a motion settles what no motion of the bare arm does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agent.core import Console
from agent.diagnosis import LAW, LIMITS, Diagnosis
from agent.excitation import LoopProblem
from agent.experiment.deadline import Deadline
from agent.experiment.piece_choice import Expected, Experiment, plan_experiment
from agent.experiment.questions import OpenPair
from agent.experiment.scorer import load_distinguishes
from agent.model import PAYLOAD, payload_text
from agent.robot import Tool

#: Longest motion that is planned [s].
LONGEST = 60.0
#: Weight of the mass that is tried, at full reach, as a share of the strongest joint's nominal torque.
_TRIAL_LOAD = 0.1


@dataclass(frozen=True)
class WithMass:
    """A known mass at the flange that separates a pair of hypotheses.

    Attributes
    ----------
    load : the mass.
    pair : the two hypotheses.
    after : probability of the right answer after a motion with the mass.
    bare : the same after a motion of the bare arm; None: no such motion helps.
    """

    load: Tool
    pair: tuple[str, str]
    after: float
    bare: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """`with_a_mass` of `next_experiment`."""
        chance = {"pair": list(self.pair), "bare": self.bare, "after": self.after}
        return {PAYLOAD: payload_text(self.load), **chance, "text": self.text()}

    def text(self) -> str:
        """For people."""
        compared = "" if self.bare is None else f" instead of {self.bare:.2f}"
        mass = payload_text(self.load)
        return (
            f"With {mass.split(',')[0]} at the flange, the right answer between {self.pair[0]} and {self.pair[1]} has "
            f"probability {self.after:.2f}{compared}. Mount it and plan with --payload '{mass}', or with the mass and "
            "centre that you have"
        )


def makes_answer_likely(expected: Expected) -> bool:
    """Whether a motion makes a right answer likely that was not."""
    sides = zip(expected.before_if, expected.after_if, strict=True)
    return any(b is not None and a is not None and a > max(LIMITS.majority, b + LIMITS.negligible) for b, a in sides)


def plan_with_mass(
    diagnosis: Diagnosis,
    pairs: Sequence[OpenPair],
    problem: LoopProblem,
    seed: int,
    console: Console,
    bare: Experiment | None = None,
    deadline: Deadline | None = None,
) -> WithMass | None:
    """A light known mass with which a motion settles a pair that no motion of the bare arm does.

    With the motion planned for the `bare` arm: a pair of the named cause that it leaves in doubt.
    """
    doubtful = {id(e.pair): e.after for e in (bare.expected if bare else ()) if _doubted(diagnosis, e)}
    load = _trial_load(diagnosis, problem)
    if load is None or (bare is not None and not doubtful):
        return None
    if bare is not None:
        asked = [pair for pair in pairs if id(pair) in doubtful]
        motions = [piece.motion for piece in bare.pieces]
        if not load_distinguishes(diagnosis.dataset, diagnosis.selected.evidence, asked, motions, load):
            return None
    console.step("checking whether a known mass at the flange settles it")
    loaded = replace(problem, load=load)
    tried = plan_experiment(diagnosis, pairs, loaded, LONGEST, seed, deadline or Deadline(console.progress))
    asked_for = [e for e in tried.expected if (id(e.pair) in doubtful if bare else makes_answer_likely(e))]
    best = max(asked_for, key=lambda e: e.after, default=None)
    if best is None or (bare is not None and best.after < LAW.detected):
        return None
    return WithMass(load, (best.pair.first.text(), best.pair.second.text()), best.after, doubtful.get(id(best.pair)))


def _doubted(diagnosis: Diagnosis, expected: Expected) -> bool:
    """Whether the named cause is hardly distinguished from one that the verdict calls equivalent."""
    names, equal = diagnosis.dataset.robot.joint_names, diagnosis.selected.rivals
    first = diagnosis.selected.causes[0].key if diagnosis.selected.causes else None
    likelier, other = expected.pair.first.key(names), expected.pair.second.key(names)
    return expected.after < LAW.detected and likelier == first and other in equal[0]


def _trial_load(diagnosis: Diagnosis, problem: LoopProblem) -> Tool | None:
    """A light mass for the arm, within its rated payload; None where the tool takes all of that."""
    robot = problem.robot
    reference = diagnosis.dataset.fit.reference
    mounted = 0.0 if problem.tool is None else problem.tool.mass
    allowed = np.inf if robot.rated_payload is None else robot.rated_payload - mounted
    torque = _TRIAL_LOAD * float(np.max(reference.scale))
    mass = float(min(float(f"{torque / (robot.weight_per_mass * reference.reach):.1g}"), allowed))
    return Tool(np.eye(4), mass, np.zeros(3)) if mass > 0 else None
