"""Which topic of a log holds the measured states of the arm, where there are several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from agent.core import InputError
from agent.recording.column_names import prefixed, prefixes_of
from agent.recording.log import Repair
from agent.recording.mcap.foxglove import FILTERED, PREDICTED, RESIDUAL
from agent.recording.mcap.log_file import CURRENTS, PLANNED, REFERENCES, STATES, TEMPERATURES
from agent.recording.mcap.message_forms import NAMELESS
from agent.recording.mcap.scan import Messages, NamedJoints, Scan, scan
from agent.robot import RobotDescription

#: Topics of joint states that are not measured states of the arm.
_OTHERS = (REFERENCES, PLANNED, CURRENTS, TEMPERATURES, FILTERED, PREDICTED, RESIDUAL)
_USUAL = ("joint_states", "joint_state")
#: As `scan` names the type of a log's measured states.
_STATES_TYPE = "sensor_msgs/msg/JointState (cdr)"
_Topics = dict[str, list[Messages]]


def choose_topics(
    path: Path, scanned: Scan, robot: RobotDescription | None, wanted: str | None, named: str | None
) -> tuple[tuple[str, ...], tuple[str, ...], list[Repair]]:
    """The topics to read, the joints by their names in the log, in the robot's order, and what there is to say.

    One topic is read unless the joints of the arm are spread over several: `wanted`, or the only one that holds the
    joints of the robot. `named` is the robot that the log says it is of.

    Raises:
        InputError: no topic of joint states, several that may be meant, or joints of the robot missing.
    """
    topics = _candidates(path, scanned, robot, wanted)
    if robot is None:
        topic = STATES if STATES in topics else next(iter(topics))
        if len(topics) > 1 and topic != STATES:
            raise InputError(f"{path}: several topics of joint states: {_listed(topics)}. Say which with --topic")
        counts: Counter[tuple[str, ...]] = Counter()
        for group in topics[topic]:
            counts[group.layout.names] += len(group.stamp)
        most = counts.most_common(1)[0][0]
        if len(set(most)) != len(most) or not most:
            raise InputError(f"{path}: joint names are empty or stand twice in a message: {list(most)}")
        return (topic,), most, []
    own = _own_names(topics, robot.joint_names)
    joints = set(own)
    chosen = _holding(topics, joints)
    if not chosen:
        raise InputError(f"{path}: {_of_another_robot(topics, robot, named)}")
    names = [name for topic in chosen for name in _names(topics[topic])]
    if len(chosen) > 1 and len(set(names)) < len(names):
        one_arm = all(joints <= set(_names(topics[topic])) for topic in chosen)
        what = "hold the joints of the robot" if one_arm else "hold joints of the same names"
        raise InputError(f"{path}: several topics {what}: {_listed(topics)}. Say which with --topic")
    others = {topic: groups for topic, groups in topics.items() if topic not in chosen}
    repairs = []
    if own != robot.joint_names:
        kind = f"joints {', '.join(own)} are taken for {', '.join(robot.joint_names)}; joints"
        repairs.append(Repair(kind, 0.0, len(own)))
    for topic, groups in others.items():
        kind = f"messages of another topic, left out: {_listed({topic: groups})}"
        repairs.append(Repair(kind, 0.0, sum(len(group.stamp) for group in groups)))
    return tuple(chosen), own, repairs


def _own_names(topics: _Topics, joints: tuple[str, ...]) -> tuple[str, ...]:
    """What the joints are called in the log: as they are, or with a prefix more or less."""
    known = {name for groups in topics.values() for name in _names(groups)}
    called = {} if set(joints) <= known else prefixed(joints, known)
    return tuple(called.get(name, name) for name in joints)


def logged_joints(path: Path, wanted: str | None = None) -> tuple[str, ...]:
    """Names of all joints in the joint states of a log, or of its topic `wanted`, whatever messages they come in.

    Raises:
        InputError: no log, or no such topic in it.
    """
    topics = _candidates(path, scan(path), None, wanted)
    return tuple(dict.fromkeys(name for groups in topics.values() for name in _names(groups)))


def namesake(scanned: Scan, wanted: str, states: str) -> str | None:
    """The topic of that name in the namespace of the measured states, or the only one in any."""
    namespace = states.removesuffix(STATES) if states.endswith(STATES) else ""
    for topic in (namespace + wanted, wanted.lstrip("/")):
        if scanned.topics.get(topic):
            return topic
    others = [topic for topic in scanned.topics if topic.endswith(wanted)]
    return others[0] if len(others) == 1 and not namespace else None


def _candidates(path: Path, scanned: Scan, robot: RobotDescription | None, wanted: str | None) -> _Topics:
    """Topics that may hold the measured states, or the one that is wanted, unless it holds commands."""
    if robot is not None:
        for topic, several in scanned.topics.items():
            scanned.topics[topic] = [_of_robot(group, robot) for group in several]
    groups = {topic: scanned.topics[topic] for topic in sorted(scanned.topics) if scanned.topics[topic]}
    if wanted is not None and not any(topic.strip("/") == wanted.strip("/") for topic in scanned.commands):
        name = next((topic for topic in groups if topic.strip("/") == wanted.strip("/")), None)
        if name is None:
            raise InputError(f"{path}: no joint states on the topic {wanted}; it has {_listed(groups) or 'none'}")
        return {name: groups[name]}
    joints = set() if robot is None else set(robot.joint_names)

    def may_be_states(topic: str) -> bool:
        """By its name, or of the robot's joints with torque."""
        own = any(joints & set(group.layout.names) and group.effort is not None for group in groups[topic])
        return not topic.endswith(_OTHERS) and (topic.endswith(_USUAL) or own) and topic not in scanned.others

    topics = {topic: groups[topic] for topic in groups if may_be_states(topic)}
    topics = topics or {topic: groups[topic] for topic in groups if topic in scanned.others}
    if not topics:
        raise InputError(f"{path}: {_no_joint_states(scanned, groups)}")
    return topics


