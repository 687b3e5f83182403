"""Ranges for domain randomisation: the remaining uncertainty of each number of a corrected simulator.

Values are those of the corrected file. All numbers that could move are x = x₀ + D c with the prior c ~ N(0, 1). The
logs reduce its covariance to cov(c) = (1 + Dᵀ H D)⁻¹, for effects and all numbers at once; H is their information, as
in `fit`. So the range of one link's mass allows that another link was meant. If the error of the held-out motion
exceeds the noise model, all deviations are scaled up by the same factor. Numbers that were not moved have no range: the
logs gave no reason to move them.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numpy as np

from agent.diagnosis.diagnosis import Diagnosis
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.simulator_file.numbers_as_causes import springs_as_effects
from agent.diagnosis.simulator_file.parameter_groups import NumberGroup, NumberKind, groups_of
from agent.diagnosis.simulator_file.released_numbers import delay_of
from agent.diagnosis.sizes import unit_of
from agent.model import FileNumbers
from agent.simulators import Correction, SimulatedArm


@dataclass(frozen=True)
class Range:
    """A number of the simulator or of an additional effect: value, 90 % interval, SI unit, and where it belongs."""

    of: str
    parameter: str
    value: float
    low: float
    high: float
    unit: str


def ranges(diagnosis: Diagnosis, correction: Correction) -> tuple[Range, ...]:
    """All numbers that the diagnosis moved or found, as the correction writes them; empty without a simulator file."""
    if diagnosis.released is None:
        return ()
    fit, released, names = diagnosis.selected.fit, diagnosis.released, diagnosis.dataset.robot.joint_names
    change, effects = fit.fitted()
    of_groups, of_effects = _deviations(diagnosis)
    result = list[Range]()
    for group in released.groups:
        deviations, of_groups = np.split(of_groups, [group.directions.shape[1]])
        if group.kind in (NumberKind.GAIN, NumberKind.OFFSET, NumberKind.DELAY, NumberKind.OWN_DELAY):
            result.append(_of_servo(diagnosis, change, group, float(deviations[0])))
        elif group.kind == NumberKind.SPRING:
            for spring in springs_as_effects(diagnosis.dataset, [group], change):
                owner, size = f"{spring.effect} of {', '.join(spring.joints)}", float(group.scale[0] * deviations[0])
                unit = _unit(spring.effect, "stiffness", diagnosis.dataset.robot.joints[group.joint].prismatic)
                result.append(_range(owner, "stiffness", spring.parameters["stiffness"], size, unit))
        else:
            result += _of_arm(diagnosis, correction.arm, group, deviations)
    for candidate, values in zip(fit.chosen, effects, strict=True):
        deviations, of_effects = np.split(of_effects, [len(values)])
        slides = any(diagnosis.dataset.robot.joints[j].prismatic for j in candidate.joints)
        for name, value, deviation in zip(candidate.names, values, deviations, strict=True):
            unit = _unit(candidate.effect.name, name, slides)
            result.append(Range(candidate.text(names), name, float(value), *_ends(value, deviation), unit))
    return tuple(result)


def _deviations(diagnosis: Diagnosis) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of the directions of all groups, the released ones first, and of parameters of effects."""
    assert diagnosis.released is not None
    fit, released = diagnosis.selected.fit, diagnosis.released
    p = len(diagnosis.dataset.stored_covariance)
    others = (group for group in groups_of(released.given) if group.key not in released.parts)
    columns = np.hstack([group.directions for group in (*released.groups, *others)])
    count = columns.shape[1]
    spread = np.zeros((fit.size, count + fit.size - p))
    spread[:p, :count] = columns
    spread[p:, count:] = np.eye(fit.size - p)
    information = fit.gram[:, :-1, :-1].sum(axis=0) / fit.rows_per_independent
    prior = np.eye(spread.shape[1])
    prior[count:, count:] = fit.prior[p:, p:]
    covariance = np.linalg.inv(spread.T @ information @ spread + prior)
    energy = np.nanmean((fit.held_out() / fit.sigma) ** 2)
    deviations = np.sqrt(np.diag(covariance) * max(1.0, float(energy)))
    return deviations[:count], deviations[count:]


