"""Arms and motions made for the tests."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from agent.recording.log import Log
from agent.robot import RobotDescription, rigid_bodies
from tests.arms import AXES, Bar, serial_arm


def _arm(
    dof: int, prismatic: Sequence[int] = (), coupling: np.ndarray | None = None, seed: int = 0
) -> RobotDescription:
    """A serial arm with axes in turn about z, y, x, links of a few kilograms, gears of about a hundred."""
    rng = np.random.default_rng(seed)
    bars = []
    for k in range(dof):
        mass = 12.0 / (k + 1)
        size = 0.02 * mass
        centre = " ".join(f"{value:.3f}" for value in rng.uniform(-0.1, 0.1, 3))
        kind, axis = "P" if k in prismatic else "R", "0 0 1" if k == 6 else AXES[k]
        bars.append(Bar(kind, f"0.05 0.02 {0.3 if k else 0.4}", axis, mass, centre, (size, size, 0.6 * size)))
    gears = [(-1.0) ** k * (100.0 - 8.0 * k) for k in range(dof)]
    limits = {"speed": 3.0, "acceleration": 20.0, "limit": 3.0}
    return serial_arm(bars, name="arm", gears=gears, coupling=coupling, nominal=1.0, rotor=1e-4, **limits)


def _multisine(
    dof: int, t: np.ndarray, seed: int = 0, speed: float = 1.5, rest: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, q̇, q̈ (S, n): eight sines a joint below 2 Hz, about `speed` fast; with `rest`, from rest to rest.

    A formula, so there is no error in it.
    """
    from scipy.special import erf

    rng = np.random.default_rng(seed)
    omega = 2 * np.pi * rng.uniform(0.1, 2.0, (8, dof))
    size = rng.normal(size=(8, dof)) / omega
    size *= speed / np.abs(size * omega).sum(axis=0)
    phase = omega * t[:, None, None] + rng.uniform(0, 2 * np.pi, (8, dof))
    centre = rng.uniform(-0.5, 0.5, dof)
    s = np.sum(size * np.sin(phase), axis=1)
    s1 = np.sum(size * omega * np.cos(phase), axis=1)
    s2 = -np.sum(size * omega**2 * np.sin(phase), axis=1)
    if not rest:
        return centre + s, s1, s2
    w, w1, w2 = np.ones((3, len(t), 1)) * [[[1]], [[0]], [[0]]]
    for middle, sign in ((t[0] + 0.9, 1.0), (t[-1] - 0.9, -1.0)):
        x = sign * (t[:, None] - middle) / 0.15
        bell = sign * np.exp(-(x**2)) / np.sqrt(np.pi) / 0.15
        ramp, ramp1, ramp2 = 0.5 * (1 + erf(x)), bell, -2 * sign * x / 0.15 * bell
        w, w1, w2 = w * ramp, w1 * ramp + w * ramp1, w2 * ramp + 2 * w1 * ramp1 + w * ramp2
    return centre + w * s, w1 * s + w * s1, w2 * s + 2 * w1 * s1 + w * s2


def _links(robot: RobotDescription, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """(S, n) [N·m] of the described links, with rotors of 1e-4 kg·m²."""
    rigid = rigid_bodies(robot)
    bodies = np.append(rigid.dynamics.standard_parameters(), np.full(robot.dof, 1e-4))
    return rigid.torque(q, qd, qdd, rigid.projection @ bodies)


def _log(
    robot: RobotDescription, t: np.ndarray, q: np.ndarray, torque: np.ndarray | None, name: str = "a.mcap", **more
) -> Log:
    rate = more.pop("rate", 1 / float(np.median(np.diff(t))))
    segments = more.pop("segments", ((0, len(t)),))
    more = {"velocity": None, "reference_position": None, "planned_position": None, **more}
    return Log(
        path=Path(name),
        joint_names=robot.joint_names,
        t=t,
        position=q,
        effort=torque,
        sample_rate=rate,
        stamp=0.0,
        segments=segments,
        **more,
    )


@pytest.fixture(scope="session")
def arm() -> Callable[..., RobotDescription]:
    """`arm(dof, prismatic=(), coupling=None, seed=0)`."""
    return _arm


@pytest.fixture(scope="session")
def multisine() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """`multisine(dof, t, seed=0, speed=1.5, rest=False)` → q, q̇, q̈ exactly."""
    return _multisine


@pytest.fixture(scope="session")
def make_log() -> Callable[..., Log]:
    """`make_log(robot, t, q, torque, name="a.mcap", **fields)`."""
    return _log
