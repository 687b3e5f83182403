"""Record, diagnose, plan, record: until what is open is settled, or nothing within the budget would settle it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import Bare, Console, Dimension, InputError, parse_quantity
from agent.link import check_cell, open_link, plan_statements, report_losses
from agent.pipeline.next_experiment import LONGEST, NextMotion, plan_next
from agent.recipe import Recipe
from agent.runs import RunFolder, sha256_file

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis, Simulated
    from agent.model import Simulator

    #: A diagnosis, what it says in simulation, and the simulator's file that was read.
    Found = tuple[Diagnosis, list[Simulated], Simulator | None]

#: With less motion left than this [s] no further one is planned.
_SHORTEST = 10.0
_LONGEST = 4 * 3600.0


def budget_of(text: str) -> float:
    """Seconds of motion, from what `--budget` says.

    Raises:
        InputError: not a time, or too short for a motion.
    """
    try:
        seconds = parse_quantity(text, Dimension.TIME, Bare("min", least=60.0))
    except InputError as error:
        raise InputError(f"--budget: {error}") from None
    if not _SHORTEST <= seconds <= _LONGEST:
        raise InputError(f"--budget {text}: {_SHORTEST:g} s to {_LONGEST / 3600:g} h of motion are allowed")
    return seconds


def until_sure(
    find: Callable[[Sequence[Path]], Found],
    logs: Sequence[Path],
    recipe: Recipe,
    run: RunFolder,
    console: Console,
    runs: Path,
    yes: bool,
    budget: float,
) -> tuple[list[Path], list[dict[str, Any]], Found]:
    """Further logs, recorded into the run folder as `experiment_01.mcap`, …, what each round asked and found, and what
    all logs together were found to say.

    Args:
        find: the diagnosis of logs; all earlier ones count in every round.
        budget: further motion that is allowed [s].

    Raises:
        AgentError, DriverError: as in recording; what was recorded before stays.
    """
    further: list[Path] = []
    rounds: list[dict[str, Any]] = []
    while True:
        last = find([*logs, *further])
        found = last[0]
        if rounds:
            rounds[-1]["verdict"] = found.result["verdict"]
            console.say(f"round {len(rounds)}: {found.result['verdict']}")
        if found.result["verdict"] in ("explained", "no_gap"):
            return further, rounds, last
        if budget < _SHORTEST:
            console.say("the budget of motion is used up")
            return further, rounds, last
        name = f"experiment_{len(rounds) + 1:02d}"
        motion = plan_next(found, recipe, console, min(LONGEST, budget), name)
        if motion is None:
            return further, rounds, last
        log, duration = _record(motion, name, recipe, run, console, runs, yes)
        budget -= duration
        further.append(log)
        rounds.append({"after": found.result["verdict"], **motion.to_dict(f"{name}.pdl")})


def _record(
    motion: NextMotion, name: str, recipe: Recipe, run: RunFolder, console: Console, runs: Path, yes: bool
) -> tuple[Path, float]:
    """Run a planned motion once; its log, and how long it moved [s]."""
    run.write_text(f"{name}.pdl", motion.text)
    with open_link(recipe, console, yes, runs) as link:
        _, chains = plan_statements(recipe, motion.text, f"{name}.pdl", link.position())
        for chain in chains:
            check_cell(recipe, chain)
        total = float(sum(chain.duration for chain in chains))
        console.step(f"recording {name}, {total:.0f} s")
        recording = link.run(name, motion.text, run.file(f"{name}.mcap"), "experiment", chains, total)
    report_losses(recording, console)
    run.finish(f"{name}.mcap", **recording.to_dict(), sha256=sha256_file(recording.path))
    return recording.path, recording.duration
