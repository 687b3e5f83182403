"""Effects that are numbers of a simulator: bodies, friction, gravity, a joint's zero, a linear spring.

`in_numbers` turns those of a model into its numbers, so that every export has them; `left_out` says what remains.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from agent.model import (
    CATALOGUE,
    IdentifiedModel,
    ModelEffect,
    Reversal,
    across,
    ball,
    effect_torque,
    full_parameters,
    is_body,
    possible_model,
)
from agent.robot import LINK_PARAMETERS, ParameterLayout, RobotDescription, rigid_bodies
from agent.simulators.urdf import move_zero

_LEVELS = {"coulomb": "coulomb_change", "viscous": "viscous_change"}
_SECONDS, _RATE = 20.0, 100.0  # of the motion that says how large a torque is
_ROUND_OFF = 1e-6  # of the friction, from where on a difference is not that of digits


def load_block(entry: ModelEffect) -> np.ndarray:
    """(10,) inertial parameters of a payload effect in the last link's frame."""
    values = entry.parameters
    added = np.array([values[name] for name in CATALOGUE["payload"].names(values)])
    return np.asarray(ball(values) @ added if "m0" in values else added)


def added_body(entry: ModelEffect, n: int) -> tuple[int, np.ndarray] | None:
    """The link, from 0, that a payload or a mismatch changes, and by how much (10,); None for other effects."""
    values = entry.parameters
    if entry.effect == "payload":
        return n - 1, load_block(entry)
    if entry.effect == "inertial_mismatch":
        link = int(values["link"])
        return link - 1, np.array([values[f"{name}{link}"] for name in LINK_PARAMETERS])
    return None


def tilted(robot: RobotDescription, values: Mapping[str, float]) -> RobotDescription:
    """The robot with gravity that is tilted by a `base_tilt`."""
    gravity = np.array(robot.gravity)
    first, second = across(gravity)
    turned = gravity + np.linalg.norm(gravity) * (values["tilt_1"] * first + values["tilt_2"] * second)
    x, y, z = map(float, turned)
    return replace(robot, gravity=(x, y, z))


def with_zero(robot: RobotDescription, joint: int, offset: float) -> RobotDescription:
    """The robot with the zero of one joint `offset` [rad or m] lower."""
    root = ElementTree.fromstring(robot.urdf)
    move_zero(next(e for e in root.findall("joint") if e.get("name") == robot.joint_names[joint]), offset)
    return replace(robot, urdf=ElementTree.tostring(root, encoding="unicode"))


def linear_spring(stiffness: float, rest: float, values: Mapping[str, float]) -> tuple[float, float] | None:
    """Stiffness and rest position of a joint with a linear spring added; None for another form, or one that pushes."""
    if set(values) != {"constant", "stiffness"}:
        return None
    total = float(stiffness + values["stiffness"])
    return (total, float(stiffness * rest - values["constant"]) / total) if total > 0 else None


@dataclass(frozen=True, eq=False)
class NumbersOfModel:
    """A model whose numbers have the effects that numbers can say.

    `stiffness` [N·m/rad] and `rest` [rad] (n,) of springs at the joints, which not every format has; `springs` are the
    effects that these say; `model` has the other effects, and none of those that are its numbers now; `note`: how far
    bodies had to move to be possible, or empty.
    """

    model: IdentifiedModel
    stiffness: np.ndarray
    rest: np.ndarray
    springs: tuple[ModelEffect, ...]
    note: str


def in_numbers(model: IdentifiedModel) -> NumbersOfModel:
    """The model with its effects turned into numbers as far as these can say them."""
    robot, layout, b, n = model.robot, ParameterLayout.of(model.robot), len(model.independent), model.robot.dof
    values = model.values.copy()
    left: list[ModelEffect] = []
    springs: list[ModelEffect] = []
    standard = None if model.standard is None else model.standard.copy()
    stiffness, rest = np.zeros(n), np.zeros(n)
    for entry in model.effects:
        joints = [robot.joint_names.index(name) for name in entry.joints]
        if (body := added_body(entry, n)) is not None:
            link, block = body
            values[:b] += model.projection[:, layout.link(link)] @ block
            if standard is not None:
                standard[layout.link(link)] += block
        elif entry.effect == "friction_change" and (terms := _levels(model, joints[0], entry)) is not None:
            for k, change in terms.items():
                values[b + k] += change
            left += own_reversal(entry)
        elif entry.effect == "base_tilt":
            robot = tilted(robot, entry.parameters)
        elif entry.effect == "encoder_offset":
            robot = with_zero(robot, joints[0], entry.parameters["offset"])
        elif entry.effect == "gravity_spring" and (
            spring := linear_spring(stiffness[joints[0]], rest[joints[0]], entry.parameters)
        ):
            stiffness[joints[0]], rest[joints[0]] = spring
            springs.append(entry)
        else:
            left.append(entry)
    note = ""
    if not np.array_equal(values, model.values):
        if standard is not None and not all(map(is_body, layout.blocks(standard))):
            standard = None
        model, note = possible_model(replace(model, values=values, standard=standard))
    if robot is not model.robot:  # other base parameters act in other gravity and at other zeros
        standard, rigid = full_parameters(model), rigid_bodies(robot)
        count = len(rigid.independent)
        model = replace(
            model,
            robot=robot,
            independent=rigid.independent,
            projection=rigid.projection,
            combinations=rigid.combinations,
            values=np.append(rigid.projection @ standard, model.friction_values),
            covariance=np.zeros((count + len(model.terms),) * 2),
            standard=standard,
        )
    return NumbersOfModel(replace(model, effects=tuple(left)), stiffness, rest, tuple(springs), note)