def _of_servo(diagnosis: Diagnosis, change: np.ndarray, group: NumberGroup, deviation: float) -> Range:
    """Gain, offset or delay of a servo, or the delay of all."""
    servos, joint = diagnosis.dataset.servos, group.joint
    assert servos is not None
    assert diagnosis.released is not None
    owner = "actuators" if joint < 0 else f"actuator of {diagnosis.dataset.robot.joint_names[joint]}"
    if group.kind == NumberKind.GAIN:
        return _range(owner, "kp", servos.gains(change)[joint], group.scale[0] * deviation, "N·m/rad")
    if group.kind == NumberKind.OFFSET:
        value = float(servos.offsets(change)[joint])
        return Range(owner, FileNumbers.OFFSET, value, *_ends(value, float(group.scale[0]) * deviation), "rad")
    delay = servos.file.delay.mean() if joint < 0 else servos.file.delay[joint]
    value = delay + delay_of(diagnosis.released, change, group)
    return _range(owner, "delay", value, servos.prior.delay * deviation, "s")


def _of_arm(diagnosis: Diagnosis, arm: SimulatedArm, group: NumberGroup, deviations: np.ndarray) -> list[Range]:
    """Friction and damping, or rotor, or mass of a joint or its body in a corrected arm."""
    joint, model, robot = group.joint, diagnosis.dataset.model, diagnosis.dataset.robot
    name, force, way = robot.joint_names[joint], robot.joints[joint].torque_unit, robot.joints[joint].position_unit
    if group.kind == NumberKind.FRICTION:
        result, base = [], len(model.independent)
        for column, k in enumerate(k for k, term in enumerate(model.terms) if term.axle == joint):
            deviation = group.directions[base + k, column] * deviations[column]
            if model.terms[k].form == "coulomb":
                result.append(_range(f"joint {name}", "frictionloss", arm.frictionloss[joint], deviation, force))
            else:
                result.append(_range(f"joint {name}", "damping", arm.damping[joint], deviation, f"{force}·s/{way}"))
        return result
    if group.kind == NumberKind.ROTOR:
        mass = "kg" if robot.joints[joint].prismatic else "kg·m²"
        deviation = robot.gear_ratios[joint] ** 2 * group.scale[0] * deviations[0]
        return [_range(f"joint {name}", "armature", arm.armature[joint], deviation, mass)]
    body = arm.carrying[joint]
    owner = f"{'link' if arm.is_urdf else 'body'} {body.name or 'of ' + name}"
    return [_range(owner, "mass", body.own[0], group.scale[0] * deviations[0], "kg")]


def _unit(effect: str, parameter: str, slides: bool) -> str:
    """1 where it is a ratio."""
    unit = unit_of(effect, parameter)
    unit = unit.replace("N·m", "N").replace("rad", "m") if slides else unit
    return "1" if unit in ("", "%") else unit


def _ends(value: float, deviation: float) -> tuple[float, float]:
    return float(value - LAW.within * deviation), float(value + LAW.within * deviation)


def _range(of: str, parameter: str, value: float, deviation: float, unit: str) -> Range:
    """Range of a number that is not negative."""
    low, high = _ends(value, deviation)
    return Range(of, parameter, max(float(value), 0.0), max(low, 0.0), max(high, 0.0), unit)


def ranges_text(ranges: tuple[Range, ...]) -> str:
    """Content of a ranges file, YAML with one line a number."""
    rows = ({key: _rounded(value) for key, value in asdict(entry).items()} for entry in ranges)
    lines = [f"  - {json.dumps(row, ensure_ascii=False)}" for row in rows]
    return "\n".join(["schema: randomisation/1", "interval: 0.9", "ranges:" if lines else "ranges: []", *lines, ""])


def _rounded(value: float | str) -> float | str:
    return value if isinstance(value, str) else float(f"{value:.6g}")
