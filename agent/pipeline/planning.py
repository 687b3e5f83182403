"""What will move, settled before anything moves: the excitation loop, the validation motions, and their programs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import Console, InputError, TaskEngine, read_json, sha256_file, sha256_text
from agent.link import check_cell, check_load, plan_statements
from agent.recipe import Recipe
from agent.runs import RunFolder

if TYPE_CHECKING:
    from agent.excitation import Loop, LoopProblem
    from agent.motion import Target, Trajectory
    from agent.robot import TorqueLimits

#: The arm goes to the first point at this share of its joint speeds.
APPROACH_SPEED = 0.1
#: A random validation motion that breaks a limit is drawn again, at most so often in all.
_MAX_DRAWS = 2000


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """A loop that will be run `cycles` times at `speed` [m/s]. `kind` is `excitation` or `validation`."""

    name: str
    kind: str
    loop: Loop
    speed: float
    cycles: int


@dataclass(frozen=True, eq=False)
class Plan:
    """The excitation loop, how it was found (`fitness`, `evaluated`, `history`), and the validation motions."""

    excitation: PlannedMotion
    search: dict[str, Any]
    validation: tuple[PlannedMotion, ...]


def plan_once(recipe: Recipe, run: RunFolder, console: Console) -> Plan:
    """Search, or take what an earlier start of this run found. Writes `plan.json` and the program.

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
    excitation, found = search_loop(recipe, console)
    console.step(f"drawing {recipe.validate.motions} validation motions at {recipe.validate.speed:g} m/s")
    return Plan(excitation, found, tuple(_draw_validation(recipe, console)))


def search_loop(
    recipe: Recipe, console: Console, engine: TaskEngine | None = None
) -> tuple[PlannedMotion, dict[str, Any]]:
    """The excitation loop, and how it was found. The loop is kept for later.

    Raises:
        InputError: as in `plan_once`.
    """
    _tell_passed_over(recipe, console)
    from agent.excitation import check_sub_region, search
    from agent.runs import keep_loop

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
    motion = PlannedMotion("excite", "excitation", loop, recipe.motion.speed, recipe.record.cycles)
    text = program_text(recipe, motion)
    keep_loop(recipe, loop.genome, loop.poses, loop.start, result.fitness, motion.name, text)
    return motion, result.to_dict()


def loop_problem(recipe: Recipe, speed: float) -> LoopProblem:
    """What a search or a draw at this speed [m/s] has to keep to."""
    from agent.excitation import LoopProblem

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


def program_text(recipe: Recipe, motion: PlannedMotion) -> str:
    """Program of a planned motion; it sets every frame itself, so it means the same whatever ran before."""
    from agent.motion import JointTarget, with_frames

    settings = with_frames(recipe.motion.settings_at(motion.speed), recipe.tool)
    approach = settings.changed(speed_override=APPROACH_SPEED)
    points = _targets(recipe, motion.loop)
    start = JointTarget(np.asarray(motion.loop.start, dtype=float))
    return recipe.dialect.write_loop(motion.name, points, settings, motion.cycles, approach, recipe.robot, start)


def programs(
    recipe: Recipe, motions: Sequence[PlannedMotion], start: np.ndarray
) -> list[tuple[str, list[Trajectory], float]]:
    """Text, set-points from stop to stop, and duration [s] of motions that run one after the other from `start` (n,).

    Every approach and every loop is checked against the cell before the first of them moves.

    Raises:
        InputError: an approach or a loop breaks a limit.
    """
    ready = []
    checked: set[int] = set()
    for motion in motions:
        text = program_text(recipe, motion)
        _, chains = plan_statements(recipe, text, f"{motion.name}{recipe.dialect.suffix}", start)
        for chain in chains:
            if id(chain) not in checked:
                check_cell(recipe, chain)
                checked.add(id(chain))
        start = chains[-1].q[-1]
        ready.append((text, chains, float(sum(chain.duration for chain in chains))))
    return ready


def checked_chains(
    recipe: Recipe, text: str, path: str, start: np.ndarray, limits: TorqueLimits | None = None
) -> tuple[str, list[Trajectory]]:
    """Name of a program, and its set-points from stop to stop from `start` (n,), all checked against the cell and,
    where a known mass is at the flange, against what the drives can bear (`limits`).

    Raises:
        InputError: one of them breaks a limit.
    """
    name, chains = plan_statements(recipe, text, path, start)
    for chain in {id(chain): chain for chain in chains}.values():
        check_cell(recipe, chain)
        check_load(limits, chain)
    return name, chains


def via_regions(recipe: Recipe) -> Any:
    """The recipe's sub-region as the search needs it."""
    from agent.motion import ViaRegions, pose_of

    via = recipe.motion.via_points
    count = via.count or 0  # never: the section requires one of the four, and their number
    if via.box is not None:
        return ViaRegions.from_box(count, via.box.centre, via.box.size, via.box.orientation, via.box.cone)
    if via.points is not None:
        return ViaRegions.from_points([point.pose for point in via.points], [point.range for point in via.points])
    if via.tube is not None:
        return ViaRegions.from_tube(count, [pose_of(pose) for pose in via.tube.path], via.tube.radius, via.tube.cone)
    return ViaRegions.from_envelope(count, _task_poses(recipe, Path(via.like or "")), via.around or 0.0)


