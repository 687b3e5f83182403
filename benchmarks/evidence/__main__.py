"""`python -m benchmarks.evidence run PIECE [--machines N] [--minutes M] [--workers N]`, `… page`."""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from agent.recipe import load_recipe
from benchmarks.evidence import page
from benchmarks.evidence.loops import FIRST_MACHINE
from benchmarks.evidence.results import FOLDER, ROOT, Results

RECIPE = Path(__file__).with_name("recipe.yaml")


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.evidence")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of the results (default: the kept ones)")
    parser.add_argument("--recipe", type=Path, default=RECIPE, help="robot, sub-region and size of the searches")
    commands = parser.add_subparsers(dest="command", required=True)
    of_run = commands.add_parser("run", help="compute what is missing of a piece")
    of_run.add_argument("piece", choices=page.PIECES)
    of_run.add_argument("--machines", type=int, default=10)
    of_run.add_argument("--minutes", type=float, default=10.0, help="start nothing new after so long (default: 10)")
    of_run.add_argument("--workers", type=int, default=1, help="local processes; each takes a machine at a time")
    of_page = commands.add_parser("page", help="write the page from the results that are there")
    of_page.add_argument("--docs", type=Path, default=ROOT / "docs/measured")
    chosen = parser.parse_args(arguments)
    recipe = load_recipe(chosen.recipe)
    if chosen.command == "page":
        if not any(len(Results(chosen.folder, piece)) for piece in page.PIECES):
            parser.error(f"{chosen.folder} has no results: run a piece first; the page stays as it is")
        print(page.write(chosen.folder, chosen.docs))
        return
    folder, end = chosen.folder.absolute(), time.time() + 60 * chosen.minutes
    work = functools.partial(page.complete, piece=chosen.piece, folder=folder, recipe=recipe, end=end)
    machines = range(FIRST_MACHINE, FIRST_MACHINE + chosen.machines)
    if chosen.workers > 1:
        with ProcessPoolExecutor(chosen.workers) as pool:
            left = sum(pool.map(work, machines))
    else:
        left = sum(map(work, machines))
    print(f"{left} left; run the same command again to do them" if left else "complete", file=sys.stderr)


if __name__ == "__main__":
    main()
