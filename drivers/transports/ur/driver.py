"""The driver for Universal Robots with PolyScope 3 (CB3) or 5 (e-Series); docs/how-to-ur.md says how to set them up.

Nothing is stored on the controller: `start` sends the program, once. The program waits until the driver has seen that
it is the one that was meant, and then moves. A script that arrives a second time waits in vain.
"""

from __future__ import annotations

import contextlib
import json
import threading
from typing import Any

import numpy as np

from drivers.errors import ConfigurationError, DriverError, MotionStopped, RefusedError
from drivers.protocol import Identity, Status
from drivers.texts import public_address
from drivers.transports.base.kept import KeptProgram
from drivers.transports.base.link import LinkDriver, check_currents
from drivers.transports.base.ports import parse_address, socket_endpoints
from drivers.transports.base.poses import rotation
from drivers.transports.ur import motion as states
from drivers.transports.ur.dashboard import Dashboard, UrModel
from drivers.transports.ur.link import UrLink
from drivers.transports.ur.motion import UrMotion, safety_text
from drivers.transports.ur.program import UrProgram, number_text, payload_text
from drivers.wire import ur_rtde as rtde
from drivers.wire.ur_primary import ProgramChange, ProgramFault

#: The arm's joints, as Universal Robots and its ROS descriptions call them.
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
_PORTS = {"dashboard": 29999, "primary": 30001, "rtde": 30004}
#: A pace from this part of the whole one on is the whole one.
_WHOLE = 0.95
#: An arm that was told to stop rests within this [s], or the heartbeat is withheld: its program then stops it within
#: `WATCHDOG`, so that a controller which confirms a stop and goes on is stopped after 1 s.
_OBEYS = 0.4
#: A simulator keeps no rhythm on the wall: its silence [s] is one from here on.
_SIMULATED = 5.0


