"""The unit of recorded positions, from the step between their values: an encoder has a finite number of ticks.

LeRobot writes degrees = (ticks - middle) · 360 / 4095, or percent = 200 (ticks - min) / (max - min) - 100 of the
calibrated range, gripper 100 (ticks - min) / (max - min) [lerobot motors_bus.py], and says nowhere which. In each, the
values lie on a grid whose step is one tick: 360°/4095 for every joint in degrees; in percent another for each joint,
which tells its range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.core import InputError
from agent.recording.datasets.episodes import UNITS, Recorded
from agent.robot import is_gripper

#: Ticks of a turn, less one as LeRobot divides, of the encoders of bus servos: 12 bits, also 10 and 14.
_TICKS = (4095.0, 4096.0, 1023.0, 1024.0, 16383.0, 16384.0)
_PERCENT_TICKS = 4095.0
#: Steps that differ by less than this part are one: float32 of a hundred and 4095 against 4096 ticks make 0.03 %.
_SAME_STEP = 1e-3
#: Distinct values of a column from which a step is found; fewer may all be several ticks apart.
_FEWEST_VALUES = 8
#: Part of the differences between values that have to lie on the grid, and how far off [steps].
_ON_GRID, _OFF_GRID = 0.98, 0.12
#: Percent are clipped here; further out is no percent.
_PERCENT = 100.5
#: A joint in rad goes no further than this [rad]: a turn either way, and a little.
_TURN = 2 * math.pi * 1.05
#: Robots whose positions LeRobot writes in degrees, from motors finer than float32 shows.
_IN_DEGREES = ("openarm",)
_BY_STEP = "found from the step of the values,"
_DISTINCT = 4000  # values are enough to see a step


@dataclass(frozen=True)
class Unit:
    """Unit of a column: its name, rad of one unit (None: unknown), what it was found from, and ticks of a percent."""

    name: str
    factor: float | None
    found: str
    ticks: float | None = None


def step_of(values: np.ndarray) -> float | None:
    """Step of the grid on which values (K,) lie; None where they lie on none or are too few to tell."""
    values = values[np.isfinite(values)]
    distinct = np.unique(values)[:_DISTINCT]
    noise = 4 * np.finfo(np.float32).eps * max(float(np.max(np.abs(distinct), initial=0.0)), 1e-9)
    apart = np.diff(distinct)
    apart = apart[apart > noise]
    if len(apart) < _FEWEST_VALUES - 1:
        return None
    step = float(np.min(apart))
    if step < 20 * noise:  # rounding alone would look like a grid
        return None
    for _ in range(3):  # differences are sums of steps, so a longer one says the step more exactly
        counts = np.rint(apart / step)
        step = float(np.sum(apart) / np.sum(counts))
    off = np.abs(apart / step - np.rint(apart / step))
    return step if np.mean(off < _OFF_GRID) >= _ON_GRID else None


def units_of_columns(names: Sequence[str], values: np.ndarray, robot_type: str = "") -> list[Unit]:
    """Unit of each column of positions (K, n), all of one arm; `robot_type` decides where the values have no step.

    Raises:
        InputError: nothing says whether the values are degrees or percent.
    """
    steps = [step_of(column) for column in values.T]
    columns = list(zip(names, steps, strict=True))
    arm = [k for k, name in enumerate(names) if not is_gripper(name)] or list(range(len(names)))
    moved = [k for k in arm if steps[k] is not None]
    most = float(np.nanmax(np.abs(values[:, arm])))
    known = [step for k in moved if (step := steps[k]) is not None]
    degree = [ticks for ticks in _TICKS if known and all(_same(step, 360 / ticks) for step in known)]
    radian = [ticks for ticks in _TICKS if known and all(_same(step, 2 * math.pi / ticks) for step in known)]
    if degree:
        reason = f"every joint that moves has a step of {360 / degree[0]:.4f}, one of {degree[0]:.0f} ticks a turn"
        return [_hand(name, step) or Unit("deg", math.pi / 180, reason) for name, step in columns]
    fine = all(step < 200 / _PERCENT_TICKS * (1 - _SAME_STEP) for step in known)  # no range is more than a turn
    steps_are = "their steps are finer than those of percent" if known else "the values have no step"
    if len(known) > 1 and all(_same(step, known[0]) for step in known):  # no two ranges are alike: a rounding
        fine, steps_are = True, f"every joint that moves has a step of {known[0]:.4g}, which percent do not have"
    if radian or (most <= _TURN and fine):
        reason = f"no joint goes beyond a turn, and {steps_are}"
        if radian:
            reason = f"every joint that moves has a step of {2 * math.pi / radian[0]:.6f}"
        return [_open_hand(name, values[:, k]) or Unit("rad", 1.0, reason) for k, name in enumerate(names)]
    if not fine and most <= _PERCENT:
        return [_percent(name, step) for name, step in columns]
    maker = next((maker for maker in _IN_DEGREES if maker in robot_type.lower()), None)
    if fine and (maker or _PERCENT < most <= math.degrees(_TURN)):
        reason = f"the values go to {most:.0f}, further than percent or rad, and {steps_are}"
        reason = reason if maker is None else f"that is the unit of {maker} arms, and {steps_are}"
        return [_hand(name, step) or Unit("deg", math.pi / 180, reason) for name, step in columns]
    listed = ", ".join(f"{names[k]} {step:.4g}" for k in arm if (step := steps[k]) is not None) or "none"
    raise InputError(
        f"the unit of the positions cannot be told: they go to {most:.4g}, and their steps are {listed}. Degrees have "
        f"one step of {360 / _TICKS[0]:.4f} for all joints, percent a step for each. Say the unit in a map: "
        "agent import --map"
    )


def in_radians(recorded: Recorded, robot_type: str = "") -> Recorded:
    """The recording in rad, without grippers whose range is unknown; it says which unit it had.

    Raises:
        InputError: the unit cannot be told, or is percent of a range that the values do not show.
    """
    values = np.concatenate([episode.position for episode in recorded.episodes])
    try:
        units = units_of_columns(recorded.joints, values, robot_type)
    except InputError as error:
        raise InputError(f"{recorded.path}: {error}") from None
    unknown = [k for k, unit in enumerate(units) if unit.factor is None]
    if bare := [recorded.joints[k] for k in unknown if not is_gripper(recorded.joints[k])]:
        raise InputError(
            f"{recorded.path}: {', '.join(bare)} is in percent of a range that nothing says: the joint moves too "
            "little to show the step of its encoder. Record it moving, or say rad per percent in a map: agent import "
            "--map, scale"
        )
    known = [k for k in range(len(units)) if k not in unknown]
    factors = np.array([factor for k in known if (factor := units[k].factor) is not None])
    descriptions = [f"{unit.name}: {unit.found}" for unit in units if unit.ticks is None and unit.factor is not None]
    ranges = [f"{recorded.joints[k]} {ticks:.0f}" for k in known if (ticks := units[k].ticks) is not None]
    if ranges:
        descriptions.append(
            f"percent of a range: {_BY_STEP} in ticks of {_PERCENT_TICKS:.0f} a turn: {', '.join(ranges)}"
        )
    units_text = "; ".join(dict.fromkeys(descriptions))
    notes = [f"positions and commands are in {units_text}"]
    notes += [f"{recorded.joints[k]} is left out: {units[k].found}" for k in unknown]
    facts = recorded.facts | {UNITS: units_text}
    changed = recorded.of_columns(known).changed(lambda array: array * factors, ("position", "command"))
    return replace(changed, unit="rad", facts=facts, notes=(*recorded.notes, *notes))


def _same(step: float, other: float) -> bool:
    return abs(step / other - 1) < _SAME_STEP


def _percent(name: str, step: float | None) -> Unit:
    if step is None:
        return Unit("percent", None, "percent of a range that nothing says")
    ticks = (100 if is_gripper(name) else 200) / step
    return Unit("percent", 2 * math.pi / _PERCENT_TICKS / step, _BY_STEP, ticks)


def _hand(name: str, step: float | None) -> Unit | None:
    """Next to joints in degrees, a gripper is in percent, unless its step is finer than a turn of it has."""
    fine = step is not None and step < 100 / _PERCENT_TICKS * (1 - _SAME_STEP)
    return _percent(name, step) if is_gripper(name) and not fine else None


def _open_hand(name: str, values: np.ndarray) -> Unit | None:
    """Next to joints in rad, a normalised gripper goes from 0 to 1."""
    if not is_gripper(name) or np.nanmin(values) < -_SAME_STEP or np.nanmax(values) > 1 + _SAME_STEP:
        return None
    return Unit("", None, "0 to 1 of a range, or rad: nothing says which")
