"""The driver for arms with a JointTrajectoryController of ROS 2 (Jazzy and later).

One goal a cycle is sent, from rest to rest and with a path tolerance; the next one only when the controller reports
success and the samples agree. A controller has no watchdog for its client: where this computer dies, the arm goes on to
the end of its goal. Where this process dies, a second one brakes the arm (`brake`).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from typing import Any

import numpy as np

from drivers.errors import ConfigurationError, DriverError, LinkStopped, RefusedError
from drivers.joint_trajectory import LONGEST, GoalProgram
from drivers.protocol import Identity, Status
from drivers.transports.base.kept import KeptProgram
from drivers.transports.base.link import LinkDriver, check_currents
from drivers.transports.ros2 import preconditions
from drivers.transports.ros2.brake import BrakeProcess
from drivers.transports.ros2.link import RosLink
from drivers.transports.ros2.motion import Ros2Motion
from drivers.wire.ros2 import DESCRIPTION, MANAGER, JointSample, RosAddress, SetPoint, joints_of

#: What `effort` of joint_states may be said to be.
EFFORTS = ("torque", "current", "none")
_DISCOVERY = 30.0  # s: nodes that were killed are known for 20 s, and keep new ones waiting
_ROBOT = re.compile(rb"<robot\b[^<>]*?\bname\s*=\s*[\"']([^\"'<>]{1,128})[\"']")
_WATCHED = 100.0  # Hz; slower samples are too few for inertia
_ALONE = (
    "the second process, which brakes the arm when the agent is gone, has ended or does not answer, so nothing may "
    "move; run the command again"
)
_BRAKES = 1.5  # s that closing waits for the arm to rest


class Ros2Driver(LinkDriver[RosLink, Ros2Motion]):
    """`drivers.protocol.Driver` over topics, parameters and, where control_msgs is there, goals.

    Args:
        address: `ros2://DOMAIN/NAMESPACE/CONTROLLER`, and `,beside=NODE` for nodes that may hold an idle client.
        effort: one of `EFFORTS`.
        options: of `LinkDriver`.

    Raises:
        ConfigurationError: not such an address or effort.
    """

    dialect = "joint_trajectory"
    efforts = EFFORTS
    longest_motion = LONGEST  # `BoundsMotion`

    def __init__(self, address: str, effort: str = "torque", **options: Any) -> None:
        self._target = RosAddress.of(address)
        if effort not in EFFORTS:
            raise ConfigurationError(f"effort {effort!r}: {', '.join(EFFORTS)} are known")
        self._text = address
        super().__init__(address, **{"timeout": _DISCOVERY, **options})
        self.effort = effort
        if effort == "current":
            self.torque_per_ampere = np.empty((0, 0))  # `MeasuresCurrents`
        self._parameters: dict[str, Any] = {}
        self._manager: dict[str, Any] = {}
        self._period = 0.0
        self._by_goal = False
        self._stored = KeptProgram[GoalProgram]()
        self._brake: BrakeProcess | None = None

    def endpoints(self) -> tuple[str, ...]:
        """`NamesEndpoints`: the controller's node."""
        return (f"ros2 domain {self._target.domain} {self._target.node}",)

    @property
    def facts(self) -> dict[str, str]:
        """`ReportsDiagnostics`: how the motion was sent, when cycles began, and how the samples came."""
        motion = self._motion
        if motion is None:
            return {}
        return {
            "ros2_sent_by": "goal" if self._by_goal else "topic",
            "ros2_effort": self.effort,
            "cycle_markers_s": json.dumps(motion.cycle_starts),
            "stamp_jitter_s": f"{motion.counter.jitter:.6f}",
            "oldest_sample_s": f"{motion.oldest:.4f}",
            "samples_without_set_point_count": str(motion.unmatched),
        }

    def _open(self) -> None:
        """See the controller, its parameters, its joints' samples, and that nobody else commands it."""
        self._stored = KeptProgram()
        link = self._link = RosLink(
            self._target, self._timeout, self._on_sample, self._on_state, self._on_turn, self._on_failure
        )
        link.watchdog = self._watchdog
        self._parameters = link.parameters(self._target.node)
        if not self._parameters:
            raise DriverError(
                f"{self.address}: no node {self._target.node} answers in ROS domain {self._target.domain} within "
                f"{self._timeout:g} s; is the controller loaded, are ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE and "
                "RMW_IMPLEMENTATION those of the robot?"
            )
        link.simulated = bool(self._parameters.get("use_sim_time"))
        self._manager = link.parameters(self._target.name(MANAGER), min(self._timeout, 3.0))
        joints = joints_of(self._parameters.get("joints") or ())
        link.listen(joints)
        link.describe()
        self._by_goal = link.goals()
        self._period = self._sampling(link)
        preconditions.check_alone(link)  # others are known by now: all of this takes seconds

    def _sampling(self, link: RosLink) -> float:
        """The period [s] of the samples: the manager's, where it says it and the stamps agree, else theirs."""
        stated = float(self._manager.get("update_rate") or 0.0)  # a controller's own may be less than its broadcaster's
        rate, _ = link.pace()
        if 0.7 * stated < rate < 1.4 * stated:
            return 1.0 / stated
        return 1.0 / (round(rate, -1) if rate > 20.0 else rate)

    def identify(self) -> Identity:
        """By the robot's description and the controller's parameters."""
        link = self._connected()
        if link.disputed:
            raise DriverError(
                f"{link.target.name(DESCRIPTION)} has had two descriptions, of this robot and of another: end the "
                "other publisher (`ros2 topic info -v` names both), then run the command again"
            )
        named = _ROBOT.search(link.description)
        if named is None:
            raise DriverError(f"{link.target.name(DESCRIPTION)} has no <robot name=…>, which says whose arm it is")
        digest = hashlib.sha256(link.description).hexdigest()
        slow = f"joint_states come {1 / self._period:.0f} times a second, which tells nothing of inertia"
        watch_only = slow if 1 / self._period < _WATCHED - 0.5 else ""
        if self.effort == "none":
            watch_only = "the recipe says that joint_states have no effort, so nothing can be identified from them"
        return Identity(
            robot=named[1].decode("utf-8", "replace"),
            serial=f"urdf-{digest[:12]}",
            controller="JointTrajectoryController",
            version=os.environ.get("ROS_DISTRO", "") or f"rclpy of {sys.prefix}",
            joint_names=link.joints,
            period=self._period,
            watch_only=watch_only,
            unguarded=f"if this computer dies, the arm ends its cycle, at most {LONGEST:g} s",
        )

    def description(self) -> str:
        """`DescribesRobot`: by robot_state_publisher."""
        return self._connected().description.decode("utf-8", "replace")

    def status(self) -> Status:
        """What the samples say; ROS 2 has no common word for modes, drives and stops, so a person confirms them."""
        link = self._connected()
        return Status(
            drives_on=True,
            mode="auto",
            emergency_stop=False,
            alarms=(),
            override=1.0 if link.scaling is None else float(link.scaling),
            cell_closed=True,
            moving=self._running is not None or bool(np.abs(link.velocity).max() > 0.05),
            program=self._stored.name,
            checksum=self._stored.checksum,
            position=link.latest.position.astype(float),
            emulator=bool(self._parameters.get("emulated_by_calibration_agent")),
            override_known=link.scaling is not None,
            modes_known=False,
        )

    def resting(self) -> tuple[np.ndarray, np.ndarray]:
        """`ReportsEffort`: of the sample that came last."""
        sample = self._connected().latest
        if self.effort != "current":
            return sample.position, sample.effort
        check_currents(self.torque_per_ampere, len(sample.position))
        return sample.position, self.torque_per_ampere @ sample.effort

    def throughput(self) -> float:
        """`MeasuresThroughput`: by the stamps of two seconds; a tenth may be left out by the controller itself."""
        rate, _ = self._connected().pace()
        return 1.0 / self._period if rate * self._period > 0.9 else rate

    def upload(self, name: str, text: str) -> str:
        """Keep a program for `start`; returns the SHA-256 (hex) of its text.

        Raises:
            RefusedError: no program, one whose goals could not be left alone, or the arm moves.
        """
        link = self._connected()
        if self._running is not None:
            raise RefusedError("no program is taken while the arm moves; stop it first")
        self._stored = KeptProgram()
        checksum = self._stored.keep(name, GoalProgram.of(text))
        if self._brake is None or not self._brake.alive:
            self._brake = BrakeProcess(self._text, link.joints, f"{link.name}_brake")
            self._brake.wait_ready(self._start_timeout)
            link.forget()
        return checksum

    def start(self, name: str, checksum: str) -> None:
        """Send the first goal, once, where every precondition holds."""
        link = self._connected()
        self._check_over()
        program = self._stored.find(name, checksum)
        if self.effort == "current":
            check_currents(self.torque_per_ampere, len(link.joints))
        preconditions.check_controller(link, self._parameters, self._manager, self._by_goal)
        preconditions.check_active(link)
        preconditions.check_alone(link)
        preconditions.check_arm(link, program.joints, self.effort != "none")
        if self._brake is None or not self._brake.alive:
            raise RefusedError(_ALONE)
        torque = self.torque_per_ampere if self.effort == "current" else None
        recorded = self.effort != "none"
        motion = Ros2Motion(
            program, link, self._period, self._by_goal, torque, recorded, self._buffer_limit, self._on_over
        )
        with self._start_of(motion):
            self._brake.arm(motion.strength)
            link.guarded = True
            motion.begin()
            if not link.wait(lambda: motion.begun, self._timeout):
                link.check()
                raise DriverError(f"{self.address}: the goal was sent, and nothing says that it was taken")

    def _bring_to_rest(self, link: RosLink, motion: Ros2Motion | None) -> None:
        """Brake by one point, and wait until the arm rests."""
        if motion is None or motion.over:
            return
        motion.stopping = True
        motion.brake()
        if not motion.wait(self._start_timeout):
            raise self._still_moves()

    def close(self) -> None:
        """Close the link; where the arm may still move, it is braked first. Never raises."""
        link, self._link = self._link, None
        if link is not None:
            if (motion := self._running) is not None:
                closed = DriverError(f"the link to {self.address} was closed while the arm moved")
                motion.brake(closed)
                if not motion.wait(_BRAKES):
                    link.cancel()
                motion.finish(closed)
            link.close()
        brake, self._brake = self._brake, None
        if brake is not None:
            brake.close()

    # From here on in the thread of the link.

    def _on_sample(self, sample: JointSample, now: float) -> None:
        if (motion := self._running) is None:
            return
        motion.sample(sample, now)
        if (error := motion.too_full()) is not None:
            motion.brake(error)

    def _on_state(self, state: SetPoint) -> None:
        if self._motion is not None:
            self._motion.state(state)

    def _on_turn(self) -> None:
        motion, brake = self._running, self._brake
        if motion is None:
            return
        if brake is not None:
            brake.beat()
            if not brake.alive:
                motion.brake(LinkStopped(_ALONE))
        motion.poll()

    def _on_over(self) -> None:
        if self._link is not None:
            self._link.guarded = False
        if self._brake is not None:
            self._brake.disarm()

    def _on_failure(self, error: DriverError) -> None:
        motion, link = self._running, self._link
        if link is not None and motion is not None:
            motion.brake(error)
            seconds = motion.send_brake()
            if self._brake is not None:
                self._brake.disarm()  # it sees no more than this process, and would brake once more
            link.linger(seconds or 0.0)
            link.cancel()
        super()._on_failure(error)
