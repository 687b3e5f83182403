"""The drivers for a COMAU controller with CNR's open programs; docs/real-robot.md says what has to be there.

Motion goes through the trajectory socket; where the arm is and how the controller feels come on two others. Samples
come from the C5G Open node by way of a broker, or, where there is none, from the feedbacks. Programs go by FTP, or
via-points through the trajectory socket, for a controller that has the programs as they are published.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.errors import DriverError, RefusedError, SafetyRefused
from drivers.protocol import Identity, Status, ViaPoint
from drivers.transports.base.link import LinkDriver, check_currents
from drivers.transports.base.ports import socket_endpoints
from drivers.transports.base.poses import poses_of_frames
from drivers.transports.cnr.address import CnrAddress, parse_address
from drivers.transports.cnr.broker import BrokerLink
from drivers.transports.cnr.feeder import Feeder, trajectories
from drivers.transports.cnr.files import CnrIdentity, ProgramFolder
from drivers.transports.cnr.motion import HAND_REST, CnrArm, CnrMotion, stop_reason
from drivers.transports.cnr.sockets import Sockets
from drivers.wire.cnr import Feedback, MessageType, Mode, Point, StatusMessage
from drivers.wire.reasons import EndReason

#: Pause of the feedback program between two messages [s].
FEEDBACK_PERIOD = 0.02
_BURSTS = 0.5  # samples come in bursts: a pace from here on is the whole one
_SAMPLE_PATIENCE = 1.0  # s without a sample, at least
_STOP_AGAIN = 0.05  # s between two stop commands of which the first was not taken
_HAND_TIMEOUT = 600.0  # s for somebody to press START

_log = logging.getLogger(__name__)


class CnrDriver(LinkDriver[Sockets, CnrMotion]):
    """`drivers.protocol.Driver` on CNR's open programs: programs are stored by FTP and started by the socket, or by
    hand.

    `STOP` is the command that ends a motion on its path for good.

    Parameters
    ----------
    address : where everything is.
    options : of `LinkDriver`; FTP is given `start_timeout` too.
    """

    STOP = MessageType.STOP

    def __init__(self, address: CnrAddress, **options: Any) -> None:
        super().__init__(address.host, **options)
        self.torque_per_ampere = np.empty((0, 0))
        self.tell: Callable[[str], None] = _log.warning
        self._where = address
        self._folder = ProgramFolder(address, self._start_timeout)
        self._broker: BrokerLink | None = None
        self._machine: CnrIdentity | None = None
        self._stored = "", ""
        self._starting = threading.Lock()  # its holder may start a trajectory, or say that none follows

    @property
    def facts(self) -> dict[str, str]:
        """Clock offset and lost messages of the last motion."""
        motion, broker = self._motion, self._broker
        if motion is None or motion.match is None:
            return {}
        facts = {} if broker is None else broker.facts
        if motion.begun_at is not None:
            facts["motion_start_s"] = f"{motion.begun_at:.6f}"
        offset = motion.match.offset()
        return facts if offset is None else {**facts, "clock_offset_s": f"{offset:.6f}"}

    def endpoints(self) -> tuple[str, ...]:
        """`NamesEndpoints`: the port that moves the arm."""
        return socket_endpoints(self._where.host, self._where.trajectory)

    def identify(self) -> Identity:
        """Who the identity file says that is there; without a broker, samples come as often as feedbacks."""
        self._connected()
        assert self._machine is not None
        who = self._machine.identity
        if self._broker is not None:
            return who
        return replace(
            who,
            period=FEEDBACK_PERIOD,
            watch_only=f"this link has no broker of C5G Open: some {1 / FEEDBACK_PERIOD:.0f} samples a second at "
            "uneven times, without set-points, are too few for an identification; give mqtt=host:port in the address",
        )

    def status(self) -> Status:
        """State of the controller after this call. The override is not on this wire."""
        sockets = self._connected()
        assert self._machine is not None
        state = sockets.fresh_status()
        feedback = sockets.feedback()
        moving = self._moves(feedback)
        if not moving:
            self._stored = self._read_stored()
        name, checksum = self._stored
        reason = stop_reason(state)
        return Status(
            drives_on=state.drives_powered == 1,
            mode="auto" if state.mode == Mode.AUTO else "teach",
            emergency_stop=state.e_stopped == 1,
            alarms=(f"error {state.error_code}",) if state.in_error == 1 else (),
            override=1.0,
            cell_closed=reason is None or reason[0] is not EndReason.PROTECTIVE_STOP,
            moving=moving,
            program=name,
            checksum=checksum,
            position=np.radians(feedback.joints[: len(self._machine.identity.joint_names)]),
            emulator=self._machine.emulator,
            override_known=False,
        )

    def throughput(self) -> float:
        """`MeasuresThroughput` with samples of the stationary arm; without a broker, feedbacks are the whole link."""
        period = self.identify().period
        pace = 1.0 if self._broker is None else self._broker.pace()
        return (pace if pace < _BURSTS else 1.0) / period

    def frames(self) -> dict[str, np.ndarray]:
        """`ReportsFrames`: as the last feedback has them."""
        feedback = self._connected().feedback()
        return poses_of_frames(feedback.base, feedback.tool, feedback.user)

    def upload(self, name: str, text: str) -> str:
        """Store a program by FTP; returns the SHA-256 (hex) of what was read back.

        Raises:
            RefusedError: not a program (with line and column, if known), no space, or the arm moves.
        """
        if self._moves(self._connected().feedback()):
            raise RefusedError("no program is stored while the arm moves; stop it first")
        self._stored = "", ""
        checksum = self._folder.store(name, text)
        self._stored = name, checksum
        return checksum

    def start(self, name: str, checksum: str) -> None:
        """Run the stored program once. Where the answer is lost the link is closed, so that the arm cannot go on."""
        sockets = self._connected()
        self._check_idle(sockets)
        if self._folder.stored() != (name, checksum):
            raise RefusedError(
                f"the program that the controller has is not the {name!r} that was sent; nothing was started"
            )
        by_hand, number = self._where.by_hand, secrets.randbelow(2**31 - 1) + 1
        is_over = None if by_hand else lambda feedback: feedback.last_point_processed == number
        with self._start_of(self._new_motion(is_over)) as motion:
            sockets.guarded = True
            if by_hand:
                self._wait_for_a_person(sockets, motion, name)
            else:
                self._command_start(sockets, motion, f"the start of {name}", number)

    def close(self) -> None:
        """Close the link; where the arm may still move, a stop is sent first. Never raises."""
        sockets, motion, broker = self._link, self._motion, self._broker
        self._broker = None
        if sockets is not None and motion is not None and not motion.over:
            with contextlib.suppress(DriverError):
                sockets.post(self.STOP)
        super().close()
        if broker is not None:
            broker.close()

    def _open(self) -> None:
        """Open the sockets, read who is there, and listen to the broker."""
        self._stored = "", ""
        address = self._where
        self._link = Sockets(address, self._timeout, self._on_turn, self._on_failure, self.STOP)
        self._machine = self._folder.machine()
        self._link.watchdog = self._machine.watchdog
        if address.broker is not None:
            self._broker = BrokerLink(address, self._machine.identity.period, self._timeout, self._on_loss)

    def _bring_to_rest(self, sockets: Sockets, motion: CnrMotion | None) -> None:
        with self._starting:
            if motion is not None:
                motion.stopping = True
            answer = sockets.command(self.STOP)
        until, warned = time.monotonic() + self._start_timeout, False
        # The controller takes no stop before its flag says that the arm moves: it is sent until the arm has rested.
        while motion is not None and answer is not None and not answer.success and not motion.wait(_STOP_AGAIN):
            if time.monotonic() > until:
                break
            if self._where.by_hand and not warned:
                warned = True
                self.tell("the controller does not take the stop command: press HOLD at the teach pendant, now")
            answer = sockets.command(self.STOP)
        rests = sockets.wait(lambda: not sockets.feedback().is_moving, self._start_timeout)
        if motion is not None:
            rests = rests and motion.wait(self._start_timeout)
        if answer is None or not rests:
            raise self._still_moves("took" if answer is not None else "did not answer")

    def _moves(self, feedback: Feedback) -> bool:
        motion = self._motion
        return bool(feedback.is_moving) or (motion is not None and motion.started and not motion.over)

    def _read_stored(self) -> tuple[str, str]:
        return self._folder.stored()

    def _check_idle(self, sockets: Sockets) -> None:
        self._check_over()
        if sockets.feedback().is_moving:
            raise RefusedError("the arm moves already, by another program; wait for it, or stop it at the controller")

    def _new_motion(self, is_over: Callable[[Feedback], bool] | None) -> CnrMotion:
        """The motion that is about to start, once samples are known to come; `is_over` as in `CnrMotion`."""
        assert self._machine is not None
        joints = len(self._machine.identity.joint_names)
        check_currents(self.torque_per_ampere, joints)
        broker = self._broker
        if broker is not None:
            broker.check(self._timeout)
            broker.begin()
        patience = max(_SAMPLE_PATIENCE, 2 * self._machine.watchdog)
        arm = CnrArm(joints, self.identify().period, self.torque_per_ampere)
        return CnrMotion(arm, self._buffer_limit, is_over, patience, None if broker is None else broker.silent)

    def _command_start(self, sockets: Sockets, motion: CnrMotion, what: str, number: int = 0) -> None:
        """Give a start, once, and see that it was carried out, by its answer or by an arm that moves.

        `number` is that of a stored program, 0 for queued points.

        Raises:
            RefusedError: it was not; nothing has moved.
            DriverError: no answer.
        """
        rested = not motion.begun  # later, motion does not prove this start

        def acts() -> bool:
            return rested and motion.begun

        answer = sockets.command(MessageType.START, Point(sequence_number=number), self._start_timeout, acts)
        if answer is None and not acts():
            raise DriverError(
                f"the controller at {self.address} did not answer {what} within {self._start_timeout:g} s; the link "
                "was closed, which stops the arm. Go and look at it"
            )
        if answer is not None and not answer.success:
            state = sockets.fresh_status()
            if sockets.feedback().is_moving:
                raise DriverError(
                    f"the controller refused {what}, because the arm moves already; it was told to stop. Do its "
                    "programs take back the permission to move at the end of a trajectory, as docs/real-robot.md asks?"
                )
            raise _refused_start(what, state, number != 0)
        motion.started = True

    def _wait_for_a_person(self, sockets: Sockets, motion: CnrMotion, name: str) -> None:
        """Ask for START at the pendant, and wait until the arm moves.

        Raises:
            DriverError: no client connected.
        """
        motion.started = True
        self.tell(
            f"at the controller: select program {name}, drives on, selector at auto, and press START within "
            f"{_HAND_TIMEOUT / 60:.0f} minutes. The recording begins with the first motion and ends when the arm has "
            f"rested for {HAND_REST:g} s"
        )
        if not sockets.wait(lambda: motion.begun, _HAND_TIMEOUT):
            raise DriverError(f"nobody started {name} within {_HAND_TIMEOUT / 60:.0f} minutes; nothing was recorded")

    # Methods from here on run in the reader thread of the sockets, except `_on_loss`.

    def _on_turn(self, feedbacks: list[Feedback]) -> None:
        motion, sockets = self._motion, self._link
        self._take_samples(motion)
        if motion is None or sockets is None or motion.over:
            return
        if feedbacks:
            motion.feedbacks(feedbacks, sockets.last_status())
        fault = motion.poll()
        fault = motion.too_full() or fault
        if fault is not None and not motion.failing:
            self._end_with(sockets, motion, fault)
        sockets.guarded = not motion.over

    def _take_samples(self, motion: CnrMotion | None) -> None:
        """Messages of the broker, for the motion; they are dropped while the arm is stationary."""
        broker = self._broker
        if broker is None:
            return
        times, values = broker.take()
        if motion is not None and not motion.over:
            motion.samples(times, values)
            motion.clock_reset |= broker.joiner.restarts > 0

    def _end_with(self, sockets: Sockets, motion: CnrMotion, fault: DriverError) -> None:
        """The recording is worthless from here on: stop the arm without waiting, and say why."""
        with contextlib.suppress(DriverError):  # a link that is down stops the arm as well
            sockets.post(self.STOP)
        motion.fail(fault)

    def _on_failure(self, error: DriverError) -> None:
        """The broker may still have samples of before, unless it was this end that closed the link."""
        motion = self._motion
        if motion is None:
            return
        try:
            motion.fail(error)
            while self._link is not None and not motion.over:
                self._take_samples(motion)
                motion.poll()
                time.sleep(FEEDBACK_PERIOD)
        finally:
            motion.finish(error)

    def _on_loss(self, error: DriverError) -> None:
        """The broker is gone (in its thread)."""
        motion, sockets = self._motion, self._link
        if motion is not None and sockets is not None and not motion.over:
            self._end_with(sockets, motion, error)


def _refused_start(what: str, state: StatusMessage, stored: bool) -> RefusedError:
    reason = stop_reason(state)
    if reason is None:
        advice = (
            "is the program translated and free of errors, does the trajectory program know how to start a stored one? "
            "(start=hand in the address does without)"
            if stored
            else "was another trajectory left in its queue?"
        )
        return RefusedError(f"the controller refused {what} and does not say why; {advice}")
    kind = SafetyRefused if reason[0] is EndReason.EMERGENCY_STOP else RefusedError
    return kind(f"the controller refused {what}: {reason[1]}")


def create(address: str, **options: Any) -> CnrDriver:
    """The driver for an address of `drivers.transports.cnr.address`; a `PointDriver` where it says `mode=points`.

    Raises:
        ConfigurationError: not an address.
    """
    parsed = parse_address(address)
    return (PointDriver if parsed.points else CnrDriver)(parsed, **options)


class PointDriver(CnrDriver):
    """`drivers.protocol.Driver` and `AcceptsViaPoints` on CNR's open programs, nearly as they are published.

    A *stop* only holds the trajectory there, and the next start would go on with it; *cancel* ends it.
    """

    STOP = MessageType.CANCEL
    _trajectories: tuple[tuple[Point, ...], ...] = ()

    def upload(self, name: str, text: str) -> str:
        """Refused: this link takes points.

        Raises:
            RefusedError: always.
        """
        raise RefusedError("this link takes via-points, no programs; leave mode=points out of the address to send one")

    def load(self, name: str, checksum: str, points: Sequence[ViaPoint]) -> None:
        """Keep the points for `start`; the controller hears nothing of them yet.

        Raises:
            RefusedError: the arm moves, or points that this link cannot take.
        """
        if self._moves(self._connected().feedback()):
            raise RefusedError("no points are taken while the arm moves; stop it first")
        assert self._machine is not None
        self._trajectories = trajectories(points, len(self._machine.identity.joint_names))
        self._stored = name, checksum

    def start(self, name: str, checksum: str) -> None:
        """Queue the first trajectory and start it; the others follow by themselves."""
        sockets = self._connected()
        self._check_idle(sockets)
        if self._stored != (name, checksum) or not self._trajectories:
            raise RefusedError(f"the points that were sent are not those of {name!r}; nothing was started")
        feeder = Feeder(sockets, self._trajectories)
        with self._start_of(self._new_motion(feeder.is_over)) as motion:
            sockets.guarded = True
            feeder.fill(motion)
            self._command_start(sockets, motion, f"the start of {name}")
            feeder.started()
        thread = threading.Thread(target=self._feed, args=(feeder, sockets, motion), name="points", daemon=True)
        thread.start()

    def _read_stored(self) -> tuple[str, str]:
        return self._stored

    def _feed(self, feeder: Feeder, sockets: Sockets, motion: CnrMotion) -> None:
        """The rest of the first trajectory and all others (in a separate thread)."""
        try:
            while feeder.go_on(motion):
                with self._starting:
                    if motion.stopping:
                        return
                    self._command_start(sockets, motion, "the start of the next trajectory")
                feeder.started()
                motion.resume()
        except Exception as error:  # any error: no other thread would send the rest
            if not (motion.over or motion.stopping):
                known = error if isinstance(error, DriverError) else DriverError(f"no points can be sent: {error!r}")
                self._end_with(sockets, motion, known)
