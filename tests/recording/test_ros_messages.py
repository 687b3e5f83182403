"""States and commands in messages of ROS 2 other than JointState, decoded by the definition in the file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer

from agent.core import InputError
from agent.recording import read_log, recorded_joints
from tests.recording.datasets.recordings import arm, motion

NAMES = ("a", "b", "c")
ARM = arm(NAMES)
Q, R = motion(400, 3, 100.0, 1)
QD, TORQUE = np.gradient(Q, 0.01, axis=0), 5 * np.cos(3 * Q)
TIME = 1.7e18 + np.arange(400) * 1e7
LINE = "=" * 80
HEADER = f"""{LINE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{LINE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
POINT = f"""{LINE}
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
{LINE}
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
"""
STATE = "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
DYNAMIC = f"""std_msgs/Header header  # of the read
string[] joint_names
control_msgs/InterfaceValue[] interface_values
{HEADER}{LINE}
MSG: control_msgs/InterfaceValue
uint8 SOME=1
string[] interface_names
float64[] values
"""


def controller(*points: str) -> str:
    fields = "".join(f"trajectory_msgs/JointTrajectoryPoint {point}\n" for point in points)
    return f"std_msgs/Header header\nstring[] joint_names\n{fields}float64 speed_scaling_factor\n{HEADER}{POINT}"


FRANKA = f"""std_msgs/Header header
bool[41] errors
uint8 robot_mode
geometry_msgs/Pose o_t_ee
sensor_msgs/JointState measured_joint_state
float64[7] ddq_d
sensor_msgs/JointState desired_joint_state
{HEADER}{LINE}
MSG: sensor_msgs/JointState
{STATE}{LINE}
MSG: geometry_msgs/Pose
float32[3] position
"""
LBR = """float32 sample_time
uint8 session_state
float64[3] measured_joint_position
float64[3] measured_torque
float64[3] ipo_joint_position
uint32 time_stamp_sec
uint32 time_stamp_nano_sec
float64 tracking_performance
"""
ARRAY = f"""std_msgs/MultiArrayLayout layout
float64[] data
{LINE}
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
{LINE}
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
TRAJECTORY = (
    f"std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint[] points\n{HEADER}{POINT}"
)


def header(k: int) -> dict[str, Any]:
    return {"stamp": {"sec": int(TIME[k] // 1e9), "nanosec": int(TIME[k] % 1e9)}, "frame_id": "base"}


def point(positions: np.ndarray, velocities: np.ndarray | None = None, after: float = 0.0) -> dict[str, Any]:
    none: list[float] = []
    fast = none if velocities is None else velocities.tolist()
    duration = {"sec": int(after), "nanosec": round(after % 1 * 1e9)}
    rest = {"accelerations": none, "effort": none, "time_from_start": duration}
    return {"positions": positions.tolist(), "velocities": fast, **rest}


def joint_state(k: int, q: np.ndarray, **others: np.ndarray) -> dict[str, Any]:
    rest = {name: others[name][k].tolist() if name in others else [] for name in ("velocity", "effort")}
    return {"header": header(k), "name": [*NAMES], "position": q[k].tolist(), **rest}


def write(path: Path, late: float = 0.0, **topics: tuple[str, str, Callable[[int], dict[str, Any] | None]]) -> Path:
    """A bag with messages of topics: type, definition, and the message of a sample, received `late` [s]."""
    with open(path, "wb") as file:
        writer = Writer(file)
        schemas = {topic: writer.register_msgdef(kind, text) for topic, (kind, text, _) in topics.items()}
        for k in range(len(Q)):
            for topic, (_, _, make) in topics.items():
                if (message := make(k)) is not None:
                    writer.write_message(f"/{topic}", schemas[topic], message, log_time=int(TIME[k] + 1e9 * late))
        writer.finish()
    return path


def interfaces(k: int) -> dict[str, Any]:
    """Joints in another order, and an entry that is no joint."""
    order = [2, 0, 1]
    kinds = ["effort", "position", "velocity"]
    values = [{"interface_names": kinds, "values": [TORQUE[k, j], Q[k, j], QD[k, j]]} for j in order]
    sensor = {"interface_names": ["force.x"], "values": [1.0]}
    return {
        "header": header(k),
        "joint_names": ["wrench", *(NAMES[j] for j in order)],
        "interface_values": [sensor, *values],
    }


def states_of(*names: str) -> Callable[[int], dict[str, Any]]:
    """A controller's state, whose fields for set-point and position are called so."""

    def make(k: int) -> dict[str, Any]:
        asked, measured = point(R[k]), point(Q[k], QD[k])
        return {"header": header(k), "joint_names": [*NAMES], "speed_scaling_factor": 1.0} | dict(
            zip(names, (asked, measured), strict=True)
        )

    return make


CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
STATES = {
    "dynamic": ("control_msgs/msg/DynamicJointState", DYNAMIC, interfaces),
    "controller": (CONTROLLER, controller("reference", "feedback"), states_of("reference", "feedback")),
    "old names": (CONTROLLER, controller("desired", "actual"), states_of("desired", "actual")),
    "franka": (
        "franka_msgs/msg/FrankaRobotState",
        FRANKA,
        lambda k: {
            "header": header(k),
            "errors": [False] * 41,
            "robot_mode": 2,
            "o_t_ee": {"position": [1.0, 2.0, 3.0]},
            "measured_joint_state": joint_state(k, Q, velocity=QD, effort=TORQUE),
            "ddq_d": [0.5] * 7,
            "desired_joint_state": joint_state(k, R),
        },
    ),
    "lbr": (
        "lbr_fri_idl/msg/LBRState",
        LBR,
        lambda k: {
            "sample_time": 0.01,
            "session_state": 4,
            "measured_joint_position": Q[k].tolist(),
            "measured_torque": TORQUE[k].tolist(),
            "ipo_joint_position": R[k].tolist(),
            "time_stamp_sec": int(TIME[k] // 1e9),
            "time_stamp_nano_sec": int(TIME[k] % 1e9),
            "tracking_performance": 1.0,
        },
    ),
}


@pytest.mark.parametrize("kind", STATES)
def test_reads_states(tmp_path: Path, kind):
    log = read_log(write(tmp_path / "log.mcap", state=STATES[kind]), ARM)
    np.testing.assert_array_equal(log.position, Q)
    np.testing.assert_allclose(log.t, np.arange(400) / 100, atol=1e-6)
    assert (log.effort is None) == (kind in ("controller", "old names"))
    if log.effort is not None:
        np.testing.assert_array_equal(log.effort, TORQUE)
    assert (log.reference_position is None) == (kind == "dynamic")
    if log.reference_position is not None:
        np.testing.assert_array_equal(log.reference_position, R)
        assert log.metadata["command_hold"] == "smooth"
    assert log.metadata.get("effort") == ("torque" if kind in ("franka", "lbr") else None)


def test_joints_without_names_are_counted(tmp_path: Path):
    path = write(tmp_path / "log.mcap", state=STATES["lbr"])
    assert recorded_joints(path) == 3
    with pytest.raises(InputError, match="3 without names"):
        read_log(path, arm(["a", "b"]))


PLAIN = ("sensor_msgs/msg/JointState", STATE + HEADER, lambda k: joint_state(k, Q))


def array_of(values: np.ndarray) -> tuple[str, str, Callable[[int], dict[str, Any]]]:
    layout = {"dim": [], "data_offset": 0}
    return "std_msgs/msg/Float64MultiArray", ARRAY, lambda k: {"layout": layout, "data": values[k].tolist()}


def trajectory(make: Callable[[int], dict[str, Any] | None]) -> tuple[str, str, Any]:
    return "trajectory_msgs/msg/JointTrajectory", TRAJECTORY, make


def streamed(k: int) -> dict[str, Any]:
    """One point in another order of the joints, sent with an empty stamp."""
    stamp = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return {"header": stamp, "joint_names": ["c", "a", "b"], "points": [point(R[k, [2, 0, 1]])]}


@pytest.mark.parametrize("late", [0.0, 0.4])
@pytest.mark.parametrize("commands", [array_of(R), trajectory(streamed)])
def test_takes_commands_as_held_set_points(tmp_path: Path, commands, late):
    log = read_log(write(tmp_path / "log.mcap", late, joint_states=PLAIN, commands=commands), ARM)
    np.testing.assert_array_equal(log.reference_position, R)
    assert log.metadata["command_hold"] == "held"


def test_a_trajectory_is_followed_until_the_next_one_comes(tmp_path: Path):
    ends = np.array([[0.0, 0, 0], [1.0, 2, 3], [0.5, 0, -1]])

    def make(k: int) -> dict[str, Any] | None:
        if k not in (0, 150):
            return None
        first = point(ends[0]) if k == 0 else point(ends[2], after=1.0)
        more = [point(ends[1], after=2.0)] if k == 0 else []
        return {"header": header(k), "joint_names": [*NAMES], "points": [first, *more]}

    log = read_log(write(tmp_path / "log.mcap", joint_states=PLAIN, commands=trajectory(make)), ARM)
    t = np.arange(400) / 100
    before = np.minimum(t, 1.5)[:, None] / 2 * ends[1]
    after = before + np.clip(t - 1.5, 0, 1)[:, None] * (ends[2] - 0.75 * ends[1])
    known = np.isfinite(log.reference_position[:, 0])
    assert known.sum() > 200
    np.testing.assert_allclose(log.reference_position[known], after[known], atol=1e-6)
    assert log.metadata["command_hold"] == "smooth"


def test_a_stream_of_points_ahead_is_followed_from_the_first_position(tmp_path: Path):
    def make(k: int) -> dict[str, Any]:
        return {"header": header(k), "joint_names": [*NAMES], "points": [point(R[k], after=0.05)]}

    log = read_log(write(tmp_path / "log.mcap", joint_states=PLAIN, commands=trajectory(make)), ARM)
    followed = [Q[0]]
    for target in R[:-1]:  # a fifth of the way to each point, until the next one comes
        followed.append(followed[-1] + (target - followed[-1]) / 5)
    np.testing.assert_allclose(log.reference_position, followed, atol=1e-6)


def test_of_topics_without_names_the_one_that_joints_follow_is_taken(tmp_path: Path):
    topics = {"effort_commands": array_of(np.random.default_rng(0).normal(size=R.shape)), "commands": array_of(R)}
    log = read_log(write(tmp_path / "log.mcap", joint_states=PLAIN, **topics), ARM)
    np.testing.assert_array_equal(log.reference_position, R)


def test_set_points_are_taken_by_their_own_names(tmp_path: Path):
    kind, text, make = STATES["franka"]

    def other(k: int) -> dict[str, Any]:
        desired = {**joint_state(k, R[:, [2, 0, 1]]), "name": ["c", "a", "b"]}
        return {**make(k), "desired_joint_state": desired}

    log = read_log(write(tmp_path / "log.mcap", state=(kind, text, other)), ARM)
    np.testing.assert_array_equal(log.reference_position, R)


def test_numbers_that_no_joint_follows_are_no_set_points(tmp_path: Path):
    noise = np.random.default_rng(0).normal(size=R.shape)
    log = read_log(write(tmp_path / "log.mcap", joint_states=PLAIN, effort_commands=array_of(noise)), ARM)
    assert log.reference_position is None
    assert "numbers that the joints do not follow" in "\n".join(map(str, log.repairs))


def test_of_several_topics_of_commands_one_is_chosen(tmp_path: Path):
    path = write(tmp_path / "log.mcap", joint_states=PLAIN, first=array_of(R), second=array_of(R + 0.1))
    log = read_log(path, ARM)
    assert log.reference_position is None
    assert "choose one with --topic: /first, /second" in "\n".join(map(str, log.repairs))
    np.testing.assert_array_equal(read_log(path, ARM, "/second").reference_position, R + 0.1)


def test_joint_states_come_before_the_states_of_a_controller(tmp_path: Path):
    plain = ("sensor_msgs/msg/JointState", STATE + HEADER, lambda k: joint_state(k, Q + 1e-3, effort=TORQUE))
    path = write(tmp_path / "log.mcap", joint_states=plain, controller_state=STATES["controller"])
    log = read_log(path, ARM)
    np.testing.assert_array_equal(log.position, Q + 1e-3)
    np.testing.assert_array_equal(log.effort, TORQUE)
    np.testing.assert_array_equal(log.reference_position, R)
    np.testing.assert_array_equal(read_log(path, ARM, "/controller_state").position, Q)


BROKEN = {
    "a list longer than the message": DYNAMIC.replace("string[] joint_names", "uint32 x\nint8[] joint_names"),
    "a type that is missing": "control_msgs/Nothing[] interface_values\n",
    "a type in itself": f"a/B b\n{LINE}\nMSG: a/B\na/B b\n",
    "empty types": f"a/B[] b\n{LINE}\nMSG: a/B\n",
    "no definition": "!!\n",
}


@pytest.mark.parametrize("case", BROKEN)
def test_another_definition_ends_in_a_message(tmp_path: Path, case):
    kind, _, make = STATES["dynamic"]
    path = write(tmp_path / "log.mcap", state=(kind, DYNAMIC, make))
    with open(tmp_path / "other.mcap", "wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(kind, "ros2msg", BROKEN[case].encode())
        channel = writer.register_channel("/state", "cdr", schema)
        from mcap.reader import make_reader

        with open(path, "rb") as source:
            for _, _, message in make_reader(source).iter_messages():
                writer.add_message(channel, message.log_time, message.data, message.log_time)
        writer.finish()
    with pytest.raises(InputError, match="no readable /joint_states"):
        read_log(tmp_path / "other.mcap", ARM)


def write_json(path: Path, observe: Callable[[int], Any], act: Callable[[int], Any]) -> Path:
    with open(path, "wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("frame", "jsonschema", b'{"type": "object"}')
        topics = {name: writer.register_channel(name, "json", schema) for name in ("observations", "actions")}
        for k in range(len(Q)):
            for name, make, after in (("observations", observe, 0), ("actions", act, 3_000_000)):
                time = k * 10_000_000 + after
                writer.add_message(topics[name], time, json.dumps(make(k)).encode(), time)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "wrapped",
    [
        lambda values: {"joint_pos": values.tolist()},
        lambda values: {"joints": ["a", "b", "c"], "qpos": values.tolist()},
        lambda values: {"robot": {"position": dict(zip("cba", values[::-1].tolist(), strict=True))}, "n": 1},
    ],
)
def test_reads_messages_in_json(tmp_path: Path, wrapped):
    log = read_log(write_json(tmp_path / "log.mcap", lambda k: wrapped(Q[k]), lambda k: wrapped(R[k])), ARM)
    np.testing.assert_allclose(log.position, Q)
    np.testing.assert_allclose(log.reference_position, R)
    assert log.metadata["command_hold"] == "held"


@pytest.mark.parametrize(
    "frame",
    [
        lambda q, r: {"joint_pos": q, "joint_pos_target": r, "joint_vel_target": [0.0] * 3},
        lambda q, r: {"observation": {"qpos": q}, "action": {"qpos": r}},
        lambda q, r: {
            "state": {f"{name}.pos": value for name, value in zip("abc", q, strict=True)},
            "action": {f"{name}.pos": value for name, value in zip("cba", r[::-1], strict=True)},
        },
    ],
)
def test_reads_states_and_commands_in_one_message_of_json(tmp_path: Path, frame):
    def both(k: int) -> Any:
        return frame(Q[k].tolist(), R[k].tolist())

    path = write_json(tmp_path / "log.mcap", both, lambda k: {"image": "…"})
    log = read_log(
        path, ARM if "joint_pos" in both(0) or "observation" in both(0) else arm(["a.pos", "b.pos", "c.pos"])
    )
    np.testing.assert_allclose(log.position, Q)
    np.testing.assert_allclose(log.reference_position, R)
    assert log.metadata["command_hold"] == "held"


def test_messages_in_json_without_positions_are_refused(tmp_path: Path):
    path = write_json(tmp_path / "log.mcap", lambda k: {"image": "…"}, lambda k: [1, 2, "x"])
    with pytest.raises(InputError, match=r"400 messages of JSON on .* have no joint positions"):
        read_log(path, ARM)
