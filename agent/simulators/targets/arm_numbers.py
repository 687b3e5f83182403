"""The numbers of an arm that simulators are told, from a model or from a simulator's file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import LARGEST_JSON, InputError, read_json, read_text
from agent.model import (
    CATALOGUE,
    FileNumbers,
    IdentifiedModel,
    ModelEffect,
    PassiveForces,
    effect_torque,
    full_parameters,
    possible_model,
)
from agent.robot import Dynamics, ParameterLayout, rotor_mass_matrix
from agent.simulators.arm import USUAL_SPEED, SimulatedArm
from agent.simulators.effect_numbers import in_numbers, left_out, torque_text, usual_motion
from agent.simulators.export import assumed, body_texts, friction_lines
from agent.simulators.loader import is_simulator, load_arm, load_simulator
from agent.simulators.servos import PositionServos
from agent.simulators.urdf import moved_links

_POSTURES = 200
_NOT_OURS = "{}: is not what agent diagnose writes next to a corrected file; delete or mend it"
#: Names of MuJoCo's interpolations between delayed controls, by number.
_INTERPOLATIONS = ("zoh", "linear", "cubic")


@dataclass(frozen=True)
class JointNumbers:
    """One joint, SI on the joint side: rad or m, N·m or N.

    `inertia` is the least that it turns over its range, rotor included; `kp`, `kv`, `effort` and `delay` [s] are those
    of its position servo, None where no servo is known; it stands `offset` off its set-points, and `closes` says what
    that makes of a gap; `force` and `asked`: its least and largest force and set-point, None without limits; `solver`:
    how MuJoCo solves its friction and limits (`SimulatedArm.solver`);
    `interpolation` of a delayed set-point; `stiffness`, `rest`: a spring. Of joints whose axles
    are coupled, `armature`, `damping` and `frictionloss` are those of their own axle.
    """

    name: str
    prismatic: bool
    lower: float
    upper: float
    velocity: float | None
    armature: float
    damping: float
    frictionloss: float
    stiffness: float
    rest: float
    inertia: float
    kp: float | None = None
    kv: float | None = None
    effort: float | None = None
    force: tuple[float, float] | None = None
    asked: tuple[float, float] | None = None
    delay: float = 0.0
    interpolation: str = "linear"
    offset: float = 0.0
    closes: str = ""
    solver: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class LeftEffect:
    """An effect that no number of the joints says, and what stays of the gap without it.

    `forces`: the same as passive forces at its one joint, as far as these can say it, and `misses`: the share of its
    torque that they do not have, from 0 to 1.
    """

    effect: str
    joints: tuple[str, ...]
    leaves: str
    forces: PassiveForces | None = None
    misses: float = 0.0


@dataclass(frozen=True)
class NumberRange:
    """A number's value and 90 % interval: `of` is "joint NAME" or "link NAME", as the exported files call them."""

    of: str
    parameter: str
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class ArmNumbers:
    """An arm: joints base to tip, bodies as URDF and MJCF text, ranges, effects left out, its file's step [s] and
    integrator."""

    name: str
    source: str
    joints: tuple[JointNumbers, ...]
    urdf: str
    mjcf: str
    ranges: tuple[NumberRange, ...]
    left: tuple[LeftEffect, ...]
    notes: tuple[str, ...]
    step: float | None = None
    integrator: str | None = None

    def table(self, key: str) -> dict[str, Any]:
        """One number of every joint by the joint's name."""
        return {joint.name: getattr(joint, key) for joint in self.joints}


