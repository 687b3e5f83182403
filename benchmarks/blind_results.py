"""Results of the blind check on the documentation: the agent and both baselines on the same fresh runs of each world.

    python -m benchmarks.blind_results --cases 100 --folder DIR [--world W …] [--seed S] [-o docs/measured]

Draws, answers and scores each world in DIR, and writes `blind-check-results.jsonl` (one line a run and tool) and the
page that is made of it; `blind-check-positions` of `--world positions`, which has no torque for the baselines.
What DIR holds already is not done again, so repeat an interrupted command. Without `--seed` the laws are those
reserved for judgement. At the end it prints CPU time, and the SHA-256 of each key.
"""

from __future__ import annotations

import argparse
import resource
import shutil
from functools import partial
from pathlib import Path

from agent.blind_check.own_check import BlindCheck, score_answers
from agent.blind_check.report import PAGE, RESULTS, read_results, write_results
from agent.blind_check.worlds import world_of
from agent.core import AgentError, Console, LocalProcesses, TaskEngine, available_cores, sha256_file
from benchmarks.blind_baselines import METHODS, answer_of


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, required=True, help="runs of each world")
    parser.add_argument("--folder", type=Path, required=True, help="where runs, keys and answers are kept")
    parser.add_argument("--world", nargs="+", default=["emulator", "mujoco"], help="emulator and mujoco if left out")
    parser.add_argument("--seed", type=int, help="draw by the laws of development")
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/measured"), help="folder of table and page")
    asked = parser.parse_args()
    results = []
    with LocalProcesses(available_cores()) as engine:
        for name in asked.world:
            check = BlindCheck(world_of(name), asked.cases, (asked.folder / name).absolute(), asked.seed)
            results += read_results(scored(check, engine) / RESULTS)
            print(f"{name}: key {sha256_file(check.key_file)}")
    write_results(asked.folder, results)
    asked.out.mkdir(parents=True, exist_ok=True)
    page = f"blind-check-{'positions' if asked.world == ['positions'] else 'results'}"
    for made in (RESULTS, PAGE):
        shutil.copy(asked.folder / made, asked.out / f"{page}{Path(made).suffix}")
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(f"{sum(one.ru_utime + one.ru_stime for one in used) / 60:.1f} CPU minutes in this call")


def scored(check: BlindCheck, engine: TaskEngine) -> Path:
    """Folder with the results of all tools on the runs of a check."""
    check.run(Console(), engine)
    answers = check.folder / "tools"
    answers.mkdir(exist_ok=True)
    shutil.copy(check.folder / "answers.jsonl", answers / "agent_diagnose.jsonl")
    torque = any((check.folder / "export" / "runs").glob("*/baseline"))
    files = [answers / f"{method}.jsonl" for method in METHODS if torque]
    if not all(file.exists() for file in files):
        runs = sorted((check.folder / "export" / "runs").iterdir())
        lines = [""] * len(runs)
        for done in engine.map(partial(answer_of, methods=tuple(METHODS)), runs):
            if done.answer is None:
                raise AgentError(f"baselines: {done.lost}")
            lines[done.number] = done.answer
        for file, column in zip(files, zip(*lines, strict=True), strict=True):
            file.write_text("".join(column), encoding="utf-8")
    score_answers(check.key_file, [answers / "agent_diagnose.jsonl", *files], answers)
    return answers


if __name__ == "__main__":
    main()
