"""Whether the commands of a recording are set-points of its joints, as far as the numbers themselves show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.core import InputError
from agent.recording.datasets.episodes import Episode, Recorded

#: A joint that goes less far than this [rad or m] stands still; turns by less are no reversals.
_MOVED = 0.02
#: Commands that differ from the positions by less than this [rad or m] are copies of them, in float32.
_COPIED = 1e-5
#: Longest time [s] by which positions may follow commands, of the lags that are tried.
_LONGEST_LAG = 0.5
#: Least correlation of positions with their own commands at the best lag, and limits of the gain between them. In 101
#: episodes of two arms the least is 0.989, with gains of 0.97 to 1.04; with the commands of the other arm of a pair it
#: is 0.13 at most, and steps relative to the position have gains of 5 and 19.
_LEAST_CORRELATION, _LEAST_GAIN, _MOST_GAIN = 0.6, 0.4, 2.5
_FEWEST_REVERSALS = 2


def checked(recorded: Recorded) -> Recorded:
    """The recording, with notes on joints that reverse too seldom to show friction.

    Raises:
        InputError: commands that are copies of positions, or that the positions do not follow, or no joint reverses.
    """
    episodes = [episode.of_rows(episode.finite) for episode in recorded.episodes]
    moved = np.max([np.ptp(episode.position, axis=0) for episode in episodes], axis=0) > _MOVED
    if not moved.any():
        raise InputError(f"{recorded.path}: no joint moves by {_MOVED:g} rad in any episode")
    if all(episode.command is None for episode in episodes):
        return recorded
    copied = np.all([_copied(episode) for episode in episodes if episode.command is not None], axis=0) & moved
    if copies := [name for name, copy in zip(recorded.joints, copied, strict=True) if copy]:
        raise InputError(
            f"{recorded.path}: the commands of {', '.join(copies)} are the positions themselves, not what the servos "
            "were sent. Record the targets that go to the robot"
        )
    longest = max(episodes, key=lambda episode: len(episode.time))
    if not 0 < _period(longest) < _LONGEST_LAG:
        raise InputError(
            f"{recorded.path}: the frames of {longest.name} are {_period(longest):.3g} s apart. Say the unit of the "
            "time in a map: agent import --map"
        )
    if not are_followed(longest):
        correlation, gain = follows(longest)
        raise InputError(
            f"{recorded.path}: the positions do not follow the commands (correlation {correlation:.2f}, gain "
            f"{gain:.2g} in {longest.name}). Commands of the end effector, steps relative to the position, or those of "
            "another arm are no set-points of these joints"
        )
    turns = np.sum([reversals(episode.position) for episode in episodes], axis=0)
    few = moved & (turns < _FEWEST_REVERSALS)
    if np.array_equal(few, moved):
        raise InputError(
            f"{recorded.path}: no joint reverses twice, so friction cannot be distinguished from a load. Record motion "
            "that goes forth and back"
        )
    if few.any():
        listed = ", ".join(name for name, seldom in zip(recorded.joints, few, strict=True) if seldom)
        return replace(recorded, notes=(*recorded.notes, f"too few reversals to show friction: {listed}"))
    return recorded


def are_followed(episode: Episode) -> bool:
    """Whether the positions of an episode follow its commands."""
    correlation, gain = follows(episode)
    return correlation >= _LEAST_CORRELATION and _LEAST_GAIN < gain < _MOST_GAIN


def follows(episode: Episode) -> tuple[float, float]:
    """Median over the joints that move of the correlation of positions with commands, and of the gain, at the lag at
    which they are most alike."""
    if episode.command is None:
        return 1.0, 1.0
    lags = min(int(_LONGEST_LAG / _period(episode)), len(episode.time) // 2)
    regressions = []
    for k in np.flatnonzero(np.ptp(episode.position, axis=0) > _MOVED):
        position, command = episode.position[:, k], episode.command[:, k]
        pairs = [_regression(command[: len(command) - lag], position[lag:]) for lag in range(lags + 1)]
        regressions.append(max(pairs))
    correlation, gain = np.median(regressions, axis=0) if regressions else (1.0, 1.0)
    return float(correlation), float(gain)


def _period(episode: Episode) -> float:
    """Mean time between frames [s]."""
    return float((episode.time[-1] - episode.time[0]) / max(len(episode.time) - 1, 1))


def reversals(position: np.ndarray) -> np.ndarray:
    """(n,) how often each joint of positions (K, n) turns by more than the least motion."""
    count = np.zeros(position.shape[1], int)
    for k, values in enumerate(position.T):
        extreme, direction = values[0], 0
        for value in values:
            if direction * (value - extreme) >= 0 and direction:
                extreme = value
            elif abs(value - extreme) > _MOVED:
                count[k] += direction != 0
                extreme, direction = value, int(np.sign(value - extreme))
    return count


def _regression(command: np.ndarray, position: np.ndarray) -> tuple[float, float]:
    """Correlation, and gain from command to position."""
    spread = np.var(command)
    if spread < 1e-12 or np.var(position) < 1e-12:
        return 0.0, 0.0
    common = float(np.mean((command - command.mean()) * (position - position.mean())))
    return common / float(np.sqrt(spread * np.var(position))), common / float(spread)


def _copied(episode: Episode) -> np.ndarray:
    """(n,) which commands are the positions of the frame before, of the same, or of the next frame."""
    position, command = episode.position, episode.command
    assert command is not None
    pairs = ((command[1:], position[:-1]), (command, position), (command[:-1], position[1:]))
    apart = [np.max(np.abs(sent - measured), axis=0, initial=0.0) for sent, measured in pairs]
    return np.asarray(np.min(apart, axis=0) < _COPIED)
