"""Positions that no arm can have reached: encoders that wrap around, single wrong samples, lost counts.

A joint cannot move further between two samples than five times its highest speed allows, plus 10 ms of it for late
stamps. Where it seems to, something happened to its position.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.recording.log import Repair
from agent.recording.scratch import Scratch
from agent.robot import RobotDescription

_NANO = 1_000_000_000
_TIMES, _LATE = 5.0, 0.010  # of the highest speed; s
_TURN = 2 * np.pi
#: No encoder wraps after more turns than this; in larger numbers every step is near some whole turn.
_MOST_TURNS = 100
#: Longest run of wrong samples that is dropped; after a longer one the joint is taken to be there.
_TORN = 5
#: With other jumps in more than this part of the samples it is the description or a unit that is wrong.
_MAX_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Mended:
    """`dropped`: samples to leave out; `cuts`: samples before which nothing is known of where the joint was."""

    dropped: tuple[int, ...] = ()
    cuts: tuple[int, ...] = ()
    repairs: tuple[Repair, ...] = ()


def mend_jumps(stamp: np.ndarray, position: np.ndarray, robot: RobotDescription, scratch: Scratch) -> Mended:
    """Unwrap positions (S, n) in place, and tell which samples at sorted stamps (S,) [ns] to leave out or to cut at."""
    places, joints, steps, limits = _find(stamp, position, robot.max_velocity, scratch)
    turning = ~np.array([joint.prismatic for joint in robot.joints])[joints]
    turns = np.round(steps / _TURN)
    wrapped = turning & (turns != 0) & (np.abs(turns) <= _MOST_TURNS) & (np.abs(steps - turns * _TURN) <= limits)
    if np.count_nonzero(~wrapped) > _MAX_SHARE * len(stamp):
        return Mended()
    time = (stamp - stamp[0]) / _NANO
    repairs = []
    for joint in np.unique(joints[wrapped]):
        own = wrapped & (joints == joint)
        _unwrap(position, int(joint), places[own], turns[own], scratch)
        name = f"positions of {robot.joint_names[joint]} that wrap around, made continuous"
        repairs.append(Repair(name, float(time[places[own][0] + 1]), int(own.sum())))
    places, joints, steps = (values[~wrapped] for values in (places, joints, steps))
    dropped: set[int] = set()
    cuts: set[int] = set()
    known = 0
    for place, joint, step in zip(places.tolist(), joints.tolist(), steps, strict=True):
        if place < known:
            continue  # within a torn stretch, or the way back
        known = _back(stamp, position, robot.max_velocity, place)
        if known > place + 1:
            dropped.update(range(place + 1, known))
        elif place + 1 not in cuts:
            cuts.add(place + 1)
            name = f"{robot.joint_names[joint]} jumps by {step:.3g}, further than it can move; cut there"
            repairs.append(Repair(name, float(time[place + 1]), 1))
    if dropped:
        repairs.append(Repair("samples with an impossible position, dropped", float(time[min(dropped)]), len(dropped)))
    return Mended(tuple(sorted(dropped)), tuple(sorted(cuts)), tuple(repairs))


def _back(stamp: np.ndarray, position: np.ndarray, fastest: np.ndarray, place: int) -> int:
    """The sample at which the arm is again where it can have come to since sample `place`; the next one if it stays."""
    later = np.arange(place + 2, min(place + 2 + _TORN, len(stamp)))
    away = np.abs(position[later] - position[place])
    limit = fastest * ((stamp[later] - stamp[place])[:, None] / _NANO + 2 * _LATE)
    there = later[np.all(away <= limit, axis=1)]
    return int(there[0]) if len(there) else place + 1


def _find(
    stamp: np.ndarray, position: np.ndarray, fastest: np.ndarray, scratch: Scratch
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of every jump: the sample before it, the joint, how far, and what would have been possible."""
    found = []
    for part in scratch.parts(len(stamp) - 1):
        after = slice(part.start + 1, part.stop + 1)
        step = position[after] - position[part]
        limit = fastest * (_TIMES * (stamp[after] - stamp[part])[:, None] / _NANO + _LATE)
        rows, joints = np.nonzero(np.abs(step) > limit)
        found.append((rows + part.start, joints, step[rows, joints], limit[rows, joints]))
    places, joints, steps, limits = (np.concatenate(values) for values in zip(*found, strict=True))
    return places, joints, steps, limits


def _unwrap(position: np.ndarray, joint: int, places: np.ndarray, turns: np.ndarray, scratch: Scratch) -> None:
    for part in scratch.parts(len(position)):
        rows = np.arange(part.start, part.stop)
        before = np.searchsorted(places, rows)  # jumps that lie before each sample
        position[part, joint] -= _TURN * np.append(0.0, np.cumsum(turns))[before]
