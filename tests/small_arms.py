"""Small arms of any joints, their logs from the simulated plant, and a model of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agent.estimation import estimate
from agent.model import IdentifiedModel
from agent.recording.log import Log
from agent.robot import RobotDescription
from fake_controller.plant import Plant
from tests.arms import AXES, Bar, serial_arm

PERIOD = 0.002
CYCLE = 5.0


def make_arm(kinds: str) -> RobotDescription:
    """R and P for every joint, base first; bars that grow lighter towards the tip."""
    bars = []
    for k, kind in enumerate(kinds):
        mass = 30.0 / (k + 1)
        bar = mass * 0.3**2 / 12
        axis = "0 0 1" if kind == "P" else AXES[k]
        bars.append(Bar(kind, f"{0.3 * (k > 0)} 0 0", axis, mass, "0.15 0 0.03", (0.1 * bar, bar, bar)))
    return serial_arm(bars)


def set_points(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(S, n) positions and velocities of two cycles that begin and end at standstill."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(CYCLE / PERIOD)) * PERIOD
    a, b = rng.normal(size=(2, 4, n)) * 0.35 / np.arange(1, 5)[:, None]
    phase = 2 * np.pi * np.arange(1, 5) * time[:, None] / CYCLE
    fade = np.sin(0.5 * np.pi * np.clip(np.minimum(time, time[-1] - time) / 0.8, 0, 1))[:, None] ** 2
    q = np.tile(fade * (np.sin(phase) @ a + np.cos(phase) @ b), (2, 1))
    return q, np.gradient(q, PERIOD, axis=0)


def true_torque(plant: Plant, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """(S, n) what the plant's controller would measure in steady sliding, without noise.

    By the machine's bodies, rotors, friction curves and sensors; of effects, by those that are parameters of these.
    """
    machine = plant.machine
    links = machine.dynamics().inverse_dynamics(q - machine.encoder_offset, qd, qdd)
    axles = links @ np.linalg.inv(machine.coupling) + machine.reflected_rotors * (qdd @ machine.coupling.T)
    speed = qd @ machine.coupling.T
    friction = [curve.steady(speed[:, k]) for k, curve in enumerate(machine.friction)]
    measured = (axles + np.stack(friction, axis=1)) * machine.torque_scale + machine.torque_offset
    return measured @ plant.robot.coupling


def record(plant: Plant, name: str, seed: int, share: Sequence[float] | float = 1.0) -> Log:
    """A log of one motion of a plant, as a reader would give it; each joint makes a `share` of its motion."""
    q, qd = (part * share for part in set_points(plant.robot.dof, seed))
    plant.rest(q[0])
    chunks = list(plant.run(q, qd))
    position, velocity, torque = (
        np.concatenate([getattr(c, part) for c in chunks]) for part in ("position", "velocity", "torque")
    )
    return Log(
        path=Path(f"{name}.mcap"),
        joint_names=plant.robot.joint_names,
        t=np.arange(len(q)) * PERIOD,
        position=position,
        velocity=velocity,
        effort=torque,
        reference_position=q,
        planned_position=None,
        sample_rate=1 / PERIOD,
        stamp=0.0,
        segments=((0, len(q)),),
        cycle_starts=(0.0, CYCLE),
    )


def learn(robot: RobotDescription) -> IdentifiedModel:
    plant = Plant(robot, seed=3)
    return estimate(robot, [record(plant, "first", 11), record(plant, "second", 12)])
