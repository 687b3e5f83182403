"""What is wrong with a machine, as changes to its arm, its friction laws, its servo and its sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from second_world.arms import Arm

#: Effects that no catalogue has a form for.
OUTSIDE = ("crosstalk", "shaking_floor", "holding_sensor", "clipped_torque")
#: Effects that the engine's own dry friction has no law for: what they change of a bristle's is added to it.
_BRISTLES = ("stribeck", "asymmetric_friction", "load_dependent_friction", "thermal_friction", "presliding")


@dataclass
class Push:
    """A contact: force (3,) [N] of the base frame on a link from `start` for `duration`, as shares of one motion."""

    link: int
    force: np.ndarray
    start: float
    duration: float


@dataclass
class RecorderFaults:
    """Neutral until told otherwise; arrays are (n,), one entry a joint. `bristles`: whose friction is not the engine's;
    `changed`: whose friction law an effect changes."""

    bristles: np.ndarray
    changed: np.ndarray
    by_direction: np.ndarray
    viscous_by_direction: np.ndarray
    rise: np.ndarray
    rise_speed: np.ndarray
    load: np.ndarray
    thin_speed: np.ndarray
    thin_power: np.ndarray
    cold_coulomb: np.ndarray
    cold_viscous: np.ndarray
    warm_after: np.ndarray
    long_share: np.ndarray
    long_travel: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    zero: np.ndarray
    clip: np.ndarray
    ripple: list[tuple[int, float, float, float]] = field(default_factory=list)
    springs: list[tuple[int, float, float, float]] = field(default_factory=list)
    hoses: list[tuple[int, float, float, float, float]] = field(default_factory=list)
    pushes: list[Push] = field(default_factory=list)
    shaking: list[tuple[int, float, float]] = field(default_factory=list)
    leaks: list[tuple[int, int, float]] = field(default_factory=list)
    holding: list[tuple[int, float, float, int]] = field(default_factory=list)
    delay: float = 0.0


def build_in(arm: Arm, effects: Sequence[Mapping[str, Any]]) -> RecorderFaults:
    """Put effects into an arm, which is changed, and say what else is wrong with the machine.

    Raises:
        ValueError: an effect that this world has no law for.
    """
    n = arm.n
    zero, one, never = np.zeros(n), np.ones(n), np.full(n, np.inf)
    faults = RecorderFaults(
        np.full(n, not arm.by_engine),
        np.zeros(n, dtype=bool),
        *(zero.copy(), zero.copy(), zero.copy(), one.copy(), zero.copy()),
        *(never.copy(), zero.copy(), zero.copy(), zero.copy(), one.copy(), zero.copy(), one.copy()),
        *(one.copy(), zero.copy(), zero.copy(), never.copy()),
    )
    for effect in effects:
        name, values = effect["effect"], effect["parameters"]
        joints = [arm.joint_names.index(joint) for joint in effect["joints"]]
        if name in _BRISTLES:
            faults.changed[joints] = True
        law = _LAWS.get(name)
        if law is None:
            raise ValueError(f"second world: no law for the effect {name!r}")
        law(arm, faults, joints, values)
    return faults


def _set(**fields: str) -> Any:
    """A law that only sets entries of `RecorderFaults`: field=name of the parameter."""

    def law(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
        for name, parameter in fields.items():
            getattr(faults, name)[joints[0]] = values[parameter]

    return law


def _friction_change(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    arm.coulomb[joints[0]] *= values["coulomb"]
    arm.viscous[joints[0]] *= values["viscous"]


def _viscous_nonlinearity(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    faults.changed[joints[0]] = True
    arm.viscous[joints[0]] += values["added"]
    faults.thin_speed[joints[0]], faults.thin_power[joints[0]] = values["speed"], values["power"]


def _payload(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    arm.inside.append((arm.n - 1, values["mass"], np.array(values["centre"])))


def _inertial_mismatch(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    link = int(values["link"])
    arm.mass[link] *= values["scale"]
    arm.inertia[link] *= values["scale"]
    arm.inside.append((link, values["mass"], np.array(values["place"])))


def _base_tilt(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    roll, pitch = values["roll"], values["pitch"]
    down = np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)])
    arm.gravity = 9.80665 * down


def _gear(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    arm.gear[joints[0]] = (values.get("stiffness", 0.0), values["damping"], values.get("gap", 0.0))


def _wrist(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    """The second joint's own drive sits on the coupled shaft, or a seal rubs there besides."""
    first, second = joints
    inertia, coulomb, viscous = 0.0, values["coulomb"], values["viscous"]
    if values["moved"]:
        inertia = arm.rotor[second]
        coulomb, viscous = coulomb + arm.coulomb[second], viscous + arm.viscous[second]
        arm.rotor[second] = 1e-6
        arm.coulomb[second] = arm.viscous[second] = 1e-6
    arm.wrist = (first, second, values["ratio"], inertia, coulomb, viscous)


def _append(name: str, *parameters: str) -> Any:
    """A law that lists (joint, parameters…) in a field of `RecorderFaults`."""

    def law(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
        getattr(faults, name).append((joints[0], *(values[p] for p in parameters)))

    return law


def _contact(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    for start in values["starts"]:
        faults.pushes.append(Push(int(values["link"]), np.array(values["force"]), start, values["duration"]))


def _delay(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    faults.delay = values["delay"]


def _crosstalk(arm: Arm, faults: RecorderFaults, joints: list[int], values: Mapping[str, Any]) -> None:
    faults.leaks.append((int(values["from"]), joints[0], values["share"]))


_LAWS = {
    "stribeck": _set(rise="rise", rise_speed="speed"),
    "asymmetric_friction": _set(by_direction="coulomb", viscous_by_direction="viscous"),
    "load_dependent_friction": _set(load="coefficient"),
    "viscous_nonlinearity": _viscous_nonlinearity,
    "thermal_friction": _set(cold_coulomb="coulomb", cold_viscous="viscous", warm_after="way"),
    "presliding": _set(long_share="share", long_travel="travel"),
    "friction_change": _friction_change,
    "joint_elasticity": _gear,
    "backlash": _gear,
    "torque_ripple": _append("ripple", "amplitude", "order", "phase"),
    "wrist_coupling": _wrist,
    "payload": _payload,
    "gravity_spring": _append("springs", "torque", "lever", "angle"),
    "dress_pack": _append("hoses", "stiffness", "centre", "slack", "rubbing"),
    "base_tilt": _base_tilt,
    "inertial_mismatch": _inertial_mismatch,
    "contact": _contact,
    "torque_constant": _set(scale="scale"),
    "torque_offset": _set(offset="offset"),
    "time_delay": _delay,
    "encoder_offset": _set(zero="offset"),
    "crosstalk": _crosstalk,
    "shaking_floor": _append("shaking", "amplitude", "frequency"),
    "holding_sensor": _append("holding", "every", "length", "seed"),
    "clipped_torque": _set(clip="limit"),
}
