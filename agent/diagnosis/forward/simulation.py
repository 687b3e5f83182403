"""The gap in forward simulation: the same set-points run by the model alone, and by the model with the effects found.

The arm is that of `agent.simulators`: rigid bodies and plain friction behind a servo of usual bandwidth, as late after
the set-points as the measured motion is. Everything else that the model predicts (other friction terms, effects) is
worked out along the motion that came out of the round before, the set-points at first, and acts in the next round as a
torque from outside (waveform relaxation: Lelarasmee, Ruehli, Sangiovanni-Vincentelli, IEEE Trans. CAD 1, 1982), so
every fitted form can drive the simulation, those with a memory too. Effects of the measurement are added to the
simulated torque instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.diagnosis.extension import extended_model
from agent.diagnosis.forward.rollout import STEP
from agent.estimation import FilterSettings, Motion, bands, motions, smooth_and_differentiate
from agent.model import CATALOGUE, PAYLOAD, IdentifiedModel, NominalModel, effect_torque
from agent.simulators import ForwardSimulation, RigidActuation, ServoGains

if TYPE_CHECKING:
    from agent.diagnosis.diagnosis import Diagnosis

#: Simulated duration per log, at most [s]; a simulation costs about a tenth of the motion's time.
LONGEST = 10.0
_ROUNDS = 2
_TRANSITION = 0.01  # numerical: of the highest speed, over which plain friction changes sign


@dataclass(frozen=True, eq=False)
class Simulated:
    """One log: what was measured, and what the model without and with the effects does with the same set-points.

    time (S,) [s] of the log; errors (S, n), measured less simulated: `torque_before`, `torque_after` [N·m], filtered
    alike, and `position_before`, `position_after` [rad]. `held_out`: the effects were fitted without this log.
    """

    log: str
    time: np.ndarray
    torque_before: np.ndarray
    torque_after: np.ndarray
    position_before: np.ndarray
    position_after: np.ndarray
    held_out: bool


def simulate(diagnosis: Diagnosis) -> list[Simulated]:
    """Simulate every log that has set-points, its longest segment without a gap, at most `LONGEST` seconds of it.

    No log where no effect was found: there are no two arms to compare.
    """
    dataset = diagnosis.dataset
    simulated: list[Simulated] = []
    if not diagnosis.selected.causes:
        return simulated
    for number, log in enumerate(dataset.logs):
        if log.reference_position is None or log.metadata.get(PAYLOAD):  # the model simulates the bare arm
            continue
        settings = FilterSettings(dataset.cutoff, dataset.model.order)
        motion = max(motions(log, settings, reduce=False), key=lambda m: len(m.time))
        motion = shortened(motion, int(LONGEST * motion.rate))  # edges included
        if motion.torque is None or motion.set_points is None or not np.all(np.isfinite(motion.set_points)):
            continue
        held_out = len(dataset.logs) > 1 and not diagnosis.selected.fit.transient  # of a push no other log knows
        extended = extended_model(diagnosis, without=number if held_out else None, transient=True)
        before = _follow(dataset.model, motion, number)
        after = _follow(extended, motion, number) if extended.effects else before
        if not all(np.all(np.isfinite(values)) for values in (*before, *after)):
            continue  # a simulator without rotors, say, runs away behind a usual servo
        torque = motion.low_pass(motion.torque)
        simulated.append(
            Simulated(
                log.name,
                motion.time[motion.kept],
                torque - before[1],
                torque - after[1],
                (motion.q - before[0])[motion.kept],
                (motion.q - after[0])[motion.kept],
                held_out,
            )
        )
    return simulated


def simulation_part(diagnosis: Diagnosis, simulated: Sequence[Simulated]) -> dict[str, Any] | None:
    """Plain figures per joint: root mean square error of torque over nominal, and of position [rad], all logs."""
    if not simulated:
        return None

    def rms(name: str) -> np.ndarray:
        return np.sqrt(np.mean(np.concatenate([getattr(s, name) for s in simulated]) ** 2, axis=0))

    return {
        "logs": [{"log": s.log, "seconds": float(s.time[-1] - s.time[0]), "held_out": s.held_out} for s in simulated],
        "torque": {side: (rms(f"torque_{side}") / diagnosis.gap.unit).tolist() for side in ("before", "after")},
        "position": {side: rms(f"position_{side}").tolist() for side in ("before", "after")},
    }


def shortened(motion: Motion, count: int) -> Motion:
    """Its first samples."""
    part = slice(count)
    return replace(
        motion,
        time=motion.time[part],
        q=motion.q[part],
        qd=motion.qd[part],
        qdd=motion.qdd[part],
        torque=None if motion.torque is None else motion.torque[part],
        set_points=None if motion.set_points is None else motion.set_points[part],
    )


def _follow(model: IdentifiedModel, motion: Motion, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (S, n) and filtered torque (S', n) of a model's arm that is given a motion's set-points."""
    reading = tuple(entry for entry in model.effects if not CATALOGUE[entry.effect].moves_arm)
    arm = _Arm(replace(model, effects=tuple(e for e in model.effects if e not in reading)), motion, number)
    position = arm.set_points
    for _ in range(_ROUNDS):
        position, torque = arm.run(arm.beyond(position))
    for entry in reading:
        torque = torque + effect_torque(model, entry, arm.motion_of(position))
    return position, motion.low_pass(torque)


