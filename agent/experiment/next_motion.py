"""The motion in a recipe's sub-region that settles what a diagnosis leaves open, as a program, or why there is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agent.core import Console, InputError
from agent.diagnosis import LIMITS, Diagnosis
from agent.estimation import known_positions
from agent.excitation import Candidates, LoopProblem, LoopScore
from agent.experiment.deadline import Deadline
from agent.experiment.known_mass import LONGEST, WithMass, makes_answer_likely, plan_with_mass
from agent.experiment.piece_choice import Experiment, plan_experiment
from agent.experiment.pieces import SPEED_ROUND_OFF, Piece
from agent.experiment.questions import OpenPair, open_pairs
from agent.link import APPROACH_SPEED, plan_program, torque_limits, with_payload
from agent.model import CATALOGUE, PAYLOAD, payload_text
from agent.motion import Dialect, JointTarget, MotionError, Move, MoveType, Statement, with_frames
from agent.recipe import Recipe
from agent.recording import PARTS, PLANNED_PARTS
from agent.robot import RobotDescription, Tool, TorqueLimits
from agent.safety import PlannedProgram

DRIVES_OFF = "--drives-off"
_BRAKES = f"record 1 s with the drives off ({DRIVES_OFF} LOG)"


@dataclass(frozen=True, eq=False)
class NextMotion:
    """A planned experiment as a program.

    Attributes
    ----------
    experiment : its pieces and what it is expected to separate.
    planned : the program, planned from the start of the first piece.
    load : known mass to mount for it.
    brakes : whether seconds with the drives off come first.
    """

    experiment: Experiment
    planned: PlannedProgram
    robot: RobotDescription
    dialect: Dialect
    load: Tool | None = None
    brakes: bool = False

    @property
    def text(self) -> str:
        """The text of the program."""
        return self.planned.text

    def to_dict(self, program: str) -> dict[str, Any]:
        """`next_experiment` of a diagnosis: what is separated, how, and the probability of the right answer."""
        expected = self.experiment.expected
        load = {} if self.load is None else {PAYLOAD: payload_text(self.load)}
        steps = [f"mount {mass} at the flange (--payload)" for mass in load.values()]
        steps += [_BRAKES] if self.brakes else []
        steps += [piece.text(self.robot) for piece in self.experiment.pieces]
        return {
            **load,
            PARTS: PLANNED_PARTS,
            "separates": sorted({name for e in expected for name in e.pair.names if name != "none"}),
            "motion": "; then ".join(steps),
            "program": program,
            **({"drives_off": True} if self.brakes else {}),
            "duration_s": self.planned.duration,
            "probability": [
                {
                    "pair": [e.pair.first.text(), e.pair.second.text()],
                    "before": e.before,
                    "after": e.after,
                    "after_if": list(e.after_if),
                    "smallest_over_practical": e.minimum_detectable_size,
                }
                for e in expected
            ],
        }

    def helps(self) -> bool:
        """Whether it makes a right answer likely that was not, for any pair."""
        return any(makes_answer_likely(expected) for expected in self.experiment.expected)


@dataclass(frozen=True)
class NoMotion:
    """Why no motion is planned, the effects that another test may separate, a `mass` that makes a motion do it, and
    whether a log with the `drives_off` comes first."""

    text: str
    separates: tuple[str, ...] = ()
    mass: WithMass | None = None
    drives_off: bool = False

    def to_dict(self) -> dict[str, Any] | None:
        """`next_experiment` of a diagnosis; None where nothing is open."""
        if not self.separates:
            return None
        mass = {} if self.mass is None else {"with_a_mass": self.mass.to_dict()}
        drives_off = {"drives_off": True} if self.drives_off else {}
        return {"separates": list(self.separates), "motion": self.text, "program": None, **drives_off, **mass}


def plan_motion(
    diagnosis: Diagnosis,
    recipe: Recipe,
    problem: LoopProblem,
    console: Console,
    seconds: float = LONGEST,
    name: str = "experiment",
    load: Tool | None = None,
    deadline: Deadline | None = None,
) -> NextMotion | NoMotion:
    """Plan the motion of at most `seconds` that settles most of what a diagnosis leaves open.

    Args:
        recipe: where the motion lies, and as what program it runs; `problem` holds its limits.
        name: of the program.
        load: known mass that somebody mounts for it.
        deadline: end of planning.

    Raises:
        InputError: a keep-out box that no motion can keep clear of.
    """
    pairs = open_pairs(diagnosis)
    if not pairs:
        return _nothing_to_separate(diagnosis)
    names = tuple(sorted({name for pair in pairs for name in pair.names if name != "none"}))
    if diagnosis.stuck_torque is not None:
        return NoMotion(diagnosis.stuck_torque.motion, names)
    deadline = deadline or Deadline(console.progress)
    problem = _where_known(replace(problem, load=load), diagnosis)
    limits = None if load is None else torque_limits(recipe, load, console)
    console.step(f"searching for a motion of at most {seconds:.0f} s that settles the cause")
    runs = RunnablePieces(recipe, name, seconds, load, limits)
    seed = recipe.search.seed
    experiment = plan_experiment(diagnosis, pairs, problem, seconds, seed, deadline.share(0.5), runs)
    if runs.motion is not None:
        brakes = zero_distinguishes(diagnosis, [e.pair for e in experiment.expected])
        motion = NextMotion(experiment, runs.motion, recipe.robot, recipe.dialect, load, brakes)
        if motion.helps():
            return motion
    if seconds < LONGEST:
        return NoMotion(f"no motion of the remaining {seconds:.0f} s settles it: allow more motion", names)
    where = f"the sub-region of {recipe.path}"
    if experiment.cut_short:
        return NoMotion(
            f"the planning time ended before a motion in {where} was found that settles it "
            f"({experiment.weighed} pieces tried): allow more with --planning-budget",
            names,
        )
    if not experiment.weighed:
        why = _refused(problem)
        return NoMotion(f"no motion found in {where} keeps all limits ({why}): run agent check for details", names)
    why = f" ({runs.refused})" if runs.refused else ""
    mass = None
    if load is None:
        mass = plan_with_mass(diagnosis, pairs, problem, seed, console, deadline=deadline.from_now())
    loads = "" if mass is None else f". {mass.text()}"
    first, second = pairs[0].first, pairs[0].second
    aim = f"distinguishes {first.text()} from {second.text()}" if second.form is not None else f"shows {first.text()}"
    moving = f"moving the arm cannot settle this: no motion in {where} {aim}{why}"
    advice, first_off = advice_without_motion(diagnosis, pairs), zero_distinguishes(diagnosis, pairs[:1])
    return NoMotion(f"{moving}. {advice}{loads}", names, mass, first_off)


def clearer_with_mass(
    diagnosis: Diagnosis,
    recipe: Recipe,
    problem: LoopProblem,
    motion: NextMotion,
    console: Console,
    deadline: Deadline | None = None,
) -> WithMass | None:
    """A known mass with which a motion separates clearly what this one of the bare arm separates with doubt.

    Args:
        diagnosis: diagnosis that leaves pairs open.
        recipe: where the motion lies.
        problem: its limits.
        motion: the one planned for the bare arm.
        console: told what is being done.
        deadline: end of planning; None: no end.

    Raises:
        InputError: as `plan_motion`.
    """
    if motion.load is not None:
        return None
    pairs = [expected.pair for expected in motion.experiment.expected]
    until = None if deadline is None else deadline.from_now()
    return plan_with_mass(
        diagnosis, pairs, _where_known(problem, diagnosis), recipe.search.seed, console, motion.experiment, until
    )


def _nothing_to_separate(diagnosis: Diagnosis) -> NoMotion:
    """No hypothesis is left to separate from another; the cause may be in doubt all the same."""
    if diagnosis.verdict != "ambiguous":
        return NoMotion("nothing is open: no further motion is needed")
    if not diagnosis.selected.causes and (experiment := diagnosis.document.next_experiment) is not None:
        return NoMotion(
            experiment.motion, experiment.separates, drives_off=experiment.drives_off
        )  # between numbers of a simulator's file
    effect, joints = diagnosis.selected.causes[0].key
    on = ", ".join(diagnosis.dataset.robot.joint_names[joint] for joint in joints)
    return NoMotion(
        f"{effect}{f' on {on}' if on else ''} closes too little of the gap to be sure. No motion can be "
        "planned, as no alternative fits. Record a longer, more varied motion in the sub-region (agent record RECIPE)",
        tuple(sorted({cause.effect.name for cause in diagnosis.selected.causes})),
    )


def _where_known(problem: LoopProblem, diagnosis: Diagnosis) -> LoopProblem:
    """Keep the joints where the external model was fitted and the logs go: elsewhere the model's error is larger."""
    fitted_range = known_positions(diagnosis.dataset.model)
    if fitted_range is None or not diagnosis.dataset.has_reference:
        return problem
    ranges = dict(problem.joint_ranges)
    q = np.concatenate([signals.q for signals in diagnosis.dataset.fit.signals])
    for k, (joint, lower, upper) in enumerate(zip(problem.robot.joints, *fitted_range, strict=True)):
        low, high = ranges.get(joint.name, (joint.lower, joint.upper))
        low, high = max(low, min(lower, q[:, k].min())), min(high, max(upper, q[:, k].max()))
        ranges[joint.name] = (float(low), float(high))
    return replace(problem, joint_ranges=ranges)


