"""One controller on ROS 2 and the thread that alone reads it: samples, set-points, and what is sent to it."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import secrets
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drivers.errors import DriverError, ProtocolError
from drivers.texts import ALARM, printable
from drivers.transports.base.link import LinkThread
from drivers.transports.ros2.following import CANCEL_AFTER, Believed
from drivers.transports.ros2.ros import DEPTH, Ros, send_brake, set_time, trajectory_message, typed
from drivers.wire.ros2 import (
    DESCRIPTION,
    JOINT_STATES,
    JointReader,
    JointSample,
    JointStateReader,
    Read,
    RosAddress,
    SetPoint,
    SetPointReader,
)

_TURN = 0.008  # s: as long as a sample waits, at most, on an idle computer
_STALL = 0.05  # s of one turn that count as silence
_URDF = 16 * 1024 * 1024  # bytes
_DRIFT = 0.03  # of a controller's clock from ours; at load 10, 43 measurements of a right one gave 0.001 at most
_SEEN = 20_000  # samples of which ages are kept, at most
_SUCCEEDED = 4  # of action_msgs/GoalStatus
#: Instead of an error code, of a goal that somebody cancels.
CANCELLED = 1
#: Ages and rate are known over this time [s].
OBSERVED = 2.0


class RosLink(LinkThread):
    """Subscriptions and publishers of one controller.

    Args:
        target: address of the controller, parsed.
        timeout: how long [s] to wait for what has to be there.
        on_sample: is given each sample and when it came [s, monotonic], in the thread.
        on_state: is given each set-point, in the thread.
        on_turn: comes often, in the thread.
        on_failure: comes once, as the last call.
    """

    def __init__(
        self,
        target: RosAddress,
        timeout: float,
        on_sample: Callable[[JointSample, float], None],
        on_state: Callable[[SetPoint], None],
        on_turn: Callable[[], None],
        on_failure: Callable[[DriverError], None],
    ) -> None:
        super().__init__(target.node, on_failure)
        self.target, self._timeout = target, timeout
        self.name = f"calibration_agent_{os.getpid()}_{secrets.token_hex(3)}"
        self._on_sample, self._on_state, self._on_turn = on_sample, on_state, on_turn
        self.believed = Believed()
        self._doubted = -math.inf, 0.0  # when a sample came last that is not believed, and its jump
        self.simulated = False  # whether the controller's time is
        self.states: deque[SetPoint] = deque(maxlen=DEPTH)  # the newest, as many as may have waited
        self.scaling: float | None = None  # of the newest of them
        self.description = b""
        self.disputed = False  # whether another description has come as well
        self.joints: tuple[str, ...] = ()
        #: Stamps and ages of the last seconds; the age is by our own clock that nobody sets, so only its changes count.
        self._seen: deque[tuple[float, float]] = deque(maxlen=_SEEN)
        self._fault: DriverError | None = None
        self._ros = Ros(target.domain, self.name)
        self._commands = self._ros.commands(target)
        self._goals: Any = None
        self._thread.start()

    @property
    def latest(self) -> JointSample:
        """The newest sample that this arm can have made; `listen` has waited for the first."""
        assert self.believed.sample is not None
        return self.believed.sample

    @property
    def velocity(self) -> np.ndarray:
        """(n,) then, from positions."""
        return self.believed.velocity

    @property
    def doubt(self) -> str:
        """Why a sample of the last seconds is not believed; empty where all are."""
        (when, jump), topic = self._doubted, self.target.name(JOINT_STATES)
        if time.monotonic() - when > OBSERVED:
            return ""
        if not math.isfinite(jump):
            return f"{topic} has positions that are no numbers; look at the robot's driver"
        return (
            f"a joint jumps by {jump:.3g} rad from one sample to the next: {self.second_source[:-1]}, or does it wrap "
            "at ±π?"
        )

    @property
    def second_source(self) -> str:
        """The question whether there is another one of the samples."""
        topic = self.target.name(JOINT_STATES)
        return f"does a second node publish {topic} (see `ros2 topic info -v {topic}`)?"

    # Of the controller, in the caller's thread

    def parameters(self, node: str, timeout: float | None = None) -> dict[str, Any]:
        """Of a node, empty where it does not answer."""
        values = self._ros.parameters(node, self._timeout if timeout is None else timeout, self.wait)
        self.check()
        return values

    def call(self, package: str, name: str, service: str) -> Any:
        """The answer of a service that is asked without arguments; None where type or service is not there."""
        kind = typed(package, name)
        if kind is None:
            return None
        client = self._ros.node.create_client(kind, service)
        if not self.wait(client.service_is_ready, 2.0):
            return None
        asked = client.call_async(kind.Request())
        return asked.result() if self.wait(asked.done, 2.0) else None

    def others(self) -> tuple[str, ...]:
        """Nodes that may command this controller: publishers of trajectories, and clients of its action."""
        node, topic = self._ros.node, self.target.name(self.target.controller, "joint_trajectory")
        names = {
            f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in node.get_publishers_info_by_topic(topic)
        }
        for name, namespace in node.get_node_names_and_namespaces():
            try:
                clients = node.get_client_names_and_types_by_node(name, namespace)
            except Exception:  # it has gone meanwhile
                continue
            if any(service == f"{self.target.action}/_action/send_goal" for service, _ in clients):
                names.add(f"{namespace.rstrip('/')}/{name}")
        return tuple(sorted(each for each in names if not each.rpartition("/")[2].startswith(self.name)))

    def listen(self, joints: Sequence[str]) -> None:
        """Receive samples of these joints, and set-points where their type is there.

        Raises:
            DriverError: none come.
        """
        self.joints = tuple(joints)
        states, reader = self.target.name(JOINT_STATES), JointStateReader(joints)
        self.wait(lambda: self._ros.best_effort(states) is not None, self._timeout)
        kinds = dict(self._ros.node.get_topic_names_and_types()).get(states, ())
        if kinds and "sensor_msgs/msg/JointState" not in kinds:
            raise ProtocolError(f"{states} has messages of type {kinds[0]}, and sensor_msgs/msg/JointState is expected")
        self._listen_to_states()  # first: after a stall, the set-points of all samples that waited are known
        self._ros.raw("sensor_msgs.msg", "JointState", states, functools.partial(self._read, reader, self._take))
        if not self.wait(lambda: self.believed.sample is not None, self._timeout):
            self.check()
            raise DriverError(
                f"{states}: no sample of {', '.join(joints)} within {self._timeout:g} s; is the "
                "joint_state_broadcaster active, and does the network let its messages through?"
            )

    def describe(self) -> None:
        """Take the robot's description.

        Raises:
            DriverError: nobody publishes it, or it is too long.
        """
        from rclpy.qos import DurabilityPolicy, QoSProfile

        kind = typed("std_msgs.msg", "String")

        def take(message: Any) -> None:
            text = message.data.encode()[: _URDF + 1]
            self.disputed = self.disputed or self.description not in (b"", text)
            self.description = text

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        topic = self.target.name(DESCRIPTION)
        self._ros.node.create_subscription(kind, topic, take, latched)
        if not self.wait(lambda: bool(self.description), self._timeout):
            self.check()
            raise DriverError(
                f"nobody publishes {topic} within {self._timeout:g} s, so nothing says which robot this is: start "
                "robot_state_publisher in the controller's namespace"
            )
        if len(self.description) > _URDF:
            raise DriverError(f"{topic} is longer than {_URDF >> 20} MiB: it is no description of one robot")

    def goals(self) -> bool:
        """Whether the controller takes goals from here: with tolerances, and a result."""
        if self._goals is None and (kind := typed("control_msgs.action", "FollowJointTrajectory")) is not None:
            from rclpy.action import ActionClient

            client = ActionClient(self._ros.node, kind, self.target.action)
            self._goals = client if self.wait(client.server_is_ready, min(self._timeout, 5.0)) else False
        return bool(self._goals)

    def pace(self, again: bool = False) -> tuple[float, float]:
        """Samples a second by the stamps of the last seconds, and the 99th percentile of their age beyond the least.

        `again`: whether it is the second time, as a clock seemed to lose or gain.
        """
        began = time.monotonic()
        until = 2 * OBSERVED + self.watchdog  # of a clock at half speed as well
        observed = self.wait(lambda: self.believed.at > began and self._span() >= 0.9 * OBSERVED, until)
        self.check()
        with self._changed:
            stamps = np.array(self._seen)
        if self.doubt:
            raise DriverError(self.doubt)
        if not observed:
            topic = self.target.name(JOINT_STATES)
            if not self.believed.at > began:
                raise DriverError(f"{topic} has fallen silent; is the joint_state_broadcaster still active?")
            raise DriverError(
                f"the stamps of {topic} stand still or jump, the last is {stamps[-1, 0]:.3f} s, so nobody knows how "
                "old its samples are: the node that publishes it has to set header.stamp by one running clock"
            )
        half = stamps[:, 0] < np.mean(stamps[[0, -1], 0])
        drift = (stamps[~half, 1].min() - stamps[half, 1].min()) / (np.ptp(stamps[:, 0]) / 2)
        if abs(drift) > _DRIFT and not again:  # a busy computer may keep either end waiting for once
            self.forget()
            return self.pace(again=True)
        if abs(drift) > _DRIFT:
            what = "simulated time (use_sim_time)" if self.simulated else "a clock"
            raise DriverError(
                f"{self.target.node} runs on {what}, which {'loses' if drift > 0 else 'gains'} {abs(drift):.2g} s in "
                "each of its seconds; let the simulator run in real time, or look at the clocks of both computers"
            )
        ages = stamps[:, 1] - stamps[:, 1].min()
        return (len(stamps) - 1) / float(np.ptp(stamps[:, 0])), float(np.quantile(ages, 0.99))

    def forget(self) -> None:
        """Leave out of `pace` how samples came so far: something else kept this computer busy."""
        with self._changed:
            while len(self._seen) > 1:
                self._seen.popleft()

    def _span(self) -> float:
        return self._seen[-1][0] - self._seen[0][0] if self._seen else 0.0

    def heard(self) -> bool:
        """Whether somebody receives what is sent by topic, as a brake is: discovery takes time."""
        return self.wait(lambda: self._commands.get_subscription_count() > 0, self._timeout)

    # To the controller, from any thread

    def clock(self) -> float:
        """Time [s] by the controller's clock, as the freshest sample of the last seconds has it."""
        with self._changed:
            return time.monotonic() - min(age for _, age in self._seen)

    def send(self, ahead: float, points: Sequence[Sequence[Any]]) -> float:
        """Send a trajectory by topic, once: points (time [s], then rows (n,) of position and rates); returns its stamp.

        That is `ahead` [s] of the controller's time at the last moment: old samples make it no later.
        """
        self.check()
        message = trajectory_message(self.joints, points)
        stamp = self.clock() + ahead
        set_time(message.header.stamp, stamp)
        self._commands.publish(message)
        return stamp

    def send_goal(
        self,
        ahead: float,
        points: Sequence[Sequence[Any]],
        tolerance: np.ndarray,
        goal_time: float,
        answered: Callable[[bool], None],
        ended: Callable[[int, str], None],
    ) -> float:
        """The same as a goal, once; `answered` says whether it was accepted, `ended` its error code and text."""
        self.check()
        joint_tolerance = typed("control_msgs.msg", "JointTolerance")
        action = typed("control_msgs.action", "FollowJointTrajectory")
        goal = action.Goal(trajectory=trajectory_message(self.joints, points))
        pairs = zip(self.joints, tolerance.tolist(), strict=True)
        goal.path_tolerance = [joint_tolerance(name=name, position=value) for name, value in pairs]
        set_time(goal.goal_time_tolerance, goal_time)

        def on_result(future: Any) -> None:
            answer = future.result()  # one that somebody cancels has no error code
            code = int(answer.result.error_code) or (0 if answer.status == _SUCCEEDED else CANCELLED)
            ended(code, printable(answer.result.error_string, ALARM))

        def on_answer(future: Any) -> None:
            handle = future.result()
            answered(bool(handle.accepted))
            if handle.accepted:
                handle.get_result_async().add_done_callback(on_result)

        stamp = self.clock() + ahead
        set_time(goal.trajectory.header.stamp, stamp)
        with self._ros.sending:
            self._goals.send_goal_async(goal).add_done_callback(on_answer)
        return stamp

    def brake(self, strength: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> float:
        """`send_brake` to this arm; never raises."""
        with contextlib.suppress(Exception):  # a context that has ended: the second process brakes
            return send_brake(self._commands, self.joints, strength, position, velocity)
        return 0.0

    def cancel(self) -> None:
        """Cancel whatever runs; never raises."""
        with contextlib.suppress(Exception):  # a context that has ended
            self._ros.cancel_all(self.target)

    def linger(self, seconds: float) -> None:
        """Let a brake act that takes `seconds`, before what runs is cancelled (in the thread, which has ended)."""
        with contextlib.suppress(Exception):  # whatever it is, the cancel follows
            self._ros.spin_for(seconds + CANCEL_AFTER)

    def close(self) -> None:
        """End the link and its thread; never raises."""
        super().close()
        with contextlib.suppress(Exception):  # a context that has ended
            if self._goals:
                self._goals.destroy()  # or it is seen, and taken for another commander's, as long as this process lives
        self._ros.close()

    # In the thread

    def _listen_to_states(self) -> None:
        kind = typed("control_msgs.msg", "JointTrajectoryControllerState")
        if kind is None or "speed_scaling_factor" not in kind.get_fields_and_field_types():
            return
        take = functools.partial(self._read, SetPointReader(self.joints), self._take_state)
        topic = self.target.name(self.target.controller, "controller_state")
        self._ros.raw("control_msgs.msg", "JointTrajectoryControllerState", topic, take)

    def _read(self, reader: JointReader[Read], take: Callable[[Read], None], data: bytes) -> None:
        try:
            message = reader.read(data)
        except ProtocolError as error:
            self._fault = error
            return
        if message is not None:
            take(message)

    def _take(self, sample: JointSample) -> None:
        now, before = time.monotonic(), self.believed.sample
        if jump := self.believed.take(sample, now):
            self._doubted = now, jump
        else:
            self._heard = self._heard or before is None or sample.stamp > before.stamp
            with self._changed:
                self._seen.append((sample.stamp, now - sample.stamp))
                while not 0.0 <= sample.stamp - self._seen[0][0] <= OBSERVED:
                    self._seen.popleft()
        self._on_sample(sample, now)

    def _take_state(self, state: SetPoint) -> None:
        self.states.append(state)
        self.scaling = state.scaling
        self._on_state(state)

    def _work(self) -> None:
        while not self._closing.is_set():
            began = time.monotonic()
            self._heard = False
            self._ros.spin_once(_TURN)
            if self._fault is not None:
                raise self._fault
            self._on_turn()
            with self._changed:
                self._changed.notify_all()
            self._count_silence(time.monotonic() - began, _STALL)

    def _fell_silent(self) -> DriverError:
        return DriverError(
            f"{self.target.name(JOINT_STATES)} fell silent: no new sample for {self.watchdog:g} s, and the arm may "
            "move; it was told to brake: go and look at it"
        )
