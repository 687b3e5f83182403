"""The next motion of a diagnosis: planned in a recipe's sub-region, checked as every motion is, and its program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import Console, InputError, write_atomically
from agent.link import torque_limits
from agent.pipeline.planning import checked_chains, loop_problem
from agent.recipe import Recipe
from agent.runs import make_folder, write_json

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.excitation import LoopProblem
    from agent.experiment import Expected, Experiment, OpenPair, Pick, Piece
    from agent.motion import Trajectory
    from agent.robot import RobotDescription, Tool, TorqueLimits

#: Longest motion that is planned [s].
LONGEST = 60.0
#: A motion that makes the right answer no likelier than this, whichever of a pair is true, settles nothing.
_HELPS = 0.3
#: A mass is tried whose weight, far out, is this part of the strongest joint's nominal torque.
_TRIAL_LOAD = 0.1
_BRAKES = "seconds of the arm on its brakes with the drives off, which tell an offset (--drives-off LOG)"
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
    load: Tool | None = None
    brakes: bool = False

    @property
    def duration(self) -> float:
        """[s] from the first piece's start on, rests included."""
        return _duration(self.text, self.chains, self.robot)

    def to_dict(self, program: str) -> dict[str, Any]:
        """`next_experiment` of a diagnosis: what is separated, how, and the probability of the right answer."""
        from agent.model import PAYLOAD, payload_text
        from agent.recording import PARTS, PLANNED_PARTS

        expected = self.experiment.expected
        load = {} if self.load is None else {PAYLOAD: payload_text(self.load)}
        return {
            **load,
            PARTS: PLANNED_PARTS,
            "separates": sorted({name for e in expected for name in e.pair.names if name != "none"}),
            "motion": "; then ".join(
                [*([_BRAKES] if self.brakes else ()), *(piece.text(self.robot) for piece in self.experiment.pieces)]
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
        return any(_helped(expected) for expected in self.experiment.expected)


def _helped(expected: Expected) -> bool:
    sides = zip(expected.before_if, expected.after_if, strict=True)
    return any(b is not None and a is not None and a > max(_HELPS, b + 0.05) for b, a in sides)


def plan_next(
    found: Diagnosis,
    recipe: Recipe,
    console: Console,
    seconds: float = LONGEST,
    name: str = "experiment",
    load: Tool | None = None,
) -> NextMotion | str:
    """The motion that settles most of what a diagnosis leaves open, or why there is none and what else may settle it.

    `load` is a known mass that somebody will mount at the flange for it; it is never assumed.

    Raises:
        InputError: the recipe is of another robot, or its cell leaves no room.
    """
    from agent.experiment import open_pairs, plan_experiment

    check_joints(recipe, found.dataset.robot.joint_names)
    pairs = open_pairs(found)
    if not pairs:
        return "nothing is open: no further motion is needed"
    problem = replace(loop_problem(recipe, recipe.motion.speed), load=load)
    limits = None if load is None else torque_limits(recipe, load, console)
    console.step(f"searching for a motion of at most {seconds:.0f} s that tells more")
    runs = _Runs(recipe, name, limits)
    experiment = plan_experiment(found, pairs, problem, seconds, recipe.search.seed, console.progress, runs)
    if runs.motion is not None:
        asked = [e.pair for e in experiment.expected]
        motion = NextMotion(experiment, *runs.motion, recipe.robot, load, _brakes_tell(found, asked))
        if motion.helps():
            return motion
    refused = f" ({runs.refused})" if runs.refused else ""
    loads = "" if load is not None else _with_a_mass(found, pairs, problem, seconds, recipe.search.seed)
    return f"no motion in the sub-region of {recipe.path} would settle it{refused}: {_other_test(found, pairs)}{loads}"


def run_otherwise(pick: Pick, recipe: Recipe, seconds: float, name: str, seed: int) -> tuple[str, float] | None:
    """Text and duration [s] of a motion chosen in another way than by what it separates; None where none can be run.

    Raises:
        InputError: the recipe's cell leaves no room.
    """
    from agent.experiment import pieces_otherwise

    runs = _Runs(recipe, name)
    pieces_otherwise(pick, loop_problem(recipe, recipe.motion.speed), seconds, seed, runs)
    if runs.motion is None:
        return None
    text, chains = runs.motion
    return text, _duration(text, chains, recipe.robot)


def _duration(text: str, chains: Sequence[Trajectory], robot: RobotDescription) -> float:
    """[s] of a program's motion and of its rests."""
    from agent.motion import parse_program
    from agent.safety import PlannedProgram, pauses

    rests = pauses(parse_program(text, "program.pdl", robot).run())
    return PlannedProgram("program", text, tuple(chains), pauses=rests).duration


def write_next(motion: NextMotion, folder: Path) -> dict[str, Any]:
    """Program and expectation in a folder of their own; returns `next_experiment` of the diagnosis.

    Raises:
        InputError: the folder holds an experiment already.
        AgentError: it cannot be made or written.
    """
    make_folder(folder, "the experiment")
    _check_folder(folder)
    program = write_atomically(folder / "program.pdl", motion.text)
    data = motion.to_dict(str(program))
    write_json(folder / "experiment.json", {"schema": "experiment/1", **data})
    return data


def check_next(recipe: Path, folder: Path | None) -> None:
    """What would refuse the motion is found before the diagnosis, not after it.

    Raises:
        InputError: no folder, one that is a file or holds an experiment; a recipe that cannot be used or reached.
    """
    from agent.excitation import Candidates
    from agent.recipe import load_recipe

    if folder is None:
        raise InputError("diagnose: --next plans a motion: name the folder for it with -o DIR")
    _check_folder(folder)
    loaded = load_recipe(recipe)
    Candidates(loop_problem(loaded, loaded.motion.speed))


def check_joints(recipe: Recipe, there: tuple[str, ...]) -> None:
    """
    Raises:
        InputError: the joints of the recipe's robot are not those of the robot of the logs, `there`.
    """
    here = recipe.robot.joint_names
    if here != there:
        raise InputError(
            f"{recipe.path}: its robot has joints {', '.join(here)}; the logs are of one with {', '.join(there)}. "
            "Name a recipe of that robot with --next"
        )


def _check_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder for the experiment with -o")
    if (folder / "experiment.json").exists():
        raise InputError(f"{folder}: holds an experiment already; name another folder with -o, or move it away")


def _other_test(found: Diagnosis, pairs: Sequence[OpenPair]) -> str:
    """What could still tell the most urgent pair apart, by the knowledge that its effects carry."""
    from agent.model import CATALOGUE

    names = [name for name in dict.fromkeys(pairs[0].names) if name in CATALOGUE]
    looks = [f"for {name}, {CATALOGUE[name].look_at}" for name in names]
    other = f"another posture, load or temperature may, or a look at the arm: {'; '.join(looks)}"
    return f"{_BRAKES}; {other}" if _brakes_tell(found, pairs[:1]) else other


def _brakes_tell(found: Diagnosis, pairs: Sequence[OpenPair]) -> bool:
    """Whether one of two that are open is an offset of a torque channel, whose zero is not known yet."""
    from agent.model import CATALOGUE

    if found.finding.zero_known:
        return False
    return any(name in CATALOGUE and CATALOGUE[name].adds_to_report for pair in pairs for name in pair.names)


def _with_a_mass(found: Diagnosis, pairs: Sequence[OpenPair], problem: LoopProblem, seconds: float, seed: int) -> str:
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
    tried = plan_experiment(found, pairs, replace(problem, load=load), seconds, seed)
    helped = [e for e in tried.expected if _helped(e)]
    if not helped:
        return ""
    best = max(helped, key=lambda e: e.after)
    return (
        f". With a known mass at the flange a motion may: {payload_text(load).split(',')[0]} would make the right "
        f"answer between {best.pair.first.text()} and {best.pair.second.text()} {best.after:.2f} likely; mount one and "
        "plan with --payload 'MASS, X, Y, Z'"
    )


class _Runs:
    """Whether pieces can be run one after the other at the controller's own period, the ways between them included.

    `motion`: text and set-points of the last ones that can; `refused`: why the last ones cannot.
    """

    def __init__(self, recipe: Recipe, name: str, limits: TorqueLimits | None = None):
        self._recipe, self._name, self._limits = recipe, name, limits
        self.motion: tuple[str, tuple[Trajectory, ...]] | None = None
        self.refused = ""

    def __call__(self, pieces: Sequence[Piece]) -> bool:
        from agent.motion import MotionError

        start, path = np.asarray(pieces[0].start), f"{self._name}.pdl"
        speed = _WAY_SPEED
        while True:
            text = _text(self._recipe, pieces, self._name, speed)
            try:
                _, chains = checked_chains(self._recipe, text, path, start, self._limits)
            except (InputError, MotionError) as error:
                self.refused = str(error)
                return False
            over = max(float(chain.path_speed.max()) for chain in chains) / self._recipe.motion.speed
            if over <= _SPEED_ROUND_OFF or speed < _SLOWEST_WAY:
                break
            speed /= 2
        self.motion = text, tuple(chains)
        return True


def _text(recipe: Recipe, pieces: Sequence[Piece], name: str, way_speed: float) -> str:
    from agent.motion import JointTarget, Move, MoveType, Statement, Termination, with_frames, write_program

    calm = with_frames(recipe.motion.settings, recipe.tool).changed(
        speed_override=way_speed, termination=Termination.FINE
    )
    statements: list[Statement] = []
    for piece in pieces:
        statements += [Move(MoveType.JOINT, JointTarget(piece.start), calm), *piece.statements]
    return write_program(name, statements, recipe.robot)
