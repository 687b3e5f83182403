"""Base parameters: the fewest combinations of the standard parameters that determine the joint torques of an arm.

Found numerically (Gautier, J. Robotic Systems 8 (1991) 485): the regressor of random states, at full precision, has as
many independent columns as there are base parameters. Columns are taken from base to tip, within a link the inertia
about the joint's own axis first and the mass last; one that the earlier ones span is expressed by them and its
parameter joins theirs. So what a distal link shares with a proximal one is counted with the proximal one, as in
published tables, and a rotor's inertia joins the inertia of its link about the same axis where it can.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.robot.description import RobotDescription
from agent.robot.drivetrain import rotor_regressor
from agent.robot.kinematics.chain import joint_axes
from agent.robot.parameter_layout import LINK_PARAMETERS, ParameterLayout

#: A column of unit length is dependent when less than this is left of it. Of an independent one a quarter or more is
#: left on the arms tried, of a dependent one round-off, or 5e-6 where the URDF has pi with four digits.
DEPENDENT = 1e-4
#: A link's column this much shorter than the longest one is zero.
NEGLIGIBLE = 1e-5
_STATES = 60


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """The b base parameters of an arm with p standard ones: ten a link, then (with rotors) one rotor inertia a joint.

    independent (b,): the columns of the standard regressor that stay; projection (b, p): π_b = P π, Y π = Y_b π_b;
    names (b,): each as the text of its combination; standard_names (p,): "m1", "mx1", …, "Izz6", "J1", ….
    """

    independent: np.ndarray
    projection: np.ndarray
    names: tuple[str, ...]
    standard_names: tuple[str, ...]


def base_parameters(robot: RobotDescription, rotors: bool = True) -> BaseParameters:
    """Base parameters of an arm: of its links and, with `rotors`, of its rotor inertias [kg·m², motor side].

    They depend on geometry, gravity, gear ratios and motor coupling alone, not on the inertial parameters.
    """
    standard = _random_regressor(robot, rotors)
    layout = ParameterLayout.of(robot, rotors)
    names = layout.names
    scale = np.linalg.norm(standard, axis=0)
    # A rotor's column is never zero, and its gear ratio squared would hide those of links.
    idle = np.arange(len(scale)) < layout.links.stop
    idle &= scale < NEGLIGIBLE * scale[layout.links].max()
    standard[:, idle], scale[idle] = 0.0, 1.0
    independent, projection = _reduce(standard / scale, _preference(robot, layout))
    projection = _clean(projection * scale / scale[independent, None])
    texts = tuple(_combination(row, k, names) for row, k in zip(projection, independent, strict=True))
    return BaseParameters(independent, projection, texts, names)


def _random_regressor(robot: RobotDescription, rotors: bool) -> np.ndarray:
    from agent.robot.dynamics import Dynamics

    rng = np.random.default_rng(1)
    q = rng.uniform(-np.pi, np.pi, (_STATES, robot.dof))
    qd, qdd = rng.normal(scale=3.0, size=(2, _STATES, robot.dof))
    columns = Dynamics(robot).regressor(q, qd, qdd)
    if rotors:
        columns = np.concatenate([columns, rotor_regressor(robot, qdd)], axis=2)
    return columns.reshape(-1, columns.shape[2])


def _preference(robot: RobotDescription, layout: ParameterLayout) -> list[int]:
    """Order in which columns are offered: links from base to tip, then rotors."""
    order: list[int] = []
    for link, (axis, joint) in enumerate(zip(joint_axes(robot), robot.joints, strict=True)):
        about = ("Ixx", "Iyy", "Izz")[int(np.argmax(np.abs(axis)))]
        first = "m" if joint.prismatic else about
        others = [name for name in ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m") if name != first]
        order += [layout.link(link).start + LINK_PARAMETERS.index(name) for name in (first, *others)]
    return order + list(range(layout.rotors.start, layout.rotors.stop))


def _reduce(columns: np.ndarray, order: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Indices (b,) of independent unit columns taken in `order`, and all columns as combinations (b, p) of them."""
    basis = np.empty((0, len(columns)))
    independent: list[int] = []
    for k in order:
        remainder = columns[:, k]
        for _ in range(2):  # twice is enough for full precision
            remainder = remainder - basis.T @ (basis @ remainder)
        length = np.linalg.norm(remainder)
        if length > DEPENDENT:
            basis = np.vstack([basis, remainder / length])
            independent.append(k)
    combinations = np.linalg.solve(basis @ columns[:, independent], basis @ columns)
    combinations[np.abs(combinations) < 1e-10] = 0.0
    ascending = np.argsort(independent)
    return np.array(independent)[ascending], combinations[ascending]


def _clean(projection: np.ndarray) -> np.ndarray:
    """Replace what differs from a number of nine digits by round-off alone with that number."""
    cleaned = projection.copy()
    for index in zip(*np.nonzero(projection), strict=True):
        rounded = float(f"{projection[index]:.9g}")
        if abs(rounded - projection[index]) < 1e-11 * abs(rounded):
            cleaned[index] = rounded
    return cleaned


def _combination(row: np.ndarray, own: int, names: tuple[str, ...]) -> str:
    text = names[own]
    for k in np.flatnonzero(row):
        if k != own:
            size = f"{abs(row[k]):.5g}"
            text += (" - " if row[k] < 0 else " + ") + ("" if size == "1" else size + " ") + names[k]
    return text
