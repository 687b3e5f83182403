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
from agent.diagnosis.simulator_file.parameter_groups import DELAY, GAIN, OFFSET, OWN_DELAY, groups_of
from agent.diagnosis.simulator_file.released_numbers import delay_of
from agent.diagnosis.sizes import unit_of
from agent.model import FileNumbers
from agent.simulators import Correction


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
    fit, released = diagnosis.selected.fit, diagnosis.released
    model, robot, arm = diagnosis.dataset.model, diagnosis.dataset.robot, correction.arm
    p, b = len(diagnosis.dataset.stored_covariance), len(model.independent)
    change = fit.fitted()[0]
    groups = [*released.groups]
    groups += [group for group in groups_of(released.given) if (group.kind, group.joint) not in released.parts]
    columns = np.hstack([group.directions for group in groups])
    count = columns.shape[1]
    spread = np.zeros((fit.size, count + fit.size - p))
    spread[:p, :count] = columns
    spread[p:, count:] = np.eye(fit.size - p)
    information = fit.gram[:, :-1, :-1].sum(axis=0) / fit.rows_per_independent
    prior = np.eye(spread.shape[1])
    prior[count:, count:] = fit.prior[p:, p:]
    covariance = np.linalg.inv(spread.T @ information @ spread + prior)
    energy = np.nanmean((fit.held_out() / fit.sigma) ** 2)
    deviation = np.sqrt(np.diag(covariance) * max(1.0, float(energy)))
    result, at = [], 0
    for group in released.groups:
        joint, name = group.joint, robot.joint_names[group.joint]
        own = slice(at, at + group.directions.shape[1])
        at = own.stop
        if group.kind in (GAIN, OFFSET, DELAY, OWN_DELAY) and (servos := diagnosis.dataset.servos) is not None:
            if group.kind == GAIN:
                value, size = servos.gains(change)[joint], group.scale[0]
                result.append(_range(f"actuator of {name}", "kp", value, size * deviation[own][0], "N·m/rad"))
            elif group.kind == OFFSET:
                value, size = float(servos.offsets(change)[joint]), float(group.scale[0])
                ends = _ends(value, size * deviation[own][0])
                result.append(Range(f"actuator of {name}", FileNumbers.OFFSET, value, *ends, "rad"))
            else:
                owner, own_delay = ("actuators", slice(None)) if joint < 0 else (f"actuator of {name}", joint)
                value = servos.file.delay[own_delay].mean() + delay_of(released, change, group)
                result.append(_range(owner, "delay", value, servos.prior.delay * deviation[own][0], "s"))
            continue
        unit, way = robot.joints[joint].torque_unit, robot.joints[joint].position_unit
        if group.kind == FileNumbers.FRICTION:
            terms = [k for k, term in enumerate(model.terms) if term.axle == joint]
            for column, k in enumerate(terms):
                least = group.directions[b + k, column] * deviation[own][column]
                if model.terms[k].form == "coulomb":
                    result.append(_range(f"joint {name}", "frictionloss", arm.frictionloss[joint], least, unit))
                else:
                    result.append(_range(f"joint {name}", "damping", arm.damping[joint], least, f"{unit}·s/{way}"))
        elif group.kind == "rotor inertia":
            gear = robot.gear_ratios[joint] ** 2
            mass = "kg" if robot.joints[joint].prismatic else "kg·m²"
            least = gear * group.scale[0] * deviation[own][0]
            result.append(_range(f"joint {name}", "armature", arm.armature[joint], least, mass))
        else:
            body = arm.carrying[joint]
            owner = f"{'link' if arm.is_urdf else 'body'} {body.name or 'of ' + name}"
            result.append(_range(owner, "mass", body.own[0], group.scale[0] * deviation[own][0], "kg"))
    at = count
    _, effects = fit.fitted()
    for candidate, values in zip(fit.chosen, effects, strict=True):
        own = slice(at, at + len(values))
        at = own.stop
        for name, value, least in zip(candidate.names, values, deviation[own], strict=True):
            unit = _unit(candidate.effect.name, name, any(robot.joints[j].prismatic for j in candidate.joints))
            result.append(Range(candidate.text(robot.joint_names), name, float(value), *_ends(value, least), unit))
    return tuple(result)


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
