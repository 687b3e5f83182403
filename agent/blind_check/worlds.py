"""Where the runs of a blind check come from: the fake controller, or arms in MuJoCo that are not of its making."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from agent.blind_check.cases import GROUP, Case, draw_cases
from agent.blind_check.runs import link_recipe, record_motions
from agent.core import Console, ControllerError, InputError, write_atomically

_PLAIN = "without_effect"
_NOWHERE = "127.0.0.1:9"  # plans are drawn without a controller
_QUIET = Console(verbosity=-1)


class World(Protocol):
    """Machines with effects."""

    @property
    def title(self) -> str:
        """What the report calls it."""

    @property
    def arms(self) -> str:
        """Which robots are in it."""

    @property
    def group(self) -> int:
        """Runs that share a machine."""

    def draw(self, count: int, seed: int) -> list[Case]:
        """The runs, the same for the same seed."""

    def robot(self, machine: Path) -> str:
        """Name or path of the description of the machine whose files begin with this path."""

    def reference(self, case: Case, machine: Path) -> list[Path]:
        """Logs of the case's machine without an effect, and its description where it has one of its own."""

    def record(self, case: Case, folder: Path) -> tuple[list[Path], list[Path]]:
        """Logs of a run, and for each a file of the set-points that were planned; none where no plan is given."""

    def size(self, case: Case, folder: Path, machine: Path) -> float:
        """Largest change of torque by the run's effects, over nominal."""

    def tidy(self, folder: Path) -> None:
        """Let go of what lies beside the logs of a run."""


@dataclass(frozen=True)
class EmulatorWorld:
    """The fake controller on one robot, over its TCP link; `cycle` [s] is one way round of every motion.

    The controller's interpolator is never quite ours, so what a run should be like is not our plan: it is what
    this controller makes of the same programs without an effect. Of that run the diagnosis sees set-points only.
    """

    arms: str
    cycle: float
    title = "the fake controller"
    group = GROUP

    def draw(self, count: int, seed: int) -> list[Case]:
        from agent.robot import load_robot

        return draw_cases(count, seed, load_robot(self.arms))

    def robot(self, machine: Path) -> str:
        return self.arms

    def reference(self, case: Case, machine: Path) -> list[Path]:
        return self._run(case.machine, case.machine, (), machine)

    def record(self, case: Case, folder: Path) -> tuple[list[Path], list[Path]]:
        logs = self._run(case.motion, case.machine, case.effects, folder)
        plain = logs  # without an effect the same machine would only repeat itself, noise and all
        if case.effects:
            plain = self._run(case.motion, case.machine, (), folder / _PLAIN)
        return logs, [self._keep_set_points(log, folder / f"{log.stem}.npy") for log in plain]

    def _run(self, motion: int, machine: int, effects: Sequence[dict[str, Any]], folder: Path) -> list[Path]:
        from agent.blind_check.motions import draw_programs

        programs = draw_programs(link_recipe(self.arms, _NOWHERE), motion, self.cycle)
        return record_motions(self.arms, machine, effects, programs, folder, _QUIET)

    def _keep_set_points(self, log: Path, path: Path) -> Path:
        from agent.recording import read_log
        from agent.robot import load_robot

        set_points = read_log(log, load_robot(self.arms)).reference_position
        assert set_points is not None
        np.save(path, set_points)
        return path

    def size(self, case: Case, folder: Path, machine: Path) -> float:
        from agent.blind_check.size import torque_change
        from agent.robot import load_robot

        logs = sorted(folder.glob("*.mcap"))
        return torque_change(load_robot(self.arms), logs, [folder / _PLAIN / log.name for log in logs])

    def tidy(self, folder: Path) -> None:
        for log in (folder / _PLAIN).glob("*.mcap"):
            log.unlink()


@dataclass(frozen=True)
class MujocoWorld:
    """Arms of several builds, in a process that shares no physics with the diagnosis; see docs/blind-check.md."""

    cycle: float
    title = "MuJoCo"
    arms = "arms of four builds"
    group = 4

    def draw(self, count: int, seed: int) -> list[Case]:
        drawn = second_world("draw", str(count), str(seed))
        return [Case(**{**case, "effects": tuple(case["effects"])}) for case in drawn]

    def robot(self, machine: Path) -> str:
        return str(machine / "robot.yaml")

    def reference(self, case: Case, machine: Path) -> list[Path]:
        job = {"machine": case.machine, "motion": case.machine, "effects": [], "describe": str(machine)}
        return self._run(job, machine)[0]

    def record(self, case: Case, folder: Path) -> tuple[list[Path], list[Path]]:
        job = {"machine": case.machine, "motion": case.motion, "effects": list(case.effects)}
        logs, size = self._run(job, folder)
        write_atomically(folder / "size.json", json.dumps(size))
        return logs, []

    def _run(self, job: dict[str, Any], folder: Path) -> tuple[list[Path], float | None]:
        answer = second_world("run", text=json.dumps({**job, "folder": str(folder), "cycle": self.cycle}))
        return [Path(log) for log in answer["logs"]], answer["size"]

    def size(self, case: Case, folder: Path, machine: Path) -> float:
        return float(json.loads((folder / "size.json").read_text(encoding="utf-8")))

    def tidy(self, folder: Path) -> None:
        pass


def second_world(*arguments: str, text: str = "") -> Any:
    """What the second world answers to a command with arguments, and `text` on its stdin.

    Raises:
        InputError: MuJoCo is missing.
        ControllerError: it failed.
    """
    command = [sys.executable, "-m", "second_world", *arguments]
    done = subprocess.run(command, input=text, capture_output=True, text=True)
    if done.returncode == 2:
        raise InputError(f"blind check: {done.stderr.strip()}")
    if done.returncode:
        raise ControllerError(f"blind check: the second world fails: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout)
