"""Machines, the worlds they live in, and what is recorded of them: in this process, without sockets or a clock."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agent.motion import Trajectory
from agent.recording import Log
from agent.robot import Dynamics, RobotDescription
from fake_controller.plant import Plant

#: Worlds by name, and what differs from the emulator's own machine of rigid bodies.
WORLDS = {
    "as it is": "rigid bodies, friction with stiction and a bent viscous part, noise and quantisation",
    "dress pack": "hoses on joints 1, 4 and 6: 2.5 to 7.5 % of nominal torque a radian, hysteresis of 1 to 3 %",
    "friction by posture and load": "friction grows by 0.04 to 0.12 N·m each N·m transmitted; rough bearings of 4 to "
    "10 % of nominal torque",
    "elastic gears": "joints 1 to 3 swing at 8 to 14 Hz",
    "thermal state": "calibrated 5 to 25 K below the temperature of work, warming up; friction falls by 1.2 % a kelvin",
    "payload 1 % wrong": "at work 0.16 kg more at the flange than when it was calibrated (1 % of the rated payload)",
    "all of them": "all of these at once",
}


def effects(world: str, robot: RobotDescription, machine: int) -> tuple[list[dict], list[dict]]:
    """What is built into a machine while it is calibrated, and while it works; drawn from the machine's number."""
    rng = np.random.default_rng([machine, 20])
    nominal, names = robot.nominal_torque, robot.joint_names

    def on(k: int, effect: str, **parameters: float) -> dict:
        numbers = {name: float(value) for name, value in parameters.items()}
        return {"effect": effect, "joints": [names[k]], "parameters": numbers}

    hoses = []
    for k in (0, 3, 5):
        stiffness, cubic = 0.05 * nominal[k] * rng.uniform(0.5, 1.5), 0.003 * nominal[k]
        centre, hysteresis = rng.uniform(-1.0, 1.0), 0.02 * nominal[k] * rng.uniform(0.5, 1.5)
        hoses.append(on(k, "dress_pack", stiffness=stiffness, cubic=cubic, centre=centre, hysteresis=hysteresis))
    friction = []
    for k, torque in enumerate(nominal):
        friction.append(on(k, "load_dependent_friction", coefficient=rng.uniform(0.04, 0.12)))
        amplitude, patch = torque * rng.uniform(0.04, 0.10), rng.uniform(0.1, 0.4)
        friction.append(on(k, "rough_bearing", amplitude=amplitude, patch=patch, seed=int(rng.integers(1_000_000))))
    lower, upper = robot.position_limits
    inertia = Dynamics(robot).mass_matrix(np.clip(0.5 * (lower + upper), -np.pi, np.pi)).diagonal()
    swing = 2 * np.pi * rng.uniform(8.0, 14.0, 3)
    elastic = [on(k, "joint_elasticity", stiffness=inertia[k] * swing[k] ** 2) for k in range(3)]
    cold, slow = -rng.uniform(5.0, 25.0), rng.uniform(300.0, 900.0)

    def thermal(start: float) -> list[dict]:
        warm = {"resistance": 0.1, "time_constant": slow, "coulomb_rate": 0.012, "viscous_rate": 0.02}
        return [on(k, "thermal_friction", start=start, **warm) for k in range(robot.dof)]

    payload = [{"effect": "payload", "parameters": {"mass": 0.16, "centre": [0.0, 0.0, 0.1]}}]
    built = [(hoses, hoses), (friction, friction), (elastic, elastic), (thermal(cold), thermal(0.0)), ([], payload)]
    drawn = dict(zip(list(WORLDS)[1:-1], built, strict=True))
    chosen = built if world == "all of them" else [drawn[world]] if world in drawn else []
    return [e for calibrated, _ in chosen for e in calibrated], [e for _, at_work in chosen for e in at_work]


def record(arm: Plant, cycles: Sequence[Trajectory], seconds: float = np.inf) -> Log:
    """What the controller measures along loops run one after the other, the first `seconds` of it."""
    period = float(cycles[0].t[1])
    reference = np.concatenate([cycle.q for cycle in cycles])
    velocity = np.concatenate([cycle.qd for cycle in cycles])
    samples = int(min(len(reference), seconds / period))
    arm.rest(reference[0])
    chunks = list(arm.run(reference[:samples], velocity[:samples]))
    starts = np.cumsum([0, *(len(cycle.q) for cycle in cycles)])[:-1] * period
    return Log(
        path=Path("motion.mcap"),
        joint_names=arm.robot.joint_names,
        t=np.arange(samples) * period,
        position=np.concatenate([chunk.position for chunk in chunks]),
        velocity=np.concatenate([chunk.velocity for chunk in chunks]),
        effort=np.concatenate([chunk.torque for chunk in chunks]),
        reference_position=reference[:samples],
        planned_position=None,
        sample_rate=1 / period,
        stamp=0.0,
        segments=((0, samples),),
        cycle_starts=tuple(float(start) for start in starts if start < samples * period) if len(cycles) > 1 else (),
    )


def repeated(arm: Plant, loop: Trajectory, seconds: float) -> Log:
    """A loop run again and again for a number of seconds."""
    return record(arm, [loop] * int(np.ceil(seconds / loop.duration)), seconds)
