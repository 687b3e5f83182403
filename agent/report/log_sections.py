"""How healthy the logs of a run are: lost samples, and how even the controller's clock was."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from agent.recording import Log
from agent.report.page import Section, Table


def log_section(logs: Iterable[Log]) -> Section:
    """Samples, losses, repairs and jitter of every log."""
    rows = []
    lost_in_all = repairs = 0
    for log in logs:
        lost = int(log.metadata.get("lost_samples", "0") or 0)
        lost_in_all += lost
        repairs += len(log.repairs)
        spread, largest = jitter(log)
        rows.append(
            (
                log.name,
                str(len(log.t)),
                str(lost),
                f"{log.t[-1] - log.t[0]:.1f}",
                f"{log.sample_rate:g}",
                f"{1e6 * spread:.1f}",
                f"{1e3 * largest:.2f}",
                "; ".join(str(repair) for repair in log.repairs) or "none",
            )
        )
    header = ("log", "samples", "lost", "seconds", "rate [Hz]", "jitter [µs RMS]", "longest interval [ms]", "repairs")
    first = (
        "No sample was lost." if lost_in_all == 0 else f"{lost_in_all} samples were lost and are marked in the logs."
    )
    second = "" if repairs == 0 else f" The reader repaired {repairs} places."
    text = (first + second, "Jitter is of the intervals between the controller's time stamps, gaps left out.")
    return Section("Logs", text, (Table("logs", header, rows),))


def jitter(log: Log) -> tuple[float, float]:
    """RMS deviation of the intervals between stamps from the nominal one, gaps left out; longest interval. [s]"""
    intervals = np.diff(log.t)
    if len(intervals) == 0:
        return 0.0, 0.0
    nominal = 1.0 / log.sample_rate
    usual = intervals[intervals < 1.6 * nominal]
    return float(np.sqrt(np.mean((usual - nominal) ** 2))) if len(usual) else 0.0, float(intervals.max())
