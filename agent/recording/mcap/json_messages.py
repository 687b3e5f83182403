"""Messages in JSON, as recorders outside ROS write them into MCAP: an object with the positions of all joints.

No schema of such recorders is a standard, so what is read is what most have: a list of numbers, or a mapping of joint
names to numbers, under a usual name, or `NAME.pos`, at the top or one level below. Commands have messages of their own,
or a field or part of a message. Their time is that of the file's log.
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
_COMMANDS = re.compile(r"action|command|cmd|target|set_?point|reference|leader|control|ctrl", re.IGNORECASE)
#: Commands of other quantities than positions.
_OTHERS = re.compile(r"vel|torque|effort|tau|force|current", re.IGNORECASE)
#: A field that is the position of one joint, as LeRobot names them.
_POSITION = re.compile(r"\.(?:pos|position|qpos)$")
_MOST_JOINTS = 64


def holds_commands(topic: str) -> bool:
    """Whether the name of a topic says that it holds commands."""
    return bool(_COMMANDS.search(topic))


def joint_values(data: bytes) -> tuple[tuple[str, ...], dict[str, list[float]]]:
    """Names of the joints (empty: none) and their numbers by quantity; `set_point` where the message has commands too.

    Raises:
        ValueError: no JSON, or no positions in it.
    """
    try:
        content = json.loads(data)
    except RecursionError:
        raise ValueError("nested too deep") from None
    children = content.items() if isinstance(content, dict) else ()
    parts = {key: part for key, part in (("", content), *children) if isinstance(part, Mapping)}
    states = (_values(part) for key, part in parts.items() if not holds_commands(key))
    state, asked = next(filter(None, states), None), _asked(parts)
    if state is None or asked is None:
        if state is None and asked is None:
            raise ValueError("no positions in it")
        return state or asked or ((), {})
    names, numbers = state
    own, set_points = asked[0], asked[1]["position"]
    if own and names and sorted(own) == sorted(names):
        set_points = [set_points[own.index(name)] for name in names]
    fit = len(set_points) == len(numbers["position"]) and (not own or not names or sorted(own) == sorted(names))
    return names or own, numbers | ({"set_point": set_points} if fit else {})


def _asked(parts: Mapping[str, Mapping[str, Any]]) -> tuple[tuple[str, ...], dict[str, list[float]]] | None:
    """Names and positions that are commanded: a part for commands, or a field for them in any part."""
    for key, part in parts.items():
        if key and holds_commands(key) and (numbers := _values(part)):
            return numbers
        for name, value in part.items():
            if holds_commands(name) and not _OTHERS.search(name) and (numbers := _values({"position": value})):
                return numbers
    return None


def _values(part: Mapping[str, Any]) -> tuple[tuple[str, ...], dict[str, list[float]]] | None:
    numbers: dict[str, list[float]] = {}
    listed: list[Any] = next((part[key] for key in _NAMES if isinstance(part.get(key), list)), [])
    names = tuple(map(str, listed))
    own = {name: value for name, value in part.items() if _POSITION.search(name)}
    part = {**part, "position": own} if own else part
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