class _Arm:
    """Bodies, plain friction and servo of a model, and what the model predicts beyond them."""

    def __init__(self, model: IdentifiedModel, motion: Motion, number: int):
        assert motion.set_points is not None
        self._model, self._motion, self._number = model, motion, number
        self.set_points = motion.set_points
        self._reference = NominalModel(model)
        robot = model.robot
        self._coupling = robot.coupling
        self._rotors = np.maximum(self._reference.rotors, 0.0)
        friction = {form: np.zeros(robot.dof) for form in ("coulomb", "viscous", "quadratic")}
        for term, value in zip(model.terms, model.friction_values, strict=True):
            if term.form in friction:
                friction[term.form][term.axle] = max(value, 0.0)
        speed = np.abs(np.gradient(self.set_points, 1 / motion.rate, axis=0) @ self._coupling.T)
        self._friction = {**friction, "transition": np.maximum(_TRANSITION * speed.max(axis=0), 1e-6)}
        bodies = np.mean([np.diag(self._reference.solid.mass_matrix(q)) for q in self.set_points[::500]], axis=0)
        self._inertia = bodies + robot.gear_ratios**2 * self._rotors

    def run(self, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and torques (S, n) under the motion's set-points, against an `extra` torque (S, n)."""
        motion, period = self._motion, 1 / self._motion.rate

        simulation = ForwardSimulation(
            self._reference.solid,
            self._rotors,
            RigidActuation(**self._friction),
            self._gains(),
            period=period,
            inner_rate=max(1 / STEP, motion.rate),
            external=-extra,
        )
        simulation.rest(self.set_points[0])
        ran = simulation.run(self.set_points, np.gradient(self.set_points, period, axis=0))
        return ran.motor_position @ np.linalg.inv(self._coupling).T, ran.torque

    def beyond(self, position: np.ndarray) -> np.ndarray:
        """(S, n) torque that the model predicts along positions (S, n), less bodies and plain friction."""
        moved, robot = self.motion_of(position), self._model.robot
        q, qd, qdd = moved["q"], moved["qd"], moved["qdd"]
        torque = np.sum(self._model.rigid_and_friction(q, qd, qdd), axis=0)
        for entry in self._model.effects:
            torque = torque + effect_torque(self._model, entry, moved, self._reference)
        speed, f = qd @ self._coupling.T, self._friction
        plain = f["coulomb"] * np.tanh(speed / f["transition"]) + f["viscous"] * speed
        plain = plain + f["quadratic"] * np.abs(speed) * speed
        rotors = robot.gear_ratios**2 * self._rotors * (qdd @ self._coupling.T)
        return torque - self._reference.solid.inverse_dynamics(q, qd, qdd) - (plain + rotors) @ self._coupling

    def motion_of(self, position: np.ndarray) -> dict[str, Any]:
        """Smooth motion along positions (S, n), as effects take it."""
        motion = self._motion
        q, qd, qdd = smooth_and_differentiate(position, motion.rate, *bands(motion.rate, motion.cutoff))
        return {"time": motion.time, "q": q, "qd": qd, "qdd": qdd, "log": self._number}

    def _gains(self) -> ServoGains:
        """Usual ones, with the position loop as late behind the set-points as the measured motion is."""
        motion = self._motion
        speed = np.gradient(self.set_points, 1 / motion.rate, axis=0)
        energy = np.maximum(np.sum(speed**2, axis=0), 1e-12)
        lag = np.maximum(np.sum((self.set_points - motion.q) * speed, axis=0) / energy - 1 / motion.rate, 0.0)
        usual = ServoGains.tuned(self._inertia, np.full(len(lag), np.inf))
        gain = np.minimum(usual.position, 1 / np.maximum(lag, 1e-9))
        return replace(usual, position=gain, feedforward=1 - gain * lag)
