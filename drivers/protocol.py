"""The controller link: what every driver offers, whatever its wire.

Units are SI on the joint side: rad, rad/s, N·m (m, m/s, N on a prismatic joint); seconds of controller time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np


@dataclass(frozen=True)
class Identity:
    """Who is at the far end. `period` [s] is the controller's interpolation and sampling period."""

    robot: str
    serial: str
    controller: str
    version: str
    joint_names: tuple[str, ...]
    period: float


@dataclass(frozen=True)
class Status:
    """The controller's state at one moment.

    `mode` is `auto` or `teach`; `override` a fraction of one; `program` and `checksum` (SHA-256, hex, of the stored
    text) are empty where nothing is stored; `position` (n,) joint side; `emulator` says that no machine moves.
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


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """K consecutive samples. `sequence` (K,) counts them from 0 at the start of motion, so a gap shows.

    time (K,) controller time; position, velocity, torque and the set-points reference_position,
    reference_velocity are (K, n). `received` is the receive time, seconds of the Unix clock.
    """

    sequence: np.ndarray
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    reference_position: np.ndarray
    reference_velocity: np.ndarray
    received: float = field(default=0.0)

    def __len__(self) -> int:
        """K."""
        return len(self.sequence)

    def part(self, start: int, stop: int | None = None) -> SampleBlock:
        """Samples `start` to `stop` of this block (views, no copies)."""
        chosen = slice(start, stop)
        return SampleBlock(
            self.sequence[chosen],
            self.time[chosen],
            self.position[chosen],
            self.velocity[chosen],
            self.torque[chosen],
            self.reference_position[chosen],
            self.reference_velocity[chosen],
            self.received,
        )


@dataclass(frozen=True)
class Gap:
    """So many samples, from sequence number `first` on, were lost for good."""

    first: int
    count: int


@runtime_checkable
class Driver(Protocol):
    """One controller link. Opened by `connect`; every method but `close` may raise the errors of `drivers.errors`.

    A command that moves the robot is sent once and never again, whatever happens to its answer.
    """

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """What is missing from the samples of the last motion, once the driver has tried to get it again."""

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

        Returns where the program ended by itself or was stopped by `stop`. Everything that arrived is yielded first.

        Raises:
            MotionStopped: the controller stopped the arm.
            DriverError: the link dropped.
        """

    def stop(self) -> None:
        """Bring the arm to rest on its path. Safe to call at any time, also twice."""

    def close(self) -> None:
        """Close the link; never raises."""
