"""The fake arm on ROS 2: controller, broadcaster, description and manager as unmodified rclpy nodes.

Without control_msgs there are no goals and no controller_state, as on a computer whose ROS lacks that package.
"""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from drivers.wire.ros2 import DESCRIPTION, JOINT_STATES, MANAGER, RosAddress
from fake_controller.ros2.cell import Ros2Cell, RosCycles
from fake_controller.ros2.controller import ErrorCode, Goal
from fake_controller.ros2.trajectory import TrajectoryMessage, TrajectoryPoint

_TURN = 0.002  # s


class JointStateWriter:
    """JointStates of these names as CDR bytes."""

    def __init__(self, names: Sequence[str]) -> None:
        body = bytearray(struct.pack("<I", 1) + b"\0")
        body += b"\0" * (-len(body) % 4) + struct.pack("<I", len(names))
        for name in names:
            text = name.encode() + b"\0"
            body += b"\0" * (-len(body) % 4) + struct.pack("<I", len(text)) + text
        self._names = bytes(body)

    def write(self, stamp: float, *rows: np.ndarray) -> bytes:
        """One message: stamp [s], then position, velocity and effort (n,)."""
        return b"\x00\x01\x00\x00" + bytes(self._body(stamp, rows))

    def _body(self, stamp: float, rows: Iterable[np.ndarray]) -> bytearray:
        sec = int(stamp)
        body = bytearray(struct.pack("<iI", sec, min(round((stamp - sec) * 1e9), 999_999_999)) + self._names)
        for row in rows:
            _append(body, row)
        return body


class SetPointWriter(JointStateWriter):
    """JointTrajectoryControllerStates (Jazzy) of these names as CDR bytes."""

    def write(self, stamp: float, *rows: np.ndarray, scaling: float = 1.0) -> bytes:
        """One message: stamp [s], position and velocity (n,) of reference and of feedback, and the speed scaling."""
        body = self._body(stamp, ())
        for point in (rows[:2], rows[2:], (), ()):  # then error and output, which are left empty
            for row in (*point, *[np.empty(0)] * (4 - len(point))):
                _append(body, row)
            body += bytes(-len(body) % 4 + 8)
        body += bytes(4 + 4 * 20)  # of joints of several degrees of freedom
        return b"\x00\x01\x00\x00" + bytes(body + bytes(-len(body) % 8) + struct.pack("<d", scaling))


def _append(body: bytearray, row: np.ndarray) -> None:
    body += bytes(-len(body) % 4) + struct.pack("<I", len(row))
    if len(row):
        body += bytes(-len(body) % 8) + np.ascontiguousarray(row, "<f8").tobytes()


def seconds(value: Any) -> float:
    """Of a Time or Duration."""
    return float(value.sec) + 1e-9 * float(value.nanosec)


def message_of(message: Any) -> TrajectoryMessage:
    """A trajectory_msgs/JointTrajectory as the controller takes it."""
    points = tuple(
        TrajectoryPoint.of(seconds(point.time_from_start), point.positions, point.velocities, point.accelerations)
        for point in message.points
    )
    return TrajectoryMessage(tuple(message.joint_names), seconds(message.header.stamp), points)


