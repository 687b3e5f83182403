"""The next motion of a diagnosis: planned in a recipe's sub-region, checked as every motion is, and its program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import Console, InputError, sha256_text, write_atomically
from agent.link import PROGRAM_SHA256, SCHEMA, torque_limits, with_payload
from agent.pipeline.next_checks import check_arm, check_folder
from agent.pipeline.other_tests import BRAKES, WithMass, brakes_tell, helped, in_doubt, other_test, with_a_mass
from agent.pipeline.planning import checked_chains, loop_problem
from agent.recipe import Recipe
from agent.runs import make_folder, write_json

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.excitation import LoopProblem
    from agent.experiment import Deadline, Experiment, Pick, Piece
    from agent.motion import Dialect, Trajectory
    from agent.robot import RobotDescription, Tool, TorqueLimits

#: Longest motion that is planned [s].
LONGEST = 60.0
#: Part of the time for planning that the motion of the bare arm gets; the rest asks whether a known mass tells more.
_BARE = 0.7
#: So many loops are asked which limit they break, where none keeps all.
_ASKED_WHY = 20
#: At so much of its joint speeds the arm goes from piece to piece, or at half of it, and so on, where the tool would be
#: faster than the recipe says by more than round-off.
_WAY_SPEED, _SLOWEST_WAY, _SPEED_ROUND_OFF = 0.2, 0.02, 1.01


@dataclass(frozen=True, eq=False)
class NextMotion:
    """A planned experiment as a program: `text`, set-points from stop to stop, and what it is expected to tell.

    `load`: a known mass that somebody has to mount for it; `brakes`: seconds with the drives off are asked for first.
    """

    experiment: Experiment
    text: str
    chains: tuple[Trajectory, ...]
    robot: RobotDescription
    dialect: Dialect
    load: Tool | None = None
    brakes: bool = False

    @property
    def duration(self) -> float:
        """[s] from the first piece's start on, rests included."""
        return _duration(self.text, self.chains, self.robot, self.dialect)

    def to_dict(self, program: str) -> dict[str, Any]:
        """`next_experiment` of a diagnosis: what is separated, how, and the probability of the right answer."""
        from agent.model import PAYLOAD, payload_text
        from agent.recording import PARTS, PLANNED_PARTS

        expected = self.experiment.expected
        load = {} if self.load is None else {PAYLOAD: payload_text(self.load)}
        mounted = [f"mount {mass} at the flange (--payload)" for mass in load.values()]
        return {
            **load,
            PARTS: PLANNED_PARTS,
            "separates": sorted({name for e in expected for name in e.pair.names if name != "none"}),
            "motion": "; then ".join(
                [
                    *mounted,
                    *([BRAKES] if self.brakes else ()),
                    *(piece.text(self.robot) for piece in self.experiment.pieces),
                ]
            ),
            "program": program,
            "duration_s": self.duration,
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
        """Whether it makes the right answer likely that was not, should one of any pair be true."""
        return any(helped(expected) for expected in self.experiment.expected)


@dataclass(frozen=True)
class NoMotion:
    """Why no motion is planned, and what else may settle what is open: the effects that it `separates`, if any, and a
    `mass` with which a motion would."""

    text: str
    separates: tuple[str, ...] = ()
    mass: WithMass | None = None

    def to_dict(self) -> dict[str, Any] | None:
        """`next_experiment` of a diagnosis; None where nothing is open."""
        mass = {} if self.mass is None else {"with_a_mass": self.mass.to_dict()}
        return (
            {"separates": list(self.separates), "motion": self.text, "program": None, **mass}
            if self.separates
            else None
        )


def plan_next(
    found: Diagnosis,
    recipe: Recipe,
    console: Console,
    seconds: float = LONGEST,
    name: str = "experiment",
    load: Tool | None = None,
    deadline: Deadline | None = None,
) -> NextMotion | NoMotion:
    """The motion that settles most of what a diagnosis leaves open, or why there is none and what else may settle it.

    `load` is a known mass that somebody will mount at the flange for it; it is never assumed. Planning ends with the
    `deadline`.

    Raises:
        InputError: the recipe is of another robot, or a keep-out box that no motion of it can keep clear of.
    """
    from agent.experiment import Deadline, open_pairs, plan_experiment

    check_arm(recipe, found.dataset.robot)
    pairs = open_pairs(found)
    if not pairs and (doubt := in_doubt(found)):
        return NoMotion(doubt, tuple(sorted({cause.effect.name for cause in found.finding.causes})))
    if not pairs:
        return NoMotion("nothing is open: no further motion is needed")
    names = tuple(sorted({name for pair in pairs for name in pair.names if name != "none"}))
    if found.held is not None:
        return NoMotion(found.held.motion, names)
    deadline = deadline or Deadline(console.progress)
    problem = _where_known(replace(loop_problem(recipe, recipe.motion.speed), load=load), found)
    limits = None if load is None else torque_limits(recipe, load, console)
    console.step(f"searching for a motion of at most {seconds:.0f} s that settles the cause")
    runs = _Runs(recipe, name, seconds, load, limits)
    experiment = plan_experiment(found, pairs, problem, seconds, recipe.search.seed, deadline.share(_BARE), runs)
    if runs.motion is not None:
        asked = [e.pair for e in experiment.expected]
        motion = NextMotion(experiment, *runs.motion, recipe.robot, recipe.dialect, load, brakes_tell(found, asked))
        if motion.helps():
            return motion
    if seconds < LONGEST:
        console.step(f"no motion of {seconds:.0f} s settles it; trying a longer one")
        longer = plan_next(found, recipe, console, LONGEST, name, load, deadline.rest())
        if isinstance(longer, NoMotion):
            return longer
        return NoMotion(
            f"no motion of the remaining {seconds:.0f} s settles it; {longer.duration:.0f} s may: allow more motion",
            names,
        )
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
        seed = recipe.search.seed
        mass = with_a_mass(found, pairs, problem, seconds, seed, console, deadline=deadline.rest())
    loads = "" if mass is None else f". {mass.text()}"
    asked_of = pairs[0]
    what = (
        f"distinguishes {asked_of.first.text()} from {asked_of.second.text()}"
        if asked_of.second.form is not None
        else f"shows {asked_of.first.text()}"
    )
    moving = f"moving the arm cannot settle this: no motion in {where} {what}{why}"
    return NoMotion(f"{moving}. {other_test(found, pairs)}{loads}", names, mass)


def mass_beside(
    found: Diagnosis, recipe: Recipe, motion: NextMotion, console: Console, deadline: Deadline | None = None
) -> WithMass | None:
    """A known mass with which a motion as long would tell what this one of the bare arm tells with much doubt.

    Raises:
        InputError: as `plan_next`.
    """
    if motion.load is not None:
        return None
    pairs = [expected.pair for expected in motion.experiment.expected]
    problem = _where_known(loop_problem(recipe, recipe.motion.speed), found)
    return with_a_mass(
        found, pairs, problem, LONGEST, recipe.search.seed, console, motion.experiment, deadline and deadline.rest()
    )


def _where_known(problem: LoopProblem, found: Diagnosis) -> LoopProblem:
    """The problem with the joints kept to positions that the model was fitted to, where the logs keep to them too:
    elsewhere a local model errs by more than on these logs."""
    from agent.estimation import known_positions

    known = known_positions(found.dataset.model)
    if known is None or not found.dataset.given:
        return problem
    ranges = dict(problem.joint_ranges)
    q = np.concatenate([signals.q for signals in found.dataset.fit.signals])
    for k, (joint, lower, upper) in enumerate(zip(problem.robot.joints, *known, strict=True)):
        low, high = ranges.get(joint.name, (joint.lower, joint.upper))
        low, high = max(low, min(lower, q[:, k].min())), min(high, max(upper, q[:, k].max()))
        ranges[joint.name] = (float(low), float(high))
    return replace(problem, joint_ranges=ranges)


def _refused(problem: LoopProblem) -> str:
    """The limit that a loop in the sub-region breaks, or a slower piece does."""
    from agent.excitation import Candidates, LoopScore

    genomes = np.random.default_rng(0).uniform(size=(_ASKED_WHY, problem.genes))
    candidates = Candidates(problem)
    said = [loop.reason for loop in map(candidates.checked_loop, genomes) if isinstance(loop, LoopScore)]
    return max(set(said), key=said.count) if said else "the last candidate took too long"


def run_otherwise(
    pick: Pick, kinds: Mapping[str, float], recipe: Recipe, seconds: float, name: str, seed: int
) -> tuple[str, float] | None:
    """Text and duration [s] of a motion chosen in another way than by what it separates; None where none can be run.

    Of pieces of the `kinds` (how often each is drawn) one is picked after the other, while all of them with the ways
    between them take no longer than `seconds`.

    Raises:
        InputError: the recipe's cell leaves no room.
    """
    from agent.experiment import pieces_otherwise

    runs = _Runs(recipe, name, seconds)
    if not pieces_otherwise(pick, loop_problem(recipe, recipe.motion.speed), seconds, seed, runs, kinds):
        return None
    assert runs.motion is not None
    text, chains = runs.motion
    return text, _duration(text, chains, recipe.robot, recipe.dialect)


def _duration(text: str, chains: Sequence[Trajectory], robot: RobotDescription, dialect: Dialect) -> float:
    """[s] of a program's motion and of its rests."""
    from agent.safety import PlannedProgram, pauses

    rests = pauses(dialect.read(text, "program", robot).run())
    return PlannedProgram("program", text, tuple(chains), pauses=rests).duration


def write_next(motion: NextMotion, folder: Path) -> dict[str, Any]:
    """Program and expectation in a folder of their own; returns `next_experiment` of the diagnosis.

    Raises:
        InputError: the folder holds an experiment already.
        AgentError: it cannot be made or written.
    """
    make_folder(folder, "the experiment")
    check_folder(folder)
    program = write_atomically(folder / f"program{motion.dialect.suffix}", motion.text)
    data = motion.to_dict(str(program))
    write_json(folder / "experiment.json", {"schema": SCHEMA, **data, PROGRAM_SHA256: sha256_text(motion.text)})
    return data


class _Runs:
    """Whether pieces can be run one after the other at the controller's own period within a time [s], the ways between
    them included.

    `motion`: text and set-points of the last ones that can; `refused`: why the last ones cannot.
    """

    def __init__(
        self, recipe: Recipe, name: str, seconds: float, load: Tool | None = None, limits: TorqueLimits | None = None
    ):
        self._recipe, self._name, self._seconds, self._load, self._limits = recipe, name, seconds, load, limits
        self.motion: tuple[str, tuple[Trajectory, ...]] | None = None
        self.refused = ""

    def __call__(self, pieces: Sequence[Piece]) -> bool:
        from agent.motion import MotionError

        start, path = np.asarray(pieces[0].start), f"{self._name}{self._recipe.dialect.suffix}"
        speed = _WAY_SPEED
        while True:
            text = _text(self._recipe, pieces, self._name, speed, self._load)
            try:
                _, chains = checked_chains(self._recipe, text, path, start, self._limits)
            except (InputError, MotionError) as error:
                self.refused = str(error)
                return False
            over = max(float(chain.path_speed.max()) for chain in chains) / self._recipe.motion.speed
            if over <= _SPEED_ROUND_OFF or speed < _SLOWEST_WAY:
                break
            speed /= 2
        took = _duration(text, chains, self._recipe.robot, self._recipe.dialect)
        if took > self._seconds:
            self.refused = f"it takes {took:.0f} s with the moves between its pieces; {self._seconds:.0f} s are allowed"
            return False
        self.motion = text, tuple(chains)
        return True


def _text(recipe: Recipe, pieces: Sequence[Piece], name: str, way_speed: float, load: Tool | None) -> str:
    from agent.motion import JointTarget, Move, MoveType, Statement, with_frames

    calm = with_frames(recipe.motion.settings, recipe.tool).changed(speed_override=way_speed).stopping()
    statements: list[Statement] = []
    for piece in pieces:
        statements += [Move(MoveType.JOINT, JointTarget(piece.start), calm), *piece.statements]
    text = recipe.dialect.write(name, statements, recipe.robot)
    return text if load is None else with_payload(text, load, recipe.dialect.comment)
