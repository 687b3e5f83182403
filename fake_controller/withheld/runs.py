"""Runs of the fake controller, recorded over the real link, and how much an effect does to their torque."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import Console, ControllerError
from agent.link import moving_segments
from agent.recipe import Recipe, load_recipe
from agent.recording import Log
from agent.robot import RobotDescription

#: Corners that fly joint by joint are held to no FLY distance: the guard and the cell are given how far they may go.
#: At full speed two interpolators differ there by a tenth of a metre at times, in one draw by 0.2 m.
_RECIPE = """\
robot: {robot}
controller: {{driver: tcp, address: "{address}"}}
motion:
  speed: 1 m/s
  fly: {{distance: 300 mm}}
  via_points: {{count: 2, box: {{centre: [1, 0, 1], size: [1, 1, 1], orientation: [0, 0, 0], cone: 0}}}}
"""
_PATIENCE = 20.0  # s


def link_recipe(robot: str, address: str) -> Recipe:
    """What `agent record` would be told about this controller."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recipe.yaml"
        path.write_text(_RECIPE.format(robot=robot, address=address), encoding="utf-8")
        return load_recipe(path)


@contextmanager
def fake_controller(
    robot: str, machine: int, effects: Sequence[Mapping[str, Any]], options: Sequence[str] = ()
) -> Iterator[str]:
    """A controller as a process, with further options; gives its address. The file with its effects is gone before
    anything moves.

    Raises:
        ControllerError: it does not start, for example because an effect cannot be simulated.
    """
    with tempfile.TemporaryDirectory() as folder:
        sealed = Path(folder) / "effects.json"
        sealed.write_text(json.dumps(list(effects)), encoding="utf-8")
        command = [sys.executable, "-m", "fake_controller", "--robot", robot, "--seed", str(machine)]
        command += ["--clock", "fast", "--port", "0", "--watchdog", "5", "--effects", str(sealed), *options]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        greeting = process.stdout.readline()
    try:
        if " at " not in greeting:
            _, errors = process.communicate()
            raise ControllerError(f"blind check: the fake controller does not start: {errors.strip()}")
        yield greeting.split(" at ")[1].split(",")[0]
    finally:
        process.terminate()
        try:
            process.communicate(timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def record_motions(
    robot: str,
    machine: int,
    effects: Sequence[Mapping[str, Any]],
    programs: Mapping[str, str],
    folder: Path,
) -> list[Path]:
    """Start a controller, run the programs one after the other, and record a log of each; returns their paths.

    Raises:
        ControllerError, SafetyError, DriverError: the arm did not do it.
        InputError: a program that cannot be planned.
    """
    from agent.link import open_link, plan_statements

    folder.mkdir(parents=True, exist_ok=True)
    logs = []
    with fake_controller(robot, machine, effects) as address:
        recipe = link_recipe(robot, address)
        with open_link(recipe, Console(verbosity=-1), True, folder) as link:
            for name, text in programs.items():
                log = folder / f"{name}.mcap"
                log.unlink(missing_ok=True)  # of a check that was stopped in the middle of it
                program, chains = plan_statements(recipe, text, f"{name}.pdl", link.position())
                link.run(program, text, log, name, chains)
                logs.append(log)
    return logs


REST = 3  # samples of equal set-points that make a stop

_MEAN = 25  # samples, against noise


def torque_change(robot: RobotDescription, logs: Sequence[Log], others: Sequence[Log]) -> float:
    """Root mean square change over nominal torque (over N·m without one), on the joint and in the motion of the most.

    Both are laid on each other from stop to stop; noise of the sensors leaves a few tenths of a percent at most.
    """
    unit = np.nan_to_num(robot.nominal_torque, nan=1.0)
    largest = 0.0
    for log, other in zip(logs, others, strict=True):
        assert log.reference_position is not None
        assert other.reference_position is not None
        assert log.effort is not None
        assert other.effort is not None
        squares, count = np.zeros(robot.dof), 0
        here, there = (
            moving_segments(positions, REST) for positions in (log.reference_position, other.reference_position)
        )
        for (a, b), (c, d) in zip(here, there, strict=False):
            length = min(b - a, d - c)
            if length < 2 * _MEAN:
                continue
            change = np.cumsum((log.effort[a : a + length] - other.effort[c : c + length]) / unit, axis=0)
            smooth = (change[_MEAN:] - change[:-_MEAN]) / _MEAN
            squares += np.sum(smooth**2, axis=0)
            count += len(smooth)
        if count:
            largest = max(largest, float(np.sqrt(np.max(squares / count))))
    return largest
