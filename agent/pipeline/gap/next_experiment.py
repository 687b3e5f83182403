"""What to do next after a diagnosis: a motion in a recipe's sub-region, seconds on the brakes, or a known mass."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import AgentError, Console, InputError, sha256_text, write_atomically
from agent.diagnosis import Diagnosis
from agent.estimation import known_positions
from agent.excitation import Candidates, LoopProblem, LoopScore
from agent.experiment import (
    Deadline,
    Expected,
    Experiment,
    OpenPair,
    Piece,
    open_pairs,
    plan_experiment,
    tells_apart_by_load,
)
from agent.link import PROGRAM_SHA256, SCHEMA, check_payload, plan_program, torque_limits, with_payload
from agent.model import CATALOGUE, PAYLOAD, payload_of, payload_text
from agent.motion import Dialect, JointTarget, MotionError, Move, MoveType, Statement, dialects, with_frames
from agent.pipeline.plan import loop_problem
from agent.recipe import Recipe, load_recipe
from agent.recording import PARTS, PLANNED_PARTS, Log
from agent.robot import RobotDescription, Tool, TorqueLimits, kinematics_for
from agent.runs import make_folder, write_json
from agent.safety import PlannedProgram

#: Longest motion that is planned [s].
LONGEST = 60.0
#: Share of the planning time for the motion of the bare arm; the rest is for the question of a known mass.
_BARE = 0.7
#: Loops that are tried to find the limit which none keeps.
_TRIED = 20
#: Share of the joint speeds between pieces. It is halved while the tool exceeds the recipe's speed by more than
#: round-off.
_WAY_SPEED, _SLOWEST_WAY, _SPEED_ROUND_OFF = 0.2, 0.02, 1.01
#: A motion settles a pair only if the right answer becomes more probable than this.
_HELPS = 0.3
#: Weight of the mass that is tried, at full reach, as a share of the strongest joint's nominal torque.
_TRIAL_LOAD = 0.1
#: A mass is proposed in addition to a motion of the bare arm if that motion leaves the right answer below the first
#: probability and the mass adds the second.
_LIKELY, _WORTH_MOUNTING = 0.8, 0.2
#: Distance of the ends of two descriptions of one arm, as a share of its reach: under another name, and the same.
_SAME_ARM, _SAME_NAME = 0.15, 0.05
DRIVES_OFF = "--drives-off"
BRAKES = f"record 1 s with the drives off ({DRIVES_OFF} LOG)"


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
        instead = "" if self.bare is None else f" instead of {self.bare:.2f}"
        mass = payload_text(self.load)
        return (
            f"With {mass.split(',')[0]} at the flange, the right answer between {self.pair[0]} and {self.pair[1]} has "
            f"probability {self.after:.2f}{instead}. Mount it and plan with --payload '{mass}', or with the mass and "
            "centre that you have"
        )


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
        steps += [BRAKES] if self.brakes else []
        steps += [piece.text(self.robot) for piece in self.experiment.pieces]
        return {
            **load,
            PARTS: PLANNED_PARTS,
            "separates": sorted({name for e in expected for name in e.pair.names if name != "none"}),
            "motion": "; then ".join(steps),
            "program": program,
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
        return any(helped(expected) for expected in self.experiment.expected)


@dataclass(frozen=True)
class NoMotion:
    """Why no motion is planned, the effects that another test may separate, and a `mass` that makes a motion do it."""

    text: str
    separates: tuple[str, ...] = ()
    mass: WithMass | None = None

    def to_dict(self) -> dict[str, Any] | None:
        """`next_experiment` of a diagnosis; None where nothing is open."""
        if not self.separates:
            return None
        mass = {} if self.mass is None else {"with_a_mass": self.mass.to_dict()}
        return {"separates": list(self.separates), "motion": self.text, "program": None, **mass}


def plan_next(
    found: Diagnosis,
    recipe: Recipe,
    console: Console,
    seconds: float = LONGEST,
    name: str = "experiment",
    load: Tool | None = None,
    deadline: Deadline | None = None,
) -> NextMotion | NoMotion:
    """Plan the motion of at most `seconds` that settles most of what a diagnosis leaves open.

    `load` is a known mass that somebody mounts for it. Planning ends with the `deadline`.

    Raises:
        InputError: the recipe is of another robot, or a keep-out box that no motion of it can keep clear of.
    """
    check_arm(recipe, found.dataset.robot)
    pairs = open_pairs(found)
    if not pairs:
        return _nothing_to_separate(found)
    names = tuple(sorted({name for pair in pairs for name in pair.names if name != "none"}))
    if found.held is not None:
        return NoMotion(found.held.motion, names)
    deadline = deadline or Deadline(console.progress)
    problem = _where_known(replace(loop_problem(recipe, recipe.motion.speed), load=load), found)
    limits = None if load is None else torque_limits(recipe, load, console)
    console.step(f"searching for a motion of at most {seconds:.0f} s that settles the cause")
    runs = Runs(recipe, name, seconds, load, limits)
    seed = recipe.search.seed
    experiment = plan_experiment(found, pairs, problem, seconds, seed, deadline.share(_BARE), runs)
    if runs.motion is not None:
        brakes = brakes_tell(found, [e.pair for e in experiment.expected])
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
    mass = None if load is not None else with_a_mass(found, pairs, problem, seed, console, deadline=deadline.rest())
    loads = "" if mass is None else f". {mass.text()}"
    first, second = pairs[0].first, pairs[0].second
    what = f"distinguishes {first.text()} from {second.text()}" if second.form is not None else f"shows {first.text()}"
    moving = f"moving the arm cannot settle this: no motion in {where} {what}{why}"
    return NoMotion(f"{moving}. {other_test(found, pairs)}{loads}", names, mass)


def clearer_with_mass(
    found: Diagnosis, recipe: Recipe, motion: NextMotion, console: Console, deadline: Deadline | None = None
) -> WithMass | None:
    """A known mass with which a motion separates clearly what this one of the bare arm separates with doubt.

    Raises:
        InputError: as `plan_next`.
    """
    if motion.load is not None:
        return None
    pairs = [expected.pair for expected in motion.experiment.expected]
    problem = _where_known(loop_problem(recipe, recipe.motion.speed), found)
    rest = None if deadline is None else deadline.rest()
    return with_a_mass(found, pairs, problem, recipe.search.seed, console, motion.experiment, rest)


def write_next(motion: NextMotion, folder: Path) -> dict[str, Any]:
    """Write program and expectation into a folder of their own; returns `next_experiment` of the diagnosis.

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


