"""Messages of ROS 2 other than JointState that hold states or commands of joints, read by the schema in the file.

A form says which fields of a type mean what; where they lie is found from the definition that the file brings, so that
one form serves all versions of a type. As in `joint_state`, one message is parsed for its layout, and all others that
have the same lengths and names are read as columns of a byte array.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

_NANO = 1_000_000_000
#: Beginning of the name of a joint that has none: its number follows.
NAMELESS = "#"
_PRIMITIVES = {
    **{"bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1"},
    **{"int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8"},
    **{"float32": "f4", "float64": "f8"},
}
_FIELD = re.compile(r"^([\w/]+)(?:<=\d+)?(\[(?:<=)?(\d*)\])?\s+(\w+)\s*(?!\s*=)")
_CONSTANT = re.compile(r"^[\w/]+\s+\w+\s*=")
_TIMES = {"time": "int32 sec\nuint32 nanosec", "duration": "int32 sec\nuint32 nanosec"}  # built into ROS 1
_DEEPEST = 12


@dataclass(frozen=True)
class MessageForm:
    """Which fields of a message mean what.

    Attributes
    ----------
    names : path of the joint names; empty: the message has none, and its joints are numbered.
    position, velocity, effort, set_point : paths of arrays, of which the first that is filled counts.
    set_point_names : path of the joint names of the set-points, where these have their own.
    interfaces : path of a list with `interface_names` and `values` for each joint instead.
    points : path of a list of set-points with `positions` and `time_from_start`, which follow the stamp.
    stamp : paths of seconds and nanoseconds; empty: the receive time counts.
    commands : the positions are set-points, not measured.
    effort_is : meaning of the effort, where the driver is known by the message.
    """

    names: str = ""
    position: tuple[str, ...] = ()
    velocity: tuple[str, ...] = ()
    effort: tuple[str, ...] = ()
    set_point: tuple[str, ...] = ()
    set_point_names: str = ""
    interfaces: str = ""
    points: str = ""
    stamp: tuple[str, ...] = ("header.stamp.sec", "header.stamp.nanosec")
    commands: bool = False
    effort_is: str = ""


_LBR = MessageForm(
    position=("measured_joint_position",),
    effort=("measured_torque",),
    set_point=("ipo_joint_position",),
    stamp=("time_stamp_sec", "time_stamp_nano_sec"),
    effort_is="torque",
)
#: Forms by type, without the folder of the type.
FORMS = {
    "control_msgs/DynamicJointState": MessageForm(names="joint_names", interfaces="interface_values"),
    "control_msgs/JointTrajectoryControllerState": MessageForm(  # first the names since 5.0.0, then those before
        names="joint_names",
        position=("feedback.positions", "actual.positions"),
        velocity=("feedback.velocities", "actual.velocities"),
        effort=("feedback.effort", "actual.effort"),
        set_point=("reference.positions", "desired.positions"),
    ),
    "franka_msgs/FrankaRobotState": MessageForm(
        names="measured_joint_state.name",
        position=("measured_joint_state.position",),
        velocity=("measured_joint_state.velocity",),
        effort=("measured_joint_state.effort",),
        set_point=("desired_joint_state.position",),
        set_point_names="desired_joint_state.name",
        effort_is="torque",
    ),
    "lbr_fri_idl/LBRState": _LBR,
    "lbr_fri_msgs/LBRState": _LBR,
    "std_msgs/Float64MultiArray": MessageForm(position=("data",), stamp=(), commands=True),
    "trajectory_msgs/JointTrajectory": MessageForm(names="joint_names", points="points", commands=True),
}
_STAMPED = "std_msgs/Header header\nstring[] joint_names\n"
_HEADER = """
===
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
===
"""
#: Definitions of types that never changed, for bags that bring none.
DEFINITIONS = {
    "std_msgs/Float64MultiArray": """std_msgs/MultiArrayLayout layout
float64[] data
===
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
===
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride""",
    "trajectory_msgs/JointTrajectory": f"""{_STAMPED}trajectory_msgs/JointTrajectoryPoint[] points{_HEADER}
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Time time_from_start""",
    "control_msgs/DynamicJointState": f"""{_STAMPED}control_msgs/InterfaceValue[] interface_values{_HEADER}
