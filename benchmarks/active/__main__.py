"""`python -m benchmarks.active [--cases N] [--seed S] [-o DIR]`; a check that was stopped continues."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from agent.core import Console, InputError, write_atomically
from agent.model import CATALOGUE
from agent.robot import load_robot
from benchmarks.active.run import ROBOT, ActiveRun
from benchmarks.active.scoring import active_scores, active_text
from fake_controller.actuation import EFFECTS
from fake_controller.withheld.cases import Mix, draw_cases

#: Weak effects of every kind that a further motion meets again: what a short first recording may leave open. A push
#: happens once, and a path that is not the planned one shows in set-points at once.
OPEN = Mix(
    {"one": 0.9, "none": 0.1},
    (0.15, 0.8),
    tuple(sorted(name for name in EFFECTS if CATALOGUE[name].shows_in == "torque" and not CATALOGUE[name].transient)),
)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.active", description=__doc__)
    parser.add_argument("--cases", type=int, default=40, help="runs to make")
    parser.add_argument("--seed", type=int, default=1, help="of the draw")
    parser.add_argument("-o", "--out", type=Path, default=Path("active_check"), help="folder, continued if it exists")
    asked = parser.parse_args()
    try:
        print(active_text(check(asked.cases, asked.seed, asked.out.absolute(), Console())))
    except InputError as error:
        parser.error(str(error))


def check(count: int, seed: int, folder: Path, console: Console) -> dict[str, Any]:
    """Do what is not done yet of `count` runs; returns the scores, which are also in `active_check.json`.

    The first motions of all runs come first, then one further motion of every way, ambiguous runs before the others.

    Raises:
        InputError: no runs, or a folder with another check in it.
    """
    if count < 1:
        raise InputError(f"--cases {count}: at least one run is needed")
    cases = draw_cases(count, seed, load_robot(ROBOT), OPEN)
    key, text = folder / "key.json", json.dumps({"seed": seed, "cases": [asdict(case) for case in cases]}, indent=1)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{folder}: is a file, or lies below one; name a folder with -o") from None
    if key.exists() and key.read_text(encoding="utf-8") != text:
        raise InputError(f"{folder}: holds a check with another seed or number of cases; name another folder with -o")
    write_atomically(key, text)
    runs = [ActiveRun(case, folder) for case in cases]
    for number, run in enumerate(runs):
        run.begin()
        console.progress(f"first motions: {number + 1} of {count} runs", (number + 1) / count)
    for number, run in enumerate(sorted(runs, key=lambda run: not run.ambiguous)):
        run.go_on()
        console.progress(f"further motions: {number + 1} of {count} runs", (number + 1) / count)
    scores = {"schema": "active-check/2", **active_scores([run.entry() for run in runs])}
    path = write_atomically(folder / "active_check.json", json.dumps(scores, indent=1) + "\n")
    return json.loads(path.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
