"""Under which conditions a run was recorded: health of the logs, temperatures, and provenance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.core import counted
from agent.pages.elements import Section, Table
from agent.recording import Log


@dataclass(frozen=True)
class LogHealth:
    """The row of a log on the page, so that the log need not be read again."""

    row: tuple[str, ...]
    lost: int
    repairs: int

    @classmethod
    def of(cls, log: Log) -> LogHealth:
        """Samples, losses, repairs and jitter of a log."""
        lost = int(log.metadata.get("lost_samples", "0") or 0)
        uneven, longest = jitter(log)
        figures = (str(len(log.t)), str(lost), f"{log.t[-1] - log.t[0]:.1f}", f"{log.sample_rate:g}")
        clock = (f"{1e6 * uneven:.1f}", f"{1e3 * longest:.2f}", "; ".join(map(str, log.repairs)) or "none")
        return cls((log.name, *figures, *clock), lost, len(log.repairs))


def log_section(logs: Sequence[LogHealth]) -> Section:
    """Samples, losses, repairs and jitter of every log."""
    lost, repairs = sum(log.lost for log in logs), sum(log.repairs for log in logs)
    header = ("log", "samples", "lost", "seconds", "rate [Hz]", "jitter [µs RMS]", "longest interval [ms]", "repairs")
    first = f"{lost} samples were lost and are marked in the logs." if lost else "No sample was lost."
    second = f" The reader made {counted(repairs, 'repair')}." if repairs else ""
    text = (first + second, "Jitter: variation of the interval between the controller's time stamps, without gaps.")
    return Section("Logs", text, (Table("logs", header, [log.row for log in logs]),))


def jitter(log: Log) -> tuple[float, float]:
    """RMS deviation of the intervals between stamps from the nominal one, gaps left out; longest interval. [s]"""
    intervals = np.diff(log.t)
    if len(intervals) == 0:
        return 0.0, 0.0
    nominal = 1.0 / log.sample_rate
    usual = intervals[intervals < 1.6 * nominal]
    return float(np.sqrt(np.mean((usual - nominal) ** 2))) if len(usual) else 0.0, float(intervals.max())


def conditions_section(conditions: dict[str, Any], joints: Sequence[str]) -> Section:
    """Temperatures, and the change of friction while the arm moved."""
    rates, rate_stds = (conditions["warm_up"][key] for key in ("rate_per_s", "standard_deviation"))
    temperatures = conditions["temperatures_c"] or {}
    first, last = (temperatures.get(key) or [None] * len(joints) for key in ("first", "last"))
    rows = [
        (joint, number(rate, 6000, "+.3f"), number(std, 6000, ".3f"), number(start), number(end))
        for joint, rate, std, start, end in zip(joints, rates, rate_stds, first, last, strict=True)
    ]
    text = (
        f"{conditions['cycles']} cycles, {conditions['motion_s']:.0f} s of motion. Friction falls as a cold "
        "arm warms up; the trends correct for that."
        + ("" if temperatures else " No temperatures from this controller."),
    )
    header = ("axis", "friction changes by [%/min]", "std. dev.", "motor at the start [°C]", "at the end [°C]")
    return Section("Conditions", text, (Table("conditions", header, rows),))


def provenance_section(result: dict[str, Any]) -> Section:
    """Versions, and SHA-256 of everything that went into the run."""
    return Section("Provenance", (), (Table("provenance", ("what", "value"), list(result["provenance"].items())),))


def percent(share: float | None) -> str:
    """Three decimals of a share, without the sign; "-" where there is none."""
    return number(share, 100.0, ".3f")


def number(value: float | None, scale: float = 1.0, form: str = ".1f") -> str:
    """A number for a table; "-" where there is none."""
    return "-" if value is None or not np.isfinite(value) else f"{scale * value:{form}}"