MSG: control_msgs/InterfaceValue
string[] interface_names
float64[] values""",
}


def form_of(kind: str) -> MessageForm | None:
    """The form of a message type such as `control_msgs/msg/DynamicJointState`."""
    return FORMS.get(kind.replace("/msg/", "/"))


def definition_of(kind: str, text: str) -> str:
    """The definition of a type: that of the file, else that of a type which never changed; empty where neither is."""
    return text or DEFINITIONS.get(kind.replace("/msg/", "/"), "")


@dataclass(frozen=True)
class _Field:
    """One field: its type, and of an array its length (0: a sequence)."""

    name: str
    kind: str
    length: int | None


class MessageSchema:
    """The fields of a message and of the types in it, from a definition as `ros2 interface show` writes it.

    Raises:
        ValueError: a line that is no field, or a type that the definition lacks.
    """

    def __init__(self, text: str):
        parts = re.split(r"^=+$", text, flags=re.MULTILINE)
        self._types = {"": _fields(parts[0])}
        for part in parts[1:]:
            head, _, body = part.strip().partition("\n")
            self._types[head.removeprefix("MSG:").strip().rsplit("/", 1)[-1]] = _fields(body)
        for name, body in _TIMES.items():
            self._types.setdefault(name, _fields(body))

    def fields(self, kind: str) -> list[_Field]:
        """Fields of a type; the empty name is the message itself."""
        fields = self._types.get(kind.rsplit("/", 1)[-1])
        if fields is None:
            raise ValueError(f"the type {kind} is not defined")
        return fields


def _fields(text: str) -> list[_Field]:
    fields = []
    for line in text.splitlines():
        line = line.split("#", 1)[0].strip()
        if not line or _CONSTANT.match(line):
            continue
        hit = _FIELD.match(line)
        if hit is None:
            raise ValueError(f"{line[:60]!r} is no field of a message")
        length = None if hit[2] is None else 0 if "<=" in hit[2] or not hit[3] else int(hit[3])
        fields.append(_Field(hit[4], hit[1], length))
    return fields


@dataclass(eq=False)
class _MessageWalk:
    """Where the fields of one message lie: numbers by path (offset, count, type), and texts by path."""

    message: bytes
    schema: MessageSchema
    ros1: bool
    order: str = field(init=False)
    numbers: dict[str, tuple[int, int, str]] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        message = self.message
        if not self.ros1 and (len(message) < 4 or message[0] != 0 or message[1] > 1):
            raise ValueError("not plain CDR")
        self.order = "<" if self.ros1 or message[1] else ">"
        self.structure = np.zeros(len(message), np.uint8)
        self._at = 0 if self.ros1 else 4
        if not self.ros1:
            self.structure[:2] = 255
        self._struct("", "", 0)

    def _struct(self, kind: str, path: str, depth: int) -> None:
        if depth > _DEEPEST:
            raise ValueError("types are nested too deep")
        for entry in self.schema.fields(kind):
            self._field(entry, f"{path}.{entry.name}" if path else entry.name, depth)

    def _field(self, entry: _Field, path: str, depth: int) -> None:
        count = 1 if entry.length is None else entry.length or self._length()
        if entry.length == 0:
            self.counts[path] = count
        if entry.kind in ("string", "wstring"):
            if entry.kind == "wstring":
                raise ValueError("texts of 16 bits are not read")
            self.texts[path] = [self._text() for _ in range(self._sane(count))]
        elif entry.kind in _PRIMITIVES:
            code = _PRIMITIVES[entry.kind]
            size = int(code[1])
            if count:
                self._align(size)
            self.numbers[path] = (self._take(size * count).start, count, code)
        else:
            for k in range(self._sane(count)):
                self._struct(entry.kind, path if entry.length is None else f"{path}[{k}]", depth + 1)

    def _sane(self, count: int) -> int:
        if count > len(self.message):
            raise ValueError("a list is longer than its message")
        return count

    def _take(self, size: int) -> slice:
        part = slice(self._at, self._at + size)
        if part.stop > len(self.message):
            raise ValueError("the message ends within a field")
        self._at = part.stop
        return part

    def _align(self, size: int) -> None:
        self._at += 0 if self.ros1 else (4 - self._at) % size

    def _length(self) -> int:
        self._align(4)
        part = self._take(4)
        self.structure[part] = 255
        return int.from_bytes(self.message[part], "little" if self.order == "<" else "big")

    def _text(self) -> str:
        part = self._take(self._length())
        self.structure[part] = 255
        return self.message[part].rstrip(b"\0").decode()


@dataclass(frozen=True, eq=False)
class FormLayout:
    """Where the numbers of a message lie: offsets (n,) of positions, velocities, efforts and set-points, or None."""

    names: tuple[str, ...]
    template: np.ndarray
    structure: np.ndarray
    order: str
    offsets: tuple[np.ndarray | None, ...]
    stamp: tuple[int, ...]
    delay: tuple[int, ...] = ()

    @property
    def whole(self) -> bool:
        """Whether the message holds a position for every name."""
        return self.offsets[0] is not None

    def matches(self, messages: np.ndarray) -> np.ndarray:
        """(K,) which of the messages (K, L) have this layout."""
        return ~np.any((messages ^ self.template) & self.structure, axis=1)

    def stamps(self, messages: np.ndarray, received: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) stamps [ns] of the numbers in messages (K, L), and those at which they were sent, which are the ones at
        which they were `received` where a message has none."""
        sent = self._time(messages, self.stamp) if self.stamp else received
        sent = np.where(sent == 0, received, sent)  # a header that nobody filled means now
        return sent + self._time(messages, self.delay) if self.delay else sent, sent

    def array(self, messages: np.ndarray, index: int) -> np.ndarray | None:
        """(K, n) positions (index 0), velocities (1), efforts (2) or set-points (3) of messages (K, L), or None."""
        offsets = self.offsets[index]
        if offsets is None:
            return None
        raw = messages[:, (offsets[:, None] + np.arange(8)).ravel()]
        return np.ascontiguousarray(raw).view(self.order + "f8").astype(float, copy=False)

    def _time(self, messages: np.ndarray, at: Sequence[int]) -> np.ndarray:
        seconds, fraction = (
            np.ascontiguousarray(messages[:, start : start + 4]).view(self.order + code)[:, 0].astype(np.int64)
            for start, code in zip(at, ("i4", "u4"), strict=True)
        )
        return seconds * _NANO + fraction


