"""Record, diagnose, plan, record: until what is open is settled, or nothing within the budget would settle it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import Bare, Console, Dimension, InputError, parse_quantity
from agent.link import open_link
from agent.pipeline.next_experiment import LONGEST, plan_next
from agent.pipeline.record_plan import record_program
from agent.recipe import Recipe
from agent.runs import RunFolder

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
        program = run.write_text(f"{name}.pdl", motion.text).name
        with open_link(recipe, console, yes, runs) as link:
            log = f"{name}.mcap"
            recording = record_program(link, run, recipe, console, motion.text, program, "experiment", log, name)
        budget -= recording.duration
        further.append(recording.path)
        rounds.append({"after": found.result["verdict"], **motion.to_dict(program)})
