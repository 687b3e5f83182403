"""From an MCAP file to a `Log`: which topic, which joints, what is missing, and what had to be repaired."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from agent.core import InputError
from agent.recording.log import Log, Repair
from agent.recording.mcap.log_file import PLANNED, REFERENCES, RUN, STATES
from agent.recording.mcap.scan import Messages, Scan, scan
from agent.recording.repair.jumps import Mended, mend_jumps
from agent.recording.repair.limits import impossible
from agent.recording.repair.spikes import find_spikes
from agent.recording.repair.stamps import BRIDGED, far_off, match, put_in_order, spacing_of
from agent.recording.scratch import Scratch
from agent.robot import RobotDescription

_NANO = 1_000_000_000
#: Set-points belong to a sample if their stamps differ by at most this part of the period.
_SAME_STAMP = 0.1
#: [rad or m] A joint that travels further than this in a log moves.
_MOVED = 0.01
#: As `scan` names the type of a log's measured states.
_STATES_TYPE = "sensor_msgs/msg/JointState (cdr)"


@dataclass(frozen=True, eq=False)
class _Table:
    """Samples of one topic in the order of the file: stamp (S,) [ns]; `arrays` (S, n): position and, where there are,
    velocity and effort; `first`: earliest stamp [ns] of these joints, also of a sample that was left out."""

    first: int
    stamp: np.ndarray
    arrays: dict[str, np.ndarray]
    repairs: tuple[Repair, ...]

    @property
    def measured(self) -> list[np.ndarray]:
        """What tells one sample from another."""
        return [values for field, values in self.arrays.items() if field != "velocity"]


def read_log(path: str | Path, robot: RobotDescription | None = None) -> Log:
    """Read a log by docs/logs.md, whoever wrote it.

    Joints come in the order of `robot`, whatever the order and the further joints of the log; without a robot, in the
    order of the log. What is repaired stands in `Log.repairs`.

    Raises:
        InputError: not an MCAP file, no joint states in it, joints of the robot missing, or stamps that cannot be used.
    """
    path = Path(path)
    found = scan(path)
    topic = _topic(found, STATES)
    if topic is None:
        raise InputError(f"{path}: {_no_joint_states(found)}")
    run = found.metadata.get(RUN, {})
    names = _joint_names(path, found.topics[topic], robot, run.get("robot"))
    table = _table(found.topics.pop(topic), names, found.scratch)
    if table is None:
        raise InputError(f"{path}: {topic}: no message holds a finite position of every joint ({', '.join(names)})")
    order = put_in_order(table.stamp, table.measured, str(path))
    arrays, rows = table.arrays, order.rows
    if len(rows) < len(table.stamp) or np.any(np.diff(rows) != 1):
        arrays = _taken(found.scratch, arrays, rows)
    stamp, arrays, cuts, mended = _mended(order.stamp, arrays, robot, found.scratch)
    if "velocity" in arrays and _never_filled(arrays["velocity"], arrays["position"], found.scratch):
        del arrays["velocity"]
        kind = "samples with a velocity of zero though the arm moves, so all velocity left out"
        mended.append(_repair(kind, stamp, int(stamp[0])))
    spacing = spacing_of(stamp, _nominal_rate(run))
    duration = (int(stamp[-1]) - int(stamp[0])) / _NANO
    repairs = [*_file_repairs(found, topic, duration), *_run_repairs(run, spacing.repairs)]
    repairs += [*table.repairs, *order.repairs, *mended, *spacing.repairs]
    t = (stamp - stamp[0]) / _NANO
    references = _set_points(found, REFERENCES, names, stamp, spacing.rate, repairs)
    planned = _set_points(found, PLANNED, names, stamp, spacing.rate, repairs)
    return Log(
        path=path,
        joint_names=names,
        t=t,
        position=arrays["position"],
        velocity=arrays.get("velocity"),
        effort=arrays.get("effort"),
        reference_position=references,
        planned_position=planned,
        sample_rate=spacing.rate,
        even=spacing.even,
        stamp=int(stamp[0]) / _NANO,
        segments=_cut(spacing.segments, cuts),
        cycle_starts=_cycle_starts(run, (int(stamp[0]) - table.first) / _NANO, duration, repairs),
        metadata=run,
        repairs=tuple(repairs),
        breaks=tuple(t[list(cuts)].tolist()),
        sha256=found.sha256,
        scratch=found.scratch,
    )


def _mended(
    stamp: np.ndarray, arrays: dict[str, np.ndarray], robot: RobotDescription | None, scratch: Scratch
) -> tuple[np.ndarray, dict[str, np.ndarray], tuple[int, ...], list[Repair]]:
    """Stamps (S,) and arrays without samples that cannot be, where to cut them, and what there is to say."""
    jumps = Mended() if robot is None else mend_jumps(stamp, arrays["position"], robot, scratch)
    spikes = find_spikes(arrays["effort"], scratch) if "effort" in arrays else np.array([], int)
    repairs = list(jumps.repairs)
    if len(spikes):
        kind = "samples whose torque stands out alone, dropped"
        repairs.append(_repair(kind, stamp[spikes], int(stamp[0])))
    dropped = np.union1d(jumps.dropped, spikes).astype(int)
    cuts = tuple(int(cut - np.searchsorted(dropped, cut)) for cut in jumps.cuts)
    if len(dropped):
        keep = np.delete(np.arange(len(stamp)), dropped)
        stamp, arrays = stamp[keep], _taken(scratch, arrays, keep)
    return stamp, arrays, cuts, repairs


def _never_filled(velocity: np.ndarray, position: np.ndarray, scratch: Scratch) -> bool:
    """Whether a recorder has left the velocity (S, n) at zero from end to end while a joint moved."""
    if any(velocity[part].any() for part in scratch.parts(len(velocity))):
        return False
    ends = [(position[part].min(axis=0), position[part].max(axis=0)) for part in scratch.parts(len(position))]
    lowest, highest = zip(*ends, strict=True)
    return bool(np.any(np.max(highest, axis=0) - np.min(lowest, axis=0) > _MOVED))


def _taken(scratch: Scratch, arrays: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    return {field: scratch.take(values, rows) for field, values in arrays.items()}


def _cut(segments: Sequence[tuple[int, int]], cuts: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """[start, stop) ranges, cut before some samples."""
    pieces: list[tuple[int, int]] = []
    for start, stop in segments:
        pieces += pairwise([start, *(cut for cut in cuts if start < cut < stop), stop])
    return tuple(pieces)


def _topic(found: Scan, wanted: str) -> str | None:
    """The topic of that name, or the only one that has it below a namespace."""
    if found.topics.get(wanted):
        return wanted
    others = [topic for topic in found.topics if topic.rstrip("/").endswith(wanted) or f"/{topic}" == wanted]
    return others[0] if len(others) == 1 else None


def _no_joint_states(found: Scan) -> str:
    empty = found.types.get(STATES) == _STATES_TYPE and not found.unreadable
    if not found.types or (empty and not found.closed):
        return "no messages in it" + ("" if found.closed else "; its writer stopped before it had written any")
    topics = ", ".join(f"{topic}: {kind}" for topic, kind in sorted(found.types.items()))
    if empty:
        return f"the topic {STATES} is in it without a single message: was it published while this was recorded?"
    return f"no readable {STATES} of type {_STATES_TYPE} in it; it has {topics}"


def _joint_names(
    path: Path, groups: Sequence[Messages], robot: RobotDescription | None, named: str | None
) -> tuple[str, ...]:
    """Of the robot, or of the log without one; `named` is the robot that the log says it is of."""
    counts: Counter[tuple[str, ...]] = Counter()
    for group in groups:
        counts[group.layout.names] += len(group.stamp)
    most = counts.most_common(1)[0][0]
    if robot is None:
        if len(set(most)) != len(most) or not most:
            raise InputError(f"{path}: joint names are empty or stand twice in a message: {list(most)}")
        return most
    if not any(set(robot.joint_names) <= set(names) for names in counts):
        closest = max(counts, key=lambda names: len(set(names) & set(robot.joint_names)))
        missing = [name for name in robot.joint_names if name not in closest]
        raise InputError(
            f"{path}: the log is {f'of robot {named!r}, ' if named else ''}not of robot {robot.name!r}: "
            f"{', '.join(missing)} missing, its joints are "
            f"{', '.join(closest) or 'without names'}. Name the robot description that belongs to the log"
        )
    return robot.joint_names


def _table(groups: list[Messages], names: tuple[str, ...], scratch: Scratch) -> _Table | None:
    """Whole, finite samples of the named joints, and what was left out."""
    others = [group for group in groups if not set(names) <= set(group.layout.names)]
    ours = [group for group in groups if set(names) <= set(group.layout.names)]
    usable = [group for group in ours if group.layout.whole]
    if not usable:
        return None
    stamps = np.concatenate([group.stamp for group in ours])
    first = int(stamps[~far_off(stamps)].min())
    stamp = np.concatenate([group.stamp for group in usable])
    order = np.concatenate([group.order for group in usable])
    keep = np.ones(len(stamp), bool)
    repairs: list[Repair] = []
    arrays: dict[str, np.ndarray] = {}
    for field in ("position", "velocity", "effort"):
        values = _column(usable, field, names, scratch)
        unknown = np.concatenate([~np.all(np.isfinite(values[part]), axis=1) for part in scratch.parts(len(values))])
        if field != "position" and np.count_nonzero(unknown) > 0.5 * len(stamp):
            if any(getattr(group, field) is not None for group in usable):
                kind = f"samples without a finite {field}, so all {field} left out"
                repairs.append(_repair(kind, stamp[unknown], first))
            continue
        torn = impossible(values, field, scratch) & ~unknown
        for rows, kind in ((unknown, f"without a finite {field}"), (torn, f"with a {field} that no arm can have")):
            if (rows & keep).any():
                repairs.append(_repair(f"samples {kind}, dropped", stamp[rows & keep], first))
            keep &= ~rows
        arrays[field] = values
    if not keep.any():
        return None
    if not keep.all() or np.any(np.diff(order) < 0):
        rows = np.argsort(order, kind="stable")
        rows = rows[keep[rows]]
        stamp = stamp[rows]
        arrays = _taken(scratch, arrays, rows)
    torn_up = [group for group in ours if not group.layout.whole]
    for kind, left_out in (
        ("messages of other joints, left out", others),
        ("samples with arrays of wrong length, dropped", torn_up),
    ):
        if left_out:
            repairs.append(_repair(kind, np.concatenate([group.stamp for group in left_out]), first))
    return _Table(first, stamp, arrays, tuple(repairs))


def _column(groups: list[Messages], field: str, names: tuple[str, ...], scratch: Scratch) -> np.ndarray:
    """(S, n) values of the named joints, NaN where a message has none."""
    result = scratch.empty((sum(len(group.stamp) for group in groups), len(names)))
    start = 0
    for group in scratch.each(groups):
        stop = start + len(group.stamp)
        values = getattr(group, field)
        if values is None:
            result[start:stop] = np.nan
        elif group.layout.names == names:
            result[start:stop] = values
        else:
            result[start:stop] = values[:, [group.layout.names.index(name) for name in names]]
        start = stop
    return result


def _set_points(
    found: Scan, wanted: str, names: tuple[str, ...], stamp: np.ndarray, rate: float, repairs: list[Repair]
) -> np.ndarray | None:
    """(S, n) set-points on the stamps (S,) [ns] of the samples, NaN where there is none."""
    topic = _topic(found, wanted)
    if topic is None:
        return None
    groups = found.topics.pop(topic)
    total = sum(len(group.stamp) for group in groups)
    table = _table(groups, names, found.scratch)
    if table is None:
        repairs.append(Repair(f"{topic}: messages without a position of every joint, left out", 0.0, total))
        return None
    try:
        order = put_in_order(table.stamp, table.measured, topic)
    except InputError:
        repairs.append(Repair(f"{topic}: messages with unusable stamps, left out", 0.0, total))
        return None
    nearest, same = match(stamp, order.stamp, _SAME_STAMP / rate)
    if not same.any():
        where = (int(order.stamp[0]) - int(stamp[0])) / _NANO
        repairs.append(Repair(f"{topic}: messages without a sample at their stamps, left out", where, total))
        return None
    values = found.scratch.take(table.arrays["position"], order.rows[nearest])
    values[~same] = np.nan
    return values


def _nominal_rate(run: dict[str, str]) -> float | None:
    try:
        rate = float(run["sample_rate_hz"])
    except (KeyError, ValueError):
        return None
    return rate if np.isfinite(rate) and rate > 0 else None


def _file_repairs(found: Scan, topic: str, end: float) -> list[Repair]:
    repairs = []
    if not found.closed:
        repairs.append(Repair("the file was not closed by its writer; unreadable bytes at its end", end, found.dropped))
    if found.damaged:
        repairs.append(Repair(f"damaged chunks, left out (first: number {found.damaged[0]})", 0.0, len(found.damaged)))
    if found.unreadable[topic]:
        repairs.append(Repair("messages that cannot be decoded, left out", 0.0, found.unreadable[topic]))
    return repairs


def _run_repairs(run: dict[str, str], seen: Sequence[Repair]) -> list[Repair]:
    """What the writer counted and the stamps do not show."""
    missing = sum(repair.count for repair in seen if "missing samples" in repair.kind)
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


def _repair(kind: str, stamps: np.ndarray, first: int) -> Repair:
    return Repair(kind, (int(stamps.min()) - first) / _NANO, len(stamps))
