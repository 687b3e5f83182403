"""How healthy the logs of a run are: lost samples, and how even the controller's clock was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.core import counted
from agent.recording import Log
from agent.report.page import Section, Table


@dataclass(frozen=True)
class LogHealth:
    """Of one log what its row says: `repairs` of the reader in words; jitter and longest interval [s]."""

    name: str
    samples: int
    lost: int
    seconds: float
    rate: float
    jitter: float
    longest: float
    repairs: tuple[str, ...]

    @classmethod
    def of(cls, log: Log) -> LogHealth:
        """What is kept of a log that need not be read again."""
        lost, seconds = int(log.metadata.get("lost_samples", "0") or 0), float(log.t[-1] - log.t[0])
        repairs = tuple(str(repair) for repair in log.repairs)
        return cls(log.name, len(log.t), lost, seconds, log.sample_rate, *jitter(log), repairs)


def log_section(logs: Sequence[LogHealth]) -> Section:
    """Samples, losses, repairs and jitter of every log."""
    rows = [
        (
            log.name,
            str(log.samples),
            str(log.lost),
            f"{log.seconds:.1f}",
            f"{log.rate:g}",
            f"{1e6 * log.jitter:.1f}",
            f"{1e3 * log.longest:.2f}",
            "; ".join(log.repairs) or "none",
        )
        for log in logs
    ]
    lost_in_all, repairs = sum(log.lost for log in logs), sum(len(log.repairs) for log in logs)
    header = ("log", "samples", "lost", "seconds", "rate [Hz]", "jitter [µs RMS]", "longest interval [ms]", "repairs")
    first = (
        "No sample was lost." if lost_in_all == 0 else f"{lost_in_all} samples were lost and are marked in the logs."
    )
    second = "" if repairs == 0 else f" The reader made {counted(repairs, 'repair')}."
    text = (first + second, "Jitter: variation of the interval between the controller's time stamps, without gaps.")
    return Section("Logs", text, (Table("logs", header, rows),))


def jitter(log: Log) -> tuple[float, float]:
    """RMS deviation of the intervals between stamps from the nominal one, gaps left out; longest interval. [s]"""
    intervals = np.diff(log.t)
    if len(intervals) == 0:
        return 0.0, 0.0
    nominal = 1.0 / log.sample_rate
    usual = intervals[intervals < 1.6 * nominal]
    return float(np.sqrt(np.mean((usual - nominal) ** 2))) if len(usual) else 0.0, float(intervals.max())
