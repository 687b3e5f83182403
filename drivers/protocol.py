"""The controller link: what every driver offers, whatever its wire.

Units are SI on the joint side: rad, rad/s, N·m (m, m/s, N on a prismatic joint); seconds of controller time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from drivers.errors import ProtocolError
from drivers.texts import ALARM, MANY, MESSAGE, NAME, printable


@dataclass(frozen=True)
class Identity:
    """Who is at the far end. `period` [s] is the controller's interpolation and sampling period.

    `watch_only` says why the link's samples do for watching a motion, not for identification; empty where they do.
    `unguarded` says why the arm may go on where this end is gone; empty where the controller stops it then.
    Texts are cut, and control characters taken out of them, whatever the controller sent.

    Raises:
        ProtocolError: no joints, or more than any arm has.
    """

    robot: str
    serial: str
    controller: str
    version: str
    joint_names: tuple[str, ...]
    period: float
    watch_only: str = ""
    unguarded: str = ""

    def __post_init__(self) -> None:
        if not 1 <= len(self.joint_names) <= MANY:
            raise ProtocolError(f"the controller names {len(self.joint_names)} joints; 1 to {MANY} are expected")
        for name in ("robot", "serial", "controller", "version"):
            object.__setattr__(self, name, printable(getattr(self, name), NAME))
        for name in ("watch_only", "unguarded"):
            object.__setattr__(self, name, printable(getattr(self, name), MESSAGE))
        object.__setattr__(self, "joint_names", tuple(printable(name, NAME) for name in self.joint_names))


@dataclass(frozen=True)
class Status:
    """The controller's state at one moment.

    `mode` is `auto` or `teach`; `override` a fraction of one; `program` and `checksum` (SHA-256, hex, of the stored
    text) are empty where nothing is stored; `position` (n,) joint side; `emulator` says that no machine moves.
    Where the wire does not tell the override, `override_known` is False and `override` is one; where it does not tell
    mode, drives, cell and emergency stop, `modes_known` is False and they are as motion needs them.
    Texts are cut, and control characters taken out of them, whatever the controller sent.
    """

    drives_on: bool
    mode: str
    emergency_stop: bool
    alarms: tuple[str, ...]
    override: float
    cell_closed: bool
    moving: bool
    program: str
    checksum: str
    position: np.ndarray
    emulator: bool = False
    override_known: bool = True
    modes_known: bool = True

    def __post_init__(self) -> None:
        for name in ("mode", "program", "checksum"):
            object.__setattr__(self, name, printable(getattr(self, name), NAME))
        alarms = tuple(printable(alarm, ALARM) for alarm in self.alarms[:MANY])
        more = len(self.alarms) - MANY
        object.__setattr__(self, "alarms", (*alarms, f"and {more} more") if more > 0 else alarms)


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """K consecutive samples. `sequence` (K,) counts them from 0 at the start of motion, so a gap shows.

    time (K,) controller time; position, velocity, torque and the set-points reference_position,
    reference_velocity are (K, n), and so is `current`, of the motors [A], where torque was computed from it. Velocity
    and set-points are None on a wire that has none. `received` is the receive time, seconds of the Unix clock.
    """

    sequence: np.ndarray
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray | None
    torque: np.ndarray
    reference_position: np.ndarray | None
    reference_velocity: np.ndarray | None
    received: float = 0.0
    current: np.ndarray | None = None

    def __len__(self) -> int:
        """K."""
        return len(self.sequence)

    def part(self, start: int, stop: int | None = None) -> SampleBlock:
        """Samples `start` to `stop` of this block (views, no copies)."""
        arrays = [name for name, values in vars(self).items() if isinstance(values, np.ndarray)]
        parts: dict[str, Any] = {name: getattr(self, name)[start:stop] for name in arrays}
        return replace(self, **parts)


@dataclass(frozen=True)
class Gap:
    """So many samples, from sequence number `first` on, were lost for good."""

    first: int
    count: int


@runtime_checkable
class Driver(Protocol):
    """One controller link. Opened by `connect`; every method but `close` may raise the errors of `drivers.errors`.

    A command that moves the robot is sent once and never again. A program language other than PDL2 is its `dialect`.
    """

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """What is missing from the samples of the last motion, once the driver has tried to get it again."""

    @property
    def watchdog(self) -> float:
        """Silence [s] after which the controller takes this end for gone and stops the arm."""

    def connect(self) -> None:
        """Open the link and agree on the protocol's version."""

    def identify(self) -> Identity:
        """Ask the far end who it is."""

    def status(self) -> Status:
        """Ask for the state. Allowed at any time, also while samples are streaming."""

    def upload(self, name: str, text: str) -> str:
        """Store a program; returns the SHA-256 (hex) of the text as the controller stored it."""

    def start(self, name: str, checksum: str) -> None:
        """Run the stored program once, if its checksum is this one. Never repeated by the driver."""

    def samples(self) -> Iterator[SampleBlock]:
        """Samples of the motion that `start` began, in order, until the arm rests again.

        A second call goes on with the samples that the first has not handed out.

        Returns where the program ended by itself or was stopped by `stop`. Everything that arrived is yielded first.

        Raises:
            MotionStopped: the controller stopped the arm.
            DriverError: the link dropped.
        """

    def stop(self) -> None:
        """Bring the arm to rest on its path. Safe to call at any time, also twice."""

    def close(self) -> None:
        """Close the link; never raises."""


