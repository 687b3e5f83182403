"""One individual machine: what is true of it, drawn from a seed around the description's nominal values."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from agent.core import InputError
from agent.robot import Dynamics, RobotDescription
from fake_controller.actuation.friction import FrictionCurve, FrictionModifier

#: Temperature [°C] at which the friction curves of a machine hold.
AMBIENT = 25.0
#: Coulomb levels of built-in robots, N·m on the axles. UR5e: breakaway and friction at 3.2 rad/s of one arm near 45 °C
#: (aurt, robot_calibration_summary.txt); the others by the size of their joints, in proportion to the largest torque.
COULOMB = {
    "comau_ns16": (68.0, 108.8, 50.4, 7.17, 12.8, 8.08),
    "ur3e": (2.1, 2.1, 1.3, 0.45, 0.45, 0.45),
    "ur5e": (5.6, 5.6, 5.6, 1.3, 1.3, 1.3),
    "ur10e": (12.5, 12.5, 5.6, 2.1, 2.1, 2.1),
}
#: Viscous friction at top speed, over the Coulomb level: between these.
_VISCOUS = {"ur3e": (1.8, 2.6), "ur5e": (1.8, 2.6), "ur10e": (1.8, 2.6)}

#: kg/m of a link of an arm that reaches 1 m.
_WEIGHT = 60.0
_ROUND_OFF = 1e-9  # of the largest eigenvalue of a mass matrix


class Load(Protocol):
    """A torque on a motor shaft or a joint that is neither friction nor gear: a ripple, a spring, a hose."""

    def torque(self, position: float, velocity: float, dt: float) -> float:
        """[N·m] at a position and velocity; advances its states by `dt`."""


class Gear(Protocol):
    """A gear that gives way. `stiffness` [N·m/rad] and `damping` [N·m·s/rad] where it is stiffest."""

    @property
    def stiffness(self) -> float: ...
    @property
    def damping(self) -> float: ...

    def torque(self, twist: float, twist_rate: float) -> float:
        """[N·m] on the load side, for the motor's lead over the axle [rad] and its rate."""

    def twist(self, torque: float) -> float:
        """Static lead [rad] under a torque."""


#: Time [s] → force (3,) [N] on the flange, in the base frame.
Contact = Callable[[float], np.ndarray]

#: Set-points (S, n) at a period [s] to the ones that are really executed; their number may change.
PathChange = Callable[[np.ndarray, float], np.ndarray]


@dataclass
class Machine:
    """The truth about one robot, which effects alter before the plant is built.

    `robot` is the description everybody has; `coupling` (n, n), `gravity` (3,) and `parameters` (10 n,) standard
    inertial, `rotor_inertias` (n,) [kg·m², motor side] are this machine's own. Per axle: `friction`, `terms` that
    alter it, `gears` that give way, `motor_loads` on the shafts; `joint_loads` sit on the joints instead.
    Of measurement: `torque_scale` (n,), `torque_offset` (n,) [N·m, axle side], `encoder_offset` (n,) [rad], and by how
    much the torque is late behind the position, `torque_delay` [s]. `nominal` (n,) [N·m] is the axles' nominal torque,
    `limit` (n,) the largest, `typical_inertia` (n,) [kg·m²] what a technician tunes the servos for.
    """

    robot: RobotDescription
    parameters: np.ndarray
    rotor_inertias: np.ndarray
    gravity: np.ndarray
    coupling: np.ndarray
    friction: list[FrictionCurve]
    nominal: np.ndarray
    limit: np.ndarray
    typical_inertia: np.ndarray
    terms: defaultdict[int, list[FrictionModifier]] = field(default_factory=lambda: defaultdict(list))
    gears: dict[int, Gear] = field(default_factory=dict)
    motor_loads: defaultdict[int, list[Load]] = field(default_factory=lambda: defaultdict(list))
    joint_loads: defaultdict[int, list[Load]] = field(default_factory=lambda: defaultdict(list))
    contacts: list[Contact] = field(default_factory=list)
    path_changes: list[PathChange] = field(default_factory=list)
    torque_scale: np.ndarray = field(init=False)
    torque_offset: np.ndarray = field(init=False)
    encoder_offset: np.ndarray = field(init=False)
    torque_delay: float = 0.0

    def __post_init__(self) -> None:
        n = self.robot.dof
        self.torque_scale, self.torque_offset, self.encoder_offset = np.ones(n), np.zeros(n), np.zeros(n)

    @property
    def temperatures(self) -> tuple[float, ...]:
        """(n,) of the drives [°C] as they are now, or none where nothing warms up."""
        warm = ((k, term.temperature) for k, terms in self.terms.items() for term in terms)
        known = {k: temperature for k, temperature in warm if temperature is not None}
        return tuple(AMBIENT + known.get(k, 0.0) for k in range(self.robot.dof)) if known else ()

    @property
    def reflected_rotors(self) -> np.ndarray:
        """(n,) rotor inertias on the axles [kg·m²]."""
        return self.robot.gear_ratios**2 * self.rotor_inertias

    def dynamics(self) -> Dynamics:
        """Rigid bodies of this machine."""
        gravity = (float(self.gravity[0]), float(self.gravity[1]), float(self.gravity[2]))
        coupling = tuple(tuple(float(value) for value in row) for row in self.coupling)
        return Dynamics(replace(self.robot, gravity=gravity, motor_coupling=coupling)).with_parameters(self.parameters)


