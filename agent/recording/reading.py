"""From an MCAP file to a `Log`: which topic, which joints, what is missing, and what had to be repaired."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from agent.core import InputError
from agent.recording.commands import commanded
from agent.recording.datasets.episodes import UNITS
from agent.recording.datasets.units import units_of_columns
from agent.recording.log import EFFORT, NANO, Log, Repair
from agent.recording.mcap.log_file import PLANNED, REFERENCES, RUN
from agent.recording.mcap.scan import Messages, Scan, scan
from agent.recording.mcap.topics import choose_topics, namesake
from agent.recording.repair.outliers import Jumps, find_spikes, impossible, mend_jumps
from agent.recording.repair.stamps import BRIDGED, Order, far_off, match, put_in_order, spacing_of
from agent.recording.scratch import Scratch
from agent.robot import RobotDescription

_FIELDS = ("position", "velocity", "effort")
#: Set-points belong to a sample if their stamps differ by at most this part of the period.
_SAME_STAMP = 0.1
#: [rad or m] A joint that travels further than this in a log moves.
_MOVED = 0.01
#: Of joints in several messages, those further apart than this times the period are not interpolated between.
_JOINED = 2.5


@dataclass(frozen=True, eq=False)
class _Table:
    """Whole, finite samples of the named joints.

    `stamp` (S,) [ns]; `arrays` (S, n): position and, where there are, velocity and effort; `first`: earliest stamp [ns]
    of these joints, also of a sample that was left out; `without_effort`: joints that hardly have any, so that the
    effort of all is left out.
    """

    first: int
    stamp: np.ndarray
    arrays: dict[str, np.ndarray]
    repairs: tuple[Repair, ...]
    without_effort: tuple[str, ...] = ()

    def order(self, name: str) -> Order:
        """Which samples to take, by their stamps; velocity does not distinguish one sample from another."""
        values = [self.arrays[key] for key in ("position", "effort") if key in self.arrays]
        return put_in_order(self.stamp, values, name)

    def taken(self, rows: np.ndarray, scratch: Scratch) -> _Table:
        """The samples of some rows, in that order."""
        arrays = {key: scratch.keep(values[rows]) for key, values in self.arrays.items()}
        return replace(self, stamp=self.stamp[rows], arrays=arrays)


def read_log(path: str | Path, robot: RobotDescription | None = None, topic: str | None = None) -> Log:
    """Read a log by docs/logs.md, whoever wrote it. `Log.repairs` lists all repairs.

    Args:
        path: MCAP file, or a bag.
        robot: joints come in its order, whatever the order and the further joints of the log; None: order of the log.
        topic: of the joint states, where there are several.

    Raises:
        InputError: neither an MCAP file nor a bag, no joint states in it, several topics that may be meant, joints of
            the robot missing, or stamps that cannot be used.
    """
    path = Path(path)
    scanned = scan(path)
    run = scanned.metadata.get(RUN, {})
    topics, names, left_out = choose_topics(path, scanned, robot, topic, run.get("robot"))
    late = scanned.receive_delay(topics)
    table, cuts, sample_repairs = _samples(path, scanned, topics, names, robot)
    stamp, arrays = table.stamp, table.arrays
    spacing = spacing_of(stamp, _nominal_rate(run))
    duration = (int(stamp[-1]) - int(stamp[0])) / NANO
    repairs = [*left_out, *_file_repairs(scanned, topics[0], duration), *_run_repairs(run, spacing.repairs)]
    repairs += [*sample_repairs, *spacing.repairs]
    t = (stamp - stamp[0]) / NANO
    references, planned = (
        _set_points(scanned, namesake(scanned, wanted, topics[0]), names, stamp, spacing.rate, repairs)
        for wanted in (REFERENCES, PLANNED)
    )
    if references is None:
        commands = commanded(scanned, topics, names, stamp, arrays["position"], late, topic)
        references = commands.values
        run = run | commands.facts
        repairs += commands.repairs
    if topics[0] in scanned.effort_is:
        run = {EFFORT: scanned.effort_is[topics[0]]} | run
    if scanned.types[topics[0]].endswith("(json)"):
        references, run = _in_radians(path, arrays, references, names, run)
    pieces = [[a, *(cut for cut in cuts if a < cut < b), b] for a, b in spacing.segments]
    return Log(
        path=path,
        joint_names=names if robot is None else robot.joint_names,
        t=t,
        position=arrays["position"],
        velocity=arrays.get("velocity"),
        effort=arrays.get("effort"),
        reference_position=references,
        planned_position=planned,
        sample_rate=spacing.rate,
        even=spacing.even,
        stamp=int(stamp[0]) / NANO,
        segments=tuple(segment for piece in pieces for segment in pairwise(piece)),
        cycle_starts=_cycle_starts(run, (int(stamp[0]) - table.first) / NANO, duration, repairs),
        metadata=run,
        repairs=tuple(repairs),
        breaks=tuple(t[list(cuts)].tolist()),
        sha256=scanned.sha256,
        without_effort=table.without_effort,
        scratch=scanned.scratch,
    )


def _samples(
    path: Path, scanned: Scan, topics: Sequence[str], names: tuple[str, ...], robot: RobotDescription | None
) -> tuple[_Table, tuple[int, ...], list[Repair]]:
    """Samples of the named joints in order and mended, those to cut before, and what was repaired."""
    table = _table([group for each in topics for group in scanned.topics.pop(each)], names, scanned.scratch)
    if table is None:
        raise InputError(
            f"{path}: {topics[0]}: no message holds finite numbers that an arm can have of {', '.join(names)}"
        )
    order = table.order(str(path))
    table = replace(table.taken(order.rows, scanned.scratch), stamp=order.stamp)
    table, cuts, mended = _mended(table, robot, scanned.scratch)
    return table, cuts, [*table.repairs, *order.repairs, *mended]


def _mended(
    table: _Table, robot: RobotDescription | None, scratch: Scratch
) -> tuple[_Table, tuple[int, ...], list[Repair]]:
    """The table without samples that cannot be, samples to cut it before, and what there is to say."""
    jumps = Jumps() if robot is None else mend_jumps(table.stamp, table.arrays["position"], robot)
    spikes = find_spikes(table.arrays["effort"]) if "effort" in table.arrays else np.array([], int)
    time = (table.stamp - table.stamp[0]) / NANO
    repairs = [*jumps.repairs, *Repair.of("samples whose torque stands out alone, dropped", time, spikes)]
    dropped = np.union1d(jumps.dropped, spikes).astype(int)
    cuts = tuple(int(cut - np.searchsorted(dropped, cut)) for cut in jumps.cuts)
    if len(dropped):
        table = table.taken(np.delete(np.arange(len(table.stamp)), dropped), scratch)
    velocity = table.arrays.get("velocity")
    if velocity is not None and not velocity.any() and np.any(np.ptp(table.arrays["position"], axis=0) > _MOVED):
        del table.arrays["velocity"]
        kind = "samples with a velocity of zero though the arm moves, so all velocity left out"
        repairs.append(Repair(kind, 0.0, len(table.stamp)))
    return table, cuts, repairs


def _table(groups: list[Messages], names: tuple[str, ...], scratch: Scratch) -> _Table | None:
    """Whole, finite samples of the named joints in the order of the file; None where there is none."""
    ours = [group for group in groups if set(names) <= set(group.layout.names)]
    usable = [group for group in ours if group.layout.whole]
    if not usable:
        return None if ours else _joined(groups, names, scratch)
    stamps = np.concatenate([group.stamp for group in ours])
    first = int(stamps[~far_off(stamps)].min())
    stamp = np.concatenate([group.stamp for group in usable])
    time, keep = (stamp - first) / NANO, np.ones(len(stamp), bool)
    repairs: list[Repair] = []
    arrays: dict[str, np.ndarray] = {}
    without_effort: tuple[str, ...] = ()
    for field in _FIELDS:
        values = _column(usable, field, names, scratch)
        known = np.isfinite(values)
        unknown = ~np.all(known, axis=1)
        if field != "position" and np.count_nonzero(unknown) > 0.5 * len(stamp):
            bare = tuple(name for name, share in zip(names, known.mean(axis=0), strict=True) if share < 0.5)
            if field == "effort":
                without_effort = bare
            if any(getattr(group, field) is not None for group in usable):
                repairs += Repair.of(_lacking_text(field, bare, names), time, unknown)
            continue
        wild = impossible(values, field) & ~unknown
        for rows, kind in ((unknown, f"without a finite {field}"), (wild, f"with a {field} that no arm can have")):
            repairs += Repair.of(f"samples {kind}, dropped", time, rows & keep)
            keep &= ~rows
        arrays[field] = values
    if not keep.any():
        return None
    for kind, left_out in (
        ("messages of other joints, left out", [group.stamp for group in groups if group not in ours]),
        ("samples with arrays of wrong length, dropped", [group.stamp for group in ours if not group.layout.whole]),
    ):
        repairs += Repair.of(kind, (np.concatenate([*left_out, stamp[:0]]) - first) / NANO)
    in_file = np.argsort(np.concatenate([group.order for group in usable]), kind="stable")
    return _Table(first, stamp, arrays, tuple(repairs), without_effort).taken(in_file[keep[in_file]], scratch)


def _column(groups: list[Messages], field: str, names: tuple[str, ...], scratch: Scratch) -> np.ndarray:
    """(S, n) values of the named joints, NaN where a message has none."""
    parts = []
    for group in groups:
        values = getattr(group, field)
        if values is None:
            parts.append(np.full((len(group.stamp), len(names)), np.nan))
        else:
            parts.append(np.take(values, [group.layout.names.index(name) for name in names], axis=1))
    return scratch.keep(np.concatenate(parts))


def _lacking_text(field: str, bare: Sequence[str], names: Sequence[str]) -> str:
    """Text about a quantity that some of the joints lack."""
    whose = f" of {', '.join(bare)}" if 0 < len(bare) < len(names) else ""
    return f"samples without a finite {field}{whose}, so all {field} left out"


def _joined(groups: list[Messages], names: tuple[str, ...], scratch: Scratch) -> _Table | None:
    """Samples of joints that come in several messages, on the stamps of the part that has the fewest.

    Where stamps are the same the values stay as they are; else those of the others are interpolated.
    """
    ordered: dict[tuple[str, ...], _Table] = {}
    for part, messages in _parts(groups, names).items():
        table = _table(messages, part, scratch)
        if table is None or len(table.stamp) < 2:
            return None
        stamp, rows = np.unique(table.stamp, return_index=True)
        ordered[part] = replace(table.taken(rows, scratch), stamp=stamp)
    if {name for part in ordered for name in part} != set(names):
        return None
    base = min(ordered.values(), key=lambda table: len(table.stamp))
    first = min(table.first for table in ordered.values())
    t, covered = (base.stamp - first) / NANO, np.ones(len(base.stamp), bool)
    fields = [field for field in _FIELDS if all(field in table.arrays for table in ordered.values())]
    arrays = {field: np.empty((len(t), len(names))) for field in fields}
    for part, table in ordered.items():
        times = (table.stamp - first) / NANO
        after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
        around = np.where(t == times[after], 0.0, times[after] - times[after - 1])
        covered &= (t >= times[0]) & (t <= times[-1]) & (around <= _JOINED * np.median(np.diff(times)))
        for field, values in arrays.items():
            for k, name in enumerate(part):
                values[:, names.index(name)] = np.interp(t, times, table.arrays[field][:, k])
    if np.count_nonzero(covered) < 2:
        return None
    without = [name for part, table in ordered.items() if "effort" not in table.arrays for name in part]
    bare = tuple(name for name in names if name in without)
    listed = " + ".join(str(len(part)) for part in ordered)
    repairs = [repair for table in ordered.values() for repair in table.repairs]
    repairs.append(Repair(f"joints in several messages ({listed}), joined by stamp; samples", 0.0, int(covered.sum())))
    if 0 < len(bare) < len(names):
        repairs.append(Repair(_lacking_text("effort", bare, names), 0.0, len(base.stamp)))
    return _Table(first, base.stamp, arrays, tuple(repairs), bare).taken(np.flatnonzero(covered), scratch)


def _parts(groups: list[Messages], names: tuple[str, ...]) -> dict[tuple[str, ...], list[Messages]]:
    """Messages by which of the joints they hold, the most frequent first; parts that share a joint are left out."""
    by_joints: dict[tuple[str, ...], list[Messages]] = {}
    for group in groups:
        if part := tuple(name for name in names if name in group.layout.names):
            by_joints.setdefault(part, []).append(group)
    parts: dict[tuple[str, ...], list[Messages]] = {}
    for part in sorted(by_joints, key=lambda part: -sum(len(group.stamp) for group in by_joints[part])):
        if not any(set(part) & set(other) for other in parts):
            parts[part] = by_joints[part]
    return parts


def _set_points(
    scanned: Scan, topic: str | None, names: tuple[str, ...], stamp: np.ndarray, rate: float, repairs: list[Repair]
) -> np.ndarray | None:
    """(S, n) set-points on the stamps (S,) [ns] of the samples, NaN where there is none."""
    if topic is None:
        return None
    groups = scanned.topics.pop(topic)
    table, problem, when = _table(groups, names, scanned.scratch), "without a position of every joint", 0.0
    if table is not None:
        try:
            order = table.order(topic)
        except InputError:
            problem = "with unusable stamps"
        else:
            nearest, same = match(stamp, order.stamp, _SAME_STAMP / rate)
            if same.any():
                values = table.arrays["position"][order.rows[nearest]]
                values[~same] = np.nan
                return scanned.scratch.keep(values)
            problem, when = "without a sample at their stamps", (int(order.stamp[0]) - int(stamp[0])) / NANO
    total = sum(len(group.stamp) for group in groups)
    repairs.append(Repair(f"{topic}: messages {problem}, left out", when, total))
    return None


def _in_radians(
    path: Path, arrays: dict[str, np.ndarray], references: np.ndarray | None, names: Sequence[str], run: dict[str, str]
) -> tuple[np.ndarray | None, dict[str, str]]:
    """Turn positions of a recorder whose unit nothing says into rad; returns set-points in rad, and the record."""
    try:
        units = units_of_columns(names, arrays["position"])
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    factors = np.array([1.0 if unit.factor is None else unit.factor for unit in units])
    arrays["position"] = arrays["position"] * factors
    units_text = "; ".join(dict.fromkeys(f"{unit.name}: {unit.found}" for unit in units))
    return (None if references is None else references * factors), {UNITS: units_text} | run


def _nominal_rate(run: dict[str, str]) -> float | None:
    try:
        rate = float(run["sample_rate_hz"])
    except (KeyError, ValueError):
        return None
    return rate if np.isfinite(rate) and rate > 0 else None


def _file_repairs(scanned: Scan, topic: str, end: float) -> list[Repair]:
    repairs = []
    if not scanned.closed:
        repairs.append(
            Repair("the file was not closed by its writer; unreadable bytes at its end", end, scanned.dropped)
        )
    if scanned.damaged:
        repairs.append(
            Repair(f"damaged chunks, left out (first: number {scanned.damaged[0]})", 0.0, len(scanned.damaged))
        )
    if scanned.unreadable[topic]:
        repairs.append(Repair("messages that cannot be decoded, left out", 0.0, scanned.unreadable[topic]))
    return repairs


def _run_repairs(run: dict[str, str], stamp_repairs: Sequence[Repair]) -> list[Repair]:
    """Losses that the writer counted and the stamps do not show."""
    missing = sum(repair.count for repair in stamp_repairs if "missing samples" in repair.kind)
    repairs = []
    for key, kind, known in (
        ("lost_samples", "lost on the link", missing),
        ("repeated_samples", "repeated on the link, left out by the writer", 0),
    ):
        text = run.get(key, "0")
        if text.isdecimal() and len(text) < 19 and int(text) > known:
            repairs.append(Repair(kind, 0.0, int(text)))
    return repairs


def _cycle_starts(run: dict[str, str], before: float, duration: float, repairs: list[Repair]) -> tuple[float, ...]:
    """Cycle starts [s] from the first sample that was kept; the first one in the file was `before` [s] earlier."""
    if "cycle_starts_s" not in run:
        return ()
    try:
        starts = [float(start) - before for start in json.loads(run["cycle_starts_s"])]
    except (ValueError, TypeError, OverflowError, RecursionError):
        starts = [np.nan]
    # a cycle may have begun with a sample that was left out
    usable = sorted({max(start, 0.0) for start in starts if -BRIDGED <= start <= duration})
    if len(usable) < len(starts) or sorted(starts) != starts:
        kind = "cycle_starts_s is no rising list of seconds within the log, used as far as possible; entries"
        repairs.append(Repair(kind, 0.0, len(starts)))
    return tuple(usable)
