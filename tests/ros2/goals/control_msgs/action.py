"""FollowJointTrajectory: rclpy's own action client and server, with the type support of a parameter service."""

import ctypes
import json
from dataclasses import asdict, dataclass, field
from types import SimpleNamespace

from action_msgs.msg import GoalStatusArray
from action_msgs.srv import CancelGoal
from builtin_interfaces.msg import Duration, Time
from rcl_interfaces.msg import Parameter, SetParametersResult
from rcl_interfaces.srv import SetParametersAtomically as Carrier
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from unique_identifier_msgs.msg import UUID

from .msg import JointTolerance

_python = ctypes.pythonapi
_python.PyCapsule_GetName.argtypes, _python.PyCapsule_GetName.restype = [ctypes.py_object], ctypes.c_char_p
_python.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
_python.PyCapsule_GetPointer.restype = ctypes.c_void_p
_python.PyCapsule_New.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
_python.PyCapsule_New.restype = ctypes.py_object


def _support(kind):
    """The address of a compiled type's support."""
    meta = type(kind)
    if meta._TYPE_SUPPORT is None:
        meta.__import_type_support__()
    capsule = meta._TYPE_SUPPORT
    return _python.PyCapsule_GetPointer(capsule, _python.PyCapsule_GetName(capsule))


#: rosidl_action_type_support_t: services of goal, result and cancelling, messages of feedback and status, and functions
#: that describe the type: those of a message, the last three words of a rosidl_message_type_support_t.
_described = (ctypes.c_void_p * 6).from_address(_support(String))[3:]
_SUPPORT = (ctypes.c_void_p * 8)(*map(_support, (Carrier, Carrier, CancelGoal, String, GoalStatusArray)), *_described)


@dataclass
class Goal:
    """The real one's fields, as far as the driver and the emulated arm use them."""

    trajectory: JointTrajectory = field(default_factory=JointTrajectory)
    path_tolerance: list = field(default_factory=list)
    goal_tolerance: list = field(default_factory=list)
    goal_time_tolerance: Duration = field(default_factory=Duration)


@dataclass
class Result:
    """Of a goal that has ended."""

    error_code: int = 0
    error_string: str = ""


@dataclass
class Feedback:
    """While it runs."""

    text: str = ""


class _Action(type):
    _TYPE_SUPPORT = _python.PyCapsule_New(ctypes.addressof(_SUPPORT), b"rosidl_action", None)


class FollowJointTrajectory(metaclass=_Action):
    """The action; tests have no other names of it."""

    Goal, Result, Feedback = Goal, Result, Feedback
    Impl = SimpleNamespace(
        SendGoalService=Carrier,
        GetResultService=Carrier,
        CancelGoalService=CancelGoal,
        FeedbackMessage=String,
        GoalStatusMessage=GoalStatusArray,
    )


# What rclpy's client and server read and write of requests, answers and feedback is kept in the carriers' texts.


def _kept(message):
    """The values in a message: of a request, an answer, or a feedback."""
    text = message.parameters[0].name if isinstance(message, Carrier.Request) and message.parameters else ""
    text = message.result.reason if isinstance(message, Carrier.Response) else text
    return json.loads((message.data if isinstance(message, String) else text) or "{}")


def _keep(message, name, value):
    text = json.dumps({**_kept(message), name: value})
    if isinstance(message, Carrier.Request):
        message.parameters = [Parameter(name=text)]
    elif isinstance(message, Carrier.Response):
        message.result.reason = text
    else:
        message.data = text


def _value(name, encode, decode):
    return property(
        lambda message: decode(_kept(message)[name]) if name in _kept(message) else decode(None),
        lambda message, value: _keep(message, name, encode(value)),
    )


def _seconds(time):
    return [time.sec, time.nanosec]


def _encoded(goal):
    return {
        "trajectory": serialize_message(goal.trajectory).hex(),
        "tolerances": [[asdict(one) for one in each] for each in (goal.path_tolerance, goal.goal_tolerance)],
        "time": _seconds(goal.goal_time_tolerance),
    }


def _decoded(kept):
    path, end = ([JointTolerance(**one) for one in each] for each in kept["tolerances"])
    trajectory = deserialize_message(bytes.fromhex(kept["trajectory"]), JointTrajectory)
    sec, nanosec = kept["time"]
    return Goal(trajectory, path, end, Duration(sec=sec, nanosec=nanosec))


_identity = _value("goal_id", lambda one: bytes(one.uuid).hex(), lambda text: UUID(uuid=list(bytes.fromhex(text))))
Carrier.Request.goal_id = String.goal_id = _identity
Carrier.Request.goal = _value("goal", _encoded, _decoded)
String.feedback = _value("feedback", asdict, lambda kept: Feedback(**kept))
Carrier.Response.accepted = _value("accepted", bool, bool)
Carrier.Response.stamp = _value("stamp", _seconds, lambda pair: Time(sec=pair[0], nanosec=pair[1]))
Carrier.Response.status = _value("status", int, lambda status: status or 0)
_carried = Carrier.Response.result
Carrier.Response.result = property(
    _carried.fget,
    lambda message, end: _keep(message, "end", asdict(end)) if isinstance(end, Result) else _carried.fset(message, end),
)
for _name in ("error_code", "error_string"):
    _read = lambda given, name=_name: json.loads(given.reason or "{}").get("end", asdict(Result()))[name]  # noqa: E731
    setattr(SetParametersResult, _name, property(_read))