def draw_machine(robot: RobotDescription, seed: int) -> Machine:
    """A machine of this type: links, rotors and friction scatter around the description by 10 to 15 %.

    Raises:
        InputError: a link with a negative mass.
    """
    nominal_links = nominal_parameters(robot)
    if np.any(nominal_links[::10] < 0):
        joint = robot.joint_names[int(np.argmin(nominal_links[::10]))]
        raise InputError(
            f"{robot.name}: the link that {joint} moves has a mass of {nominal_links[::10].min():.4g} kg; "
            "no machine can have that: correct it in the robot's URDF"
        )
    inertia, load = _typical(robot, nominal_links)
    rng = [np.random.default_rng([seed, part]) for part in range(3)]
    # Without a nominal torque: what full acceleration takes. Without a rotor: three tenths of that torque turn it.
    accelerating = load + inertia * robot.max_acceleration
    drive = np.where(np.isnan(robot.nominal_torque), accelerating, robot.nominal_torque)
    usual = 0.3 * drive / robot.max_acceleration / robot.gear_ratios**2
    prior = np.array(
        [u if j.rotor_inertia is None else j.rotor_inertia for u, j in zip(usual, robot.joints, strict=True)]
    )
    rotors = prior * rng[0].uniform(0.9, 1.1, robot.dof)
    reflected = robot.gear_ratios**2 * rotors
    with_rotors = accelerating + reflected * robot.max_acceleration
    nominal = np.where(np.isnan(robot.nominal_torque), with_rotors, robot.nominal_torque)
    limit = np.array(
        [4.0 * nominal[k] if joint.max_torque is None else joint.max_torque for k, joint in enumerate(robot.joints)]
    )
    links = [_scatter_link(block, rng[1]) for block in nominal_links.reshape(-1, 10)]
    return Machine(
        robot=robot,
        parameters=np.concatenate(links),
        rotor_inertias=rotors,
        gravity=np.array(robot.gravity),
        coupling=robot.coupling,
        friction=_draw_friction(robot, nominal, reflected + 0.1 * inertia, rng[2]),
        nominal=nominal,
        limit=limit,
        typical_inertia=inertia + reflected,
    )


def check_bodies(machine: Machine) -> None:
    """Refuse bodies that cannot exist: with them the arm gains energy by moving faster, and no number stays finite.

    Raises:
        InputError: the kinetic energy of some motion is negative; names the pose and the joint that moves most in it.
    """
    dynamics, robot = machine.dynamics(), machine.robot
    rotors = machine.coupling.T @ np.diag(machine.reflected_rotors) @ machine.coupling
    for q in poses(robot, 64):
        matrix = dynamics.mass_matrix(q) + rotors
        values, vectors = np.linalg.eigh(matrix)
        if values[0] < -_ROUND_OFF * values[-1]:
            joint = robot.joint_names[int(np.argmax(np.abs(vectors[:, 0])))]
            raise InputError(
                f"{robot.name}: the bodies of this machine cannot exist: at joint positions {np.round(q, 2).tolist()} "
                f"a motion of {joint} has a negative kinetic energy. Correct the inertias in the robot's URDF, or "
                "estimate the model with --method consistent"
            )


def poses(robot: RobotDescription, count: int) -> np.ndarray:
    """(count, n) joint positions over the workspace, one turn at most; always the same ones."""
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    return np.random.default_rng(0).uniform(lower, upper, (count, robot.dof))


def weighs_nothing(robot: RobotDescription) -> bool:
    """The description gives no link a mass."""
    return not Dynamics(robot).standard_parameters()[::10].any()