def parse_form(message: bytes, form: MessageForm, schema: MessageSchema, ros1: bool) -> list[FormLayout]:
    """Layouts of one message: one, or of a trajectory one for each of its points.

    Raises:
        ValueError: not such a message, or no position for every joint in it.
    """
    walk = _MessageWalk(message, schema, ros1)
    names = tuple(walk.texts.get(form.names, ()))
    parsed: list[tuple[list[np.ndarray | None], tuple[int, ...]]]
    if form.interfaces:
        names, offsets = _interfaces(walk, form.interfaces, names)
        parsed = [(offsets, ())]
    elif form.points:
        parsed = [_point(walk, f"{form.points}[{k}]", len(names)) for k in range(walk.counts[form.points])]
    else:
        paths = (form.position, form.velocity, form.effort, form.set_point)
        arrays = [_numbers(walk, several, len(names)) for several in paths]
        own = walk.texts.get(form.set_point_names, [*names])
        if arrays[3] is not None and own != [*names]:
            arrays[3] = arrays[3][[own.index(name) for name in names]] if sorted(own) == sorted(names) else None
        parsed = [(arrays, ())]
    stamp = _clock(walk, form.stamp)
    layouts = []
    for offsets, delay in parsed:
        position = offsets[0]
        if position is None:
            raise ValueError("no position for every joint")
        called = names or tuple(f"{NAMELESS}{k + 1}" for k in range(len(position)))
        alike = tuple(each if each is not None and len(each) == len(called) else None for each in offsets)
        template = np.frombuffer(message, np.uint8)
        layouts.append(FormLayout(called, template, walk.structure, walk.order, alike, stamp, delay))
    return layouts


def _clock(walk: _MessageWalk, paths: Sequence[str]) -> tuple[int, ...]:
    """Offsets of seconds and nanoseconds; empty where the message lacks them."""
    parts = [walk.numbers[path] for path in paths if path in walk.numbers]
    whole = len(parts) == 2 and all(count == 1 and code in ("i4", "u4") for _, count, code in parts)
    return tuple(start for start, _, _ in parts) if whole else ()


def _numbers(walk: _MessageWalk, paths: Sequence[str], joints: int) -> np.ndarray | None:
    """Offsets of the first of several arrays that is filled; None where none has a number for every joint."""
    for path in paths:
        start, count, code = walk.numbers.get(path, (0, 0, ""))
        if count and code == "f8" and count == (joints or count):
            return start + 8 * np.arange(count)
    return None


def _point(walk: _MessageWalk, path: str, joints: int) -> tuple[list[np.ndarray | None], tuple[int, ...]]:
    """Offsets of the positions of a point of a trajectory, and of the time from its start."""
    delay = _clock(walk, [f"{path}.time_from_start.{part}" for part in ("sec", "nanosec")])
    return [_numbers(walk, (f"{path}.positions",), joints), None, None, None], delay


def _interfaces(walk: _MessageWalk, path: str, names: Sequence[str]) -> tuple[tuple[str, ...], list[np.ndarray | None]]:
    """Joints that have a position, and the offsets of their positions, velocities and efforts."""
    kinds = [walk.texts.get(f"{path}[{k}].interface_names", []) for k in range(len(names))]
    joints = [k for k, kind in enumerate(kinds) if "position" in kind]
    offsets: list[np.ndarray | None] = []
    for quantity in ("position", "velocity", "effort"):
        places = [_value(walk, f"{path}[{k}].values", kinds[k], quantity) for k in joints]
        known = [place for place in places if place is not None]
        offsets.append(np.array(known) if known and len(known) == len(places) else None)
    return tuple(names[k] for k in joints), [*offsets, None]


def _value(walk: _MessageWalk, path: str, kinds: Sequence[str], quantity: str) -> int | None:
    start, count, code = walk.numbers.get(path, (0, 0, ""))
    if quantity not in kinds or kinds.index(quantity) >= count or code != "f8":
        return None
    return start + 8 * list(kinds).index(quantity)