def _refused(problem: LoopProblem) -> str:
    """The limit that most loops in the sub-region break."""
    genomes = np.random.default_rng(0).uniform(size=(LIMITS.min_samples, problem.genes))
    candidates = Candidates(problem)
    reasons = [loop.reason for loop in map(candidates.checked_loop, genomes) if isinstance(loop, LoopScore)]
    return max(set(reasons), key=reasons.count) if reasons else "the last candidate took too long"


class RunnablePieces:
    """Whether pieces can run one after the other within a time [s], including the moves between them.

    These are slower while the tool exceeds the recipe's speed by more than round-off, down to the least whole percent
    that controllers take.

    `motion`: program of the last pieces that can; `refused`: why the last ones cannot.
    """

    def __init__(
        self, recipe: Recipe, name: str, seconds: float, load: Tool | None = None, limits: TorqueLimits | None = None
    ):
        self._recipe, self._name, self._seconds, self._load, self._limits = recipe, name, seconds, load, limits
        self.motion: PlannedProgram | None = None
        self.refused = ""

    def __call__(self, pieces: Sequence[Piece]) -> bool:
        recipe, speed = self._recipe, APPROACH_SPEED
        start, path = np.asarray(pieces[0].start), f"{self._name}{recipe.dialect.suffix}"
        while True:
            text = self._program(pieces, speed)
            try:
                planned = plan_program(recipe, text, path, start, self._limits)
            except (InputError, MotionError) as error:
                self.refused = str(error)
                return False
            over = planned.speed / recipe.motion.speed
            if over <= SPEED_ROUND_OFF or 100 * speed < 2:
                break
            speed /= 2
        took = planned.duration
        if took > self._seconds:
            self.refused = f"it takes {took:.0f} s with the moves between its pieces; {self._seconds:.0f} s are allowed"
            return False
        self.motion = planned
        return True

    def _program(self, pieces: Sequence[Piece], way_speed: float) -> str:
        recipe = self._recipe
        calm = with_frames(recipe.motion.settings, recipe.tool).changed(speed_override=way_speed).stopping()
        statements: list[Statement] = []
        for piece in pieces:
            statements += [Move(MoveType.JOINT, JointTarget(piece.start), calm), *piece.statements]
        text = recipe.dialect.write(self._name, statements, recipe.robot)
        return text if self._load is None else with_payload(text, self._load, recipe.dialect.comment)


def advice_without_motion(diagnosis: Diagnosis, pairs: Sequence[OpenPair]) -> str:
    """What could still distinguish the most urgent pair where no motion does."""
    sides = {side.text(): side.effect for side in (pairs[0].first, pairs[0].second) if side.effect in CATALOGUE}
    looks = "; ".join(f"for {text}, {CATALOGUE[effect].look_at}" for text, effect in sides.items())
    brakes = f"First, {_BRAKES}. If it stays open, try" if zero_distinguishes(diagnosis, pairs[:1]) else "Try"
    return f"{brakes} another posture, load or temperature, or look at the arm: {looks}"


def zero_distinguishes(diagnosis: Diagnosis, pairs: Sequence[OpenPair]) -> bool:
    """Whether an offset of a torque channel is open and the zero of the channel is not known."""
    if diagnosis.selected.zero_known:
        return False
    return any(name in CATALOGUE and CATALOGUE[name].adds_to_report for pair in pairs for name in pair.names)