class Ros2Server:
    """Nodes of a cell at an address, in a context of their own.

    Args:
        cell: what is served.
        address: `ros2://DOMAIN/NAMESPACE/CONTROLLER`.
        goals: whether goals and controller_state are offered, where control_msgs is there.

    Raises:
        ImportError: no ROS 2 in this environment.
    """

    def __init__(self, cell: Ros2Cell, address: str, goals: bool = True) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.cell, self.address = cell, address
        self.taken: deque[Any] = deque(maxlen=100)  # trajectories, as they came
        self._target = place = RosAddress.of(address)
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=place.domain, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._nodes = [self._controller_node(goals), self._manager_node()]
        self._executor = SingleThreadedExecutor(context=self.context)
        for node in self._nodes:
            self._executor.add_node(node)
        names = sorted(cell.robot.joint_names)  # as a joint_state_broadcaster filtered by a URDF has them
        self._order = [cell.robot.joint_names.index(name) for name in names]
        self._writers = JointStateWriter(names), JointStateWriter(names[:-1])
        self._closing = threading.Event()
        self._threads = [threading.Thread(target=loop, daemon=True) for loop in (self._live, self._spin)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the nodes."""
        self._closing.set()
        for thread in self._threads:
            thread.join(5.0)
        self._executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
        self.context.try_shutdown()

    def _controller_node(self, goals: bool) -> Any:
        from action_msgs.srv import CancelGoal
        from rclpy.node import Node
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from sensor_msgs.msg import JointState
        from std_msgs.msg import String
        from trajectory_msgs.msg import JointTrajectory

        place, cell = self._target, self.cell
        node = Node(place.controller, namespace=place.namespace, context=self.context)
        tolerances = {f"constraints.{name}.trajectory": cell.tolerance for name in cell.robot.joint_names}
        parameters: dict[str, Any] = {
            "joints": list(cell.robot.joint_names),
            "command_interfaces": ["position"],
            "state_interfaces": ["position", "velocity"],
            "interpolation_method": "splines",
            "allow_partial_joints_goal": False,
            "allow_nonzero_velocity_at_trajectory_end": False,
            "constraints.stopped_velocity_tolerance": 0.01,
            "constraints.goal_time": 0.0,
            "emulated_by_calibration_agent": cell.state.emulator,
            **tolerances,
        }
        for name, value in parameters.items():
            node.declare_parameter(name, value)
        self._states = node.create_publisher(JointState, place.name(JOINT_STATES), 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._description = node.create_publisher(String, place.name(DESCRIPTION), latched)
        self._description.publish(String(data=cell.robot.urdf))
        node.create_subscription(JointTrajectory, place.name(place.controller, "joint_trajectory"), self.take, 10)
        self._state_publisher: Any = None
        if not (goals and self._offer_goals(node)):
            node.create_service(CancelGoal, f"{place.action}/_action/cancel_goal", self._cancel)
        return node

    def _manager_node(self) -> Any:
        from rclpy.node import Node

        node = Node(MANAGER, namespace=self._target.namespace, context=self.context)
        node.declare_parameter("update_rate", round(1.0 / self.cell.period))
        kind = "joint_trajectory_controller/JointTrajectoryController"
        node.declare_parameter(f"{self._target.controller}.type", kind)
        return node

    def _offer_goals(self, node: Any) -> bool:
        try:
            from control_msgs.action import FollowJointTrajectory
            from control_msgs.msg import JointTrajectoryControllerState
        except ImportError:
            return False
        from rclpy.action import ActionServer, CancelResponse, GoalResponse
        from rclpy.callback_groups import ReentrantCallbackGroup

        cell = self.cell

        def offered(goal: Any) -> Any:
            refusal = message_of(goal.trajectory).refusal(cell.robot.joint_names, cell.now())
            return GoalResponse.REJECT if refusal or not cell.controller.active else GoalResponse.ACCEPT

        async def execute(handle: Any) -> Any:
            from rclpy.task import Future

            over = Future(executor=self._executor)
            request = handle.request
            goal = Goal(
                message_of(request.trajectory),
                lambda *end: over.set_result(end),
                {tolerance.name: tolerance.position for tolerance in request.path_tolerance},
                {tolerance.name: tolerance.position for tolerance in request.goal_tolerance},
                seconds(request.goal_time_tolerance),
            )
            if not cell.accepts() or cell.controller.take_goal(goal, cell.now()):
                over.set_result(("aborted", ErrorCode.INVALID_GOAL, "refused"))
            status, code, text = await over
            {"succeeded": handle.succeed, "aborted": handle.abort, "canceled": handle.canceled}[status]()
            return FollowJointTrajectory.Result(error_code=int(code), error_string=text)

        def cancelled(_: Any) -> Any:
            if cell.accepts():
                threading.Timer(0.001, cell.controller.cancel).start()  # the server has to note it first
            return CancelResponse.ACCEPT

        self._action = ActionServer(
            node,
            FollowJointTrajectory,
            self._target.action,
            execute,
            goal_callback=offered,
            cancel_callback=cancelled,
            callback_group=ReentrantCallbackGroup(),
        )
        topic = self._target.name(self._target.controller, "controller_state")
        self._state_publisher = node.create_publisher(JointTrajectoryControllerState, topic, 10)
        self._state = SetPointWriter(cell.robot.joint_names)
        return True

    # What comes in, in the executor's thread

    def take(self, message: Any) -> None:
        """A trajectory by topic."""
        self.taken.append(message)
        if self.cell.faults.heard(b" ") and self.cell.accepts():
            self.cell.controller.take(message_of(message), self.cell.now())

    def _cancel(self, request: Any, response: Any) -> Any:
        if self.cell.faults.heard(b" ") and self.cell.accepts():
            self.cell.controller.cancel()
        return response

    def _spin(self) -> None:
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=0.1)

    # What goes out

    def _live(self) -> None:
        dropped = False
        while not self._closing.wait(_TURN):
            cycles = self.cell.run()
            if cycles is not None and self.context.ok() and not dropped:
                try:
                    self._publish(cycles)
                except ConnectionResetError:  # the fault `drop`: the arm goes on all the same
                    dropped = True

    def _publish(self, cycles: RosCycles) -> None:
        for k, stamp in enumerate(cycles.stamps):
            self.cell.late.append(self.cell.now() - stamp)
            rows = (cycles.position[k], cycles.velocity[k], cycles.effort[k])
            if not self.cell.mute:
                order = self._order[:-1] if self.cell.one_less else self._order
                data = self._writers[self.cell.one_less].write(stamp, *(row[order] for row in rows))
                self.cell.faults.send(data, self._states.publish, lambda: None, spare=False)
            if self._state_publisher is not None and not self.cell.mute:
                self._publish_state(float(stamp), cycles, k)

    def _publish_state(self, stamp: float, cycles: RosCycles, k: int) -> None:
        rows = (cycles.reference, cycles.reference_velocity, cycles.position, cycles.velocity)
        scaling = float(self.cell.controller.scaling)
        self._state_publisher.publish(self._state.write(stamp, *(row[k] for row in rows), scaling=scaling))