def _nothing_to_separate(found: Diagnosis) -> NoMotion:
    """No hypothesis is left to separate from another; the cause may be in doubt all the same."""
    if found.verdict != "ambiguous":
        return NoMotion("nothing is open: no further motion is needed")
    if not found.selected.causes and (experiment := found.document.next_experiment) is not None:
        return NoMotion(experiment.motion, experiment.separates)  # between numbers of a simulator's file
    effect, joints = found.selected.causes[0].place
    on = ", ".join(found.dataset.robot.joint_names[joint] for joint in joints)
    return NoMotion(
        f"{effect}{f' on {on}' if on else ''} closes too little of the gap to be sure. No motion can be "
        "planned, as no alternative fits. Record a longer, more varied motion in the sub-region (agent record RECIPE)",
        tuple(sorted({cause.effect.name for cause in found.selected.causes})),
    )


def _where_known(problem: LoopProblem, found: Diagnosis) -> LoopProblem:
    """Keep the joints where the external model was fitted and the logs go: elsewhere the model's error is larger."""
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
    """The limit that most loops in the sub-region break."""
    genomes = np.random.default_rng(0).uniform(size=(_TRIED, problem.genes))
    candidates = Candidates(problem)
    said = [loop.reason for loop in map(candidates.checked_loop, genomes) if isinstance(loop, LoopScore)]
    return max(set(said), key=said.count) if said else "the last candidate took too long"


