"""`python -m benchmarks.active [--cases N] [--seed S] [--world WORLD] [-o DIR]`; a check that was stopped goes on."""

from __future__ import annotations

import argparse
from pathlib import Path

from agent.core import Console
from benchmarks.active.check import WORLDS, ActiveCheck
from benchmarks.active.scoring import active_text


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.active", description=__doc__)
    parser.add_argument("--cases", type=int, default=40, help="runs to make")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("--world", choices=WORLDS, default=WORLDS[0], help="where the machines come from")
    parser.add_argument("-o", "--out", type=Path, default=Path("active_check"), help="folder, continued if it exists")
    asked = parser.parse_args()
    print(active_text(ActiveCheck(asked.cases, asked.seed, asked.out.absolute(), asked.world).run(Console())))


if __name__ == "__main__":
    main()
