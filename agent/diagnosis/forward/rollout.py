"""A simulator's file run forward: MuJoCo by its own integrator, a URDF through Pinocchio, contacts off.

Joints that are not compared are held; actuators of the file are off, as the torque comes from the recorded robot or a
servo like its own. Ranges of joints are off too:
where the recorded robot was, the simulator may go.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from agent.model import CATALOGUE, IdentifiedModel
from agent.robot import ParameterLayout
from agent.simulators import LOST, Simulator, compiled, mujoco_package

#: (seconds since the start, q (n,), q̇ (n,)) → torque of the motors (n,) [N·m].
Drive = Callable[[float, np.ndarray, np.ndarray], np.ndarray]

STEP = 1e-3  # s, of the URDF's roll-out
_HOLD = 1e6  # armature that holds a joint, over the arm's mass


class RolloutEngine(Protocol):
    """A simulator that can be put into a state."""

    def run(self, q: np.ndarray, qd: np.ndarray, drive: Drive, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (T, n) at ascending times (T,) [s] from a state (n,); not finite where it fails."""


class MujocoEngine:
    """An MJCF in MuJoCo with the effects of a second file."""

    def __init__(self, path: Path, joints: tuple[str, ...], effects: Path | None = None):
        self._mujoco = mujoco = mujoco_package()
        self._model = model = compiled(path)
        off = mujoco.mjtDisableBit
        for bit in ("CONTACT", "LIMIT", "AUTORESET", "ACTUATION"):
            model.opt.disableflags |= int(getattr(off, f"mjDSBL_{bit}", 0))
        model.opt.density = model.opt.viscosity = 0.0
        model.body_gravcomp[:] = 0.0
        self._at = np.array([int(model.joint(name).qposadr[0]) for name in joints])
        self._dof = np.array([int(model.joint(name).dofadr[0]) for name in joints])
        held = np.setdiff1d(np.arange(model.nv), self._dof)
        model.dof_armature[held] = _HOLD * max(float(model.body_mass.sum()), 1.0)
        self._effects = None if effects is None else runpy.run_path(str(effects))

    def run(self, q: np.ndarray, qd: np.ndarray, drive: Drive, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mujoco, model = self._mujoco, self._model
        data = mujoco.MjData(model)
        data.qpos[self._at], data.qvel[self._dof] = q, qd
        states = np.empty((2, len(times), len(q)))
        try:
            if self._effects is not None:
                self._effects["install"](mujoco, model)
            for row, until in enumerate(times):
                while data.time < until - 0.5 * model.opt.timestep:
                    given = drive(data.time, data.qpos[self._at], data.qvel[self._dof])
                    data.qfrc_applied[self._dof] = given
                    mujoco.mj_step(model, data)
                    if not np.abs(data.qvel).max() < LOST:
                        states[:, row:] = np.nan
                        return states[0], states[1]
                states[:, row] = data.qpos[self._at], data.qvel[self._dof]
        finally:
            mujoco.set_mjcb_passive(None)
        return states[0], states[1]


class ChainEngine:
    """The arm of a URDF: semi-implicit steps of 1 ms, friction taken implicitly."""

    def __init__(self, model: IdentifiedModel, effects: Path | None = None):
        n = model.robot.dof
        assert model.standard is not None
        self._rotors = model.robot.gear_ratios**2 * model.standard[ParameterLayout.of(model.robot).rotors]
        self._links = model.rigid.dynamics
        values = model.friction_values
        level: dict[str, np.ndarray] = {"coulomb": np.zeros(n), "viscous": np.zeros(n)}
        self._reversal = np.ones(n)
        for term, value in zip(model.terms, values, strict=True):
            level[term.form][term.axle] = value
            if term.reversal is not None:
                self._reversal[term.axle] = term.reversal.scale
        self._coulomb, self._viscous = level["coulomb"], level["viscous"]
        self._accelerate = self._links.acceleration_function(self._rotors)
        self._effects = None if effects is None else runpy.run_path(str(effects))

    def run(self, q: np.ndarray, qd: np.ndarray, drive: Drive, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, v, a, now = q.copy(), qd.copy(), np.zeros(len(q)), 0.0
        extra = None if self._effects is None else self._effects["Effects"](dt=STEP)
        if extra is not None:
            extra.armature = np.zeros(len(q))  # part of the arm here
        states = np.empty((2, len(times), len(q)))
        for row, until in enumerate(times):
            while now < until - 0.5 * STEP:
                torque = drive(now, q, v)
                if extra is not None:
                    load = self._links.inverse_dynamics(q[None], v[None], a[None])[0]
                    slope = self._links.torque_slope(q[None], v[None], a[None])[0]
                    torque = torque - extra.torque(q, v, a, load, self._links.mass_matrix(q), slope)
                size = np.maximum(np.abs(v), 1e-9 * self._reversal)
                damping = self._coulomb * np.tanh(size / self._reversal) / size + self._viscous
                a = np.array(self._accelerate(q, v, torque - damping * v, damping * STEP))
                v = v + STEP * a
                q = q + STEP * v
                now += STEP
            states[:, row] = q, v
        return states[0], states[1]


def engine(simulator: Simulator, path: Path, model: IdentifiedModel, effects: Path | None) -> RolloutEngine:
    """That of a simulator's format, for a file of it and its model."""
    if simulator.arm.path.suffix.lower() == ".urdf":
        return ChainEngine(model, effects)
    return MujocoEngine(path, simulator.arm.file_joints, effects)


def at_motors(entries: Any, names: tuple[str, ...], torque: np.ndarray) -> np.ndarray:
    """(S, n) torque of the motors from what was reported, by the effects of measurement that were found."""
    offset, scale = np.zeros(len(names)), np.ones(len(names))
    for entry in entries:
        effect = CATALOGUE[entry.effect]
        for into, parameter in ((offset, effect.adds_to_report), (scale, effect.scales_report)):
            if parameter is not None:
                into[names.index(entry.joints[0])] += entry.parameters[parameter]
    return (torque - offset) / scale
