"""What is measured, piece by piece. Apart from the command line: a worker cannot import what runs as `__main__`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

from agent.excitation import one_blas_thread
from agent.recipe import Recipe
from benchmarks.evidence import criteria, few_data, local, search
from benchmarks.evidence.results import Results

#: Pieces by name.
PIECES: dict[str, tuple[Callable, Callable]] = {
    "local": (local.settings, local.measure),
    "few-data": (few_data.settings, few_data.measure),
    "criteria": (criteria.settings, criteria.measure),
    **{f"search-{budget}": (search.settings_at(budget), search.measure) for budget in search.BUDGETS},
}


def complete(machine: int, piece: str, folder: Path, recipe: Recipe, end: float) -> int:
    """Compute what is missing of a machine in a piece, and keep it; how many lines are left. At `end`, a time [s] as of
    `time.time`, nothing new is started."""
    results, loops = Results(folder, piece), Results(folder, "loops")
    settings, measure = PIECES[piece]
    memory: dict = {}
    missing = [setting for setting in settings(recipe) if results.get(machine, setting) is None]
    for done, setting in enumerate(missing):
        if time.time() > end:
            return len(missing) - done
        started = time.process_time()
        with one_blas_thread():
            values = measure(recipe, machine, setting, loops, memory)
        seconds = time.process_time() - started
        results.keep(machine, setting, values, seconds)
        print(f"{piece}: machine {machine}, {setting}: {seconds:.0f} s", file=sys.stderr, flush=True)
    return 0
