"""A machine that is what a model file says of it: its bodies, its friction, and the effects it was extended with.

Bodies, Coulomb and viscous friction are the machine's own, and so is what swings too fast for any other way (gears that
give way, ripples) or is of its sensors (scale, shift and delay of the torque). Everything else that the model predicts
is worked out along the set-points as they come, and acts on the joints as a torque from outside that the motors have to
give: so any form that a model can have can be run, those with a memory too, and the controller reads the torque that
the model predicts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from agent.core import RejectedError
from agent.model import IdentifiedModel, ModelEffect, full_parameters
from agent.robot import Dynamics
from fake_controller.actuation import load_effect
from fake_controller.actuation.friction import FrictionCurve
from fake_controller.actuation.machine import Machine, draw_machine

_OWN = ("coulomb", "viscous")  # forms of friction that the machine has itself
_SIMULATED = ("joint_elasticity", "backlash", "torque_ripple", "torque_constant", "torque_offset", "time_delay")


def modelled_machine(model: IdentifiedModel) -> Machine:
    """A machine with the model's bodies and its Coulomb and viscous friction.

    Where no bodies that could exist have the model's base parameters they are the description's; what the two differ
    by is in `BeyondMachine`.
    """
    robot = model.robot
    machine = draw_machine(robot, 0)
    try:
        links, rotors = np.split(full_parameters(model), [10 * robot.dof])
    except RejectedError:
        links, rotors = Dynamics(robot).standard_parameters(), machine.rotor_inertias
    machine.parameters, machine.rotor_inertias = links.copy(), rotors.copy()
    levels = _own_friction(model)
    machine.friction = [
        FrictionCurve(
            coulomb=max(coulomb, 1e-6 * nominal),
            rise=0.0,
            stribeck_speed=usual.stribeck_speed,
            viscous=viscous,
            knee=1e9,
            stiffness=usual.stiffness * min(max(coulomb, 1e-6 * nominal) / usual.coulomb, 1.0),
        )
        for usual, nominal, (coulomb, viscous) in zip(machine.friction, machine.nominal, levels, strict=True)
    ]
    for entry in model.effects:
        for simulated in _simulated(entry, machine):
            load_effect(simulated).install(machine)
    return machine


def _simulated(entry: ModelEffect, machine: Machine) -> Iterator[dict[str, Any]]:
    """The simulated form of an effect of `_SIMULATED`, as `load_effect` takes it; nothing of others."""
    fitted, parameters = entry.parameters, list[dict[str, float]]()
    match entry.effect:
        case "joint_elasticity":
            parameters = [{"stiffness": fitted["stiffness"]}]
        case "backlash":
            parameters = [{"gap": fitted["gap"]}]
        case "torque_ripple":
            gear = machine.robot.gear_ratios[machine.robot.joint_names.index(entry.joints[0])]
            for harmonic in range(1, int(fitted["harmonics"]) + 1):  # the motor gives what its ripple takes away
                cosine, sine = fitted[f"cosine_{harmonic}"], fitted[f"sine_{harmonic}"]
                wave = {"amplitude": float(np.hypot(cosine, sine)), "phase": float(np.arctan2(-cosine, -sine))}
                parameters.append({**wave, "order": float(harmonic * fitted["order"] / gear)})
        case "torque_constant":
            parameters = [{"scale": 1.0 + fitted["scale_error"]}]
        case "torque_offset":
            parameters = [{"offset": fitted["offset"]}]
        case "time_delay":
            parameters = [{"delay": fitted["delay"] * fitted["share"]}]
    for values in parameters:
        yield {"effect": entry.effect, "joints": list(entry.joints), "parameters": values}


def _own_friction(model: IdentifiedModel) -> np.ndarray:
    """(n, 2) Coulomb [N·m] and viscous [N·m·s/rad] levels of the axles, none below zero."""
    levels = np.zeros((model.robot.dof, len(_OWN)))
    for term, value in zip(model.terms, model.values[len(model.independent) :], strict=True):
        if term.form in _OWN:
            levels[term.axle, _OWN.index(term.form)] = max(float(value), 0.0)
    return levels


class BeyondMachine:
    """Joint torque that a model predicts beyond what the machine made of it has itself."""

    def __init__(self, model: IdentifiedModel, machine: Machine):
        self._model, self._rotors = model, machine.reflected_rotors
        self._links = machine.dynamics()
        own = _own_friction(model)
        is_own = [term.form in _OWN for term in model.terms]
        values = np.array(model.values)
        for k, term in enumerate(model.terms):
            if is_own[k]:
                values[len(model.independent) + k] -= own[term.axle, _OWN.index(term.form)]
        others = tuple(entry for entry in model.effects if entry.effect not in _SIMULATED)
        self._other_terms = replace(model, values=values, effects=others)

    def torque(self, start: float, position: np.ndarray, velocity: np.ndarray, period: float) -> np.ndarray:
        """(S, n) [N·m] along set-points (S, n) and their velocities, the first at `start` [s]."""
        if len(position) < 3:
            return np.zeros_like(position)
        acceleration = np.gradient(velocity, period, axis=0)
        time = start + period * np.arange(len(position))
        whole = self._other_terms.predict(position, velocity, acceleration, time)
        coupling = self._model.robot.coupling
        rotors = self._rotors * (acceleration @ coupling.T)
        return whole - self._links.inverse_dynamics(position, velocity, acceleration) - rotors @ coupling