def numbers_of_file(path: Path, joints: Sequence[str] = ()) -> ArmNumbers:
    """The numbers of a model file, an MJCF or a URDF; of a corrected one also what is written next to it.

    `joints` are those of the arm in a simulator's file; without them, the longest chain.

    Raises:
        InputError: a file that cannot be read or used.
        RejectedError: no bodies that could exist have these numbers.
    """
    if not is_simulator(path):
        return _of_model(IdentifiedModel.load(path), path, None, (), (), None)
    names = tuple(joints) or load_arm(path).joint_names
    simulator = load_simulator(path, None, names, {name: name for name in names})
    servos = simulator.arm.servos if isinstance(simulator.arm.servos, PositionServos) else None
    changes, ranges = path.with_name(f"{path.stem}.changes.json"), path.with_name(f"{path.stem}.ranges.yaml")
    left_effects = tuple(_of_changes(changes, simulator.model)) if changes.is_file() else ()
    closes = _offset_reasons(changes) if changes.is_file() else {}
    exported_ranges = tuple(_as_exported(_of_ranges(ranges), simulator.arm)) if ranges.is_file() else ()
    numbers = _of_model(simulator.model, path, servos, left_effects, exported_ranges, simulator.arm.step)
    notes = [*simulator.notes, *numbers.notes]
    if servos is None and not simulator.arm.is_urdf:
        notes.append(f"no servos are in the files: {simulator.arm.servos}")
    notes += [
        f"{joint.name}: its force goes from {joint.force[0]:.4g} to {joint.force[1]:.4g}; where a file has one limit, "
        f"it is {joint.effort:.4g}"
        for joint in numbers.joints
        if joint.force is not None and joint.force[0] != -joint.force[1]
    ]
    solvers = simulator.arm.solver or [dict[str, str]()] * len(numbers.joints)
    whole = tuple(
        replace(joint, closes=closes.get(joint.name, ""), solver=solver)
        for joint, solver in zip(numbers.joints, solvers, strict=True)
    )
    return replace(numbers, joints=whole, notes=tuple(notes), integrator=simulator.arm.integrator)


def _of_changes(path: Path, model: IdentifiedModel) -> Iterator[LeftEffect]:
    try:
        for entry in read_json(path)["effects"]:
            reason = entry.get("reason") or "its part of the gap stays"
            effect = ModelEffect(entry["effect"], tuple(entry["joints"]), entry["parameters"])
            yield _left_effect(model, effect, f"{reason}, which stays")
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(_NOT_OURS.format(path)) from None


def _offset_reasons(path: Path) -> dict[str, str]:
    """Why servos of joints stand off their set-points, by joint."""
    try:
        entries = [entry for entry in read_json(path).get("changes", ()) if entry["attribute"] == FileNumbers.OFFSET]
        return {entry["element"].removeprefix("actuator of "): str(entry["reason"]) for entry in entries}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(_NOT_OURS.format(path)) from None


def _of_ranges(path: Path) -> Iterator[NumberRange]:
    """Each line is a list item with a JSON object, as `ranges_text` writes it."""
    keys = ("of", "parameter", "value", "low", "high")
    try:
        for line in read_text(path, LARGEST_JSON).splitlines():
            if line.strip().startswith("- {"):
                row = json.loads(line.strip()[2:])
                yield NumberRange(*(row[key] for key in keys))
    except (ValueError, KeyError):
        raise InputError(_NOT_OURS.format(path)) from None


def _as_exported(ranges: Iterable[NumberRange], arm: SimulatedArm) -> Iterator[NumberRange]:
    """Ranges of bodies as those of the links that they are part of in the exported files."""
    links = ParameterLayout.of(arm.robot).blocks(Dynamics(arm.robot).standard_parameters())
    for number in ranges:
        kind, _, owner = number.of.partition(" ")
        k = next((k for k, body in enumerate(arm.carrying) if kind in ("body", "link") and body.name == owner), None)
        if k is None:
            yield number
        else:
            other_mass = float(links[k][0]) - number.value
            name = f"link {moved_links(arm.robot)[k]}"
            yield NumberRange(
                name, number.parameter, other_mass + number.value, other_mass + number.low, other_mass + number.high
            )


