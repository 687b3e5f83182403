"""Logs of position-controlled servos without torque: the torque that the servos of the simulator's file would give.

A simulator is its servos too, so where a log has positions and set-points only, the torque that its file's servos give
at each recorded instant, τ = clip(k (r − q) − d q̇), stands for the measured one: where the simulator is right, its
inverse dynamics need that torque. What is at the servo's limit is a bound and no torque, and is left out. A set-point
is in force until the next one, so at its stamp the torque is that of both in the middle.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from agent.core import InputError
from agent.data_quality import unsigned_torque
from agent.diagnosis.rows.rounding import rounding_step
from agent.estimation import FilterSettings, motions
from agent.recording import Log
from agent.simulators import SERVO_STIFFNESS, PositionServos, Simulator, servo_stiffness

_FAR = 1.5  # rad or m from the set-points in the middle: they are of another unit or zero
_FEW = 0.01  # of the samples, that are left out without a word
_COARSE = 0.25  # of a joint's torque, that rounding of its positions may make at its servo
_MOVES = 1e-2  # rad or m that a joint travels to count as moving


def with_servo_torque(simulator: Simulator, logs: Sequence[Log]) -> tuple[Simulator, list[Log], tuple[str, ...]]:
    """Logs with the torque of the file's servos where they have none of their own, and what is to be said about it.

    The simulator that is returned has the `servos` whose torque it is; with measured torque all is as it was.

    Raises:
        InputError: torque in some logs only, no servo in the file, set-points that are missing, copied from the
            positions or of another unit, or nothing left that is not at the servos' limits.
    """
    arm, servos = simulator.arm, simulator.arm.servos
    bare = [log for log in logs if log.effort is None]
    if not bare and isinstance(servos, PositionServos) and all(log.reference_position is not None for log in logs):
        bare = list(logs) if np.any(unsigned_torque(logs)) else []
    if not bare:
        return simulator, list(logs), ()
    if len(bare) < len(logs):
        other = next(log for log in logs if log.effort is not None)
        raise InputError(
            f"{bare[0].path}: no torque (effort) was recorded, and {other.name} has some: give logs that all have "
            "torque, or none of which has"
        )
    if isinstance(servos, str):
        raise InputError(
            f"{bare[0].path}: no torque (effort) was recorded, and {arm.path.name} has no position servo for each "
            f"joint that would say it from set-points: {servos}. Record the current times the torque constant of the "
            "joint, or give an MJCF with a position actuator (kp, kv, forcerange) on every joint, and logs with "
            "set-points; joints without one can be left out (--map)"
        )
    found = [_driven(servos, log) for log in bare]
    said = [_about(arm.path.name)]
    if any(log.effort is not None for log in bare):
        said.append("the recorded efforts have no sign, as some drives report their current, and are not used")
    left_out = sum(len(log.t) - len(one.t) for log, (one, _) in zip(bare, found, strict=True))
    at_limit = np.sum([count for _, count in found], axis=0)
    if at_limit.any() or left_out > _FEW * sum(len(log.t) for log in bare):
        names = [f"{arm.joint_names[k]} {at_limit[k]}" for k in np.flatnonzero(at_limit)]
        said.append(
            f"{left_out} of {sum(len(log.t) for log in bare)} samples are left out, where a servo of the file would be "
            f"at its largest torque or no set-point is known (at the limit: {', '.join(names) or 'none'}): there its "
            "torque is only bounded"
        )
    driven = [log for log, _ in found]
    return replace(simulator, servos=servos), driven, (*said, *_coarse(servos, arm.joint_names, driven))


def at_gains(logs: Sequence[Log], factors: np.ndarray) -> list[Log]:
    """Logs with the torque of servos whose gains are the file's times `factors` (n,)."""
    found = []
    for log in logs:
        stiffness = servo_stiffness(log.metadata)
        assert log.effort is not None
        assert stiffness is not None
        said = {SERVO_STIFFNESS: json.dumps((stiffness * factors).tolist())}
        found.append(replace(log, effort=log.effort * factors, metadata={**log.metadata, **said}))
    return found


def _about(name: str) -> str:
    return (
        f"no torque was measured: it is what the position servos of {name} would give at the recorded set-points, "
        "positions and speeds, and the simulator is judged with its servos; figures in motion (forward) are what "
        "counts. A joint's torque_constant is its servo's gain, a time_delay that of its set-points, and gains that "
        "are all wrong alike cannot be told from masses that are, nor that of a joint without load from its friction"
    )


