"""The formats that are read as they stand, and what makes logs of their episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agent.core import InputError, counted
from agent.recording.datasets.demonstrations import read_demonstrations
from agent.recording.datasets.episodes import Episode, Recorded
from agent.recording.datasets.isaac_csv import is_isaac_csv, read_isaac_csv
from agent.recording.datasets.joints import columns_of, side_of, without_side
from agent.recording.datasets.lerobot import INFO, is_lerobot, read_lerobot
from agent.recording.datasets.pace import read_pace
from agent.recording.datasets.position_commands import checked
from agent.recording.log import NANO, Log, Repair
from agent.recording.mcap.log_file import nanoseconds
from agent.recording.repair.stamps import put_in_order, spacing_of
from agent.robot import RobotDescription


@dataclass(frozen=True)
class DatasetFormat:
    """A format: name of its preset, what it is called, whether a path is of it, and what reads it, from the number of
    the arm's joints where the file does not say it."""

    preset: str
    text: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, int | None], Recorded]


def _ends(*endings: str) -> Callable[[Path], bool]:
    return lambda path: path.suffix.lower() in endings


def _refuse_pickle(path: Path, joints: int | None = None) -> Recorded:
    raise InputError(
        f"{path}: a pickle runs whatever code is in it when it is loaded, so it is not read. Where you trust its "
        "source, save plain arrays from it: np.savez('log.npz', t=t, q=q, target=target), then "
        "agent import --map MAP.yaml log.npz log.mcap"
    )


def _refuse_table(path: Path, joints: int | None = None) -> Recorded:
    raise InputError(
        f"{path}: is one table: name the folder of the LeRobot dataset that it is of, the one with {INFO}, or describe "
        "its columns: agent import --map MAP.yaml IN log.mcap"
    )


#: A shorter episode is no motion.
_FEWEST_FRAMES = 10
#: Formats of recordings that need no map.
FORMATS = (
    DatasetFormat("lerobot", "a LeRobot dataset", is_lerobot, lambda path, joints: read_lerobot(path)),
    DatasetFormat("pace", "a PACE recording", _ends(".pt", ".pth"), lambda path, joints: read_pace(path)),
    DatasetFormat("isaac-sysid", "a CSV file of Isaac Sim", is_isaac_csv, read_isaac_csv),
    DatasetFormat("isaaclab", "demonstrations", _ends(".h5", ".hdf5"), lambda path, joints: read_demonstrations(path)),
    DatasetFormat("", "a table", _ends(".parquet"), _refuse_table),
    DatasetFormat("", "a pickle", _ends(".pkl", ".pickle"), _refuse_pickle),
)
#: Names of the formats for `agent import --preset`.
DATASET_PRESETS = tuple(each.preset for each in FORMATS if each.preset)


def _format_of(path: Path) -> DatasetFormat | None:
    return next((each for each in FORMATS if each.recognises(path)), None)


def is_dataset(path: Path) -> bool:
    """Whether a path is of one of the `FORMATS`."""
    return _format_of(path) is not None


def open_dataset(path: Path, arm: str | None = None, joints: Sequence[str] = (), preset: str | None = None) -> Recorded:
    """The recording of a path, in rad, of one arm.

    `arm` says which of two: `left` or `right`; else that of the `joints`, where these tell it. `preset` names the
    format where the path does not show it.

    Raises:
        InputError: it cannot be read, holds two arms without a choice, or no such arm.
    """
    kind = _format_of(path) if preset is None else next(each for each in FORMATS if each.preset == preset)
    if kind is None:
        raise InputError(f"{path}: none of {', '.join(each.text for each in FORMATS)}")
    recorded = _long_enough(kind.read(path, len(joints) or None))
    sides = sorted({side_of(name) for name in recorded.joints} - {""})
    if arm is not None and arm.lower() not in sides:
        raise InputError(
            f"{path}: --topic {arm}: {kind.text} has no topics; for one arm of a pair it takes left or right, and "
            f"the joints here are {', '.join(recorded.joints) or 'without names'}"
        )
    if arm is None and len(sides) > 1:
        if joints and columns_of(recorded.joints, joints) is not None:
            return recorded
        raise InputError(
            f"{path}: holds two arms ({', '.join(recorded.joints)}). Choose one with --topic {sides[0]} or "
            f"--topic {sides[1]}"
        )
    if not sides:
        return recorded
    side = arm.lower() if arm else sides[0]
    one_arm = recorded.of_columns([k for k, name in enumerate(recorded.joints) if side_of(name) in (side, "")])
    return replace(one_arm, joints=tuple(map(without_side, one_arm.joints)))


def _long_enough(recorded: Recorded) -> Recorded:
    """The recording without episodes that are too short for a motion.

    Raises:
        InputError: all are.
    """
    long_episodes = tuple(each for each in recorded.episodes if np.count_nonzero(each.finite) >= _FEWEST_FRAMES)
    if not long_episodes:
        raise InputError(f"{recorded.path}: no episode has {_FEWEST_FRAMES} frames with a number for every joint")
    short = len(recorded.episodes) - len(long_episodes)
    notes = (f"{counted(short, 'episode')} of less than {_FEWEST_FRAMES} frames left out",) if short else ()
    return replace(recorded, episodes=long_episodes, notes=(*recorded.notes, *notes))