def _of_model(
    model: IdentifiedModel,
    path: Path,
    servos: PositionServos | None,
    left_effects: Sequence[LeftEffect],
    ranges: Sequence[NumberRange],
    step: float | None,
) -> ArmNumbers:
    numbers = in_numbers(model)
    model, far = possible_model(numbers.model)
    numbers, robot = replace(numbers, model=model), model.robot
    standard, lines = full_parameters(model), friction_lines(model)
    rotors = standard[ParameterLayout.of(robot).rotors]
    bodies = model.rigid.dynamics
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    postures = np.random.default_rng(0).uniform(low, high, (_POSTURES, robot.dof))
    turned = np.diag(rotor_mass_matrix(robot, rotors)) + np.min(
        [np.diag(bodies.mass_matrix(q)) for q in postures], axis=0
    )
    delay = getattr(servos, "delay", np.zeros(robot.dof))
    joints = tuple(
        JointNumbers(
            joint.name,
            joint.prismatic,
            joint.lower,
            joint.upper,
            None if joint.max_velocity == USUAL_SPEED else joint.max_velocity,
            float(joint.gear_ratio**2 * rotors[k]),
            float(lines[k, 0]),
            float(lines[k, 1]),
            float(numbers.stiffness[k]),
            float(numbers.rest[k]),
            float(turned[k]),
            None if servos is None else float(servos.stiffness[k]),
            None if servos is None else float(servos.damping[k]),
            _effort(servos, k, joint.max_torque),
            _limits(servos, "low", "high", k),
            _limits(servos, "least", "most", k),
            0.0 if servos is None else float(delay[k]),
            _INTERPOLATIONS[servos.interpolations[k]] if servos is not None and delay[k] > 0 else "linear",
            0.0 if servos is None else float(servos.offset[k]),
        )
        for k, joint in enumerate(robot.joints)
    )
    own = [_left_effect(model, entry, f"{torque_text(model, entry)} stays out") for entry in model.effects]
    more = [f"not in the files: {text}" for text in left_out(model, lines) if text.startswith("what friction")]
    if np.any(robot.coupling - np.diag(np.diag(robot.coupling))):
        more.append("axles are coupled: numbers of a joint are those of its own axle; the MJCF has tendons for them")
    more += assumed(model)
    urdf, mjcf = body_texts(numbers, standard, lines)
    notes = (*filter(None, [numbers.note, far]), *more)
    return ArmNumbers(robot.name, path.name, joints, urdf, mjcf, tuple(ranges), (*own, *left_effects), notes, step)


def _left_effect(model: IdentifiedModel, entry: ModelEffect, leaves: str) -> LeftEffect:
    """An effect, with the passive forces that say it where it is one of a single uncoupled joint's motion."""
    robot, effect = model.robot, CATALOGUE.get(entry.effect)
    if effect is None or not effect.moves_arm or len(entry.joints) != 1 or entry.joints[0] not in robot.joint_names:
        return LeftEffect(entry.effect, entry.joints, leaves)
    k = robot.joint_names.index(entry.joints[0])
    forces = effect.passive_forces(entry.parameters, robot.joints[k].max_velocity)
    if forces is None or np.count_nonzero(robot.coupling[k]) + np.count_nonzero(robot.coupling[:, k]) > 2:
        return LeftEffect(entry.effect, entry.joints, leaves)
    time, q, qd, qdd = usual_motion(robot)
    torque = effect_torque(model, entry, {"time": time, "q": q, "qd": qd, "qdd": qdd})
    missing = torque.copy()
    missing[:, k] -= forces.torque(q[:, k], qd[:, k], float(friction_lines(model)[k, 1]))
    turning = np.abs(qd[:, k]) < 1e-9 * np.abs(qd[:, k]).max()  # round-off says in which direction
    torque, missing = torque[~turning], missing[~turning]
    misses = float(np.sum(missing**2) / np.sum(torque**2)) ** 0.5
    return LeftEffect(entry.effect, entry.joints, leaves, *((forces, misses) if misses < 1 else ()))


def _limits(servos: PositionServos | None, low: str, high: str, k: int) -> tuple[float, float] | None:
    """Two limits of a joint's servo; None where neither is finite."""
    ends = (-np.inf, np.inf) if servos is None else (float(getattr(servos, low)[k]), float(getattr(servos, high)[k]))
    return ends if np.any(np.isfinite(ends)) else None


def _effort(servos: PositionServos | None, k: int, known: float | None) -> float | None:
    """Largest torque of a joint's servo, or of its drive; None where there is no limit."""
    most = np.inf if servos is None else float(min(servos.high[k], -servos.low[k]))
    most = min(most, np.inf if known is None else known)
    return float(most) if np.isfinite(most) else None
