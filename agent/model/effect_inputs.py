"""Inputs of the forms of effects: one motion, and the reference model as separate physical parts."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from agent.core import symmetric_eigen
from agent.model.friction_terms import AxleMotion, Reversal, axle_columns
from agent.model.known_load import carrying
from agent.model.rigid_friction import RigidFrictionModel
from agent.model.standard_parameters import from_pseudo_inertia, link_scale, pseudo_inertia
from agent.robot import ParameterLayout, RobotDescription

if TYPE_CHECKING:
    from agent.robot import Dynamics, Tool

T = TypeVar("T")

_MASS_STEP = 10  # mass matrices change slowly: one in ten samples is computed


class NominalModel:
    """The model that is diagnosed against, with its base parameters spread over links and rotors.

    Base parameters β = P π fix only combinations of the standard parameters π. Of all π with P π = β the one nearest
    to the description's is taken, distances counted in the prior deviation D of each parameter:
    π = π₀ + D² Pᵀ (P D² Pᵀ)⁻¹ (β − P π₀).

    `payload`: a mass at the flange that somebody knows of; the model given is without it, `model` is with it.
    """

    def __init__(self, model: RigidFrictionModel, payload: Tool | None = None):
        from agent.robot import Dynamics

        self.payload = payload
        model = model if payload is None else carrying(model, payload)
        self.model, self.robot = model, model.robot
        nominal = Dynamics(self.robot)
        links = nominal.standard_parameters()
        mean, prior_std = _doubt(self.robot, nominal, links)
        spread = (model.projection * prior_std**2) @ model.projection.T
        difference = model.base_values - model.projection @ mean
        standard = mean + prior_std**2 * (model.projection.T @ np.linalg.solve(spread, difference))
        layout = ParameterLayout.of(self.robot)
        self.links: Dynamics = nominal.with_parameters(standard[layout.links])
        # a description without masses, or with invented ones, does not give their size; the model does
        if np.any(links):
            times = _times_further(difference, spread, model.covariance[: len(difference), : len(difference)])
        else:
            times = _liftable(self.links, nominal) / prior_std[0]
        self.prior_std = times * prior_std
        #: links whose mass matrix is sound: where the spread ones could not be bodies, those of the description, or,
        #: where that has none, the nearest bodies to the spread ones
        self.solid: Dynamics = self.links
        if not np.any(links):
            self.solid = nominal.with_parameters(_bodies(standard, layout, nominal.reach))
        elif not _sound(self.links, nominal):
            self.solid = nominal
        self.rotors = standard[layout.rotors]
        self.reach = nominal.reach
        self.coupling = self.robot.coupling
        self.from_joints = np.linalg.inv(self.coupling)
        self.reversals = tuple(self._reversal(axle) for axle in range(self.robot.dof))

    @property
    def scale(self) -> np.ndarray:
        """(n,) torque that makes figures of a joint comparable [N·m]: nominal, or what the model leaves, × 100."""
        typical = np.maximum(100 * self.model.held_out_rmse, 1e-9)  # a joint that its brake holds leaves nothing
        return np.where(np.isfinite(self.robot.nominal_torque), self.robot.nominal_torque, typical)

    def _reversal(self, axle: int) -> Reversal:
        for term in self.model.terms:
            if term.axle == axle and term.form == "coulomb" and term.reversal is not None:
                return term.reversal
        return self.sharp_reversal(axle)

    def sharp_reversal(self, axle: int) -> Reversal:
        """That of friction on an axle that changes its sign at once."""
        return Reversal("speed", 2e-3 * float(self.robot.max_velocity[axle]))


def _sound(links: Dynamics, nominal: Dynamics) -> bool:
    postures = np.random.default_rng(0).uniform(-1.5, 1.5, (8, nominal.dof))
    return all(np.all(np.diag(links.mass_matrix(q)) > 0.3 * np.diag(nominal.mass_matrix(q))) for q in postures)


def _bodies(standard: np.ndarray, layout: ParameterLayout, reach: float) -> np.ndarray:
    """(10 n,) links whose pseudo-inertias have no eigenvalue below a ten-thousandth of all links' together."""
    blocks = layout.blocks(standard)
    unit = np.array([0.1 * reach] * 3 + [1.0])  # a length, so that mass and inertia compare
    scaled = [pseudo_inertia(block) / np.outer(unit, unit) for block in blocks]
    least = 1e-4 * max(sum(float(np.abs(np.linalg.eigvalsh(part)).max()) for part in scaled), 1e-6)
    bodies = np.empty_like(blocks)
    for k, part in enumerate(scaled):
        values, vectors = np.linalg.eigh(part)
        bodies[k] = from_pseudo_inertia((vectors * np.maximum(values, least)) @ vectors.T * np.outer(unit, unit))
    return bodies.ravel()