class Runs:
    """Whether pieces can run one after the other within a time [s], including the moves between them.

    `motion`: program of the last pieces that can; `refused`: why the last ones cannot.
    """

    def __init__(
        self, recipe: Recipe, name: str, seconds: float, load: Tool | None = None, limits: TorqueLimits | None = None
    ):
        self._recipe, self._name, self._seconds, self._load, self._limits = recipe, name, seconds, load, limits
        self.motion: PlannedProgram | None = None
        self.refused = ""

    def __call__(self, pieces: Sequence[Piece]) -> bool:
        recipe, speed = self._recipe, _WAY_SPEED
        start, path = np.asarray(pieces[0].start), f"{self._name}{recipe.dialect.suffix}"
        while True:
            text = self._program(pieces, speed)
            try:
                planned = plan_program(recipe, text, path, start, self._limits)
            except (InputError, MotionError) as error:
                self.refused = str(error)
                return False
            over = planned.speed / recipe.motion.speed
            if over <= _SPEED_ROUND_OFF or speed < _SLOWEST_WAY:
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


def helped(expected: Expected) -> bool:
    """Whether a motion makes a right answer likely that was not."""
    sides = zip(expected.before_if, expected.after_if, strict=True)
    return any(b is not None and a is not None and a > max(_HELPS, b + 0.05) for b, a in sides)


def other_test(found: Diagnosis, pairs: Sequence[OpenPair]) -> str:
    """What could still distinguish the most urgent pair where no motion does."""
    sides = {side.text(): side.effect for side in (pairs[0].first, pairs[0].second) if side.effect in CATALOGUE}
    looks = "; ".join(f"for {text}, {CATALOGUE[effect].look_at}" for text, effect in sides.items())
    brakes = f"First, {BRAKES}. If it stays open, try" if brakes_tell(found, pairs[:1]) else "Try"
    return f"{brakes} another posture, load or temperature, or look at the arm: {looks}"


def brakes_tell(found: Diagnosis, pairs: Sequence[OpenPair]) -> bool:
    """Whether an offset of a torque channel is open and the zero of the channel is not known."""
    if found.selected.zero_known:
        return False
    return any(name in CATALOGUE and CATALOGUE[name].adds_to_report for pair in pairs for name in pair.names)


