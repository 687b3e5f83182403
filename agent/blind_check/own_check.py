"""This agent's own blind check: export, diagnose without the key, score. A rerun continues where it stopped."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from agent.blind_check.answers import answer_line, read_answers
from agent.blind_check.exported_runs import INDEX, export_runs
from agent.blind_check.key import NAME, VERSION, Key
from agent.blind_check.report import write_results
from agent.blind_check.scoring import results_of, score
from agent.blind_check.worlds import World
from agent.core import AgentError, Console, InProcess, InputError, TaskEngine, write_atomically

TOOL = "agent diagnose"
_AT_ONCE = 4  # runs that one diagnosing process answers

Question = tuple[str, list[str]]  # a run, and the effects that are left out of the catalogue


@dataclass(frozen=True)
class BlindCheck:
    """`count` runs of a world with a `seed`, from the operating system if None, in a folder that all workers see.

    The runs lie in `export/`, the key in `withheld/`, the answers in `answers.jsonl`.
    """

    world: World
    count: int
    folder: Path
    seed: int | None = None

    @property
    def key_file(self) -> Path:
        """Path of the answer key."""
        return self.folder / "withheld" / "key.json"

    def run(self, console: Console, engine: TaskEngine | None = None) -> dict[str, Any]:
        """Do what is not done yet; returns the scores, and keeps results and page in the folder.

        Raises:
            InputError: no runs, or a folder with another check in it.
            AgentError: a task was lost.
        """
        engine = engine or InProcess()
        key = self._exported(console, engine)
        console.step(f"{len(key.runs)} runs in {self.folder / 'export'}; the key is {self.key_file}")
        answers_file = self.folder / "answers.jsonl"
        self._answer([(run["run"], []) for run in key.runs], answers_file, console, engine)
        named = [run for run in key.runs if run["kind"] not in ("none", "outside")]
        withheld = [(run["run"], sorted({effect["effect"] for effect in run["effects"]})) for run in named]
        console.step("again, each run without its true effects in the catalogue")
        self._answer(withheld, answers_file, console, engine)
        return _scored(key, {TOOL: read_answers(answers_file)}, self.folder)

    def _exported(self, console: Console, engine: TaskEngine) -> Key:
        if not (self.folder / "export" / INDEX).exists():
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                self.key_file.parent.mkdir(0o700, exist_ok=True)
            except (FileExistsError, NotADirectoryError):
                raise InputError(f"{self.folder}: is a file, or lies below one; name a folder with -o") from None
            export = self.folder / "export"
            return export_runs(self.world, export, self.key_file, self.count, self.seed, console, engine)
        return Key.load(self.key_file, (self.world.name, self.count, self.seed))

    def _answer(self, questions: Sequence[Question], path: Path, console: Console, engine: TaskEngine) -> None:
        """Append answers to questions that have none; a run that could not be diagnosed has none in the end."""
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        known = {(answer["run"], tuple(answer.get("without", ()))) for answer in map(json.loads, lines)}
        unanswered = [(run, without) for run, without in questions if (run, tuple(without)) not in known]
        groups = [unanswered[at : at + _AT_ONCE] for at in range(0, len(unanswered), _AT_ONCE)]
        work = partial(_answered, self.folder)
        for count, done in enumerate(engine.map(work, groups), start=1):
            if done.answer is None:
                raise AgentError(f"blind check: {done.lost}")
            lines += done.answer
            write_atomically(path, "".join(f"{line}\n" for line in lines))
            console.progress(f"{count} of {len(groups)} groups diagnosed", count / len(groups))


def score_answers(key_file: Path, files: Sequence[Path], out: Path | None = None) -> dict[str, Any]:
    """Scores of files of answers, each a tool by the file's name; with `out`, results and page are kept there.

    Args:
        key_file: the sealed key of the runs.
        files: of answers, one per tool.
        out: new folder for results and page; None: nothing is kept.

    Raises:
        InputError: no whole key, or a file that cannot be scored.
    """
    key = Key.load(key_file)
    if not key.runs:
        raise InputError(f"{key_file}: its runs are not recorded yet; repeat the export with this key")
    if len({file.stem for file in files}) < len(files):
        raise InputError("blind check: two files of answers have one name, which names the tool; rename one")
    return _scored(key, {file.stem: read_answers(file) for file in files}, out)


def _scored(key: Key, answers: Mapping[str, Sequence[Mapping[str, Any]]], out: Path | None) -> dict[str, Any]:
    results = list(results_of(key, answers))
    if out is not None:
        write_results(out, results)
    return {"schema": "blind-score/1", "benchmark": f"{NAME} {VERSION}", "world": key.world, "tools": score(results)}


def _answered(folder: Path, questions: Sequence[Question]) -> list[str]:
    """Lines of answers by a diagnosing process that cannot see the key."""
    jobs = "".join(
        json.dumps({"folder": str(folder / "export" / "runs" / run), "without": without}) + "\n"
        for run, without in questions
    )
    command = hidden_from([sys.executable, "-m", "agent.blind_check.worker"], folder / "withheld")
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, input=jobs, stdout=subprocess.PIPE, text=True, env=environment)
    if done.returncode:
        raise AgentError("the diagnosing process of the blind check has died; its message is above")
    answers = []
    for (run, without), line in zip(questions, done.stdout.splitlines(), strict=True):
        reply = json.loads(line)
        if "result" in reply:
            answers.append(answer_line(run, reply["result"], without))
        else:
            print(f"agent: run {run}: {reply['error']}", file=sys.stderr)
    return answers


def hidden_from(command: Sequence[str], folder: Path) -> list[str]:
    """Wrap a command in a mount namespace that hides a folder; unchanged if the system has no namespaces."""
    script = 'mount -t tmpfs none "$0" && exec "$@"'
    prefix = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script, str(folder)]
    if shutil.which("unshare") and subprocess.run([*prefix, "true"], capture_output=True).returncode == 0:
        return [*prefix, *command]
    return list(command)
