"""`agent check`: everything that could stop a calibration, found without motion and reported all at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from agent.core import AgentError, Console, ControllerError, InputError, counted
from agent.excitation import Candidates, LoopScore, check_sub_region
from agent.link import answering, check_effort
from agent.motion import tool_frame
from agent.pipeline.planning.plan import loop_problem
from agent.pipeline.setup.findings import CheckedItem, Findings
from agent.recipe import Recipe, examine_recipe
from agent.robot import not_judged_text
from agent.safety import check_frames, check_period, check_throughput, frames_text
from drivers.protocol import AcceptsViaPoints, BoundsMotion, ReportsFrames

#: Random loops that are run through the interpolator and the cell.
LOOPS = 50
#: A smaller share of feasible loops makes a search hard.
FEW = 0.2


def check_recipe(path: Path, console: Console) -> Findings:
    """Recipe, reach, limits, cell and controller.

    A wrong key that has a default does not stop the check: the rest is checked with the default.

    Raises:
        InputError: no such file, or not YAML.
    """
    console.step(f"checking {path}")
    recipe, faults = examine_recipe(path)
    findings = [CheckedItem("recipe", fault, 2) for fault in faults]
    if recipe is None:
        return Findings(tuple(findings))
    if not faults:
        complete = f"{path} is complete; robot {recipe.robot.name}, {counted(recipe.robot.dof, 'joint')}"
        findings.append(CheckedItem("recipe", complete))
    if not_judged := not_judged_text(recipe.robot, recipe.gate.normalised_rmse):
        findings.append(CheckedItem("gate", not_judged))
    looks: dict[str, Callable[[], str]] = {
        "sub-region": lambda: _reach(recipe),
        "loops": lambda: _feasible(recipe, recipe.motion.speed, recipe.search.seed, console),
        "validation": lambda: _feasible(recipe, recipe.validate.speed, recipe.validate.seed, console),
        "controller": lambda: _controller(recipe),
    }
    for subject, look in looks.items():
        console.step(f"checking {subject}")
        try:
            findings.append(CheckedItem(subject, look()))
        except Exception as error:
            code = getattr(error, "exit_code", None)
            if code is None and not isinstance(error, AgentError):
                raise
            findings.append(CheckedItem(subject, str(error), code or 2))
    return Findings(tuple(findings))


def _reach(recipe: Recipe) -> str:
    missed = check_sub_region(loop_problem(recipe, recipe.motion.speed))
    if not missed:
        return "all corners and orientations asked can be reached"
    return f"{len(missed)} poses are out of reach and the search avoids them; the first: {missed[0]}"


def _feasible(recipe: Recipe, speed: float, seed: int, console: Console) -> str:
    candidates = Candidates(loop_problem(recipe, speed))
    rng = np.random.default_rng(seed)
    broken = []
    for number in range(LOOPS):
        checked = candidates.checked_loop(rng.uniform(size=candidates.problem.genes))
        if isinstance(checked, LoopScore):
            broken.append(checked)
        console.progress(f"{number + 1} of {LOOPS} random loops at {speed:g} m/s tried", (number + 1) / LOOPS)
    text = f"{LOOPS - len(broken)} of {LOOPS} random loops at {speed:g} m/s keep all limits and clear of the cell"
    if not broken:
        return text
    nearest = min(broken, key=lambda score: score.excess)
    text += f"; one that does not: {nearest.reason}"
    if len(broken) > (1 - FEW) * LOOPS:
        raise InputError(f"{text}. Move or shrink motion.via_points, or lower the speed")
    return text


def _controller(recipe: Recipe) -> str:
    address = recipe.controller.public_address
    with answering(recipe) as (driver, identity):
        if not identity.watch_only:
            check_period(identity, recipe.record.rate, address)
        check_throughput(driver, identity, address)
        effort = check_effort(driver, recipe.robot, recipe.tool, address)
        status = driver.status()
        frames = driver.frames() if isinstance(driver, ReportsFrames) else {}
        if isinstance(driver, AcceptsViaPoints):
            tool = {recipe.dialect.frame_names["tool"]: tool_frame(recipe.tool)}
            check_frames("of via-points", tool, driver, address)
    modes = [
        f"mode {status.mode}",
        f"drives {'on' if status.drives_on else 'off'}",
        f"cell {'closed' if status.cell_closed else 'open'}",
    ]
    state = [
        *(modes if status.modes_known else ["mode, drives and emergency stop not readable on this link"]),
        f"override {100 * status.override:.0f} %" if status.override_known else "override not readable on this link",
        *(["emergency stop pressed"] if status.emergency_stop else []),
        *(f"alarm {alarm}" for alarm in status.alarms),
        *([identity.watch_only] if identity.watch_only else []),
        *([f"somebody has to stand by: {identity.unguarded}"] if identity.unguarded else []),
        *([frames_text(frames)] if frames else []),
        *([effort] if effort else []),
    ]
    reached = (
        f"{identity.robot}, serial {identity.serial}, {identity.controller} {identity.version} at "
        f"{address}, {1 / identity.period:g} Hz: {', '.join(state)}"
    )
    if identity.unguarded and not isinstance(driver, BoundsMotion):
        raise ControllerError(reached)
    return reached