def dataset_logs(
    path: Path, robot: RobotDescription, arm: str | None = None, preset: str | None = None
) -> tuple[list[Log], tuple[str, ...]]:
    """One log for each episode, with the joints of a robot in its order, and what there is to say.

    Columns are found by name. Where the format has no names they are those of the robot in its order.

    Raises:
        InputError: as `open_dataset`, or joints of the robot are missing.
    """
    recorded = open_dataset(path, arm, robot.joint_names, preset)
    if recorded.joints:
        columns = columns_of(recorded.joints, robot.joint_names)
        if columns is None:
            raise InputError(
                f"{path}: its joints are {', '.join(recorded.joints)}, those of {robot.name} are "
                f"{', '.join(robot.joint_names)}. Give them the same names in robot.yaml, or with --map"
            )
        recorded = recorded.of_columns(columns)
    elif recorded.columns != robot.dof:
        raise InputError(
            f"{path}: has {counted(recorded.columns, 'column')} without names, and {robot.name} has "
            f"{counted(robot.dof, 'joint')}: they can't be assigned. Say in a map which are its joints: agent import "
            "--map"
        )
    else:
        recorded = replace(recorded, joints=robot.joint_names, notes=(*recorded.notes, _by_place(robot)))
    recorded = checked(_in_ranges(recorded, robot))
    return [_log(recorded, episode, robot) for episode in recorded.episodes], recorded.notes


def _in_ranges(recorded: Recorded, robot: RobotDescription) -> Recorded:
    """The recording, whose columns are the joints of a robot, with a note on those that leave their ranges.

    Raises:
        InputError: a joint goes further than its range is wide.
    """
    position = np.concatenate([episode.position for episode in recorded.episodes])
    least, most = np.nanmin(position, axis=0), np.nanmax(position, axis=0)
    outside, wider = [], []
    for joint, low, high in zip(robot.joints, least, most, strict=True):
        text = f"{joint.name} goes from {low:.3g} to {high:.3g}, its range from {joint.lower:.3g} to {joint.upper:.3g}"
        if low < joint.lower or high > joint.upper:
            outside.append(text)
        if high - low > joint.upper - joint.lower:
            wider.append(text)
    if wider:
        raise InputError(
            f"{recorded.path}: {'; '.join(wider)} (rad or m): further than the range is wide, so its unit is another. "
            "Import it with a map that says unit or scale (agent import --map), or correct the range"
        )
    if normalised := _normalised(recorded):
        note = (
            f"no position or command goes further than 1, and commands of {', '.join(normalised)} end at 1: they "
            "look normalised to a range, and are taken as rad or m. If they are, import with a map that says the scale "
            "of each joint (agent import --map)"
        )
        recorded = replace(recorded, notes=(*recorded.notes, note))
    if outside:
        note = f"unit, zero or sign may not be those of the model: {'; '.join(outside)} (rad or m)"
        return replace(recorded, notes=(*recorded.notes, note))
    return recorded


def _normalised(recorded: Recorded) -> list[str]:
    """Joints whose commands end at −1 or 1 exactly where nothing goes further, as of a policy's actions."""
    commands = [each.command for each in recorded.episodes if each.command is not None]
    largest = np.nanmax(np.abs(np.concatenate([*(each.position for each in recorded.episodes), *commands])))
    if not commands or largest > 1:
        return []
    ends = np.nanmax(np.abs(np.concatenate(commands)), axis=0) == 1
    return [name for name, end in zip(recorded.joints, ends, strict=True) if end]


def _by_place(robot: RobotDescription) -> str:
    return f"the file names no joints; its columns are taken as {', '.join(robot.joint_names)}"


def _log(recorded: Recorded, episode: Episode, robot: RobotDescription) -> Log:
    """An episode as a log."""
    path = recorded.path / episode.name if recorded.path.is_dir() or len(recorded.episodes) > 1 else recorded.path
    whole = episode.finite
    repairs = Repair.of("frames without a number for every joint, dropped", _from_first(episode.time), ~whole)
    order = put_in_order(nanoseconds(episode.time[whole]), [episode.position[whole]], str(path))
    frames = episode.of_rows(np.flatnonzero(whole)[order.rows])
    spacing = spacing_of(order.stamp, recorded.rate)
    return Log(
        path=path,
        joint_names=robot.joint_names,
        t=(order.stamp - order.stamp[0]) / NANO,
        position=frames.position,
        velocity=frames.velocity,
        effort=frames.effort,
        reference_position=frames.command,
        planned_position=None,
        sample_rate=spacing.rate,
        stamp=int(order.stamp[0]) / NANO,
        segments=spacing.segments,
        even=spacing.even,
        metadata={"robot": robot.name, "motion": episode.name, **recorded.facts},
        repairs=(*repairs, *order.repairs, *spacing.repairs),
        sha256=recorded.sha256,
    )


def _from_first(time: np.ndarray) -> np.ndarray:
    """(K,) [s] from the first known time; 0 where it is unknown."""
    known = time[np.isfinite(time)]
    return np.nan_to_num(time - known[0]) if len(known) else np.zeros(len(time))