def _levels(model: IdentifiedModel, axle: int, entry: ModelEffect) -> dict[int, float] | None:
    """Friction term → change of its level; None where the model has no term for one."""
    terms = {term.form: k for k, term in enumerate(model.terms) if term.axle == axle}
    changes = {form: entry.parameters[key] for form, key in _LEVELS.items() if key in entry.parameters}
    return {terms[form]: change for form, change in changes.items()} if set(changes) <= set(terms) else None


def own_reversal(entry: ModelEffect) -> tuple[ModelEffect, ...]:
    """What a friction that reverses over a travel of its own has beyond its levels: a presliding, or nothing."""
    if "reversal_travel" not in entry.parameters:
        return ()
    travel, level = (entry.parameters[f"reversal_{key}"] for key in ("travel", "level"))
    return (reversal_over(entry.joints, travel, level),)


def reversal_over(joints: tuple[str, ...], travel: float, level: float) -> ModelEffect:
    """A friction `level` [N·m] that reverses over a `travel` [rad], beyond the one that changes sign at once."""
    return ModelEffect("presliding", joints, {"travel": travel, "level": level})


def left_out(model: IdentifiedModel, friction: np.ndarray) -> Iterator[str]:
    """What numbers do not say of a model, and its torque on joints that turn to and fro over their range.

    `friction` (n, 2): damping and Coulomb level of each axle as they are written.
    """
    _, q, qd, qdd = usual_motion(model.robot)
    for entry in model.effects:
        place = f" of {', '.join(entry.joints)}" if entry.joints else ""
        of = "" if CATALOGUE[entry.effect].moves_arm else ", of what the robot measures, not of how it moves"
        yield f"{entry.effect}{place} ({torque_text(model, entry)}{of})"
    speed = qd @ model.robot.coupling.T
    line = (friction[:, 0] * speed + friction[:, 1] * np.sign(speed)) @ model.robot.coupling
    sharp = tuple(term if term.reversal is None else replace(term, reversal=Reversal()) for term in model.terms)
    curve = replace(model, terms=sharp).rigid_and_friction(q, qd, qdd)[1] - line
    if np.any(np.abs(curve).max(axis=0) > _ROUND_OFF * np.maximum(np.abs(line).max(axis=0), 1e-12)):
        yield f"what friction differs by from the line of damping and Coulomb level ({_most(model.robot, curve)})"


def torque_text(model: IdentifiedModel, entry: ModelEffect) -> str:
    """The largest torque of an effect on that motion, and on which joint."""
    time, q, qd, qdd = usual_motion(model.robot)
    return _most(model.robot, effect_torque(model, entry, {"time": time, "q": q, "qd": qd, "qdd": qdd}))


def _most(robot: RobotDescription, torque: np.ndarray) -> str:
    largest = np.abs(torque).max(axis=0)
    k = int(np.argmax(largest))
    return f"up to {largest[k]:.3g} {'N' if robot.joints[k].prismatic else 'N·m'} on {robot.joint_names[k]}"


def usual_motion(robot: RobotDescription) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time (S,) and q, qd, qdd (S, n) of sines over each joint's range, at the highest speed that its limits allow."""
    time = np.arange(0.0, _SECONDS, 1 / _RATE)
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    size = np.maximum(0.5 * (high - low), 1e-6)
    turn = np.minimum(robot.max_velocity / size, np.sqrt(robot.max_acceleration / size))
    angle = np.outer(time, turn) + np.arange(robot.dof)
    q = 0.5 * (low + high) + size * np.sin(angle)
    return time, q, size * turn * np.cos(angle), -size * turn**2 * np.sin(angle)
