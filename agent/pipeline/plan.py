"""What will move, settled before anything moves: the loop, the validation motions, their programs and margins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import (
    LARGEST_PROGRAM,
    Console,
    InputError,
    TaskEngine,
    read_bytes,
    read_json,
    read_text,
    sha256_file,
    sha256_text,
    write_atomically,
)
from agent.excitation import Candidates, Loop, LoopProblem, LoopScore, check_sub_region, search, via_joints
from agent.link import APPROACH_SPEED, check_cell, trajectories
from agent.motion import CartesianTarget, JointTarget, LoopProgram, Target, ViaRegions, dialect_of, pose_of, with_frames
from agent.pages import ShownLoop, plan_report
from agent.recipe import Recipe
from agent.recording import read_log
from agent.robot import Dynamics, kinematics_for
from agent.runs import RunFolder, keep_loop, make_folder, write_json

#: Largest number of random motions that are drawn for the validation.
_MAX_DRAWS = 2000


@dataclass(frozen=True, eq=False)
class LoopMotion:
    """A loop that will be run `cycles` times at `speed` [m/s]. `kind` is `excitation` or `validation`."""

    name: str
    kind: str
    loop: Loop
    speed: float
    cycles: int


@dataclass(frozen=True, eq=False)
class Plan:
    """The excitation loop, how it was found (`fitness`, `evaluated`, `history`), and the validation motions."""

    excitation: LoopMotion
    search: dict[str, Any]
    validation: tuple[LoopMotion, ...]


def plan_once(recipe: Recipe, run: RunFolder, console: Console) -> Plan:
    """Search, or take the plan of an earlier start of this run. Writes `plan.json` and the program.

    Raises:
        InputError: the sub-region cannot be reached, or no loop in it keeps all limits.
    """
    file = f"program{recipe.dialect.suffix}"
    if run.finished("plan"):
        for name, key in {"plan.json": "plan", file: "program"}.items():
            run.check_file(name, run.state.get(key))
        plan = replan(recipe, run.file("plan.json"))
        if sha256_text(program_text(recipe, plan.excitation)) != run.state["program"]:
            raise InputError(
                f"{run.path}: plan.json does not lead to the program that was planned; was the agent updated since? "
                "Start a new run"
            )
        return plan
    plan = make_plan(recipe, console)
    genomes = [motion.loop.genome.tolist() for motion in plan.validation]
    planned = run.write_json("plan.json", {"schema": "plan/1", "search": plan.search, "validation": genomes})
    program = run.write_text(file, program_text(recipe, plan.excitation))
    run.note(
        plan=sha256_file(planned),
        program=sha256_file(program),
        inputs_sha256={**run.state["inputs_sha256"], file: sha256_file(program)},
    )
    return plan


def make_plan(recipe: Recipe, console: Console) -> Plan:
    """Search for the excitation loop and draw the validation motions.

    Raises:
        InputError: as in `plan_once`.
    """
    excitation, search = search_loop(recipe, console)
    console.step(f"drawing {recipe.validate.motions} validation motions at {recipe.validate.speed:g} m/s")
    return Plan(excitation, search, tuple(_validation(recipe, _draw_validation(recipe, console))))


def search_loop(
    recipe: Recipe, console: Console, engine: TaskEngine | None = None
) -> tuple[LoopMotion, dict[str, Any]]:
    """Search for the excitation loop and store it; returns it with how it was found.

    Raises:
        InputError: as in `plan_once`.
    """
    like = recipe.motion.via_points.like
    skipped = {} if like is None or Path(like).suffix.lower() == ".mcap" else _job(recipe, Path(like))[1]
    if skipped:
        words = ", ".join(f"{word} {count}" for word, count in sorted(skipped.items(), key=lambda item: -item[1])[:8])
        console.step(f"{like}: {sum(skipped.values())} lines without motion are skipped ({words})")

    problem = loop_problem(recipe, recipe.motion.speed)
    for missed in check_sub_region(problem):
        console.detail(f"out of reach, so the search avoids it: {missed}")
    settings = recipe.search
    console.step(f"search: {settings.method}, {settings.population} candidates x {settings.generations} generations")
    result = search(
        problem,
        method=settings.method,
        population=settings.population,
        generations=settings.generations,
        seed=settings.seed,
        engine=engine,
        progress=lambda g: console.progress(
            f"generation {g.number + 1} of {settings.generations}: fitness {g.best:.2f}, "
            f"{g.feasible} of {settings.population} keep all limits",
            (g.number + 1) / settings.generations,
        ),
    )
    loop = result.loop
    duration = loop.trajectory.duration
    console.say(f"  fitness {result.fitness:.2f} from {result.evaluated} candidates; a cycle takes {duration:.1f} s")
    motion = _excitation(recipe, loop)
    text = program_text(recipe, motion)
    keep_loop(recipe, loop.genome, loop.poses, loop.start, result.fitness, motion.name, text)
    return motion, result.to_dict()


def loop_problem(recipe: Recipe, speed: float) -> LoopProblem:
    """The constraints of a search or a draw at this speed [m/s]."""
    return LoopProblem(
        robot=recipe.robot,
        regions=via_regions(recipe),
        settings=recipe.motion.settings_at(speed),
        tool=recipe.tool,
        keep_out=recipe.cell.keep_out,
        joint_ranges=recipe.cell.joint_ranges,
        interpolator=recipe.interpolator,
        period=1.0 / recipe.record.rate,
    )


def program_text(recipe: Recipe, motion: LoopMotion) -> str:
    """Program of a planned motion. It sets every frame, so earlier programs do not change its meaning."""
    settings = with_frames(recipe.motion.settings_at(motion.speed), recipe.tool)
    approach = settings.changed(speed_override=APPROACH_SPEED)
    points = _targets(recipe, motion.loop)
    start = JointTarget(np.asarray(motion.loop.start, dtype=float))
    loop = LoopProgram.of(points, settings, motion.cycles, approach, start)
    return recipe.dialect.write_loop(motion.name, loop, recipe.robot)


def via_regions(recipe: Recipe) -> Any:
    """The recipe's sub-region as the search needs it."""
    via = recipe.motion.via_points
    count = via.count or 0  # the section requires one of the four, and a count for all but points
    if via.box is not None:
        return ViaRegions.from_box(count, via.box.centre, via.box.size, via.box.orientation, via.box.cone)
    if via.points is not None:
        return ViaRegions.from_points([point.pose for point in via.points], [point.range for point in via.points])
    if via.tube is not None:
        return ViaRegions.from_tube(count, [pose_of(pose) for pose in via.tube.path], via.tube.radius, via.tube.cone)
    return ViaRegions.from_envelope(count, _task_poses(recipe, Path(via.like or "")), via.around or 0.0)


