"""Whether the channels of a log are simultaneous: how far velocity lags position, and position lags the set-points.

A channel y that is x delayed by L is x(t) = y(t + L), so x ≈ y + L ẏ where both are slow. A regression of x on y and ẏ
gives L for a recorder's filters of any order: it is their group delay at low frequency.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from agent.data_quality.faults import MOVING, QualityFinding, Recordings
from agent.estimation import smooth_and_differentiate
from agent.recording import Log

_SLOW = 5.0  # Hz, below which a filter of a recorder is a pure delay
_NOTHING = 1.5 * _SLOW  # numerical: Hz, from which on nothing passes
_LATE = 4e-3  # s: recorders without a filter show up to 3.1 ms, those with one 4.5 ms or more (two worlds, 27 logs)


@dataclass(frozen=True)
class Alignment:
    """Seconds (median over the moving joints) by which channels of a log lag; None where the log lacks one.

    `velocity` behind position, `position` behind the set-points: the latter is the servo's lag and no fault.
    """

    log: str
    velocity: float | None
    position: float | None


def alignment(log: Log) -> Alignment:
    """The lags between the channels of a log."""
    return Alignment(log.name, _lag(log, log.velocity, True), _lag(log, log.reference_position, False))


def late_velocity(of: Recordings) -> Iterator[QualityFinding]:
    """Velocities that a filter of the recorder delays."""
    lags = {log.name: lag for log in of.logs if (lag := alignment(log).velocity) is not None and abs(lag) > _LATE}
    if lags:
        longest = max(lags.values(), key=abs)
        way = "lags" if longest > 0 else "leads"
        yield QualityFinding(
            f"the velocity in {', '.join(lags)} {way} its position by {1e3 * abs(longest):.0f} ms",
            advice="it is not used: positions are differentiated instead",
            refuses=False,
        )


def _lag(log: Log, other: np.ndarray | None, is_velocity: bool) -> float | None:
    """Seconds by which the velocity lags the position, or the position lags its set-points."""
    if other is None or log.sample_rate <= 2.5 * _SLOW:
        return None
    lags = []
    for joint in np.flatnonzero(np.ptp(log.position, axis=0) > MOVING):
        early, late, slope = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
        for a, b in log.segments:
            if b - a < 2 * log.sample_rate / _SLOW:
                continue
            (_, speed, acceleration), (second, second_rate, _) = (
                smooth_and_differentiate(x[a:b, [joint]], log.sample_rate, _SLOW, _NOTHING)
                for x in (log.position, other)
            )
            parts = (speed, second, second_rate) if is_velocity else (second_rate, speed, acceleration)
            for rows, part in zip((early, late, slope), parts, strict=True):
                rows.append(part[:, 0])
        if early:
            lags.append(_delay(*map(np.concatenate, (early, late, slope))))
    return float(np.median(lags)) if lags else None


def _delay(early: np.ndarray, late: np.ndarray, slope: np.ndarray) -> float:
    """Seconds by which one signal (S,) lags another: x = a y + b ẏ has the delay b / a; `slope` is ẏ."""
    scale, by_slope = np.linalg.lstsq(np.column_stack([late, slope]), early, rcond=None)[0]
    return float(by_slope / scale) if scale else 0.0
