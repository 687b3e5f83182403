"""Messages in JSON, as recorders outside ROS write them into MCAP: an object with the positions of all joints.

No schema of such recorders is a standard, so what is read is what most have: a list of numbers, or a mapping of joint
names to numbers, under a usual name, at the top or one level below. Their time is that of the file's log.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

#: Names of a quantity in an object.
_QUANTITIES = {
    "position": ("joint_pos", "joint_position", "joint_positions", "position", "positions", "qpos", "q"),
    "velocity": ("joint_vel", "joint_velocity", "joint_velocities", "velocity", "velocities", "qvel", "dq"),
    "effort": ("joint_torque", "joint_torques", "joint_effort", "torque", "torques", "effort", "tau"),
}
_NAMES = ("joint_names", "names", "name", "joints")
_COMMANDS = re.compile(r"action|command|target|set_?point|reference|leader|control", re.IGNORECASE)
_MOST_JOINTS = 64


def holds_commands(topic: str) -> bool:
    """Whether the name of a topic says that it holds commands."""
    return bool(_COMMANDS.search(topic))


def joint_values(data: bytes) -> tuple[tuple[str, ...], dict[str, list[float]]]:
    """Names of the joints (empty: none) and their numbers by quantity.

    Raises:
        ValueError: no JSON, or no positions in it.
    """
    try:
        content = json.loads(data)
    except RecursionError:
        raise ValueError("nested too deep") from None
    parts = [content, *(content.values() if isinstance(content, dict) else ())]
    for part in parts:
        if isinstance(part, Mapping) and (numbers := _values(part)):
            return numbers
    raise ValueError("no positions in it")


def _values(part: Mapping[str, Any]) -> tuple[tuple[str, ...], dict[str, list[float]]] | None:
    numbers: dict[str, list[float]] = {}
    listed: list[Any] = next((part[key] for key in _NAMES if isinstance(part.get(key), list)), [])
    names = tuple(map(str, listed))
    for quantity, keys in _QUANTITIES.items():
        value = next((part[key] for key in keys if isinstance(part.get(key), (list, dict))), None)
        if isinstance(value, dict):
            names, value = tuple(map(str, value)), [*value.values()]
        if value is not None and 0 < len(value) <= _MOST_JOINTS and _are_numbers(value):
            numbers[quantity] = [float(number) for number in value]
    if "position" not in numbers:
        return None
    joints = len(numbers["position"])
    return names if len(names) == joints else (), {key: row for key, row in numbers.items() if len(row) == joints}


def _are_numbers(values: Iterable[Any]) -> bool:
    return all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
