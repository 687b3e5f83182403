"""The arm in MuJoCo under a joint servo.

Friction is a bristle torque z of its own per joint (LuGre, Canudas de Wit et al., IEEE TAC 1995), advanced exactly over
a step of constant speed, z ← z + (1 − exp(−σ|v|Δt/g)) (g sign v − z), or on every second machine the engine's own
dry friction (a constraint) and damping. There an effect adds what it changes of the bristle law, so that nothing else
about a reversal is another one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from second_world.arms import Arm, mujoco_text
from second_world.faults import RecorderFaults
from second_world.motions import RATE, Motions

_STEP = 1.0 / RATE


class MujocoPlant:
    """One machine; `run` moves it. What has warmed up stays warm from one motion to the next."""

    def __init__(self, arm: Arm, faults: RecorderFaults, machine: int):
        self._arm, self._faults = arm, faults
        shaft = faults.bristles.copy()
        if arm.wrist:
            shaft[arm.wrist[1]] &= arm.coulomb[arm.wrist[1]] > 1e-3
        self._known = shaft | faults.changed
        self._engine = faults.changed & ~shaft
        self._model = mujoco.MjModel.from_xml_string(mujoco_text(arm, shaft))
        self._data = mujoco.MjData(self._model)
        index = [self._model.joint(name).id for name in arm.joint_names]
        self._motor = np.array(index)  # one degree of freedom a joint: ids, positions and speeds agree
        self._link = [self._model.body(f"link_{k}").id for k in range(arm.n)]
        rng = np.random.default_rng([machine, 6])
        n = arm.n
        mujoco.mj_forward(self._model, self._data)
        full = np.zeros((self._model.nv, self._model.nv))
        mujoco.mj_fullM(self._model, self._data, full)
        inertia = np.diag(full)[self._motor]
        frequency = 2 * np.pi * rng.uniform(4.0, 7.0, n)
        self._stiff, self._damp = inertia * frequency**2, inertia * 1.6 * frequency
        self._weight = rng.uniform(0.85, 1.1, n)  # of gravity as the servo knows it
        self._ahead = inertia * rng.uniform(0.6, 1.0, n)
        self._way = np.zeros(n)

    def run(self, motions: Motions) -> dict[str, dict[str, np.ndarray]]:
        """Position, velocity and torque (S, n) of each motion as the servo has them, at `RATE`, without noise."""
        return {name: self._move(set_points) for name, (set_points, _) in motions.items()}

    def _move(self, q_ref: np.ndarray) -> dict[str, np.ndarray]:
        faults, data, motor = self._faults, self._data, self._motor
        mujoco.mj_resetData(self._model, data)
        data.qpos[motor] = q_ref[0] - faults.zero
        mujoco.mj_forward(self._model, data)
        qd_ref = np.gradient(q_ref, _STEP, axis=0)
        qdd_ref = np.gradient(qd_ref, _STEP, axis=0)
        samples, n = q_ref.shape
        position, velocity, torque = (np.empty((samples, n)) for _ in range(3))
        z, z_long, z_plain, hose = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        carried, friction = np.zeros(n), np.zeros(n)
        for k in range(samples):
            q, v = data.qpos[motor], data.qvel[motor]
            seen = q + faults.zero
            drive = (
                self._weight * data.qfrc_bias[motor]
                + self._ahead * qdd_ref[k]
                + self._stiff * (q_ref[k] - seen)
                + self._damp * (qd_ref[k] - v)
            )
            position[k], velocity[k], torque[k] = seen, v, drive
            carried += 0.1 * (np.abs(drive - friction) - carried)  # by the gear, over 10 ms
            friction, z, z_long = self._friction(v, carried, z, z_long)
            z_plain = self._bristle(v, self._arm.coulomb, z_plain)
            by_engine = np.where(self._engine, z_plain + self._arm.viscous * v, 0.0)
            data.qfrc_applied[motor] = drive - friction + by_engine - self._other(q, v, k * _STEP, hose)
            for push in faults.pushes:
                x = (k / samples - push.start) / push.duration
                rise = min(x, 1 - x) * push.duration * samples * _STEP / 0.05  # over 50 ms
                data.xfrc_applied[self._link[push.link], :3] = push.force * min(max(rise, 0.0), 1.0)
                if 0 <= x <= 1:
                    break
            mujoco.mj_step(self._model, data)
        return {"position": position, "velocity": velocity, "torque": torque}

    def _friction(
        self, v: np.ndarray, load: np.ndarray, z: np.ndarray, z_long: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Torque (n,) that the joints' own friction takes, and both bristles one step on."""
        arm, faults = self._arm, self._faults
        speed, sign = np.abs(v), np.sign(v)
        self._way += speed * _STEP
        cold = np.exp(-self._way / faults.warm_after)
        level = arm.coulomb * (1 + faults.cold_coulomb * cold) * (1 + faults.by_direction * sign)
        level = level + faults.rise * np.exp(-speed / faults.rise_speed) + faults.load * load
        short = level * (1 - faults.long_share)
        z = self._bristle(v, short, z)
        z_long = z_long - np.expm1(-speed * _STEP / faults.long_travel) * (level * faults.long_share * sign - z_long)
        viscous = arm.viscous * v * (1 + faults.cold_viscous * cold) * (1 + faults.viscous_by_direction * sign)
        viscous = viscous / (1 + (speed / faults.thin_speed) ** 2) ** faults.thin_power
        return np.where(self._known, z + z_long + viscous, 0.0), z, z_long

    def _bristle(self, v: np.ndarray, level: np.ndarray, z: np.ndarray) -> np.ndarray:
        """(n,) torque of bristles that slide at a level (n,), one step on."""
        moved = self._arm.coulomb / self._arm.travel * np.abs(v) * _STEP
        return z - np.expm1(-moved / level) * (level * np.sign(v) - z)

    def _other(self, q: np.ndarray, v: np.ndarray, t: float, hose: np.ndarray) -> np.ndarray:
        """Torque (n,) that springs, hoses, ripple and a shaking floor take."""
        taken = np.zeros(len(q))
        for joint, peak, lever, angle in self._faults.springs:
            taken[joint] += peak * _between_pivots(q[joint] - angle, lever)
        for joint, stiffness, centre, slack, rubbing in self._faults.hoses:
            x = q[joint] - centre
            hose[joint] -= np.expm1(-abs(v[joint]) * _STEP / 0.05) * (rubbing * np.sign(v[joint]) - hose[joint])
            taken[joint] += stiffness * np.sign(x) * max(abs(x) - slack, 0.0) ** 2 + hose[joint]
        for joint, amplitude, order, phase in self._faults.ripple:
            turned = order * self._arm.build.ratio * q[joint] + phase
            taken[joint] += amplitude * (np.sin(turned) + 0.3 * np.sin(2 * turned))
        for joint, amplitude, frequency in self._faults.shaking:
            taken[joint] += amplitude * np.sin(2 * np.pi * frequency * t)
        return taken


