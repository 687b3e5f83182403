"""Where the runs of the benchmark come from: worlds, each a process of its own.

A world is two calls. `draw` says what each run holds, `write` records one run into a folder. Nothing else of a world is
known here, so a further one only has to offer these two and a line in `world_of`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from agent.core import ControllerError, InputError

#: What a run holds, as the key lists it. Every world says `kind` (none, one, two or outside) and `effects` (each with
#: `effect`, `joints`, `parameters`), optionally `recorder` (how the logs are kept); the rest is the world's own.
Truth = Mapping[str, Any]


class World(Protocol):
    """Machines with effects."""

    @property
    def name(self) -> str:
        """Name used by `--world` and the key."""

    def draw(self, count: int, seed: int, laws: str) -> list[dict[str, Any]]:
        """The truth of every run, by laws of `development` or `judgement` where a world has laws for both.

        The seed is large and secret: nothing a run shows may allow anybody to guess it.
        """

    def write(self, truth: Truth, folder: Path) -> dict[str, Any]:
        """Record one run: `robot.yaml` with its URDF, `baseline/*.mcap` and `logs/*.mcap`, the same names every time.
        A run without torque is `arm.xml` and `logs/`, a LeRobot folder or tables, neither with dates nor serials.

        Returns
        -------
        dict
            What is known of the run now. `size`: largest root mean square change of a joint's torque by the effects,
            over nominal; None where no effect changes torques. `numbers` of servos, where a diagnosis gives them.

        Raises
        ------
        AgentError
            The run could not be recorded.
        """


@dataclass(frozen=True)
class EmulatorWorld:
    """The fake controller, recorded over its link; `options` as `fake_controller.withheld` takes them."""

    options: Mapping[str, Any] = field(default_factory=dict)
    name = "emulator"
    _process = ("-m", "fake_controller.withheld")

    def draw(self, count: int, seed: int, laws: str) -> list[dict[str, Any]]:
        return list(ask_world([*self._process, "draw"], {"count": count, "seed": seed, "options": self.options}))

    def write(self, truth: Truth, folder: Path) -> dict[str, Any]:
        return dict(ask_world([*self._process, "write"], {"truth": truth, "folder": str(folder)}))


@dataclass(frozen=True)
class SecondWorld:
    """A family of simulated arms that share no physics with the diagnosis; `cycle` [s] is one cycle of every motion."""

    cycle: float = 10.0
    name = "mujoco"
    _process = ("-m", "second_world")

    def draw(self, count: int, seed: int, laws: str) -> list[dict[str, Any]]:
        return list(ask_world([*self._process, "draw"], {"count": count, "seed": seed, "laws": laws}))

    def write(self, truth: Truth, folder: Path) -> dict[str, Any]:
        machine = {"machine": truth["machine"], "cycle": self.cycle}
        baseline = {"motion": truth["machine"], "effects": [], "describe": str(folder)}
        logs = {"motion": truth["motion"], "effects": truth["effects"], "folder": str(folder / "logs")}
        jobs = [{**machine, **baseline, "folder": str(folder / "baseline")}, {**machine, **logs}]
        _, answer = ask_world([*self._process, "run"], jobs)
        return {"size": answer["size"], "effects": answer["effects"]}


@dataclass(frozen=True)
class ServoedWorld:
    """Arms with position servos that record no torque; `seconds` of each episode that a person leads."""

    seconds: float = 16.0
    name = "positions"
    _process = ("-m", "fake_controller.servoed")

    def draw(self, count: int, seed: int, laws: str) -> list[dict[str, Any]]:
        return list(ask_world([*self._process, "draw"], {"count": count, "seed": seed}))

    def write(self, truth: Truth, folder: Path) -> dict[str, Any]:
        job = {"truth": truth, "folder": str(folder), "seconds": self.seconds}
        return dict(ask_world([*self._process, "write"], job))


def world_of(name: str) -> World:
    """The world of a name.

    Raises:
        InputError: there is no such world.
    """
    worlds: dict[str, World] = {world.name: world for world in (EmulatorWorld(), SecondWorld(), ServoedWorld())}
    if name not in worlds:
        raise InputError(f"blind check: --world {name}: there is no such world; one of {', '.join(worlds)}")
    return worlds[name]


def ask_world(arguments: Sequence[str], question: Any = None) -> Any:
    """Run the process of a world with arguments for Python and an object on stdin; returns its answer.

    Raises:
        InputError: something it needs is not installed.
        ControllerError: it failed.
    """
    done = subprocess.run([sys.executable, *arguments], input=json.dumps(question), capture_output=True, text=True)
    if done.returncode == 2:
        raise InputError(f"blind check: {done.stderr.strip()}")
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise ControllerError(f"blind check: the world {arguments[1]} fails: {last}")
    return json.loads(done.stdout)