def _task_poses(recipe: Recipe, path: Path) -> np.ndarray:
    """(S, 4, 4) poses of the job that the recipe's `like` names: a program or a log."""
    from agent.robot import Dynamics

    if path.suffix.lower() == ".mcap":
        from agent.recording import read_log

        q = read_log(path, recipe.robot).position
        return Dynamics(recipe.robot, recipe.tool).tcp_pose(q[:: max(1, len(q) // 2000)])
    from agent.motion import dialect_of
    from agent.robot import kinematics_for

    kinematics = kinematics_for(recipe.robot, recipe.tool)
    _, chains = plan_statements(recipe, _job(recipe, path)[0], str(path), kinematics.middle, dialect_of(path))
    if not chains:
        raise InputError(f"{path}: nothing in this program moves the arm; name the program that does")
    job = chains[1:] or chains  # the first leads from an arbitrary start to the job
    return np.concatenate([kinematics.forward(chain.q[::25]) for chain in job])


def _job(recipe: Recipe, path: Path) -> tuple[str, dict[str, int]]:
    """What moves in the program of a job, and how often each word was passed over."""
    from agent.motion import dialect_of

    dialect = dialect_of(path) or recipe.dialect
    try:
        text = path.read_text(encoding="utf-8")
        beside = dialect.companion(path)
        companion = "" if beside is None else beside.read_text(encoding="utf-8", errors="replace")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    return dialect.job(text, str(path), recipe.robot, companion)


def _tell_passed_over(recipe: Recipe, console: Console) -> None:
    """What of the job's program was passed over, because it does not move."""
    like = recipe.motion.via_points.like
    if like is not None and Path(like).suffix.lower() != ".mcap":
        passed = _job(recipe, Path(like))[1]
        words = ", ".join(f"{word} {count}" for word, count in sorted(passed.items(), key=lambda item: -item[1])[:8])
        if passed:
            console.step(f"{like}: {sum(passed.values())} lines without motion are skipped ({words})")


def replan(recipe: Recipe, path: Path) -> Plan:
    """The plan that a run's `plan.json` holds.

    Raises:
        InputError: it is damaged, or no plan for this recipe.
    """
    stored = read_json(path)
    if isinstance(stored, dict) and "folder" in stored:  # its schema was `plan/1` once, as a run's is
        raise InputError(f"{path}: is what `agent plan` wrote of a loop, not the plan of a run; start a new run")
    try:
        return _replanned(recipe, stored)
    except (InputError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: no plan for this recipe ({what}); start a new run") from None


def _replanned(recipe: Recipe, stored: dict[str, Any]) -> Plan:
    from agent.excitation import Candidates

    fast = Candidates(loop_problem(recipe, recipe.motion.speed))
    slow = Candidates(loop_problem(recipe, recipe.validate.speed))
    loop = fast.loop(np.array(stored["search"]["genome"]))
    excitation = PlannedMotion("excite", "excitation", loop, recipe.motion.speed, recipe.record.cycles)
    validation = [
        PlannedMotion(f"valid{k + 1:02d}", "validation", slow.loop(np.array(genome)), recipe.validate.speed, 1)
        for k, genome in enumerate(stored["validation"])
    ]
    return Plan(excitation, stored["search"], tuple(validation))


def _draw_validation(recipe: Recipe, console: Console) -> Iterator[PlannedMotion]:
    from agent.excitation import Candidates, LoopScore

    candidates = Candidates(loop_problem(recipe, recipe.validate.speed))
    rng = np.random.default_rng(recipe.validate.seed)
    found, reason = 0, ""
    for draw in range(_MAX_DRAWS):
        if found == recipe.validate.motions:
            return
        genome = rng.uniform(size=candidates.problem.genes)
        loop = candidates.checked_loop(genome)
        if isinstance(loop, LoopScore):
            reason = loop.reason
            continue
        try:
            check_cell(recipe, loop.trajectory)
        except InputError as error:
            reason = str(error)
            continue
        found += 1
        yield PlannedMotion(f"valid{found:02d}", "validation", loop, recipe.validate.speed, 1)
        done = found / recipe.validate.motions
        console.progress(f"{found} of {recipe.validate.motions} drawn, {draw + 1 - found} broke a limit", done)
    if found < recipe.validate.motions:
        raise InputError(
            f"only {found} of {_MAX_DRAWS} random motions in the sub-region keep all limits at "
            f"{recipe.validate.speed:g} m/s; the last one: {reason}. Move or shrink motion.via_points"
        )


def _targets(recipe: Recipe, loop: Loop) -> list[Target]:
    """Via-points as a controller takes them: poses with flags where the arm has flags, joint positions elsewhere."""
    from agent.excitation import via_joints
    from agent.motion import CartesianTarget, JointTarget
    from agent.robot import kinematics_for

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
