"""What a recalibration goes by: the last accepted run, its model, and the loop that was approved with it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from itertools import chain, islice, repeat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError, read_json
from agent.pipeline import planning
from agent.recipe import Recipe
from agent.runs import PastRun, approved_parts, current_model, differences, open_history, problem, run_key

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.motion import Move, Target
    from agent.runs import StoredLoop

#: Of poses [m] and joints [rad] that are written with nine decimals.
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Reference:
    """The last accepted run of the same loop, the model that is compared with and the run it is of, and the loop."""

    past: PastRun
    run: str
    model: IdentifiedModel
    loop: StoredLoop


def last_accepted(recipe: Recipe, logs: Path, now: datetime) -> PastRun:
    """The newest accepted run with the recipe's robot, tool, cell, sub-region and motion settings, up to now.

    Raises:
        InputError: there is none; what differs from the newest of this robot is named.
    """
    key = run_key(recipe)
    others: list[PastRun] = []
    if logs.is_dir():
        with open_history(logs) as history:
            past = history.last_accepted(recipe.robot.name, key["loop"], key["controller"], now)
            others = [run for run in history.runs(recipe.robot.name) if run.accepted]
        if past is not None:
            return past
    raise InputError(
        f"{recipe.path}: no accepted calibration with this robot, tool, sub-region and motion settings in {logs}"
        f"{_against(recipe, logs, others)}: run `agent calibrate {recipe.path}` first, with somebody watching"
    )


def _against(recipe: Recipe, logs: Path, others: list[PastRun]) -> str:
    """What differs from the newest accepted run of this robot's name, where that can be said."""
    if not others:
        return ""
    run = logs / others[-1].run
    try:
        then = approved_parts(run, read_json(run / "state.json"))
    except InputError:
        return ""
    return f"; against {run.name}: {differences(then, problem(recipe))}"


def find_reference(recipe: Recipe, logs: Path, past: PastRun) -> Reference:
    """The model and the loop that belong to an accepted run.

    Raises:
        InputError: the loop is not kept here, was changed, or does not lie in the recipe's sub-region; or no model.
    """
    from agent.model import IdentifiedModel
    from agent.runs import FOLDER, find_loop

    loop = find_loop(recipe, program=past.program)
    if loop is None:
        raise InputError(
            f"{recipe.path}: {Path.cwd() / FOLDER} has no stored loop for this robot, tool, sub-region and motion "
            f"settings with the program that was accepted in {past.run} ({past.program[:12]}); call from the folder "
            "where it was calibrated, or calibrate again"
        )
    check_loop(recipe, loop)
    current = current_model(logs, past.robot, past.serial)
    applied = current is not None and current.run != past.run and _loop_of(logs, current.run) == past.loop
    if current is not None and applied:
        return Reference(past, current.run, IdentifiedModel.load(current.model), loop)
    return Reference(past, past.run, IdentifiedModel.load(logs / past.run / "model.json"), loop)


def _loop_of(logs: Path, run: str) -> str:
    with open_history(logs) as history:
        return next((past.loop for past in history.runs() if past.run == run), "")


def check_loop(recipe: Recipe, loop: StoredLoop) -> None:
    """A stored loop's program is the one that its genome gives in the recipe's own sub-region, move by move.

    The number of cycles is the program's. Whatever passes lies in the sub-region and keeps the recipe's speed and FLY
    settings; limits and the cell are checked where it is planned from the arm's position.

    Raises:
        InputError: it was changed since it was stored, or is no loop for this recipe.
    """
    from agent.excitation import Candidates
    from agent.motion import Move
    from agent.runs import FOLDER

    def moves(text: str) -> list[Move]:
        program = recipe.dialect.read(text, f"{loop.program_name}{recipe.dialect.suffix}", recipe.robot)
        return [statement for statement in program.run() if isinstance(statement, Move)]

    refused = f"the stored loop {loop.checksum[:12]} is not one that this recipe allows"
    advice = f"move it away from {FOLDER}, then calibrate again"
    try:
        own = Candidates(planning.loop_problem(recipe, recipe.motion.speed)).loop(np.array(loop.genome))
    except InputError as error:
        raise InputError(f"{recipe.path}: {refused}: {error}; {advice}") from None
    motion = planning.PlannedMotion(loop.program_name, "excitation", own, recipe.motion.speed, 1)
    approach, *cycle = moves(planning.program_text(recipe, motion))
    found = moves(loop.program)
    expected = chain([approach], chain.from_iterable(repeat(cycle)))
    for number, (move, wanted) in enumerate(zip(found, islice(expected, len(found)), strict=True)):
        if (what := _unlike(move, wanted)) is not None:
            raise InputError(
                f"{recipe.path}: {refused}: {what} of its move {number + 1} (line {move.line} of its program) is not "
                f"the one that was searched for in motion.via_points; {advice}"
            )
    if len(found) < 1 + len(cycle) or (len(found) - 1) % len(cycle):
        raise InputError(f"{recipe.path}: {refused}: its program does not end where a cycle ends; {advice}")


def _unlike(move: Move, wanted: Move) -> str | None:
    """What differs between two moves."""
    if (move.type, move.fly, move.via) != (wanted.type, wanted.fly, None):
        return "the kind"
    if move.settings != wanted.settings:
        return "a speed, frame or FLY setting"
    return None if _same_target(move.target, wanted.target) else "the target"


def _same_target(one: Target, other: Target) -> bool:
    if type(one) is not type(other) or getattr(one, "configuration", "") != getattr(other, "configuration", ""):
        return False
    there, here = (np.asarray(getattr(t, "pose", getattr(t, "position", None)), dtype=float) for t in (one, other))
    return there.shape == here.shape and bool(np.all(np.abs(there - here) <= _SAME))
