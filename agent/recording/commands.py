"""Set-points of a log that has no topic of them as joint states: of controllers' states, or of topics of commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from agent.core import InputError
from agent.recording.datasets.episodes import HELD, HOLD, SMOOTH, Episode
from agent.recording.datasets.position_commands import are_followed
from agent.recording.log import NANO, Repair
from agent.recording.mcap.message_forms import NAMELESS
from agent.recording.mcap.scan import Messages, Scan
from agent.recording.repair.held import held, interpolated


@dataclass(frozen=True, eq=False)
class CommandedPositions:
    """Set-points (S, n) on the stamps of a log, what the record `run` says of them, and what there is to say."""

    values: np.ndarray | None = None
    facts: dict[str, str] = field(default_factory=dict)
    repairs: tuple[Repair, ...] = ()


def commanded(
    scanned: Scan,
    states: Sequence[str],
    names: Sequence[str],
    stamp: np.ndarray,
    position: np.ndarray,
    late: int,
    wanted: str | None,
) -> CommandedPositions:
    """Set-points of the named joints at the stamps (S,) [ns] of their positions (S, n), received `late` [ns].

    The first of these that there is: the topic that is `wanted`, set-points in the messages of the `states`, those of
    another controller, and a topic of commands.

    Raises:
        InputError: the wanted topic has no set-points of these joints.
    """
    offers = {**scanned.set_points, **scanned.commands}
    fitting = {topic: rows for topic, groups in offers.items() if (rows := _columns(groups, names)) is not None}
    if wanted is not None and wanted in offers and wanted not in states:
        if wanted not in fitting:
            raise InputError(f"{wanted}: holds no set-points of {', '.join(names)}")
        fitting = {wanted: fitting[wanted]}
    for several in ([t for t in fitting if t in states], [t for t in fitting if t in scanned.set_points], [*fitting]):
        if len(several) == 1:
            commands = _on_stamps(scanned, several[0], fitting[several[0]], stamp, position, late)
            return replace(commands, repairs=()) if several[0] in states and commands.values is not None else commands
        followed = {topic: _on_stamps(scanned, topic, fitting[topic], stamp, position, late) for topic in several}
        followed = {topic: commands for topic, commands in followed.items() if commands.values is not None}
        if len(followed) == 1:
            return next(iter(followed.values()))
        if several:
            kind = f"several topics of set-points, none taken; choose one with --topic: {', '.join(several)}; topics"
            return CommandedPositions(repairs=(Repair(kind, 0.0, len(several)),))
    return CommandedPositions()


@dataclass(frozen=True, eq=False)
class _Rows:
    """Set-points (C, n) with the stamps (C,) [ns] at which they hold, and those at which they were sent."""

    stamp: np.ndarray
    sent: np.ndarray
    values: np.ndarray
    received: bool
    nameless: bool


def _columns(groups: Sequence[Messages], names: Sequence[str]) -> _Rows | None:
    """Set-points of the named joints; of messages without names, if there are as many numbers."""
    parts = []
    for group in groups:
        own = group.layout.names
        nameless = own[0].startswith(NAMELESS)
        if group.position is None or not (set(names) <= set(own) or (nameless and len(own) == len(names))):
            continue
        columns = [k if nameless else own.index(name) for k, name in enumerate(names)]
        parts.append((group, group.position[:, columns], nameless))
    if not parts:
        return None
    stamp, sent = (np.concatenate([getattr(group, name) for group, _, _ in parts]) for name in ("stamp", "sent"))
    values = np.concatenate([values for _, values, _ in parts])
    order = np.lexsort((stamp, sent))
    known = order[np.all(np.isfinite(values[order]), axis=1)]
    received = all(np.array_equal(group.sent, group.received) for group, _, _ in parts)
    return _Rows(stamp[known], sent[known], values[known], received, any(nameless for _, _, nameless in parts))


def _on_stamps(
    scanned: Scan, topic: str, rows: _Rows, stamp: np.ndarray, position: np.ndarray, late: int
) -> CommandedPositions:
    """Set-points at the stamps of the samples."""
    late = late if rows.received else 0
    at, sent = rows.stamp - late, rows.sent - late
    if len(at) < 2:
        return CommandedPositions(repairs=(Repair(f"{topic}: too few set-points, left out", 0.0, len(at)),))
    steps = topic in scanned.commands and np.array_equal(at, sent)
    if steps:
        values = held(stamp, at, rows.values)
    else:
        begin = np.clip(sent[0], stamp[0], stamp[-1])
        start = position[min(int(np.searchsorted(stamp, begin)), len(stamp) - 1)]
        at, knots = _followed(at, sent, rows.values, start) if topic in scanned.commands else (at, rows.values)
        at, first = np.unique(at, return_index=True)
        values = interpolated(stamp, at, knots[first])
    known = np.all(np.isfinite(values), axis=1)
    if not known.any():
        when = (int(at[0]) - int(stamp[0])) / NANO
        return CommandedPositions(repairs=(Repair(f"{topic}: set-points at other times, left out", when, len(at)),))
    episode = Episode(topic, (stamp[known] - stamp[0]) / NANO, position[known], values[known])
    if rows.nameless and not are_followed(episode):
        return CommandedPositions(
            repairs=(Repair(f"{topic}: numbers that the joints do not follow, left out", 0.0, len(at)),)
        )
    facts = {HOLD: HELD if steps else SMOOTH}
    kind = f"set-points of {topic}" + (", taken in the order of the arm" if rows.nameless else "")
    return CommandedPositions(values, facts, (Repair(f"{kind}; samples", 0.0, int(known.sum())),))


def _followed(at: np.ndarray, sent: np.ndarray, values: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of trajectories as they were followed: the first begins at the position (n,) `start`, and each ends where
    the next one is sent."""
    starts = np.flatnonzero(np.append(True, np.diff(sent) != 0))
    times = [int(sent[0])] if at[0] > sent[0] else []
    points = [start] if times else []
    for first, stop in zip(starts, [*starts[1:], len(sent)], strict=True):
        begin = int(sent[first])
        while times and times[-1] > begin:
            last, at_last = times.pop(), points.pop()
            if times and times[-1] <= begin:
                share = (begin - times[-1]) / max(last - times[-1], 1)
                times.append(begin)
                points.append(points[-1] + share * (at_last - points[-1]))
        if times and times[-1] < begin:
            times.append(begin)
            points.append(points[-1])
        times += at[first:stop].tolist()
        points += [*values[first:stop]]
    return np.array(times), np.array(points)
