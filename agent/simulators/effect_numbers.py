"""Effects that are numbers of a simulator: bodies, friction, gravity, a joint's zero, a linear spring.

`in_numbers` turns those of a model into its numbers, so that every export has them; `left_out` says what remains.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.model import (
    CATALOGUE,
    IdentifiedModel,
    ModelEffect,
    Reversal,
    SimulatorNumbers,
    across,
    effect_torque,
    full_parameters,
    is_body,
    possible_model,
)
from agent.robot import ParameterLayout, RobotDescription, rigid_bodies
from agent.simulators.urdf import move_zero

_SECONDS, _RATE = 20.0, 100.0  # of the motion that says how large a torque is
_ROUND_OFF = 1e-6  # of the friction, from where on a difference is not that of digits


def tilted(robot: RobotDescription, tilt: tuple[float, float]) -> RobotDescription:
    """The robot with gravity turned by small angles [rad] about the directions across it."""
    gravity = np.array(robot.gravity)
    first, second = across(gravity)
    turned = gravity + np.linalg.norm(gravity) * (tilt[0] * first + tilt[1] * second)
    x, y, z = map(float, turned)
    return replace(robot, gravity=(x, y, z))


def with_zero(robot: RobotDescription, joint: int, offset: float) -> RobotDescription:
    """The robot with the zero of one joint `offset` [rad or m] lower."""
    root = ElementTree.fromstring(robot.urdf)
    move_zero(next(e for e in root.findall("joint") if e.get("name") == robot.joint_names[joint]), offset)
    return replace(robot, urdf=ElementTree.tostring(root, encoding="unicode"))


def with_spring(stiffness: float, spring_rest: float, added: tuple[float, float]) -> tuple[float, float] | None:
    """Stiffness and rest position of a joint with a spring (constant, stiffness) added; None for one that pushes."""
    total = float(stiffness + added[1])
    return (total, float(stiffness * spring_rest - added[0]) / total) if total > 0 else None


def further(entry: ModelEffect, numbers: SimulatorNumbers) -> list[ModelEffect]:
    """The effects for what numbers do not say of an effect."""
    return [ModelEffect(name, entry.joints, dict(values)) for name, values in numbers.beyond.items()]


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
    remaining: list[ModelEffect] = []
    springs: list[ModelEffect] = []
    standard = None if model.standard is None else model.standard.copy()
    stiffness, spring_rest = np.zeros(n), np.zeros(n)
    for entry in model.effects:
        joints = [robot.joint_names.index(name) for name in entry.joints]
        numbers = CATALOGUE[entry.effect].simulator_numbers(entry.parameters, robot.load_link)
        levels = None if numbers is None else _levels(model, joints, numbers)
        if numbers is None or levels is None:
            remaining.append(entry)
            continue
        if numbers.spring is not None:
            (springs if _add_spring(stiffness, spring_rest, joints[0], numbers.spring) else remaining).append(entry)
        if numbers.body is not None:
            link, block = numbers.body
            values[:b] += model.projection[:, layout.link(link)] @ block
            if standard is not None:
                standard[layout.link(link)] += block
        for k, change in levels.items():
            values[b + k] += change
        if numbers.tilt is not None:
            robot = tilted(robot, numbers.tilt)
        if numbers.zero is not None:
            robot = with_zero(robot, joints[0], numbers.zero)
        remaining += further(entry, numbers)
    note = ""
    if not np.array_equal(values, model.values):
        if standard is not None and not all(map(is_body, layout.blocks(standard))):
            standard = None
        model, note = possible_model(replace(model, values=values, standard=standard))
    if robot is not model.robot:
        model = _on(robot, model)
    return NumbersOfModel(replace(model, effects=tuple(remaining)), stiffness, spring_rest, tuple(springs), note)


def _add_spring(stiffness: np.ndarray, spring_rest: np.ndarray, joint: int, added: tuple[float, float]) -> bool:
    """Whether a joint could take the spring."""
    spring = with_spring(stiffness[joint], spring_rest[joint], added)
    if spring is not None:
        stiffness[joint], spring_rest[joint] = spring
    return spring is not None


def _on(robot: RobotDescription, model: IdentifiedModel) -> IdentifiedModel:
    """The model on an arm with other gravity or zeros: other base parameters act there."""
    standard, rigid = full_parameters(model), rigid_bodies(robot)
    count = len(rigid.independent)
    return replace(
        model,
        robot=robot,
        independent=rigid.independent,
        projection=rigid.projection,
        combinations=rigid.combinations,
        values=np.append(rigid.projection @ standard, model.friction_values),
        covariance=np.zeros((count + len(model.terms),) * 2),
        standard=standard,
    )


def _levels(model: IdentifiedModel, joints: Sequence[int], numbers: SimulatorNumbers) -> dict[int, float] | None:
    """Friction term → change of its level; None where the model has no term for one."""
    terms = {term.form: k for k, term in enumerate(model.terms) if term.axle in joints[:1]}
    if not set(numbers.friction) <= set(terms):
        return None
    return {terms[form]: change for form, change in numbers.friction.items()}


def reversal_over(joints: tuple[str, ...], travel: float, level: float) -> ModelEffect:
    """A friction `level` [N·m] that reverses over a `travel` [rad], beyond the one that changes sign at once.

    Args:
        joints: name of the joint.
        travel: over which friction reverses [rad].
        level: of friction [N·m].
    """
    return ModelEffect("presliding", joints, {"travel": travel, "level": level})


def left_out(model: IdentifiedModel, friction: np.ndarray) -> Iterator[str]:
    """What numbers do not say of a model, and its torque on joints that turn to and fro over their range.

    Friction counts at the speeds of the fit: beyond, the curve is no better known than the line.

    `friction` (n, 2): damping and Coulomb level of each axle as they are written.
    """
    _, q, qd, qdd = usual_motion(model.robot, model.fastest)
    for entry in model.effects:
        joints_text = f" of {', '.join(entry.joints)}" if entry.joints else ""
        of = "" if CATALOGUE[entry.effect].moves_arm else ", of what the robot measures, not of how it moves"
        yield f"{entry.effect}{joints_text} ({torque_text(model, entry)}{of})"
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


def usual_motion(
    robot: RobotDescription, fastest: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time (S,) and q, qd, qdd (S, n) of sines over each joint's range, at the highest speed that its limits allow.

    `fastest` (n,): lower limits of speed.
    """
    time = np.arange(0.0, _SECONDS, 1 / _RATE)
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    size = np.maximum(0.5 * (high - low), 1e-6)
    angular_frequency = np.minimum(
        (robot.max_velocity if fastest is None else fastest) / size, np.sqrt(robot.max_acceleration / size)
    )
    angle = np.outer(time, angular_frequency) + np.arange(robot.dof)
    q = 0.5 * (low + high) + size * np.sin(angle)
    return time, q, size * angular_frequency * np.cos(angle), -size * angular_frequency**2 * np.sin(angle)
