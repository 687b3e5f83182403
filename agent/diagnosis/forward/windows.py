"""The gap in motion: the given and the corrected simulator run from measured states, and how far they drift.

Windows of up to two seconds start at measured positions and velocities. If logs have set-points, a servo is
fitted:

    τ = kp e + kd ė + ki ∫ e + a ṙ + b r̈ + c,  e = r − q

If it describes the torque on motion that it was not fitted to, both simulators follow the set-points through it.
Otherwise both apply the recorded torque. A window's corrected simulator is fitted without the motion of the window.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, RejectedError
from agent.diagnosis.corrected_simulator import corrected_numbers
from agent.diagnosis.diagnosis import Diagnosis
from agent.diagnosis.forward.interval import expected_range
from agent.diagnosis.forward.rollout import Drive, RolloutEngine, at_motors, engine
from agent.diagnosis.forward.simulation import shortened
from agent.diagnosis.limits import LIMITS
from agent.estimation import FilterSettings, Motion, motions
from agent.model import PAYLOAD, ModelEffect
from agent.simulators import Simulator, write_corrected, written_files

_HORIZONS = (0.2, 0.5, 1.0, 2.0)  # s
_WINDOWS = 24  # at most, over all motions
_RUNS_AWAY = np.pi  # rad, rad/s or m: upper bound of an error


@dataclass(frozen=True, eq=False)
class ForwardWindow:
    """`motion` from sample `first`, seen by the fit of `fold` not at all."""

    motion: Motion
    first: int
    fold: int


def forward(diagnosis: Diagnosis, simulator: Simulator) -> dict[str, Any]:
    """`forward` of a result; an empty dictionary where no window is long enough.

    Raises:
        InputError, RejectedError: the corrected file cannot be written.
    """
    windows = _windows(diagnosis)
    horizons = [h for h in _HORIZONS if any(_lasts(window, h) for window in windows)]
    if not horizons:
        return {}
    all_motions = list({id(window.motion): window.motion for window in windows}.values())
    servo = _servo(all_motions)
    given = engine(simulator, simulator.arm.path, simulator.model, None)
    dof = len(simulator.arm.joint_names)
    errors = np.full((2, 2, len(windows), len(horizons), dof), np.nan)
    with tempfile.TemporaryDirectory() as folder:
        for fold in sorted({window.fold for window in windows}):
            correction = corrected_numbers(diagnosis, simulator, without=fold)
            path = Path(folder) / f"fold_{fold}{simulator.arm.path.suffix}"
            written = write_corrected(simulator, correction, path)
            effects = written_files(path)[1] if written_files(path)[1] in written else None
            fixed = engine(simulator, path, correction.model, effects)
            for number, window in enumerate(windows):
                if window.fold != fold:
                    continue
                times = np.array([h for h in horizons if _lasts(window, h)])
                for side, (which, entries) in enumerate(((given, ()), (fixed, correction.effects))):
                    drive = _drive(window, servo, entries, simulator.arm.joint_names)
                    drift = _drift(which, window, times, drive)
                    errors[side, :, number, : len(times)] = drift
    group = np.array([window.fold for window in windows])
    driven = "set_points" if servo is not None else "torque"
    return _figures(errors, horizons, driven, group, simulator)


def _lasts(window: ForwardWindow, seconds: float) -> bool:
    return window.first + round(seconds * window.motion.rate) < len(window.motion.time)


def _windows(diagnosis: Diagnosis) -> list[ForwardWindow]:
    """Starts that are spread evenly over the held-out part of each fold, with the whole window inside it."""
    dataset, fit = diagnosis.dataset, diagnosis.selected.fit
    settings = FilterSettings(dataset.cutoff, dataset.model.order)
    of_folds: list[list[ForwardWindow]] = []
    for number, log in enumerate(dataset.logs):
        if log.metadata.get(PAYLOAD):  # the model simulates the bare arm
            continue
        parts = [m for m in motions(log, settings, reduce=False) if m.torque is not None]
        for fold, held_out in enumerate(fit.folds):
            rows = np.isin(fit.cell_of_row, np.flatnonzero(held_out.test)) & (dataset.log == number)
            if not rows.any():
                continue
            first, last = dataset.time[rows].min(), dataset.time[rows].max()
            starts = [
                ForwardWindow(motion, int(k), fold)
                for motion in (shortened(p, int(np.searchsorted(p.time, last, side="right"))) for p in parts)
                for k in range(motion.edge, len(motion.time), max(1, int(0.5 * motion.rate)))
                if first <= motion.time[k] <= last - _HORIZONS[0]
            ]
            of_folds.append(starts)
    share = max(1, _WINDOWS // max(len(of_folds), 1))
    chosen = []
    for starts in of_folds:
        long = [window for window in starts if _lasts(window, _HORIZONS[-1])] or starts
        pick = np.unique(np.linspace(0, len(long) - 1, min(share, len(long))).astype(int))
        chosen += [long[k] for k in pick]
    return chosen


def _features(motion: Motion, joint: int) -> np.ndarray:
    """(S, 6) e, ė, ∫ e, ṙ, r̈ and 1 of one joint."""
    assert motion.set_points is not None
    r, period = motion.set_points[:, joint], 1 / motion.rate
    rd = np.gradient(r, period)
    e = r - motion.q[:, joint]
    return np.stack(
        [e, rd - motion.qd[:, joint], np.cumsum(e) * period, rd, np.gradient(rd, period), np.ones(len(r))], 1
    )


def _servo(parts: Sequence[Motion]) -> np.ndarray | None:
    """Gains (n, 6) of the servo that the recorded motion shows; None if it shows none."""
    if any(m.set_points is None or not np.all(np.isfinite(m.set_points)) for m in parts):
        return None
    motion = max(parts, key=lambda m: len(m.time))
    assert motion.torque is not None
    split, gains = len(motion.time) // 2, []
    for joint in range(motion.q.shape[1]):
        columns, torque = _features(motion, joint), motion.torque[:, joint]
        size = np.maximum(np.abs(columns).max(axis=0), 1e-12)
        fitted = np.linalg.lstsq(columns[:split] / size, torque[:split], rcond=1e-9)[0] / size
        unexplained = np.var(torque[split:] - columns[split:] @ fitted)
        if fitted[0] <= 0 or fitted[1] < 0 or unexplained > LIMITS.negligible * np.var(torque[split:]):
            return None
        gains.append(fitted)
    return np.array(gains)


def _drift(which: RolloutEngine, window: ForwardWindow, times: np.ndarray, drive: Drive) -> np.ndarray:
    """(2, T, n) error of position [rad] and velocity [rad/s] at the times of a window."""
    motion, first = window.motion, window.first
    q, qd = which.run(motion.q[first], motion.qd[first], drive, times)
    samples = first + np.round(times * motion.rate).astype(int)
    error = np.stack([q - motion.q[samples], qd - motion.qd[samples]])
    return np.asarray(np.clip(np.where(np.isfinite(error), error, _RUNS_AWAY), -_RUNS_AWAY, _RUNS_AWAY))


def _drive(window: ForwardWindow, servo: np.ndarray | None, entries: Sequence[ModelEffect], names: Any) -> Drive:
    """The recorded torque, or that of an identified servo."""
    motion, first = window.motion, window.first
    assert motion.torque is not None
    if servo is not None:
        return _following(motion, first, servo)
    return _recorded(motion, first, at_motors(entries, names, motion.torque))


def _recorded(motion: Motion, first: int, torque: np.ndarray) -> Drive:
    def drive(time: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        low, share = _between(first + time * motion.rate, len(torque))
        return np.asarray((1 - share) * torque[low] + share * torque[low + 1])

    return drive


def _between(row: float, count: int) -> tuple[int, float]:
    """Sample before a row that is no whole number, of `count`, and the share of the one after it."""
    low = min(int(row), count - 2)
    return low, min(row - low, 1.0)


def _following(motion: Motion, first: int, servo: np.ndarray) -> Drive:
    assert motion.set_points is not None
    r, period = motion.set_points, 1 / motion.rate
    rd = np.gradient(r, period, axis=0)
    rdd = np.gradient(rd, period, axis=0)
    integral = np.cumsum(r - motion.q, axis=0)[first] * period
    before = 0.0

    def drive(time: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        nonlocal integral, before
        low, share = _between(first + time * motion.rate, len(r))
        now, speed, bend = ((1 - share) * part[low] + share * part[low + 1] for part in (r, rd, rdd))
        integral = integral + (now - q) * (time - before)
        before = time
        columns = np.stack([now - q, speed - qd, integral, speed, bend, np.ones(len(q))], axis=1)
        return np.asarray(np.sum(servo * columns, axis=1))

    return drive


def _figures(
    errors: np.ndarray, horizons: Sequence[float], driven: str, group: np.ndarray, simulator: Simulator
) -> dict[str, Any]:
    """Root mean squares over the windows, and what they may be on other motions."""
    result: dict[str, Any] = {
        "horizon_s": list(horizons),
        "joints": list(simulator.arm.joint_names),
        "engine": "pinocchio" if simulator.arm.path.suffix.lower() == ".urdf" else "mujoco",
        "driven_by": driven,
        "windows": len(group),
    }
    for side, name in enumerate(("before", "after")):
        for kind, prefix in enumerate(("", "velocity_")):
            squares = errors[side, kind] ** 2
            result[f"{prefix}{name}"] = np.sqrt(np.nanmean(squares, axis=0)).tolist()
            interval = np.stack(expected_range(squares, group, _RUNS_AWAY), axis=-1)
            result[f"{prefix}{name}_interval"] = interval.tolist()
    return result


def forward_or_reason(diagnosis: Diagnosis, simulator: Simulator) -> tuple[dict[str, Any], str]:
    """`forward`, or an empty dictionary and why there is none."""
    try:
        return forward(diagnosis, simulator), ""
    except (InputError, RejectedError) as error:
        return {}, f"no roll-out: {error}"


def forward_warning(result: dict[str, Any]) -> str:
    """Warning if the corrected simulator drifts further than the given one; empty otherwise."""
    before, after = (np.sqrt(np.mean(np.array(result[side]) ** 2, axis=1)) for side in ("before", "after"))
    worse = [
        f"{seconds:g} s"
        for seconds, a, b in zip(result["horizon_s"], after, before, strict=True)
        if a > LIMITS.equal_ratio * b
    ]
    if not worse:
        return ""
    return (
        f"the corrected simulator drifts further than the one given after {', '.join(worse)}: what was found predicts "
        "torque, but do not train in it; more motion, faster and over more of the range, settles its numbers"
    )


def forward_lines(result: dict[str, Any]) -> Iterator[str]:
    """For people: the joint whose position drifts most."""
    horizons, before, after = result["horizon_s"], np.array(result["before"]), np.array(result["after"])
    worst = int(np.argmax(before[-1]))
    yield (
        f"run forward in {result['engine']} by the recorded {result['driven_by'].replace('_', '-')}, "
        f"{result['windows']} windows held out: position error of {result['joints'][worst]} [rad or m]"
    )
    for k, horizon in enumerate(horizons):
        low, high = result["after_interval"][k][worst]
        yield (
            f"  after {horizon:3.1f} s  {before[k, worst]:.3g}, corrected {after[k, worst]:.3g} "
            f"({low:.2g} to {high:.2g} on another motion)"
        )