def _task_poses(recipe: Recipe, path: Path) -> np.ndarray:
    """(S, 4, 4) poses of the job that the recipe's `like` names: a program or a log."""
    if path.suffix.lower() == ".mcap":
        q = read_log(path, recipe.robot).position
        return Dynamics(recipe.robot, recipe.tool).tcp_pose(q[:: max(1, len(q) // 2000)])

    kinematics = kinematics_for(recipe.robot, recipe.tool)
    text, dialect = _job(recipe, path)[0], dialect_of(path) or recipe.dialect
    ways = list(trajectories(recipe, dialect.read(text, str(path), recipe.robot).run(), kinematics.middle))
    if not ways:
        raise InputError(f"{path}: nothing in this program moves the arm; name the program that does")
    first = ways[0][0]  # leads from an arbitrary start to the job
    job = [chain for moves, chain in ways if moves is not first] or [chain for _, chain in ways]
    return np.concatenate([kinematics.forward(chain.q[::25]) for chain in job])


def _job(recipe: Recipe, path: Path) -> tuple[str, dict[str, int]]:
    """The moving part of a job's program, and how often each word without motion was skipped."""
    dialect = dialect_of(path) or recipe.dialect
    text = read_text(path, LARGEST_PROGRAM)
    listing = dialect.companion(path)
    variables = "" if listing is None else read_bytes(listing, LARGEST_PROGRAM).decode("utf-8", errors="replace")
    return dialect.job(text, str(path), recipe.robot, variables)


def replan(recipe: Recipe, path: Path) -> Plan:
    """The plan that a run's `plan.json` holds.

    Raises:
        InputError: it is damaged, or no plan for this recipe.
    """
    stored = read_json(path)
    if isinstance(stored, dict) and "folder" in stored:  # its schema was `plan/1` once, as a run's is
        raise InputError(f"{path}: is what `agent plan` wrote of a loop, not the plan of a run; start a new run")
    try:
        fast, slow = (Candidates(loop_problem(recipe, speed)) for speed in (recipe.motion.speed, recipe.validate.speed))
        loop = fast.loop(np.array(stored["search"]["genome"]))
        validation = [slow.loop(np.array(genome)) for genome in stored["validation"]]
        return Plan(_excitation(recipe, loop), stored["search"], tuple(_validation(recipe, validation)))
    except (InputError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: no plan for this recipe ({what}); start a new run") from None


def _excitation(recipe: Recipe, loop: Loop) -> LoopMotion:
    return LoopMotion("excite", "excitation", loop, recipe.motion.speed, recipe.record.cycles)


def _validation(recipe: Recipe, loops: Sequence[Loop]) -> Iterator[LoopMotion]:
    for number, loop in enumerate(loops, 1):
        yield LoopMotion(f"valid{number:02d}", "validation", loop, recipe.validate.speed, 1)


def _draw_validation(recipe: Recipe, console: Console) -> list[Loop]:
    """Random loops that keep all limits, as many as the recipe validates on."""
    candidates, wanted = Candidates(loop_problem(recipe, recipe.validate.speed)), recipe.validate.motions
    rng = np.random.default_rng(recipe.validate.seed)
    loops: list[Loop] = []
    reason = ""
    for draw in range(_MAX_DRAWS):
        loop = candidates.checked_loop(rng.uniform(size=candidates.problem.genes))
        if isinstance(loop, LoopScore):
            reason = loop.reason
            continue
        try:
            check_cell(recipe, loop.trajectory)
        except InputError as error:
            reason = str(error)
            continue
        loops.append(loop)
        broken = draw + 1 - len(loops)
        console.progress(f"{len(loops)} of {wanted} drawn, {broken} broke a limit", len(loops) / wanted)
        if len(loops) == wanted:
            return loops
    raise InputError(
        f"only {len(loops)} of {_MAX_DRAWS} random motions in the sub-region keep all limits at "
        f"{recipe.validate.speed:g} m/s; the last one: {reason}. Move or shrink motion.via_points"
    )


def _targets(recipe: Recipe, loop: Loop) -> list[Target]:
    """Via-points for a controller: poses with configuration flags if the arm has them, else joint positions."""
    if isinstance(loop.moves[0].target, JointTarget):
        *flown, closing = (move.target for move in loop.moves)
        return [closing, *flown]
    kinematics = kinematics_for(recipe.robot, recipe.tool)
    passed = via_joints(kinematics, loop)
    if not hasattr(kinematics, "solve_configuration"):
        return [JointTarget(position) for position in passed]

    return [
        CartesianTarget(pose, kinematics.configuration_text(position))
        for pose, position in zip(loop.poses, passed, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class PlanFiles:
    """Output of `agent plan`: its folder, the name of the program, the loop, and how it was found."""

    folder: Path
    program: str
    loop: ShownLoop
    search: dict[str, Any]

    @property
    def limit_use(self) -> dict[str, float]:
        """Largest share of each kind of joint limit that the loop uses."""
        return {kind: float(values.max()) for kind, values in self.loop.limit_use.items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "schema": "planned-loop/1",
            "folder": str(self.folder),
            "fitness": self.search["fitness"],
            "cycle_s": self.loop.cycle.duration,
            "description": self.loop.description,
            "largest_use_of_limits": self.limit_use,
            "files": [self.program, "plan.json", "plan.html"],
        }

    def text(self) -> str:
        """A few lines for people."""
        use = ", ".join(f"{kind} {100 * value:.0f} %" for kind, value in self.limit_use.items())
        lines = [
            f"fitness {self.search['fitness']:.2f} (higher is better)",
            self.loop.description,
            f"largest use of the joint limits: {use}",
        ]
        return "\n".join([*lines, *(str(self.folder / name) for name in (self.program, "plan.html"))])


def plan_recipe(recipe: Recipe, folder: Path, console: Console, engine: TaskEngine | None = None) -> PlanFiles:
    """Search, check the cell, and write program, page and data into a new folder. Opens no port.

    The `engine` scores candidates; default: one process per core.

    Args:
        recipe: whose loop is searched.
        folder: to write to; it must not hold a plan yet.
        console: where progress is shown.
        engine: scores candidates; None: one process per core.

    Raises:
        InputError: as in `plan_once`, or the folder holds a plan already.
        AgentError: the folder cannot be made.
    """
    if (folder / "plan.json").exists():
        raise InputError(f"{folder}: holds a plan already; name another folder with -o, or move it away")
    made = not folder.exists()
    make_folder(folder, "the plan")  # before the search, which may take long
    try:
        motion, search = search_loop(recipe, console, engine)
        check_cell(recipe, motion.loop.trajectory)
    except BaseException:
        if made:
            folder.rmdir()
        raise
    text, loop = program_text(recipe, motion), shown_loop(recipe, motion)
    files = PlanFiles(folder, f"program{recipe.dialect.suffix}", loop, search)
    for name, content in {files.program: text, **recipe.dialect.messages(text)}.items():
        write_atomically(folder / name, content)
    write_atomically(folder / "plan.html", plan_report(loop, search, text))
    write_json(folder / "plan.json", {**files.to_dict(), "search": search})
    return files


def shown_loop(recipe: Recipe, motion: LoopMotion) -> ShownLoop:
    """A planned loop, for a page."""
    loop = motion.loop
    return ShownLoop(recipe, loop.trajectory, loop.poses[:, :3, 3], motion.cycles)
