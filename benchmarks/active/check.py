"""A blind check whose runs may ask further motions: the one planned for what is open, and other ways to use its time.

Every way starts from the same first recording, the excitation loop of a recipe, gets the same robot time, and is
diagnosed with all logs before it. A way's motions run after the first one on the same machine, so it is as warm as it
would be. Diagnosis and planning are given logs, model and recipe; the key is sealed before them.

Where the first answer may be an offset of a torque channel, the tool asks for seconds of the arm on its brakes. So
every way has a second answer there, after its first further motion, with them; the planned motion is planned anew for
what they leave open. Nothing stands on brakes here: the log is noise about the zero of every channel. Where the tool
asks for a known mass at the flange, it is mounted, and a motion that is planned with it is run instead.

Every answer is kept in a file of its own, and a check that was stopped goes on with the next one. The first motions of
all runs come first: they take seconds, and say where the dear rest is worth it. Then the runs that are ambiguous get a
further motion of every way, the others that are not `explained` after them, and second ones last. Where nothing was
found the question is what would have been: one further motion of every way, and the smallest sizes before and after it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from agent.core import Console, InputError, sha256_text, write_atomically
from benchmarks.active.machines import ActiveWorld, ControllerMachines, MujocoMachines
from benchmarks.active.run import ROUNDS, ActiveRun
from benchmarks.active.scoring import active_scores
from fake_controller.withheld.cases import Case

WORLDS = ("emulator", "mujoco")
#: The hash, there from the start; and the key itself, there after the last diagnosis.
SEAL, KEY = "key.sha256", "key.json"


def key_text(seed: int, robot: str, cases: Sequence[Case]) -> str:
    """The whole key as text, the same for the same draw."""
    data = {"seed": seed, "robot": robot, "cases": [case.to_dict() for case in cases]}
    return json.dumps(data, indent=1, sort_keys=True) + "\n"


def seal(folder: Path, text: str) -> str:
    """Note the key's SHA-256 in a folder, where it is not noted yet; returns it.

    Raises:
        InputError: the folder is that of a check with another key.
    """
    digest = sha256_text(text)
    path = folder / SEAL
    if path.exists():
        if path.read_text(encoding="utf-8").split()[:1] != [digest]:
            raise InputError(
                f"{folder}: holds a blind check with another seed or number of cases, or of another version; name "
                "another folder with -o"
            )
    else:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise InputError(f"{folder}: is a file, or lies below one; name a folder with -o") from None
        write_atomically(path, f"{digest}  {KEY}\n")
    return digest


def open_key(folder: Path, text: str) -> None:
    """Write the key in clear; nothing is diagnosed any more."""
    write_atomically(folder / KEY, text)


@dataclass(frozen=True)
class ActiveCheck:
    """What to do: runs, seed, folder (gone on with), the world, of WORLDS, and the emulator's robot."""

    count: int
    seed: int
    folder: Path
    world: str = "emulator"
    robot: str = "comau_ns16"

    @cached_property
    def _world(self) -> ActiveWorld:
        return MujocoMachines() if self.world == "mujoco" else ControllerMachines(self.robot)

    def run(self, console: Console) -> dict[str, Any]:
        """Do what is not done yet; returns the scores, which are also in `active_check.json`.

        Raises:
            InputError: no runs, no such world, or a folder with another check in it.
        """
        if self.count < 1:
            raise InputError(f"blind check: --cases {self.count}: at least one run is needed")
        if self.world not in WORLDS:
            raise InputError(f"blind check: --world {self.world}: there is no such world; one of {', '.join(WORLDS)}")
        cases = self._world.draw(self.count, self.seed)
        text = key_text(self.seed, f"{self._world.title}, further motions after the excitation loop", cases)
        digest = seal(self.folder, text)
        console.step(f"{self.count} runs; SHA-256 of the key, which stays closed until the last diagnosis: {digest}")
        runs = [ActiveRun(self._world, case, self.folder) for case in cases]
        for number, run in enumerate(runs):
            run.go_on(0)
            console.progress(f"first motions: {number + 1} of {self.count} runs", (number + 1) / self.count)
        runs.sort(key=lambda run: not run.ambiguous)
        for rounds in range(1, ROUNDS + 1):
            for number, run in enumerate(runs):
                run.go_on(rounds)
                done = ((rounds - 1) * len(runs) + number + 1) / (ROUNDS * len(runs))
                console.progress(f"further motion {rounds} of {ROUNDS}: {number + 1} of {self.count} runs", done)
        runs.sort(key=lambda run: run.number)
        open_key(self.folder, text)
        scores = {"schema": "active-check/1", "key_sha256": digest, "world": self._world.title}
        scores |= active_scores([run.entry() for run in runs])
        write_atomically(self.folder / "active_check.json", json.dumps(scores, indent=1) + "\n")
        return scores
