"""A motion log in memory, as analysis sees it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from agent.recording.scratch import Scratch

#: Nanoseconds of a second: stamps in files are integers.
NANO = 1_000_000_000
#: Keys of `Log.metadata` that say whose motion it is, where that is known.
MACHINE = ("serial", "tool", "controller")
#: Key of `Log.metadata`: what the effort is, where the driver or the user says it (docs/logs.md).
EFFORT = "effort"
#: Key of `Log.metadata`: number of parts in which a motion of pieces that differ is held out.
PARTS = "parts"
#: Parts of a motion planned for a diagnosis: after one short look, it would else be predicted from that alone.
PLANNED_PARTS = "2"
#: Attributes of `Log` that are arrays (S, n).
ARRAYS = ("position", "velocity", "effort", "reference_position", "planned_position")
#: Shortest standstill [s] of set-points that is a stop.
SHORTEST_STOP = 0.006
#: An earlier stamp [s] is a controller's time since it was switched on.
_FIRST_DATE = 946_684_800.0
_AROUND = 1.0  # s kept on either side of a cycle that is cut out of a log: filters drop less at its ends


def machines_of(logs: Sequence[Log]) -> dict[str, list[str]]:
    """Machines that logs name: the sorted values of each key of `MACHINE`."""
    return {key: sorted({log.metadata.get(key, "") for log in logs} - {""}) for key in MACHINE}


@dataclass(frozen=True)
class Repair:
    """Something the reader found in a log and dealt with: what, when [s from the first sample], how many samples."""

    kind: str
    time: float
    count: int

    def __str__(self) -> str:
        return f"{self.kind}: {self.count} at {self.time:.3f} s"

    @classmethod
    def of(cls, kind: str, times: np.ndarray, which: Any = slice(None)) -> list[Repair]:
        """One for samples at times (S,) [s], by mask or number, at the earliest of them; none where there are none."""
        moments = times[which]
        return [cls(kind, float(moments.min()), len(moments))] if len(moments) else []


@dataclass(frozen=True, eq=False)
class Log:
    """One motion, sorted by controller time. S samples, n joints, SI on the joint side.

    t (S,) [s] from the first sample, strictly increasing, even or not; position (S, n); velocity and effort (S, n) or
    None where the log has none;
    reference_position, planned_position (S, n) or None: set-points of the controller, and what was planned, on the
    same stamps (NaN where there is none). `sample_rate` [Hz] is that of intervals without a missing sample; `even`: the
    samples were taken on a grid, however late their stamps are. `segments`
    are [start, stop) sample ranges without a gap in them: stretches of at most 10 ms or two samples may be missing;
    `breaks` [s] are those of their starts at which a position jumps. `stamp` is the first
    sample's controller time [s], `sha256` of the file that was read. `scratch` owns the arrays of a long log.
    """

    path: Path
    joint_names: tuple[str, ...]
    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray | None
    effort: np.ndarray | None
    reference_position: np.ndarray | None
    planned_position: np.ndarray | None
    sample_rate: float
    stamp: float
    segments: tuple[tuple[int, int], ...]
    cycle_starts: tuple[float, ...] = ()
    metadata: dict[str, str] = field(default_factory=dict)
    repairs: tuple[Repair, ...] = ()
    breaks: tuple[float, ...] = ()
    sha256: str = ""
    without_effort: tuple[str, ...] = ()
    even: bool = True
    scratch: Scratch = field(default_factory=Scratch, repr=False)

    @property
    def name(self) -> str:
        """File name, as results report it."""
        return self.path.name

    @property
    def date(self) -> datetime | None:
        """When it begins; None where the controller's clock counts from its start."""
        return datetime.fromtimestamp(self.stamp, UTC) if self.stamp >= _FIRST_DATE else None

    def with_arrays(self, change: Callable[[np.ndarray], np.ndarray], **others: Any) -> Log:
        """A copy in which the arrays (S, n) that there are have been changed alike, and `others` are as given."""
        for name in ARRAYS:
            if name not in others and (values := getattr(self, name)) is not None:
                others[name] = change(values)
        return replace(self, **others)

    def between(self, start: float, stop: float) -> Log:
        """The samples from `start` to `stop` [s], a view; times and cycle starts stay those of the whole log."""
        first, last = np.searchsorted(self.t, (start, stop))
        clipped = [(max(a, first) - first, min(b, last) - first) for a, b in self.segments]
        return self.with_arrays(
            lambda values: values[first:last],
            t=self.t[first:last],
            segments=tuple((int(a), int(b)) for a, b in clipped if a < b),
            cycle_starts=tuple(cycle for cycle in self.cycle_starts if start <= cycle < stop),
        )

    def bridged(self, gap: float) -> tuple[tuple[int, int], ...]:
        """The segments, joined over gaps of at most `gap` [s] across which positions go on."""
        joined: list[tuple[int, int]] = []
        for start, stop in self.segments:
            if joined and self.t[start] - self.t[start - 1] <= gap and self.t[start] not in self.breaks:
                joined[-1] = (joined[-1][0], stop)
            else:
                joined.append((start, stop))
        return tuple(joined)

    def middle_cycle(self) -> tuple[float, float]:
        """Start and end [s] of the cycle nearest the middle of the log that has no gap; of all of it where none is."""
        cycles = list(pairwise(self.cycle_starts))
        spans = [(self.t[a], self.t[b - 1]) for a, b in self.segments]
        whole = [(start, stop) for start, stop in cycles if any(a <= start and stop <= b for a, b in spans)]
        half = float(self.t[0] + self.t[-1]) / 2
        everything = (float(self.t[0]), float(self.t[-1]))
        return min(whole, key=lambda cycle: abs(sum(cycle) / 2 - half), default=everything)

    def middle_part(self) -> Log:
        """That cycle alone, with what filters drop on either side of it."""
        start, stop = self.middle_cycle()
        return self.between(start - _AROUND, stop + _AROUND)
