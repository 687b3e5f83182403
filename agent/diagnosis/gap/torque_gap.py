"""The torque gap in plain held-out error, by the definitions of docs/diagnosis.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.rows.standstill import stiction


@dataclass(frozen=True, eq=False)
class HeldOutGap:
    """Held-out errors without and with the causes, `error_before` and `error_after` (S', n) [N·m], NaN on guards.

    At standstill, friction is anything within the Coulomb level in either direction. No model knows it, although it
    repeats with every cycle. So both errors are already reduced by the open part of stiction, `open_stiction` (S', n)
    [N·m].

    `before`, `after` and `floor` (n,) are RMSE values over `unit` (n,): nominal torque, or 1 N·m if unknown. `floor` is
    the repeatability from cycle to cycle, None without repeats.
    """

    error_before: np.ndarray
    error_after: np.ndarray
    open_stiction: np.ndarray
    unit: np.ndarray
    before: np.ndarray
    after: np.ndarray
    floor: np.ndarray | None

    @property
    def rmse_before(self) -> np.ndarray:
        """(n,) [N·m] `before` without its unit."""
        return self.before * self.unit

    @property
    def rmse_after(self) -> np.ndarray:
        """(n,) [N·m] `after` without its unit."""
        return self.after * self.unit

    @property
    def closure(self) -> float | None:
        """(B² − A²) / (B² − F²); None where there is nothing to close."""
        return closure(self.before, self.before, self.after, self.floor)

    @property
    def unclosed(self) -> HeldOutGap:
        """The same without causes: what the model leaves as it is, though its own parameters may move."""
        return replace(self, error_after=self.error_before, after=self.before)

    @property
    def absorbed(self) -> float:
        """Part of the squared error that is taken away."""
        whole = float(np.mean(self.before**2))
        return 1 - float(np.mean(self.after**2)) / whole if whole > 0 else 0.0

    def closure_without(self, residual: np.ndarray) -> float | None:
        """Loss of explained gap with a residual (S', n) [N·m] instead."""
        return closure(self.before, rms(self.beyond(residual)) / self.unit, self.after, self.floor)

    def closure_on(self, joints: Sequence[int], residual: np.ndarray) -> float | None:
        """Part that is closed of the error of joints, compared with a residual (S', n) [N·m]."""
        indices, floor = list(joints), None if self.floor is None else self.floor[list(joints)]
        without = (rms(self.beyond(residual)) / self.unit)[indices]
        return closure(without, without, self.after[indices], floor)

    def beyond(self, rows: np.ndarray) -> np.ndarray:
        """Part of an error (S', n) [N·m] that stiction does not allow."""
        return _beyond(rows, self.open_stiction)


def closure(before: np.ndarray, worse: np.ndarray, better: np.ndarray, floor: np.ndarray | None) -> float | None:
    """(W² − A²) / (B² − F²) of errors per joint (n,), `worse` W to `better` A; None where there is nothing to close."""
    b = np.mean(before**2)
    f = 0.0 if floor is None else float(np.mean(floor**2))
    if b < LIMITS.equal_ratio**2 * f or b <= 0:
        return None
    return float((np.mean(worse**2) - np.mean(better**2)) / (b - f))


def held_out_gap(dataset: Dataset, fit: Fit, unit: np.ndarray | None = None) -> HeldOutGap:
    """The gap with the effects of a fit: every row under the parameters that did not see it."""
    if unit is None:
        unit = np.nan_to_num(dataset.robot.nominal_torque, nan=1.0)
    remaining = fit.held_out()
    raw = dataset.residual if dataset.has_reference else dataset.fit.held_out()
    raw = np.where(np.isnan(remaining[:, :1]), np.nan, raw)
    # friction that is predicted to hold one way may hold the other way: twice the level
    possible = np.maximum(fit.sigma, 2 * stiction(fit.reference))
    stuck = np.where(fit.near_rest, np.minimum(np.abs(remaining), possible), 0.0)
    raw, remaining = _beyond(raw, stuck), _beyond(remaining, stuck)
    before, after = rms(raw) / unit, rms(remaining) / unit
    floor = _floor(dataset, fit, remaining, unit, before)
    return HeldOutGap(raw, remaining, stuck, unit, before, after, floor)


def _beyond(rows: np.ndarray, stuck: np.ndarray) -> np.ndarray:
    """Subtract the energy that stiction leaves open, row by row."""
    return np.sign(rows) * np.sqrt(np.maximum(rows**2 - stuck**2, 0.0))


def rms(rows: np.ndarray) -> np.ndarray:
    """(n,) root mean square of (S', n), guards left out."""
    return np.sqrt(np.nanmean(rows**2, axis=0))


def _floor(
    dataset: Dataset, fit: Fit, remaining: np.ndarray, unit: np.ndarray, before: np.ndarray
) -> np.ndarray | None:
    """√(½ mean (e_{c+1} − e_c)²) over adjacent cycles of the final residual, at equal times since the cycle's start."""
    parts = []
    for number, log in enumerate(dataset.logs):
        starts = np.asarray(log.cycle_starts, dtype=float)
        if len(starts) < 2:
            continue
        here = dataset.log == number
        time, rows = dataset.time[here], remaining[here]
        good = ~np.isnan(rows[:, 0])
        time, rows = time[good], rows[good]
        if len(time) < LIMITS.min_samples:
            continue
        for a, b in pairwise(starts):
            common = np.arange(max(time[0], a), min(b, time[-1] - (b - a)), 1 / dataset.rate)
            if len(common) < LIMITS.min_samples:
                continue
            first = np.stack([np.interp(common, time, column) for column in rows.T], axis=1)
            second = np.stack([np.interp(common + b - a, time, column) for column in rows.T], axis=1)
            parts.append(second - first)
    if not parts:
        return None
    floor = np.sqrt(0.5 * np.mean(np.concatenate(parts) ** 2, axis=0)) / unit
    if not dataset.has_reference:
        return floor
    # a contact or a drifting torque does not repeat either: the model's error on other motions bounds the repeatability
    usual = dataset.model.held_out_rmse / unit
    return np.where(fit.beyond_usual(before * unit), np.minimum(floor, usual), floor)
