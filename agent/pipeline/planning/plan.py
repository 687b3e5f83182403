"""What will move, settled before anything moves: the loop, the validation motions and their margins."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import Console, InputError, TaskEngine, read_json, sha256_file, sha256_text
from agent.excitation import Candidates, Loop, LoopProblem, LoopScore, check_sub_region, search
from agent.link import check_cell
from agent.pipeline.planning.loop_program import LoopMotion
from agent.pipeline.planning.sub_region import moving_part, via_regions
from agent.recipe import Recipe
from agent.runs import RunFolder, keep_loop

#: Largest number of random motions that are drawn for the validation.
_MAX_DRAWS = 2000


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
        if sha256_text(plan.excitation.program) != run.state["program"]:
            raise InputError(
                f"{run.path}: plan.json does not lead to the program that was planned; was the agent updated since? "
                "Start a new run"
            )
        return plan
    plan = make_plan(recipe, console)
    genomes = [motion.loop.genome.tolist() for motion in plan.validation]
    planned = run.write_json("plan.json", {"schema": "plan/1", "search": plan.search, "validation": genomes})
    program = run.write_text(file, plan.excitation.program)
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
    return Plan(excitation, search, LoopMotion.validation(recipe, _draw_validation(recipe, console)))


def search_loop(
    recipe: Recipe, console: Console, engine: TaskEngine | None = None
) -> tuple[LoopMotion, dict[str, Any]]:
    """Search for the excitation loop and store it; returns it with how it was found.

    Raises:
        InputError: as in `plan_once`.
    """
    like = recipe.motion.via_points.like
    skipped = {} if like is None or Path(like).suffix.lower() == ".mcap" else moving_part(recipe, Path(like))[1]
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
    motion = LoopMotion.excitation(recipe, loop)
    keep_loop(recipe, loop.genome, loop.poses, loop.start, result.fitness, motion.name, motion.program)
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
        return Plan(LoopMotion.excitation(recipe, loop), stored["search"], LoopMotion.validation(recipe, validation))
    except (InputError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: no plan for this recipe ({what}); start a new run") from None


def _draw_validation(recipe: Recipe, console: Console) -> list[Loop]:
    """Random loops that keep all limits, as many as the recipe validates on."""
    candidates, wanted = Candidates(loop_problem(recipe, recipe.validate.speed)), recipe.validate.motions
    rng = np.random.default_rng(recipe.validate.seed)
    loops: list[Loop] = []
    draws, reason = 0, ""
    while len(loops) < wanted:
        if draws == _MAX_DRAWS:
            raise InputError(
                f"only {len(loops)} of {_MAX_DRAWS} random motions in the sub-region keep all limits at "
                f"{recipe.validate.speed:g} m/s; the last one: {reason}. Move or shrink motion.via_points"
            )
        draws += 1
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
        console.progress(f"{len(loops)} of {wanted} drawn, {draws - len(loops)} broke a limit", len(loops) / wanted)
    return loops