@dataclass(frozen=True, eq=False)
class ViaPoint:
    """Target of a straight tool motion: joint positions (n,) [rad, m].

    `fly_tolerance` [m]: how far the arm may pass by; 0 is a stop. `linear_speed` [m/s] of the tool centre point.
    """

    position: np.ndarray
    fly_tolerance: float
    linear_speed: float


@runtime_checkable
class ListensFirst(Protocol):
    """A driver whose samples can be read while `start` still runs.

    `start` calls `listening` once it hands out samples and before it sends anything; then `samples` may be called by
    another thread. A stop that is asked for meanwhile keeps the motion from beginning, or ends it.
    """

    listening: Callable[[], None]


@runtime_checkable
class NamesEndpoints(Protocol):
    """A driver whose address is more than `host:port`; two runs at one controller are kept apart by its endpoints."""

    def endpoints(self) -> tuple[str, ...]:
        """Where the address leads, by `socket_endpoints`."""


@runtime_checkable
class DescribesRobot(Protocol):
    """A driver whose controller describes its robot."""

    def description(self) -> str:
        """A URDF, as it came. Allowed at any time, as `status` is."""


@runtime_checkable
class BoundsMotion(Protocol):
    """A driver whose arm rests by itself within a known time, whoever is gone: `Identity.unguarded` says so.

    `longest_motion` [s]: of what it sends at once.
    """

    longest_motion: float


@runtime_checkable
class MeasuresThroughput(Protocol):
    """A driver that can measure how many samples its link carries."""

    def throughput(self) -> float:
        """Samples a second that the link carries, measured now while the arm rests."""


@runtime_checkable
class MeasuresCurrents(Protocol):
    """A driver whose wire has motor currents; torque is computed from them.

    `torque_per_ampere` (n, n) [N·m/A], joint side: whoever creates the driver sets it before the first motion.
    """

    torque_per_ampere: np.ndarray


@runtime_checkable
class ReportsEffort(Protocol):
    """A driver whose wire does not say what effort is: `effort` is `torque`, `current` or `none`, as in the recipe."""

    effort: str

    def resting(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and torque (n,) of the arm now, while it rests; torque is computed where effort is current."""


@runtime_checkable
class ReportsTemperatures(Protocol):
    """A driver whose wire has temperatures of the motors."""

    def temperatures(self) -> np.ndarray | None:
        """(n,) [°C], or None where this controller measures none. Allowed at any time, as `status` is."""


@runtime_checkable
class ReportsFrames(Protocol):
    """A driver whose wire has the frames that are in force at the controller."""

    def frames(self) -> Mapping[str, np.ndarray]:
        """(4, 4) [m] of `$BASE`, `$TOOL` and `$UFRAME`, by these names; empty where this controller does not say.

        Allowed at any time, as `status` is.
        """


@runtime_checkable
class ReportsSettings(Protocol):
    """A driver whose wire has what is set at the controller for the tool and its load."""

    def settings(self) -> Mapping[str, str]:
        """Texts by name, such as TCP and payload. Allowed at any time, as `status` is."""


@runtime_checkable
class AcceptsViaPoints(Protocol):
    """A driver that is given via-points instead of a program. The last of them is a stop."""

    def load(self, name: str, checksum: str, points: Sequence[ViaPoint]) -> None:
        """Get ready to move through the points of the program of this name and checksum; `start` begins it."""


@runtime_checkable
class RequiresOperator(Protocol):
    """A driver whose `start` waits for somebody at the controller; `tell` says to them what to do."""

    tell: Callable[[str], None]


@runtime_checkable
class ReportsDiagnostics(Protocol):
    """A driver that knows more of the last motion than its samples say."""

    @property
    def facts(self) -> dict[str, str]:
        """Names and values, for the log; those of durations and counts end in their unit."""
