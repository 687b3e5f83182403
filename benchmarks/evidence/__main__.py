"""`python -m benchmarks.evidence run PIECE [--machines N] [--minutes M]`, `… page`: see docs/evidence.md."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from agent.excitation import one_blas_thread
from agent.recipe import Recipe, load_recipe
from benchmarks.evidence import criteria, few_data, local, page, search
from benchmarks.evidence.loops import FIRST_MACHINE
from benchmarks.evidence.results import FOLDER, ROOT, Results

RECIPE = Path(__file__).with_name("recipe.yaml")
#: Pieces by name.
PIECES: dict[str, tuple[Callable, Callable]] = {
    "local": (local.settings, local.measure),
    "few-data": (few_data.settings, few_data.measure),
    "criteria": (criteria.settings, criteria.measure),
    **{f"search-{budget}": (search.settings_at(budget), search.measure) for budget in search.BUDGETS},
}


def run(piece: str, machines: int, minutes: float, folder: Path, recipe: Recipe) -> int:
    """Compute what is missing of a piece, machine by machine; how much is left. After so many minutes nothing new is
    started, but something always is."""
    results, loops = Results(folder, piece), Results(folder, "loops")
    settings, measure = PIECES[piece]
    memory: dict = {}
    wanted = [(m, s) for m in range(FIRST_MACHINE, FIRST_MACHINE + machines) for s in settings(recipe)]
    missing = [(machine, setting) for machine, setting in wanted if results.get(machine, setting) is None]
    end = time.monotonic() + 60 * minutes
    for done, (machine, setting) in enumerate(missing):
        if done and time.monotonic() > end:
            return len(missing) - done
        started = time.process_time()
        with one_blas_thread():
            values = measure(recipe, machine, setting, loops, memory)
        seconds = time.process_time() - started
        results.keep(machine, setting, values, seconds)
        print(f"{piece}: machine {machine}, {setting}: {seconds:.0f} s", file=sys.stderr, flush=True)
    return 0


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.evidence")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of the results (default: build/evidence)")
    parser.add_argument("--recipe", type=Path, default=RECIPE, help="robot, sub-region and size of the searches")
    commands = parser.add_subparsers(dest="command", required=True)
    of_run = commands.add_parser("run", help="compute what is missing of a piece")
    of_run.add_argument("piece", choices=PIECES)
    of_run.add_argument("--machines", type=int, default=10)
    of_run.add_argument("--minutes", type=float, default=10.0, help="start nothing new after so long (default: 10)")
    of_page = commands.add_parser("page", help="write the page from the results that are there")
    of_page.add_argument("--docs", type=Path, default=ROOT / "docs")
    chosen = parser.parse_args(arguments)
    recipe = load_recipe(chosen.recipe)
    if chosen.command == "page":
        print(page.write(chosen.folder, chosen.docs, recipe, PIECES))
        return
    left = run(chosen.piece, chosen.machines, chosen.minutes, chosen.folder, recipe)
    print(f"{left} left; the same command goes on" if left else "complete", file=sys.stderr)


if __name__ == "__main__":
    main()
