"""Corrects a simulator: moves its numbers, keeps bodies physical, and collects effects that no file can hold.

What is linear in numbers that the file has becomes part of them: friction levels, rotor and link inertias, a payload,
gravity of a tilted base, the zero of an encoder (joint `ref` of an MJCF, `origin` of a URDF), a linear spring (MJCF).
The other effects go to a file next to it (`effects_file`).
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
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


@dataclass(frozen=True, eq=False)
class FittedChange:
    """What a fit to logs says of a simulator: a `change` (p,) of its model's parameters.

    `weight` (b, b) is the information of the logs on the base parameters, `unexplained` in the same unit the squared
    error that the fit leaves, `inertia` as in `Correction`.
    """

    change: np.ndarray
    weight: np.ndarray
    unexplained: float
    inertia: np.ndarray


def correct(
    simulator: Simulator,
    fitted: FittedChange,
    effects: Sequence[ModelEffect],
    released: Released,
    reasons: Mapping[tuple[str, tuple[str, ...]], str],
) -> Correction:
    """Move a simulator's numbers by a fitted change, and take in effects.

    Args:
        simulator: as given.
        fitted: the change of its numbers.
        effects: found in addition to the change.
        released: numbers that may move; those that effects move are added.
        reasons: by effect and joints.
    """
    original, model = simulator.arm, simulator.model
    b = len(model.independent)
    friction = np.zeros((len(original.joint_names), 2))
    for k, term in enumerate(model.terms):
        if term.axle in released.friction and term.form in _FRICTION:
            friction[term.axle, _FRICTION.index(term.form)] = fitted.change[b + k]
    numbers = _MovedNumbers(original, fitted.change[:b].copy(), friction)
    for entry in effects:
        numbers.take(entry, model, released, reasons.get((entry.effect, entry.joints), entry.effect))
    moved = np.maximum(np.stack([original.frictionloss, original.damping], axis=1) + numbers.friction, 0.0)
    arm = replace(numbers.arm, frictionloss=moved[:, 0], damping=moved[:, 1])
    notes = []
    if np.any(moved[list(released.friction)] == 0):
        notes.append("friction cannot be negative: where the fit gave less, the file has 0")
    if released.links or released.rotors:
        arm, remarks = _with_bodies(arm, model, numbers.base, fitted, released)
        notes += remarks
    description, _ = described(arm, simulator.robot)
    fixed = model_of(arm, description, dict(model.provenance))
    fixed = replace(
        fixed,
        effects=(*fixed.effects, *numbers.remaining),
        notes=(f"corrected from {original.path.name}, by what logs of the robot say", *original.notes),
    )
    return Correction(original, arm, fixed, released, tuple(numbers.remaining), fitted.inertia, tuple(notes), reasons)


@dataclass
class _MovedNumbers:
    """Numbers of an arm on the way to a correction: changes of base parameters (b,) and of friction (n, 2), and the
    effects that numbers do not say."""

    arm: SimulatedArm
    base: np.ndarray
    friction: np.ndarray
    remaining: list[ModelEffect] = field(default_factory=list)

    def take(self, entry: ModelEffect, model: IdentifiedModel, released: Released, reason: str) -> None:
        """Make an effect part of the numbers as far as they can say it."""
        effect, arm = CATALOGUE[entry.effect], self.arm
        joints = [arm.joint_names.index(name) for name in entry.joints]
        numbers = effect.simulator_numbers(entry.parameters, model.robot.load_link)
        spring = None if numbers is None or numbers.spring is None else _spring(arm, joints[0], numbers.spring)
        if numbers is None or (numbers.spring is not None and spring is None):
            self.remaining += [entry] if effect.of_the_arm else []
            return
        if numbers.body is not None:
            link, block = numbers.body
            self.base += model.projection[:, ParameterLayout.of(model.robot).link(link)] @ block
            released.links.setdefault(link, reason)
        if numbers.friction:
            self.friction[joints[0]] += [numbers.friction.get(form, 0.0) for form in _FRICTION]
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
        self.arm = arm
        self.remaining += further(entry, numbers)


def with_servos(
    correction: Correction, changed: PositionServos, simulated: SimulatedArm, reasons: Mapping[str, str]
) -> Correction:
    """The correction with its servos changed; `reasons` by joint.

    Args:
        correction: without servos.
        changed: its servos.
        simulated: the arm whose motion was compared: how its friction holds, and which bodies do not collide.
        reasons: why, by joint.
    """
    servos, released = correction.arm.servos, correction.released
    if not isinstance(servos, PositionServos):
        return correction
    pairs = ((getattr(changed, kind), getattr(servos, kind)) for kind in ("stiffness", "damping", "delay", "offset"))
    moved = np.any([new != old for new, old in pairs], axis=0)
    for k in np.flatnonzero(moved).tolist():
        released.gains[k] = reasons.get(correction.arm.joint_names[k], FileNumbers.DELAY)
    for k in np.flatnonzero(simulated.impedance != correction.arm.impedance).tolist():
        released.holding[k] = "friction holds the stationary joint"
    arm = replace(correction.arm, servos=changed, impedance=simulated.impedance, excluded=simulated.excluded)
    return replace(correction, arm=arm)


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


@dataclass(frozen=True, eq=False)
class _Bodies:
    """Bodies that could exist for released links and some rotors: blocks of links, armature, what is lost by them, and
    whether one is strained to exist."""

    rotors: list[int]
    blocks: np.ndarray
    armature: np.ndarray
    lost: float
    strained: bool


def _with_bodies(
    arm: SimulatedArm, model: IdentifiedModel, target: np.ndarray, fitted: FittedChange, released: Released
) -> tuple[SimulatedArm, list[str]]:
    """Move released bodies and rotors so that base parameters change by `target` (b,), as closely as bodies allow."""
    links = sorted(released.links)
    size = float(target @ fitted.weight @ target)
    nearest = _nearest_bodies(arm, model, target, fitted, links)
    bodies = nearest(sorted(released.rotors))
    if bodies.strained and not set(links) <= set(bodies.rotors):
        # what turns with a motor may have been found as a link's, and no body turns about one axis only
        turning = nearest(sorted({*bodies.rotors, *links}))
        if not turning.strained or turning.lost < 0.5 * bodies.lost:
            bodies = turning
            for k in links:
                released.rotors.setdefault(k, released.links[k])
    remarks = []
    if size > 0 and bodies.lost > _LOST * size:
        remarks.append(
            f"the bodies that fit best could not exist; the nearest that could are written, which lose "
            f"{100 * min(bodies.lost / size, 1.0):.0f} % of what moving them gained"
        )
    weightless = [arm.joint_names[k] for k in links if not is_body(arm.carrying[k].own)]
    if weightless:
        remarks.append(
            f"the file's inertia of the link that {', '.join(weightless)} moves was of no body that could exist"
        )
    return _written_bodies(arm, model, links, bodies), remarks


def _nearest_bodies(
    arm: SimulatedArm, model: IdentifiedModel, target: np.ndarray, fitted: FittedChange, links: Sequence[int]
) -> Callable[[list[int]], _Bodies]:
    """The bodies of these links nearest to a change of base parameters by `target` (b,), as a function of rotors."""
    robot, layout = model.robot, ParameterLayout.of(model.robot)
    own = [arm.carrying[k].own for k in links]
    inertia = np.diag(model.rigid.dynamics.mass_matrix(np.zeros(robot.dof)))
    reach = max(float(np.abs(model.rigid.dynamics.tip_pose(np.zeros((1, robot.dof)))[0, :3, 3]).sum()), 0.1)
    values, vectors = np.linalg.eigh(fitted.weight)
    root_weight = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    total = max(sum(max(block[0], 0.0) for block in own), 1e-3)
    bodies = [block if is_body(block) else nearby_body(block, 0.02 * total, reach) for block in own]
    size = float(target @ fitted.weight @ target)

    def with_rotors(rotors: list[int]) -> _Bodies:
        columns = root_weight @ np.hstack(
            [
                *(model.projection[:, layout.link(k)] for k in links),
                model.projection[:, layout.rotors][:, rotors] / robot.gear_ratios[rotors] ** 2,
            ]
        )
        usual = np.where(arm.armature[rotors] > 0, arm.armature[rotors], 0.1 * np.maximum(inertia[rotors], 1e-6))
        wanted = root_weight @ target + columns @ np.concatenate([*own, arm.armature[rotors]])
        parameters = ParameterLayout(len(links), len(rotors))
        nearest = nearest_bodies(columns, wanted, np.concatenate([*bodies, usual]), parameters, _PULLS)
        blocks, armature = parameters.blocks(nearest), nearest[parameters.rotors]
        lost = float(np.sum((columns @ nearest - wanted) ** 2))
        heavy = any(block[0] > _STRAINED * old[0] > 0 for block, old in zip(blocks, own, strict=True))
        strained = heavy or lost > min(_LOST * size, _LOST_OF_REST * fitted.unexplained)
        return _Bodies(rotors, blocks, armature, lost, strained)

    return with_rotors


def _written_bodies(arm: SimulatedArm, model: IdentifiedModel, links: Sequence[int], bodies: _Bodies) -> SimulatedArm:
    """The arm with these bodies in its links and rotors."""
    root = ElementTree.fromstring(arm.robot.urdf)
    elements = {link.get("name"): link for link in root.findall("link")}
    whole = ParameterLayout.of(model.robot).blocks(model.rigid.dynamics.standard_parameters())
    carrying, armature = list(arm.carrying), arm.armature.copy()
    for k, block in zip(links, bodies.blocks, strict=True):
        body = carrying[k]
        lumped = block if arm.is_urdf else whole[k] - body.own + block
        set_inertial(elements[body.link], seen_from(lumped, body.link_pose))
        carrying[k] = replace(body, own=block)
    armature[bodies.rotors] = bodies.armature
    return replace(_reshaped(arm, root), armature=armature, carrying=tuple(carrying))
