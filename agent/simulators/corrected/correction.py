"""Corrects a simulator: moves its numbers, keeps bodies physical, and collects effects that no file can hold.

What is linear in numbers that the file has becomes part of them: friction levels, rotor and link inertias, a payload,
gravity of a tilted base, the zero of an encoder (joint `ref` of an MJCF, `origin` of a URDF), a linear spring (MJCF).
The other effects go to a file next to it (`effects_file`).
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from agent.model import (
    CATALOGUE,
    FileNumbers,
    IdentifiedModel,
    ModelEffect,
    is_body,
    nearby_body,
    nearest_bodies,
    seen_from,
)
from agent.robot import ParameterLayout
from agent.simulators.arm import SimulatedArm, described, model_of
from agent.simulators.effect_numbers import further, tilted, with_spring, with_zero
from agent.simulators.loader import Simulator
from agent.simulators.servos import PositionServos
from agent.simulators.urdf import set_inertial

_FRICTION = ("coulomb", "viscous")
_LOST = 0.01  # of what moving bodies gained, from where on it is said that they could not exist
_LOST_OF_REST = 0.1  # of the squared error that the fit leaves, from where on more than chance is lost
_PULLS = (1.0, 10.0)  # weights of the logs' information over the nearness to the file's bodies
_STRAINED = 10.0  # times the mass in the file, which no wrong number of a file is


@dataclass
class Released:
    """Numbers of a simulator that were allowed to move, with the reason per joint (counted from 0)."""

    links: dict[int, str] = field(default_factory=dict)
    rotors: dict[int, str] = field(default_factory=dict)
    friction: dict[int, str] = field(default_factory=dict)
    offsets: dict[int, float] = field(default_factory=dict)
    springs: dict[int, str] = field(default_factory=dict)
    holding: dict[int, str] = field(default_factory=dict)
    gains: dict[int, str] = field(default_factory=dict)
    gravity: str = ""


@dataclass(frozen=True, eq=False)
class Correction:
    """The corrected arm, its model with all effects, what was released, and the effects that are not in the file.

    `inertia` (n,) [kg·m²] that the joints carried on average while effects were fitted; `reasons` for effects, by
    effect and joints.
    """

    given: SimulatedArm
    arm: SimulatedArm
    model: IdentifiedModel
    released: Released
    effects: tuple[ModelEffect, ...]
    inertia: np.ndarray
    notes: tuple[str, ...]
    reasons: Mapping[tuple[str, tuple[str, ...]], str]


def correct(
    simulator: Simulator,
    change: np.ndarray,
    weight: np.ndarray,
    unexplained: float,
    inertia: np.ndarray,
    effects: Sequence[ModelEffect],
    released: Released,
    reasons: Mapping[tuple[str, tuple[str, ...]], str],
) -> Correction:
    """Move a simulator's numbers by a fitted `change` (p,) of its model's parameters, and take in effects.

    Args:
        weight: (b, b) information of the logs on the base parameters; `unexplained` in the same unit: squared
            error that the fit leaves; `inertia` as in `Correction`.
        effects: found in addition to the change; `reasons` by effect and joints.
    """
    original, model = simulator.arm, simulator.model
    names, n = original.joint_names, len(original.joint_names)
    b = len(model.independent)
    target, friction = change[:b].copy(), np.zeros((n, 2))
    for k, term in enumerate(model.terms):
        if term.axle in released.friction and term.form in _FRICTION:
            friction[term.axle, _FRICTION.index(term.form)] = change[b + k]
    layout = ParameterLayout.of(model.robot)
    arm = original
    remaining: list[ModelEffect] = []
    for entry in effects:
        reason = reasons.get((entry.effect, entry.joints), entry.effect)
        joints = [names.index(name) for name in entry.joints]
        numbers = CATALOGUE[entry.effect].simulator_numbers(entry.parameters, model.robot.load_link)
        spring = None if numbers is None or numbers.spring is None else _spring(arm, joints[0], numbers.spring)
        if numbers is None or (numbers.spring is not None and spring is None):
            remaining += [entry] if CATALOGUE[entry.effect].of_the_arm else []
            continue
        if numbers.body is not None:
            link, block = numbers.body
            target += model.projection[:, layout.link(link)] @ block
            released.links.setdefault(link, reason)
        if numbers.friction:
            friction[joints[0]] += [numbers.friction.get(form, 0.0) for form in _FRICTION]
            released.friction.setdefault(joints[0], reason)
        if numbers.tilt is not None:
            arm, released.gravity = replace(arm, robot=tilted(arm.robot, numbers.tilt)), reason
        if numbers.zero is not None:
            arm = replace(arm, robot=with_zero(arm.robot, joints[0], numbers.zero))
            released.offsets[joints[0]] = numbers.zero
        if spring is not None:
            stiffness, spring_rest = _put(arm.stiffness, joints[0], spring[0]), _put(arm.rest, joints[0], spring[1])
            arm = replace(arm, stiffness=stiffness, rest=spring_rest)
            released.springs[joints[0]] = reason
        remaining += further(entry, numbers)
    moved = np.maximum(np.stack([original.frictionloss, original.damping], axis=1) + friction, 0.0)
    arm = replace(arm, frictionloss=moved[:, 0], damping=moved[:, 1])
    notes = []
    if np.any(moved[list(released.friction)] == 0):
        notes.append("friction cannot be negative: where the fit gave less, the file has 0")
    arm, remarks = _with_bodies(arm, model, target, weight, unexplained, released)
    description, _ = described(arm, simulator.robot)
    fixed = model_of(arm, description, dict(model.provenance))
    fixed = replace(
        fixed,
        effects=(*fixed.effects, *remaining),
        notes=(f"corrected from {original.path.name}, by what logs of the robot say", *original.notes),
    )
    return Correction(original, arm, fixed, released, tuple(remaining), inertia, (*notes, *remarks), reasons)


def with_servos(
    found: Correction, changed: PositionServos, simulated: SimulatedArm, reasons: Mapping[str, str]
) -> Correction:
    """The correction with its servos changed; `reasons` by joint.

    Args:
        found: correction without servos.
        changed: its servos.
        simulated: the arm whose motion was compared: how its friction holds, and which bodies do not collide.
        reasons: why, by joint.
    """
    servos, released = found.arm.servos, found.released
    if not isinstance(servos, PositionServos):
        return found
    pairs = ((getattr(changed, kind), getattr(servos, kind)) for kind in ("stiffness", "damping", "delay", "offset"))
    moved = np.any([new != old for new, old in pairs], axis=0)
    for k in np.flatnonzero(moved).tolist():
        released.gains[k] = reasons.get(found.arm.joint_names[k], FileNumbers.DELAY)
    for k in np.flatnonzero(simulated.impedance != found.arm.impedance).tolist():
        released.holding[k] = "friction holds the stationary joint"
    arm = replace(found.arm, servos=changed, impedance=simulated.impedance, excluded=simulated.excluded)
    return replace(found, arm=arm)


def _spring(arm: SimulatedArm, joint: int, added: tuple[float, float]) -> tuple[float, float] | None:
    """Stiffness and rest position of a joint with a linear spring added; None if the file cannot hold one."""
    return None if arm.is_urdf else with_spring(arm.stiffness[joint], arm.rest[joint], added)


def _put(values: np.ndarray, joint: int, value: float) -> np.ndarray:
    changed = values.copy()
    changed[joint] = value
    return changed


def _reshaped(arm: SimulatedArm, root: ElementTree.Element) -> SimulatedArm:
    """The arm with another URDF as its chain."""
    return replace(arm, robot=replace(arm.robot, urdf=ElementTree.tostring(root, encoding="unicode")))


def _with_bodies(
    arm: SimulatedArm,
    model: IdentifiedModel,
    target: np.ndarray,
    weight: np.ndarray,
    unexplained: float,
    released: Released,
) -> tuple[SimulatedArm, list[str]]:
    """Move released bodies and rotors so that base parameters change by `target` (b,), as closely as bodies allow."""
    links = sorted(released.links)
    if not links and not released.rotors:
        return arm, []
    robot, layout = model.robot, ParameterLayout.of(model.robot)
    own = [arm.carrying[k].own for k in links]
    inertia = np.diag(model.rigid.dynamics.mass_matrix(np.zeros(robot.dof)))
    reach = max(float(np.abs(model.rigid.dynamics.tip_pose(np.zeros((1, robot.dof)))[0, :3, 3]).sum()), 0.1)

    values, vectors = np.linalg.eigh(weight)
    root_weight = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    total = max(sum(max(block[0], 0.0) for block in own), 1e-3)
    bodies = [block if is_body(block) else nearby_body(block, 0.02 * total, reach) for block in own]

    def with_rotors(rotors: list[int]) -> tuple[np.ndarray, np.ndarray, float, bool]:
        """Bodies, armature of rotors, what is lost by bodies that exist, and whether one is strained to exist."""
        columns = root_weight @ np.hstack(
            [
                *(model.projection[:, layout.link(k)] for k in links),
                model.projection[:, layout.rotors][:, rotors] / robot.gear_ratios[rotors] ** 2,
            ]
        )
        usual = np.where(arm.armature[rotors] > 0, arm.armature[rotors], 0.1 * np.maximum(inertia[rotors], 1e-6))
        wanted = root_weight @ target + columns @ np.concatenate([*own, arm.armature[rotors]])
        released = ParameterLayout(len(links), len(rotors))
        nearest = nearest_bodies(columns, wanted, np.concatenate([*bodies, usual]), released, _PULLS)
        blocks, armature = released.blocks(nearest), nearest[released.rotors]
        lost = float(np.sum((columns @ nearest - wanted) ** 2))
        heavy = any(block[0] > _STRAINED * old[0] > 0 for block, old in zip(blocks, own, strict=True))
        return blocks, armature, lost, heavy or lost > min(_LOST * size, _LOST_OF_REST * unexplained)

    size = float(target @ weight @ target)
    rotors = sorted(released.rotors)
    blocks, armature, lost, strained = with_rotors(rotors)
    if strained and not set(links) <= set(rotors):
        # what turns with a motor may have been found as a link's, and no body turns about one axis only
        every = sorted({*rotors, *links})
        other = with_rotors(every)
        if not other[3] or other[2] < 0.5 * lost:
            rotors, (blocks, armature, lost, _) = every, other
            for k in links:
                released.rotors.setdefault(k, released.links[k])
    remarks = []
    if size > 0 and lost > _LOST * size:
        remarks.append(
            f"the bodies that fit best could not exist; the nearest that could are written, which lose "
            f"{100 * min(lost / size, 1.0):.0f} % of what moving them gained"
        )
    weightless = [arm.joint_names[k] for k, block in zip(links, own, strict=True) if not is_body(block)]
    if weightless:
        remarks.append(
            f"the file's inertia of the link that {', '.join(weightless)} moves was of no body that could exist"
        )
    root = ElementTree.fromstring(arm.robot.urdf)
    elements = {link.get("name"): link for link in root.findall("link")}
    whole = layout.blocks(model.rigid.dynamics.standard_parameters())
    carrying, moved = list(arm.carrying), arm.armature.copy()
    for k, block in zip(links, blocks, strict=True):
        body = carrying[k]
        lumped = block if arm.is_urdf else whole[k] - body.own + block
        set_inertial(elements[body.link], seen_from(lumped, body.link_pose))
        carrying[k] = replace(body, own=block)
    moved[rotors] = armature
    return replace(_reshaped(arm, root), armature=moved, carrying=tuple(carrying)), remarks