def is_nameless(names: Sequence[str]) -> bool:
    """Whether the joints of messages have numbers for names."""
    return bool(names) and all(name.startswith(NAMELESS) for name in names)


def _of_robot(group: Messages, robot: RobotDescription) -> Messages:
    """Messages without names, with those of the robot if it has as many joints."""
    names = group.layout.names
    if not is_nameless(names) or len(names) != robot.dof:
        return group
    return replace(group, layout=NamedJoints(robot.joint_names, group.layout.whole))


def _holding(topics: _Topics, joints: set[str]) -> list[str]:
    """Topics that hold all joints in one message, else in several, else those that hold them together; of several,
    the only one with torques."""
    whole = [t for t, groups in topics.items() if any(joints <= set(group.layout.names) for group in groups)]
    whole = whole or [topic for topic, groups in topics.items() if joints <= set(_names(groups))]
    if not whole:
        parts = [topic for topic, groups in topics.items() if joints & set(_names(groups))]
        return parts if joints <= {name for topic in parts for name in _names(topics[topic])} else []
    with_torque = [topic for topic in whole if any(group.effort is not None for group in topics[topic])]
    return with_torque if len(with_torque) == 1 else whole


def _of_another_robot(topics: _Topics, robot: RobotDescription, named: str | None) -> str:
    known = {name for groups in topics.values() for name in _names(groups)}
    missing = ", ".join(name for name in robot.joint_names if name not in known)
    of = f"of robot {named!r}, " if named else ""
    joints = _listed(topics) if len(topics) > 1 else _shown(_names(next(iter(topics.values()))))
    advice = "Name the robot description that belongs to the log"
    if prefixes := prefixes_of(robot.joint_names, known):
        advice = f"Its names begin with {' or '.join(prefixes)}: give the joints of one arm these names in robot.yaml"
    return f"the log is {of}not of robot {robot.name!r}: {missing} missing, its joints are {joints}. {advice}"


def _names(groups: Sequence[Messages]) -> list[str]:
    """Each once, in the order of the messages."""
    return list(dict.fromkeys(name for group in groups for name in group.layout.names))


def _listed(topics: _Topics) -> str:
    return "; ".join(f"{topic} ({_shown(_names(groups))})" for topic, groups in topics.items())


def _shown(names: Sequence[str]) -> str:
    return f"{len(names)} without names" if is_nameless(names) else ", ".join(names) or "without names"


def _no_joint_states(scanned: Scan, groups: _Topics) -> str:
    empty = scanned.types.get(STATES) == _STATES_TYPE and not scanned.unreadable
    if not scanned.types or (empty and not scanned.closed):
        return "no messages in it" + ("" if scanned.closed else "; its writer stopped before it had written any")
    if empty:
        return f"the topic {STATES} is in it without a single message: was it published while this was recorded?"
    if scanned.unreadable:
        topic, count = max(scanned.unreadable.items(), key=lambda item: item[1])
        if scanned.types[topic].endswith("(json)"):
            return f"{count} messages of JSON on {topic} have no joint positions under a usual name, such as joint_pos"
        return (
            f"no readable {STATES} in it: {count} messages on {topic} are no {_STATES_TYPE}, or compressed in a way "
            "that is not known here; ros2 bag convert writes them plainly"
        )
    topics = ", ".join(f"{topic}: {kind}" for topic, kind in sorted(scanned.types.items()))
    which = f". If one of these is the arm, name it with --topic: {_listed(groups)}" if groups else ""
    return f"no readable {STATES} of type {_STATES_TYPE} in it; it has {topics}{which}"