def _between_pivots(q: float, lever: float) -> float:
    """Torque over its highest possible value of a spring between a pivot at distance 1 and one at `lever`."""
    length = np.sqrt(1 + lever**2 - 2 * lever * np.cos(q))
    free = 1 - lever - 0.25
    return float((length - free) / (lever + 0.25) * np.sin(q) / length)


def measured(plant_out: Mapping[str, np.ndarray], faults: RecorderFaults) -> np.ndarray:
    """(S, n) the torque channel of one motion: servo's torque, as scaled, shifted, late or broken as it is."""
    torque = plant_out["torque"]
    late = faults.delay * RATE
    if late:
        at = np.arange(len(torque)) - late
        torque = np.stack([np.interp(at, np.arange(len(torque)), column) for column in torque.T], axis=1)
    reported = torque * faults.scale + faults.offset
    for source, joint, share in faults.leaks:
        reported[:, joint] += share * torque[:, source]
    reported = np.clip(reported, -faults.clip, faults.clip)
    for joint, every, length, seed in faults.holding:
        rng = np.random.default_rng([int(seed), len(reported)])
        moment = 0.0
        while (moment := moment + rng.exponential(every)) * RATE < len(reported) - 1:
            first = int(moment * RATE)
            last = first + max(2, int(rng.exponential(length) * RATE))
            reported[first:last, joint] = reported[first, joint]
    return reported


def largest_change(
    reported: Sequence[np.ndarray], plain: Sequence[np.ndarray], nominal: np.ndarray, mean: int = 50
) -> float:
    """Root mean square over nominal of what effects change, in the motion and on the joint of the most."""
    largest = 0.0
    for a, b in zip(reported, plain, strict=True):
        change = np.cumsum((a - b) / nominal, axis=0)
        smooth = (change[mean:] - change[:-mean]) / mean
        largest = max(largest, float(np.sqrt(np.mean(smooth**2, axis=0)).max()))
    return largest


def simulate(
    machine: Arm, faults: RecorderFaults, seed: int, motions: Motions
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """All motions of one machine, and the torque channel of each."""
    out = MujocoPlant(machine, faults, seed).run(motions)
    return out, [measured(motion, faults) for motion in out.values()]