def nominal_parameters(robot: RobotDescription) -> np.ndarray:
    """(10n,) standard parameters of the description's links; rods where none of them weighs anything.

    Many public descriptions are kinematics alone. Their arm gets `_WEIGHT` reach^1.5 a metre of link (0.6 m with 20 kg
    and 1.6 m with 250 kg lie near that), to half of it at the tip, in rods whose radius is a tenth of the mean link.
    """
    dynamics = Dynamics(robot)
    if not weighs_nothing(robot):
        return dynamics.standard_parameters()
    ends = dynamics.link_ends()
    lengths = np.linalg.norm(ends, axis=1)
    radius = max(0.1 * lengths.mean(), 0.01)
    weight = _WEIGHT * max(lengths[1:].sum(), 0.1) ** 1.5 * np.linspace(1.0, 0.5, robot.dof)
    rods = []
    for end, length, per_metre in zip(ends, lengths, weight, strict=True):
        mass = per_metre * max(length, 2.0 * radius)
        about_end = mass / 3.0 * (end @ end * np.eye(3) - np.outer(end, end)) + 0.4 * mass * radius**2 * np.eye(3)
        xx, xy, yy, xz, yz, zz = about_end[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
        rods.append([mass, *(0.5 * mass * end), xx, xy, yy, xz, yz, zz])
    return np.concatenate(rods)


def _typical(robot: RobotDescription, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) inertia that an axle sees [kg·m²] and (n,) torque it carries [N·m] without rotors, over the workspace."""
    dynamics = Dynamics(robot).with_parameters(parameters)
    q = poses(robot, 64)
    qdd = np.random.default_rng(1).choice([-1.0, 1.0], q.shape) * robot.max_acceleration
    to_axles = np.linalg.inv(robot.coupling)
    matrices = np.array([to_axles.T @ dynamics.mass_matrix(row) @ to_axles for row in q])
    load = np.abs(dynamics.inverse_dynamics(q, np.zeros_like(q), qdd) @ to_axles)
    inertia = matrices.diagonal(axis1=1, axis2=2).mean(axis=0)
    # A description whose last link weighs nothing still has a shaft.
    return np.maximum(inertia, 1e-3 * inertia.max() + 1e-9), np.quantile(load, 0.9, axis=0)


def _scatter_link(parameters: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(10,) standard parameters of the body after a random affine change of its mass distribution.

    The pseudo-inertia matrix P (4, 4) of the body x → A x + b with s times the density is s T P Tᵀ, T = [[A, b],
    [0, 1]] (Wensing, Kim, Slotine, RA-L 2018): positive definite if P was, so what is drawn is a body.
    """
    m, mx, my, mz, xx, xy, yy, xz, yz, zz = parameters
    rotational = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    pseudo = np.zeros((4, 4))
    pseudo[:3, :3] = 0.5 * np.trace(rotational) * np.eye(3) - rotational
    pseudo[:3, 3] = pseudo[3, :3] = mx, my, mz
    pseudo[3, 3] = m
    size = np.sqrt(max(np.trace(rotational), 0.0) / (2.0 * m)) if m > 0 else 0.0
    change = np.eye(4)
    change[:3, :3] += rng.uniform(-0.06, 0.06, (3, 3))
    change[:3, 3] = 0.08 * size * rng.uniform(-1.0, 1.0, 3)
    pseudo = rng.uniform(0.87, 1.13) * change @ pseudo @ change.T
    second = pseudo[:3, :3]
    inertia = np.trace(second) * np.eye(3) - second
    return np.array([pseudo[3, 3], *pseudo[:3, 3], *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def _draw_friction(
    robot: RobotDescription, nominal: np.ndarray, inertia: np.ndarray, rng: np.random.Generator
) -> list[FrictionCurve]:
    """Levels from the built-in table, else 10 to 20 % of nominal; speeds scale with the axle's largest."""
    curves = []
    for k, joint in enumerate(robot.joints):
        table = COULOMB.get(robot.name)
        usual = rng.uniform(0.1, 0.2) * nominal[k]
        coulomb = (usual if table is None else table[k]) * rng.uniform(0.85, 1.15)
        rise = coulomb * rng.uniform(0.08, 0.16)
        fastest = joint.max_velocity
        viscous = rng.uniform(*_VISCOUS.get(robot.name, (0.3, 0.6))) * coulomb / fastest
        # Bristles give way over a few milliradians of the motor shaft, never so stiffly that the steps cannot follow.
        presliding = min(rng.uniform(3e-3, 6e-3) / abs(joint.gear_ratio), 1e-4 * fastest)
        stiffness = min(coulomb / presliding, inertia[k] * 700.0**2)
        speed = rng.uniform(0.008, 0.014) * min(1.0, fastest / 2.0)
        curves.append(FrictionCurve(coulomb, rise, speed, viscous, fastest * rng.uniform(3.0, 6.0), stiffness))
    return curves