def _driven(servos: PositionServos, log: Log) -> tuple[Log, np.ndarray]:
    """The log with torque, without the samples that say none, and how many of them are at a limit per joint (n,)."""
    r, q = log.reference_position, log.position
    if r is None:
        raise InputError(
            f"{log.path}: neither torque (effort) nor set-points (/joint_references) were recorded: one of them is "
            "needed, torque as current times torque constant, or set-points for the servos of the simulator's file"
        )
    known = np.all(np.isfinite(r), axis=1)
    names, moving = np.array(log.joint_names), np.ptp(q, axis=0) > _MOVES
    if not known.any():
        raise InputError(f"{log.path}: no sample has a set-point at its stamp; record them on the positions' stamps")
    copied = moving & np.all(r[known] == q[known], axis=0)
    if copied.any():
        raise InputError(
            f"{log.path}: the set-points of {', '.join(names[copied])} are the measured positions themselves, so no "
            "servo would give any torque: record what was commanded"
        )
    away = np.median(np.abs(r - q)[known], axis=0)
    if np.any(away > _FAR):
        k = int(np.argmax(away))
        raise InputError(
            f"{log.path}: {names[k]} is {away[k]:.3g} rad or m from its set-points in the middle: they are of another "
            "unit or zero than its positions"
        )
    before = np.concatenate([r[:1], r[:-1]])
    for start, _ in log.segments:
        before[start] = r[start]
    qd = _speed(log)
    each = np.stack([servos.torque(asked, q, qd) for asked in (before, r)])
    known &= np.all(np.isfinite(each), axis=(0, 2))
    limit = np.any(servos.saturated(each), axis=0) & known[:, None]
    kept = known & ~limit.any(axis=1)
    segments = [part for start, stop in log.segments for part in _runs(kept, start, stop)]
    if not segments:
        worst = int(np.argmax(limit.sum(axis=0)))
        raise InputError(
            f"{log.path}: the servos of the simulator's file would be at their largest torque all the time "
            f"({names[worst]} in {100 * limit[:, worst].mean():.0f} % of it), which says nothing: its kp is far too "
            "large for how far this robot stays behind its set-points, or forcerange too small"
        )
    number = np.cumsum(kept) - 1
    driven = log.with_arrays(
        lambda values: values[kept],
        effort=each.mean(axis=0)[kept],
        t=log.t[kept],
        segments=tuple((int(number[a]), int(number[b - 1]) + 1) for a, b in segments),
        metadata={**log.metadata, SERVO_STIFFNESS: json.dumps(servos.stiffness.tolist())},
    )
    return driven, limit.sum(axis=0)


def _runs(kept: np.ndarray, start: int, stop: int) -> Iterator[tuple[int, int]]:
    """Stretches of samples that are kept, of two at least."""
    borders = np.flatnonzero(np.diff(np.concatenate([[False], kept[start:stop], [False]]).astype(int)))
    for first, last in zip(borders[::2], borders[1::2], strict=True):
        if last - first > 1:
            yield start + int(first), start + int(last)


def _speed(log: Log) -> np.ndarray:
    """(S, n) as the analysis has it; not a number in segments too short to be filtered."""
    speed = np.full(log.position.shape, np.nan)
    parts = [(m, slice(None)) for m in motions(log, FilterSettings(), reduce=False)]
    for motion, rows in (*parts, *((m, m.kept) for m, _ in parts)):
        time = motion.time[rows]
        here = slice(*np.searchsorted(log.t, [time[0] - 0.5 / motion.rate, time[-1] + 0.5 / motion.rate]))
        for joint, column in enumerate(motion.qd[rows].T):
            speed[here, joint] = np.interp(log.t[here], time, column)
    return speed


def _coarse(servos: PositionServos, names: Sequence[str], logs: Sequence[Log]) -> Iterator[str]:
    """Joints whose positions are too coarse for so stiff a servo."""
    for k, name in enumerate(names):
        size = np.std(np.concatenate([log.effort[:, k] for log in logs if log.effort is not None]))
        step = max(rounding_step(log.position[:, k]) for log in logs)
        noise = servos.stiffness[k] * step / np.sqrt(12)
        if noise > _COARSE * size:
            yield (
                f"positions of {name} are rounded to {step:.2g} rad or m, which at its servo's gain is a torque of "
                f"{noise:.2g} N·m, of {size:.2g} N·m in all: little can be said about it"
            )
