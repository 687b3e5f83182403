"""The whole blind check: draw, seal, record and diagnose, open the key, judge. A rerun goes on where it stopped."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeVar

from agent.blind_check.cases import Case
from agent.blind_check.key import key_text, open_key, seal
from agent.blind_check.scoring import outcome, score
from agent.blind_check.worlds import EmulatorWorld, MujocoWorld, World
from agent.core import AgentError, Console, InProcess, InputError, TaskEngine, write_atomically
from drivers.errors import DriverError

Found = TypeVar("Found")
#: A log of the first two motions is about this long [s], two cycles and the way to where they start.
CYCLE = 10.0
WORLDS = ("emulator", "mujoco")


@dataclass(frozen=True)
class BlindCheck:
    """What to do: runs, seed, folder, the emulator's robot, the duration of one cycle of every motion [s], and the
    world the runs come from, of WORLDS."""

    count: int
    seed: int
    folder: Path
    robot: str = "comau_ns16"
    cycle: float = CYCLE
    world: str = "emulator"

    @cached_property
    def _world(self) -> World:
        if self.world == "mujoco":
            return MujocoWorld(self.cycle)
        return EmulatorWorld(self.robot, self.cycle)

    def run(self, console: Console, engine: TaskEngine | None = None) -> dict[str, Any]:
        """Do what is not done yet; returns the scores, which are also in `blind_check.json` and `blind_check.md`.

        Runs that share a machine are one task of the `engine`, in this process without one; all see the same folder.

        Raises:
            InputError: no runs, or a folder with another check in it.
            AgentError: a task was lost.
        """
        from agent.blind_check.report import report_text

        if self.count < 1:
            raise InputError(f"blind check: --cases {self.count}: at least one run is needed")
        if self.world not in WORLDS:
            raise InputError(f"blind check: --world {self.world}: there is no such world; one of {', '.join(WORLDS)}")
        cases = self._world.draw(self.count, self.seed)
        text = key_text(self.seed, self._world.arms, cases)
        digest = seal(self.folder, text)
        console.step(f"{self.count} runs; SHA-256 of the key, which stays closed until the last diagnosis: {digest}")
        engine = engine or InProcess()
        groups = [list(group) for _, group in groupby(cases, self._machine)]
        for _ in self._each(self.diagnose_group, groups, engine, console, "diagnosed"):
            pass
        open_key(self.folder, text)
        console.step(f"the key is open: {self.folder / 'key.json'}")
        judged = self._each(self.judge_group, groups, engine, console, "judged")
        entries = [entry for _, entries in sorted(judged, key=itemgetter(0)) for entry in entries]
        scores = {
            "schema": "blind-check/1",
            "key_sha256": digest,
            "world": self._world.title,
            "robot": self._world.arms,
        }
        scores |= score(entries)
        write_atomically(self.folder / "blind_check.json", json.dumps(scores, indent=1) + "\n")
        write_atomically(self.folder / "blind_check.md", report_text(scores))
        return scores

    def _each(
        self,
        work: Callable[[list[Case]], Found],
        groups: list[list[Case]],
        engine: TaskEngine,
        console: Console,
        what: str,
    ) -> Iterator[tuple[int, Found]]:
        """What the work gives for each group, with its number, as it comes."""
        count, total = 0, sum(len(group) for group in groups)
        for done in engine.map(work, groups):
            if done.answer is None:
                raise AgentError(f"blind check: {done.lost}")
            count += len(groups[done.number])
            console.progress(f"{count} of {total} runs {what}", count / total)
            yield done.number, done.answer

    def diagnose_group(self, cases: Sequence[Case]) -> bool:
        """Record and diagnose those of a machine that are not diagnosed yet."""
        with _Diagnosing(self.folder) as diagnosing:
            for case in cases:
                answer = self._folder(case) / "diagnosis.json"
                if answer.exists():
                    continue
                job, reason = self._record(case)
                found = {"error": reason} if reason else diagnosing.ask(job)
                answer.parent.mkdir(parents=True, exist_ok=True)  # without a model nothing is recorded into it
                write_atomically(answer, json.dumps(found) + "\n")
        return True

    def judge_group(self, cases: Sequence[Case]) -> list[dict[str, Any]]:
        """Entries of the runs of a machine, judged by the key."""
        return [self._judge(case) for case in cases]

    def _record(self, case: Case) -> tuple[dict[str, Any], str]:
        """What a diagnosis is given of a run, or why there is nothing; its machine's model is made where missing."""
        try:
            self._make_model(case)
            _, planned = self._world.record(case, self._folder(case))
            return self._job(case, planned), ""
        except (AgentError, DriverError) as error:
            return {}, str(error)

    def _make_model(self, case: Case) -> None:
        """Estimate from effect-free motions of the same machine, other ones than those of its runs."""
        from agent.estimation import estimate
        from agent.recording import read_log
        from agent.robot import load_robot

        path = self._model(case)
        if path.exists():
            return
        logs = self._world.reference(case, path.with_suffix(""))
        robot = load_robot(self._robot(case))
        model = estimate(robot, [read_log(log, robot) for log in logs])
        for log in logs:
            log.unlink()
        model.save(path)

    def _judge(self, case: Case) -> dict[str, Any]:
        """The case with its diagnosis, the one without its effect, and the oracle. Logs of clear cases are let go."""
        from agent.blind_check.size import kind_by_size

        folder = self._folder(case)
        kept = folder / "judged.json"
        if kept.exists():
            return json.loads(kept.read_text(encoding="utf-8"))
        found = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
        entry = {**case.to_dict(), **found}
        logs = sorted(folder.glob("*.mcap"))
        if case.effects and "error" not in found:
            entry["size"] = self._world.size(case, folder, self._model(case).with_suffix(""))
            entry["kind"] = kind_by_size(case.kind, entry["size"])
        if case.kind in ("one", "two") and "error" not in found:
            entry.update(self._second_opinions(case))
        entry["outcome"] = outcome(entry)
        write_atomically(kept, json.dumps(entry) + "\n")
        if entry["outcome"] in ("right", "in class"):
            for log in logs:
                log.unlink()
            self._world.tidy(folder)
        return entry

    def _second_opinions(self, case: Case) -> dict[str, Any]:
        from agent.blind_check.oracle import reference_closures
        from agent.blind_check.worker import diagnose_job
        from agent.core import finite

        names = sorted({effect["effect"] for effect in case.effects})
        planned = sorted(self._folder(case).glob("*.npy"))
        withheld = diagnose_job(self._job(case, planned), without=names)
        closures = reference_closures(withheld, case.effects, case.number)
        return finite({"withheld": withheld.result, "closures": closures})

    def _folder(self, case: Case) -> Path:
        return self.folder / "runs" / f"{case.number:04d}"

    def _machine(self, case: Case) -> int:
        """Machines are numbered as they come: their seed would tell of the key."""
        return case.number // self._world.group

    def _model(self, case: Case) -> Path:
        return self.folder / "machines" / f"{self._machine(case):04d}.json"

    def _robot(self, case: Case) -> str:
        return self._world.robot(self._model(case).with_suffix(""))

    def _job(self, case: Case, planned: Sequence[Path]) -> dict[str, Any]:
        """All that a diagnosis is given."""
        description = self._model(case).with_suffix("").glob("*")
        return {
            "robot": self._robot(case),
            "description": [str(path) for path in description],
            "model": str(self._model(case)),
            "logs": [str(log) for log in sorted(self._folder(case).glob("*.mcap"))],
            "planned": [str(path) for path in sorted(planned)],
        }


class _Diagnosing:
    """The diagnosing process; started with the first job."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> _Diagnosing:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process.terminate()
            self._process.wait()

    def ask(self, job: dict[str, Any]) -> dict[str, Any]:
        """Its answer to one job.

        Raises:
            RuntimeError: the process died.
        """
        if self._process is None:
            command = [sys.executable, "-m", "agent.blind_check.worker", str(self._folder)]
            environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError("the diagnosing process of the blind check has died; its message is above")
        return json.loads(answer)