class UrDriver(LinkDriver[UrLink, UrMotion]):
    """`drivers.protocol.Driver` over dashboard, primary interface and RTDE.

    Args:
        address: `host`, or `host,dashboard=29999,primary=30001,rtde=30004` where ports are not the usual ones.
        options: of `LinkDriver`.

    Raises:
        ConfigurationError: not such an address.
    """

    dialect = "urscript"

    def __init__(self, address: str, **options: Any) -> None:
        self._places = places(address)
        super().__init__(address, **options)
        self.torque_per_ampere = np.empty((0, 0))
        self._dashboard: Dashboard | None = None
        self._model: UrModel | None = None
        self._stored = KeptProgram[UrProgram]()
        self._restoring = ""  # a script that sets TCP and payload as they were, to be sent after the motion
        self._permitting = threading.Lock()  # its holder may allow the program to move, or say that it may not

    @property
    def facts(self) -> dict[str, str]:
        """`ReportsDiagnostics`: when cycles began, by the program's register."""
        motion = self._motion
        return {} if motion is None or not motion.markers else {"cycle_markers_s": json.dumps(motion.markers)}

    def endpoints(self) -> tuple[str, ...]:
        """`NamesEndpoints`: the port that moves the arm."""
        return socket_endpoints(*parse_address(self._places["primary"]))

    def _open(self) -> None:
        """Ask the dashboard who is there, then open RTDE and the primary interface."""
        self._stored = KeptProgram()
        self._dashboard = Dashboard(self._places["dashboard"], self._timeout)
        self._model = self._dashboard.model()
        self._link = UrLink(
            self._places["primary"],
            self._places["rtde"],
            (*rtde.FIELDS, rtde.INERTIA) if self._model.tells_inertia else rtde.FIELDS,
            self._model.period,
            self._timeout,
            self._on_samples,
            self._on_message,
            self._on_failure,
        )
        if self._link.simulated():
            self._link.watchdog = _SIMULATED  # it moves no arm

    def identify(self) -> Identity:
        """As the dashboard has it."""
        self._connected()
        assert self._model is not None
        version = ".".join(str(part) for part in self._model.version)
        return Identity(self._model.robot, self._model.serial, "PolyScope", version, JOINTS, self._model.period)

    def status(self) -> Status:
        """What the controller says after this call."""
        link, motion = self._connected(), self._motion
        streaming = motion is not None and motion.begun and not motion.over
        asked = link.count
        remote = self._remote()
        sample = link.fresh(asked)
        if not (streaming or np.isfinite(sample["actual_q"]).all()):
            raise DriverError(f"{self.address}: the controller sends joint positions that are no numbers; look at it")
        safety = int(sample["safety_mode"])
        stops = (*states.EMERGENCY_STOPS, states.SAFEGUARD, states.NORMAL)
        return Status(
            drives_on=int(sample["robot_mode"]) == states.RUNNING,
            mode="auto" if remote else "teach",
            emergency_stop=safety in states.EMERGENCY_STOPS,
            alarms=() if safety in stops else (safety_text(safety),),
            override=float(sample["target_speed_fraction"]),
            cell_closed=safety != states.SAFEGUARD,
            moving=streaming or _plays(sample),
            program=self._stored.name,
            checksum=self._stored.checksum,
            position=sample["actual_q"].astype(float),
            emulator=link.simulated(),
        )

    def throughput(self) -> float:
        """`MeasuresThroughput`: by the samples that come now."""
        assert self._model is not None
        pace = self._connected().pace() * self._model.period
        return (pace if pace < _WHOLE else 1.0) / self._model.period

    def temperatures(self) -> np.ndarray:
        """`ReportsTemperatures`: of the joints (6,) [°C]."""
        return self._connected().fresh(0)["joint_temperatures"].astype(float)

    def frames(self) -> dict[str, np.ndarray]:
        """`ReportsFrames`: the TCP; poses of scripts are in the robot's base."""
        tool = self._connected().fresh()["tcp_offset"]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation(tool[3:]), tool[:3]
        return {"TCP": pose}

    def settings(self) -> dict[str, str]:
        """`ReportsSettings`: TCP and payload."""
        sample = self._connected().fresh(0)
        mass, centre = float(sample["payload"]), sample["payload_cog"].astype(float)
        return {"TCP": f"{number_text(sample['tcp_offset'])} [m, rad]", "payload": payload_text(mass, centre)}

    def upload(self, name: str, text: str) -> str:
        """Keep a program for `start`; returns the SHA-256 (hex) of its text.

        Raises:
            RefusedError: no program, one that could not be stopped, or the arm moves.
        """
        self._connected()
        if self._running is not None:
            raise RefusedError("no program is taken while the arm moves; stop it first")
        self._stored = KeptProgram()
        return self._stored.keep(name, UrProgram.of(text))

    def start(self, name: str, checksum: str) -> None:
        """Send the program, see that it is the one that runs, and let it move. Each is done once."""
        link = self._connected()
        self._check_over()
        program = self._stored.find(name, checksum)
        self._check_ready(link, program)
        assert self._model is not None
        self._restoring = program.restoring(link.latest)
        motion = UrMotion(program.name, self._model.period, self.torque_per_ampere, self._buffer_limit)
        with self._start_of(motion):
            link.beating = True
            link.allow(0)
            motion.begun = link.guarded = True
            link.send_program(program.text)
            self._see_program(link, motion, program)
            with self._permitting:
                if motion.stopping or motion.over:
                    raise motion.foreign or DriverError(
                        f"{self.address}: the motion was stopped before the program was allowed to move"
                    )
                motion.permitted = True
                link.allow(program.number)
            self._see_permit_taken(link, motion, program)
            link.allow(0)  # a program that arrives once more is not allowed to move

    def _not_started(self) -> None:
        if self._link is not None:
            self._link.beating = self._link.guarded = False

    def _bring_to_rest(self, link: UrLink, motion: UrMotion | None) -> None:
        """End the program, and wait until the arm rests; where it goes on, the heartbeat is withheld."""
        if motion is not None:
            with self._permitting:
                motion.stopping = True
        elif link.failure is None and not _plays(link.fresh()):
            return
        self._end_program(link)
        if self._rests(link, motion, _OBEYS):
            return
        if motion is not None:
            motion.withheld = True
        link.beating = False
        self._end_by_primary(link)  # the dashboard may confirm what it does not do, and another script has no watchdog
        if not self._rests(link, motion, self._start_timeout):
            raise self._still_moves()

    def close(self) -> None:
        """Close the link; where the arm may still move, its program is ended first. Never raises."""
        link, self._link = self._link, None
        if link is not None:
            if self._motion is not None and not self._motion.over:
                self._motion.finish(DriverError(f"the link to {self.address} was closed while the arm moved"))
                self._end_program(link)
            link.close()
        dashboard, self._dashboard = self._dashboard, None
        if dashboard is not None:
            dashboard.close()

    def _remote(self) -> bool:
        """Whether the robot is in remote control."""
        model, dashboard = self._model, self._dashboard
        if model is None or dashboard is None:
            raise DriverError(f"the link to {self.address} is not open; connect first")
        return not model.remote or dashboard.remote()

    def _end_program(self, link: UrLink) -> str:
        """End what runs, by the dashboard or, where that does not, by the primary interface; the dashboard's answer."""
        answer = ""
        with contextlib.suppress(DriverError):
            if self._dashboard is not None:
                answer = self._dashboard.ask("stop", _OBEYS)
        if answer != "Stopped":
            self._end_by_primary(link)
        return answer

    def _end_by_primary(self, link: UrLink) -> None:
        with contextlib.suppress(DriverError):
            link.send_program("stop program\n")

    def _rests(self, link: UrLink, motion: UrMotion | None, timeout: float) -> bool:
        if motion is not None and not motion.over:
            return motion.wait(timeout)
        return link.wait(lambda: link.failure is not None or not _plays(link.fresh()), timeout)

    def _check_ready(self, link: UrLink, program: UrProgram) -> None:
        """What has to be so before anything is sent.

        Raises:
            RefusedError: it is not; both values are named.
            ConfigurationError: nobody has said what torque an ampere is.
        """
        check_currents(self.torque_per_ampere, len(JOINTS))
        sample = link.fresh()
        if _plays(sample):
            raise RefusedError(f"{self.address}: another program runs on the controller; stop it there first")
        if not self._remote():
            raise RefusedError(
                f"{self.address}: the robot is in local control, and remote control is needed: choose it at the "
                "pendant, then connect again"
            )
        differs = self._differs(program, sample)
        if differs is not None:
            raise RefusedError(
                f"{self.address}: {differs}. Set it in the installation at the pendant, or change the recipe's tool"
            )

    def _differs(self, program: UrProgram, sample: np.void) -> str | None:
        """What is set at the controller where it is not what the program sets."""
        tool, centre = (sample[name].astype(float) for name in ("tcp_offset", "payload_cog"))
        return program.differs(tool, float(sample["payload"]), centre)

    def _see_program(self, link: UrLink, motion: UrMotion, program: UrProgram) -> None:
        """Wait until the program that was sent is seen to run; it moves nothing yet.

        Raises:
            RefusedError: the controller cannot run it.
            DriverError: it says nothing of it.
        """

        def runs() -> bool:
            waits = int(link.latest[rtde.RUNNING]) == program.number
            return motion.loaded and waits and int(link.latest["runtime_state"]) == states.PLAYING

        def over() -> bool:
            return motion.fault is not None or motion.stopping or motion.over

        started = link.wait(lambda: runs() or over(), self._timeout)
        link.check()
        motion.check()
        if motion.fault is not None:
            self._end_program(link)
            raise RefusedError(
                f"{self.address}: the controller refused program {program.name}: {motion.fault} ({motion.seen})"
            )
        if not started:
            raise DriverError(
                f"{self.address}: the controller did not start program {program.name} within {self._timeout:g} s "
                f"({motion.seen}). Is the primary interface switched on there, and the robot in remote control?"
            )

    def _see_permit_taken(self, link: UrLink, motion: UrMotion, program: UrProgram) -> None:
        """Wait until the program that was sent goes on.

        Raises:
            DriverError: it does not, or the motion is to end.
        """

        def permit_taken() -> bool:
            return int(link.latest[rtde.RUNNING]) != program.number

        if not link.wait(lambda: permit_taken() or motion.stopping or motion.over, self._timeout) or not permit_taken():
            link.check()
            motion.check()
            raise motion.foreign or DriverError(
                f"{self.address}: the program was let go and does not answer; it is being stopped ({motion.seen})"
            )

    # From here on in the thread of the link.

    def _on_failure(self, error: DriverError) -> None:
        motion, link = self._motion, self._link
        if link is not None and motion is not None and motion.begun and not motion.over:
            with contextlib.suppress(DriverError):
                if self._end_program(link) and not self._remote():
                    error = MotionStopped(
                        f"the robot at {self.address} was switched to local control in motion: {error}"
                    )
        super()._on_failure(error)

    def _on_samples(self, samples: np.ndarray) -> None:
        motion, link = self._motion, self._link
        if motion is None or link is None or not motion.begun or motion.over:
            return
        motion.samples(samples)
        if (error := motion.too_full() or motion.slow) is not None:
            motion.finish(error)
        elif motion.foreign is not None and not motion.stopping:
            motion.stopping = True
            self._end_by_primary(link)
        # A program that was interrupted feels no heartbeat any more, so that nobody can resume the rest of it.
        link.beating = not (motion.over or motion.unsafe or motion.withheld or motion.foreign is not None)
        link.guarded = not motion.over
        if motion.over and self._restoring:
            script, self._restoring = self._restoring, ""
            program = self._stored.program
            if program is not None and self._differs(program, samples[-1]) is None:
                with contextlib.suppress(DriverError):
                    link.send_program(script)

    def _on_message(self, message: ProgramChange | ProgramFault) -> None:
        if self._motion is not None:
            self._motion.message(message)


def _plays(sample: np.void) -> bool:
    """Whether a program runs, or the arm moves without one."""
    return int(sample["runtime_state"]) != states.STOPPED or bool(np.abs(sample["target_qd"]).max() >= states.STILL)


def places(address: str) -> dict[str, str]:
    """host:port of each service."""
    host, *options = (part.strip() for part in str(address).split(","))
    if ":" in host:
        raise ConfigurationError(
            f"address {public_address(address)!r}: name the host alone; ports follow as host,rtde=30004"
        )
    ports: dict[str, object] = dict(_PORTS)
    for option in options:
        service, equals, port = option.partition("=")
        if service not in _PORTS or not equals:
            raise ConfigurationError(
                f"address {public_address(address)!r}: after the host, {', '.join(_PORTS)} may follow"
            )
        ports[service] = port
    places = {service: f"{host}:{port}" for service, port in ports.items()}
    for endpoint in places.values():
        parse_address(endpoint)
    return places
