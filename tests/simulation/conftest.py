"""Arms and motions for the simulation's tests."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from agent.robot import RobotDescription
from tests.arms import AXES, Bar, serial_arm


def make_arm(
    links: int, *, prismatic_first: bool = False, coupling: np.ndarray | None = None, gear: float = 100.0
) -> RobotDescription:
    """A serial arm of bars that turn about z, y, y, x, y, x, y; the first may slide along x."""
    bars = []
    for k in range(links):
        mass, length = 20.0 / (k + 1), 0.4
        bar = mass * length**2 / 12
        kind, axis = ("P", "1 0 0") if k == 0 and prismatic_first else ("R", AXES[k])
        centre, inertia = f"{length / 2} 0 0", (0.1 * bar, bar, bar)
        bars.append(Bar(kind, f"{length if k else 0} 0 0", axis, mass, centre, inertia))
    return serial_arm(bars, gears=gear, coupling=coupling)


@pytest.fixture(name="make_arm", scope="session")
def make_arm_fixture() -> Callable[..., RobotDescription]:
    return make_arm


def stop_and_go(
    targets: np.ndarray, duration: float, pause: float = 0.1, period: float = 0.002
) -> tuple[np.ndarray, np.ndarray]:
    """(S, n) set-points and velocities from target to target (K, n), fifth-order, stationary at each target."""
    samples = round(duration / period)
    s = np.arange(1, samples + 1)[:, None] / samples
    shape, slope = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / duration
    still = np.zeros((round(pause / period), targets.shape[1]))
    q, qd = [still + targets[0]], [still]
    for start, end in pairwise(targets):
        q += [start + (end - start) * shape, still + end]
        qd += [(end - start) * slope, still]
    return np.concatenate(q), np.concatenate(qd)


@pytest.fixture(name="stop_and_go", scope="session")
def stop_and_go_fixture() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    return stop_and_go