def with_a_mass(
    found: Diagnosis,
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
    doubtful = {id(e.pair): e.after for e in (bare.expected if bare else ()) if _doubted(found, e)}
    load = _trial_load(found, problem)
    if load is None or (bare is not None and not doubtful):
        return None
    if bare is not None:
        asked = [pair for pair in pairs if id(pair) in doubtful]
        motions = [piece.motion for piece in bare.pieces]
        if not tells_apart_by_load(found.dataset, found.selected.evidence, asked, motions, load):
            return None
    console.step("checking whether a known mass at the flange settles it")
    loaded = replace(problem, load=load)
    tried = plan_experiment(found, pairs, loaded, LONGEST, seed, deadline or Deadline(console.progress))
    asked_for = [e for e in tried.expected if (id(e.pair) in doubtful if bare else helped(e))]
    better = [e for e in asked_for if e.after >= doubtful.get(id(e.pair), -np.inf) + _WORTH_MOUNTING]
    if not better:
        return None
    best = max(better, key=lambda e: e.after)
    return WithMass(load, (best.pair.first.text(), best.pair.second.text()), best.after, doubtful.get(id(best.pair)))


def _doubted(found: Diagnosis, expected: Expected) -> bool:
    """Whether the named cause is hardly distinguished from one that the verdict calls equivalent."""
    names, equal = found.dataset.robot.joint_names, found.selected.rivals
    first = found.selected.causes[0].place if found.selected.causes else None
    one, other = expected.pair.first.place(names), expected.pair.second.place(names)
    return expected.after < _LIKELY and one == first and other in equal[0]


def _trial_load(found: Diagnosis, problem: LoopProblem) -> Tool | None:
    """A light mass for the arm, within its rated payload; None where the tool takes all of that."""
    robot = problem.robot
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    postures = np.random.default_rng(0).uniform(lower, upper, (50, robot.dof))
    reach = float(np.linalg.norm(kinematics_for(robot, None).forward(postures)[:, :3, 3], axis=1).max())
    strongest = float(np.max(found.dataset.fit.reference.scale))
    mounted = 0.0 if problem.tool is None else problem.tool.mass
    allowed = np.inf if robot.rated_payload is None else robot.rated_payload - mounted
    mass = float(min(float(f"{_TRIAL_LOAD * strongest / (9.81 * max(reach, 0.1)):.1g}"), allowed))
    return Tool(np.eye(4), mass, np.zeros(3)) if mass > 0 else None


def check_next(recipe: Path, folder: Path | None, load: str | None = None) -> None:
    """Refuse before the diagnosis what would refuse the motion after it.

    Raises:
        InputError: no folder, one that is a file or holds an experiment; a recipe that cannot be used or reached; a
            mass that the arm must not carry.
    """
    if folder is None:
        raise InputError("diagnose: --next plans a motion: name the folder for it with -o DIR")
    check_folder(folder)
    loaded = load_recipe(recipe)
    if load is not None:
        check_payload(loaded.robot, loaded.tool, payload_of(load))
    Candidates(loop_problem(loaded, loaded.motion.speed))


def check_arm(recipe: Recipe, there: RobotDescription) -> None:
    """Refuse a recipe whose robot is not that of the logs.

    Raises:
        InputError: other joints, or another geometry.
    """
    here = recipe.robot
    if here.joint_names != there.joint_names:
        raise InputError(
            f"{recipe.path}: its robot has joints {', '.join(here.joint_names)}; the logs are of one with "
            f"{', '.join(there.joint_names)}. Name a recipe of that robot with --next"
        )
    postures = np.random.default_rng(0).uniform(-1.0, 1.0, (20, here.dof))
    ends = [kinematics_for(robot).forward(postures)[:, :3, 3] for robot in (here, there)]
    apart = float(np.linalg.norm(ends[0] - ends[1], axis=1).max())
    if apart > (_SAME_NAME if here.name == there.name else _SAME_ARM) * float(np.linalg.norm(ends[1], axis=1).max()):
        raise InputError(
            f"{recipe.path}: is for {here.name}, but the logs are of {there.name}. In the same posture, their ends "
            f"are {1e3 * apart:.0f} mm apart. Name a recipe of that robot with --next"
        )


def check_tool(recipe: Recipe, logs: Sequence[Log], of_model: Mapping[str, Any]) -> None:
    """Refuse a recipe with another tool than the logs or the model (by its provenance): the logs would not be pooled.

    Raises:
        InputError: as said.
    """
    mine = "none" if recipe.tool is None else recipe.tool.text()
    known = {tool: log.name for log in reversed(logs) if (tool := log.metadata.get("tool"))}
    known |= {tool: "the model" for tool in of_model.get("tool", ())}
    for tool, where in known.items():
        if tool != mine:
            raise InputError(
                f"{recipe.path}: its tool is {mine}, but that of {where} is {tool}. Name a recipe "
                "with the same tool with --next"
            )


def check_folder(folder: Path) -> None:
    """Refuse a folder that holds an experiment, or that cannot be made or written.

    Raises:
        InputError: as said; AgentError where nothing can be written.
    """
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    if not there.is_dir():
        raise InputError(f"{there}: is a file; name a folder for the experiment with -o")
    if not os.access(there, os.W_OK | os.X_OK):
        raise AgentError(f"{there}: nothing can be written there; name another folder for the experiment with -o")
    programs = {f"program{one.suffix}": "a program" for one in dialects()}
    for name, what in {"experiment.json": "an experiment", **programs}.items():
        if (folder / name).exists():
            raise InputError(f"{folder}: holds {what} already; name another folder with -o, or move it away")