def _liftable(links: Dynamics, nominal: Dynamics) -> float:
    """Mass at the tip that weighs as much as all links together [kg], at least 1 g."""
    poses = np.random.default_rng(0).uniform(-3, 3, (50, nominal.dof))
    weight = np.abs(links.inverse_dynamics(poses, np.zeros_like(poses), np.zeros_like(poses))).max()
    gravity = max(float(np.linalg.norm(links.robot.gravity)), 1.0)
    return max(float(weight) / gravity / nominal.reach, 1e-3)


def _doubt(robot: RobotDescription, nominal: Dynamics, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and prior deviation (10 n + n,) of the standard parameters: half a link, any rotor that the drive turns."""
    blocks = ParameterLayout.of(robot).blocks(links)
    scale = link_scale(blocks, 0.02 * max(blocks[:, 0].sum(), 1e-3), 0.1 * nominal.reach)
    matrix = nominal.mass_matrix(np.zeros(robot.dof))
    rotors = np.array([joint.rotor_inertia or 0.0 for joint in robot.joints])
    usual = np.maximum(np.diag(matrix), 1e-3 * np.diag(matrix).max() + 1e-9) / robot.gear_ratios**2
    return np.append(blocks.ravel(), rotors), np.append(0.5 * scale.ravel(), np.where(rotors > 0, 0.5 * rotors, usual))


def _times_further(difference: np.ndarray, spread: np.ndarray, covariance: np.ndarray) -> float:
    """Factor on the prior deviations by which a model finds its description wrong; at least 1.

    `difference` (b,): base parameters of the model less those of the description; `spread` (b, b): their covariance by
    the prior; `covariance` (b, b): that of the model, all in the base parameters' units. The s with most evidence for
    `difference` ~ N(0, s² spread + covariance) (MacKay, Neural Computation 4, 1992): about a tenth for a description
    that was measured, hundreds for links of ten grams that stand in for unknown ones.
    """

    def evidence(times: float) -> float:
        total = times**2 * spread + covariance
        unit = np.sqrt(np.diag(total))
        values, vectors = symmetric_eigen(total / np.outer(unit, unit))
        values = np.maximum(values, 1e-12)
        return float(
            -np.sum(np.log(values)) - 2 * np.sum(np.log(unit)) - np.sum((vectors.T @ (difference / unit)) ** 2 / values)
        )

    return max(np.geomspace(1.0, 1e4, 41), key=evidence)


@dataclass(frozen=True, eq=False)
class MotionSignals:
    """One motion without gaps. S samples, n joints: time (S,) [s] of the log, q, qd, qdd (S, n) smoothed.

    `log_index` counts logs (-1 where unknown), `cycle_starts` [s] are those of its log and `started` [s] is when that
    began, counted from the first log: all for effects that happen at some time. `low_pass` is the torque's filter, of
    whose samples it returns `kept`. Where positions are judged instead of torque, `position_response` says what they
    show of torque columns (S, K) by joint: (S', K) by joint. `through_play` says what they show, (S', K), of a joint
    whose servo reads its link, behind gears with stiffness, gap and damping ratio (K,).
    """

    reference: NominalModel
    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    log_index: int = -1
    kept: slice = field(default_factory=lambda: slice(None))
    cycle_starts: tuple[float, ...] = ()
    started: float = 0.0
    low_pass: Callable[[np.ndarray], np.ndarray] = np.asarray
    position_response: Callable[[Mapping[int, np.ndarray]], dict[int, np.ndarray]] | None = None
    through_play: Callable[[int, np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None
    memory: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    def remembered(self, key: Hashable, make: Callable[[], T]) -> T:
        """What `make` returns for a key, computed once for this motion."""
        if key not in self.memory:
            self.memory[key] = make()
        return cast(T, self.memory[key])

    def shown(self, joint: int, columns: np.ndarray) -> np.ndarray:
        """(S', K) what the recorded rows of a joint show of torque columns (S, K) on it."""
        if self.position_response is None:
            return self.low_pass(columns)
        return self.position_response({joint: columns})[joint]

    @cached_property
    def axles(self) -> AxleMotion:
        """Positions and speeds of the axles, and the load they carry."""
        return AxleMotion.of(self.reference.robot, self.q, self.qd, self.rigid)

    @cached_property
    def rigid(self) -> np.ndarray:
        """(S, n) joint torque of the model's base parameters."""
        model = self.reference.model
        return model.rigid.torque(self.q, self.qd, self.qdd, model.base_values)

    @cached_property
    def friction(self) -> np.ndarray:
        """(S, n) friction torque of the model, on the axles."""
        model = self.reference.model
        columns = axle_columns(model.terms, self.axles)
        values = model.friction_values
        torque = np.zeros(self.q.shape)
        for k, term in enumerate(model.terms):
            torque[:, term.axle] += columns[:, k] * values[k]
        return torque

    @cached_property
    def predicted(self) -> np.ndarray:
        """(S, n) joint torque of the model's bodies and friction."""
        return self.rigid + self.friction @ self.reference.coupling

    @cached_property
    def axle_torque(self) -> np.ndarray:
        """(S, n) the same on the axles: what the motors give, times the gear ratio."""
        return self.rigid @ self.reference.from_joints + self.friction

    def direction(self, axle: int) -> np.ndarray:
        """(S,) direction of sliding, as the model's friction reverses."""
        return self.axles.direction(axle, self.reference.reversals[axle])

    @cached_property
    def link_load(self) -> np.ndarray:
        """(S, n) joint torque of the links alone, without rotors."""
        return self.reference.links.inverse_dynamics(self.q, self.qd, self.qdd)

    @cached_property
    def link_slope(self) -> np.ndarray:
        """(S, n, n) what `link_load` changes by [N·m/rad] with the position of each joint (columns)."""
        return self.reference.links.torque_slope(self.q, self.qd, self.qdd)

    @cached_property
    def slow_slope(self) -> np.ndarray:
        """(S, n, n) `link_slope` next to servos' stiffness, computed on every tenth sample and straight in between."""
        return self._from_some(
            lambda rows: self.reference.links.torque_slope(self.q[rows], self.qd[rows], self.qdd[rows])
        )

    @cached_property
    def mass(self) -> np.ndarray:
        """(S, n, n) mass matrix of the links, computed on every tenth sample and straight in between."""
        return self._from_some(lambda rows: np.array([self.reference.solid.mass_matrix(q) for q in self.q[rows]]))

    def _from_some(self, matrices_at: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """(S, n, n) from those of every tenth sample."""
        rows = np.append(np.arange(0, len(self.q) - 1, _MASS_STEP), len(self.q) - 1)
        matrices, sample = matrices_at(rows), np.arange(len(self.q))
        first = np.minimum(sample // _MASS_STEP, len(rows) - 2)
        share = ((sample - rows[first]) / (rows[first + 1] - rows[first]))[:, None, None]
        return (1 - share) * matrices[first] + share * matrices[first + 1]

    def regressor(self) -> np.ndarray:
        """(S, n, 10 n) regressor of the links' standard parameters."""
        return self.reference.links.regressor(self.q, self.qd, self.qdd)

    @cached_property
    def standard(self) -> np.ndarray:
        """The same, kept: it is large."""
        return self.regressor()

    def pushed(self, link: int, rows: np.ndarray, place: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> np.ndarray:
        """Jacobian (K, 3, n) in the base frame of a point on a link (from 0), at the K set rows (S,) bool.

        `place` (3,) [m] is the point relative to the link's far end, in the link's frame.
        """
        screws, ends, computed = self._screws
        if np.any(new := rows & ~computed):
            screws[new], ends[new] = self.reference.links.joint_screws(self.q[new])
            computed |= new
        screws, point = screws[rows], ends[rows, link]
        if np.any(place):
            point = point + self._turned(link, rows) @ np.asarray(place)
        jacobian = screws[:, :3] + np.cross(screws[:, 3:], point[:, :, None], axis=1)
        jacobian[:, :, link + 1 :] = 0
        return jacobian

    def _turned(self, link: int, rows: np.ndarray) -> np.ndarray:
        """(K, 3, 3) rotation of a link (from 0) in the base frame; the latest ones are kept."""
        key = link, rows.tobytes()
        if self.memory.get("rotations", (None, None))[0] != key:
            self.memory["rotations"] = key, self.reference.links.link_rotations(self.q[rows], link)
        return cast(np.ndarray, self.memory["rotations"][1])

    @cached_property
    def _screws(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Joint screws (S, 6, n) and ends of links (S, n, 3), and in which rows (S,) they are known so far."""
        samples, dof = self.q.shape
        return np.empty((samples, 6, dof)), np.empty((samples, dof, 3)), np.zeros(samples, dtype=bool)
