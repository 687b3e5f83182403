"""The observation: measured torque and regressor columns of all logs, filtered alike, ready for any fit.

Rows of joint i hold only what acts on it, so each joint has its own narrow matrix: the base parameters of its own and
of outer links, and the friction of the axles coupled to it. Long logs are cut in pieces whose columns wait on disk.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.errors import InputError
from agent.estimation.filtering import FilterSettings, Motion, motions, resolve_cutoff
from agent.estimation.friction_terms import AxleMotion, FrictionTerm, axle_columns
from agent.recording.log import Log
from agent.recording.scratch import Scratch
from agent.robot import RobotDescription

if TYPE_CHECKING:
    from agent.robot.dynamics import Dynamics

#: Standard parameters of a kilogram of some size.
_BODY = (1.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.01, 0.0, 0.0, 0.01)
_CHUNK = 256  # samples of the regressor worked on at a time: it stays in the cache


@dataclass(frozen=True, eq=False)
class Stretch:
    """One motion, filtered: S' samples. torque (S', n); rigid: per joint (S', b_i) of its base-parameter columns.

    `log_index` counts logs, `speed` (S', n) is the joints' speed at the same samples.
    """

    log_index: int
    motion: Motion
    time: np.ndarray
    speed: np.ndarray
    torque: np.ndarray
    rigid: tuple[np.ndarray, ...]


class RigidBodies:
    """The regressor of base parameters, with which (joint, parameter) pairs can be other than zero.

    `independent` (b,) are the standard parameters kept as base parameters; `projection` (b, p) turns standard ones into
    base ones (see `agent.robot.base_parameters`); `support[i]` lists what acts on joint i.
    """

    def __init__(self, dynamics: Dynamics, independent: np.ndarray, projection: np.ndarray):
        self.robot, self.dynamics = dynamics.robot, dynamics
        self.independent, self.projection = independent, projection
        rng = np.random.default_rng(0)
        samples = (50, self.robot.dof)
        columns = self.columns(rng.uniform(-3, 3, samples), rng.normal(size=samples), rng.normal(size=samples))
        largest = np.abs(columns).max(axis=(0, 1))
        acts = np.abs(columns).max(axis=0) > 1e-12 * np.where(largest > 0, largest, 1.0)
        self.support = tuple(np.flatnonzero(row) for row in acts)

    @property
    def count(self) -> int:
        """Number of base parameters b."""
        return len(self.independent)

    def columns(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, b)."""
        columns = np.empty((*q.shape, self.count))
        for part in _chunks(len(q)):
            columns[part] = self._regressor(q[part], qd[part], qdd[part])[:, :, self.independent]
        return columns

    def acting(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, Σ b_i) what is other than zero of `columns`: for each joint those that `support` lists."""
        joints = np.repeat(np.arange(self.robot.dof), [len(support) for support in self.support])
        standard = self.independent[np.concatenate(self.support)]
        place = joints * (11 * self.robot.dof) + standard
        columns = np.empty((len(place), len(q)))
        for part in _chunks(len(q)):
            regressor = self._regressor(q[part], qd[part], qdd[part])
            columns[:, part] = regressor.reshape(len(regressor), -1)[:, place].T
        return columns.T

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """(S, n) [N·m] for base parameters (b,)."""
        from agent.robot.drivetrain import rotor_regressor

        # of all links with these base parameters some with mass, which Newton and Euler need: cheaper than the columns
        bodies = np.append(np.tile(_BODY, self.robot.dof), np.zeros(self.robot.dof))
        bodies = bodies + self._inverse @ (parameters - self.projection @ bodies)
        links, rotors = np.split(bodies, [10 * self.robot.dof])
        torque = self.dynamics.with_parameters(links).inverse_dynamics(q, qd, qdd)
        return torque + rotor_regressor(self.robot, qdd) @ rotors

    @cached_property
    def _inverse(self) -> np.ndarray:
        """(11 n, b) from base parameters to the shortest standard ones."""
        return np.linalg.pinv(self.projection)

    def _regressor(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, 11 n) of all standard parameters."""
        from agent.robot.drivetrain import rotor_regressor

        return np.concatenate([self.dynamics.regressor(q, qd, qdd), rotor_regressor(self.robot, qdd)], axis=2)


def _chunks(size: int) -> Iterator[slice]:
    return (slice(first, first + _CHUNK) for first in range(0, size, _CHUNK))


@dataclass(frozen=True, eq=False)
class Stretches(Sequence[Stretch]):
    """Stretches whose arrays lie in `scratch`: going over them gives the memory of each back."""

    items: tuple[Stretch, ...]
    scratch: Scratch = field(default_factory=Scratch)

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: Any) -> Any:
        return self.items[index]

    def __iter__(self) -> Iterator[Stretch]:
        for stretch in self.items:
            yield stretch
            self.scratch.release()


@dataclass(frozen=True, eq=False)
class Observation:
    """All logs, filtered. Columns of any friction term, or of anything else computed from the motions, can be added.

    `noisy` is the joint whose spectrum lowered the cut-off.
    """

    robot: RobotDescription
    rigid: RigidBodies
    stretches: Stretches
    noisy: int | None = None

    def joint_columns(
        self, stretch: Stretch, terms: tuple[FrictionTerm, ...], rigid_parameters: np.ndarray | None = None
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per joint: indices into [base parameters, terms] and the filtered columns (S', len(indices)).

        `rigid_parameters` (b,) give the load where a term needs it.
        """
        friction = self.friction(stretch, terms, rigid_parameters)
        return [(index, rows[:, :-1]) for index, rows in self.joint_rows(stretch, terms, friction)]

    def friction(
        self, stretch: Stretch, terms: tuple[FrictionTerm, ...], rigid_parameters: np.ndarray | None = None
    ) -> np.ndarray:
        """(S', T) each term's torque on its own axle, filtered; `rigid_parameters` as in `joint_columns`."""
        motion = stretch.motion
        if not terms:
            return np.empty((len(stretch.torque), 0))
        load = None
        if any(term.form == "load" for term in terms):
            assert rigid_parameters is not None
            load = self.rigid.torque(motion.q, motion.qd, motion.qdd, rigid_parameters)
        return motion.low_pass(axle_columns(terms, AxleMotion.of(self.robot, motion.q, motion.qd, load)))

    def joint_rows(
        self, stretch: Stretch, terms: tuple[FrictionTerm, ...], friction: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Joint after joint: indices (c,) into [base parameters, terms], and (S', c + 1): these columns, the torque.

        `friction` (S', T) is that of the terms on their axles.
        """
        coupling = self.robot.coupling
        axles = np.array([term.axle for term in terms], dtype=int)
        for joint, support in enumerate(self.rigid.support):
            share = coupling[axles, joint]
            felt = np.flatnonzero(share)
            base = len(support)
            rows = np.empty((base + len(felt) + 1, len(stretch.torque))).T
            rows[:, :base] = stretch.rigid[joint]
            np.multiply(friction[:, felt], share[felt], out=rows[:, base:-1])
            rows[:, -1] = stretch.torque[:, joint]
            yield np.concatenate([support, self.rigid.count + felt]), rows


def observe(rigid: RigidBodies, logs: Sequence[Log], settings: FilterSettings) -> Observation:
    """Filter logs into an observation, all with the cut-off that the slowest sampling allows, unless it is given.

    Raises:
        InputError: a log without torque, with other joints than the robot, or too short for the filter.
    """
    for log in logs:
        check_log(rigid.robot, log)
    settings = replace(settings, cutoff=min(resolve_cutoff(log, settings) for log in logs))
    scratch = Scratch()
    stretches = []
    for index, log in enumerate(logs):
        for motion in motions(log, settings):
            stretches.append(filtered(rigid, index, motion, scratch))
            scratch.release()
    return Observation(rigid.robot, rigid, Stretches(tuple(stretches), scratch))


def filtered(rigid: RigidBodies, log_index: int, motion: Motion, scratch: Scratch) -> Stretch:
    """Regressor columns of one motion and its torque, through the same filter; unfiltered torque is not kept."""
    assert motion.torque is not None
    signals = scratch.keep(motion.low_pass(np.hstack([motion.torque, motion.qd])))
    torque, speed = np.split(signals, 2, axis=1)
    q, qd, qdd = (scratch.keep(values) for values in (motion.q, motion.qd, motion.qdd))
    set_points = None if motion.set_points is None else scratch.keep(motion.set_points)
    return Stretch(
        log_index=log_index,
        motion=replace(motion, q=q, qd=qd, qdd=qdd, set_points=set_points, torque=None),
        time=motion.time[motion.kept],
        speed=speed,
        torque=torque,
        rigid=rigid_columns(rigid, motion, scratch),
    )


def rigid_columns(rigid: RigidBodies, motion: Motion, scratch: Scratch) -> tuple[np.ndarray, ...]:
    """Per joint (S', b_i): the filtered columns of the base parameters that act on it."""
    every = motion.fewest
    thinned = motion.thinned(every)
    acting = rigid.acting(motion.q[thinned], motion.qd[thinned], motion.qdd[thinned])
    columns = scratch.keep(motion.low_pass(acting, every))
    return tuple(np.split(columns, np.cumsum([len(support) for support in rigid.support])[:-1], axis=1))


def check_log(robot: RobotDescription, log: Log) -> None:
    """Raise InputError unless a log has torque for exactly the robot's joints."""
    if log.joint_names != robot.joint_names:
        raise InputError(
            f"{log.path}: its joints are {', '.join(log.joint_names)}; those of {robot.name} are "
            f"{', '.join(robot.joint_names)}"
        )
    if log.effort is None:
        raise InputError(f"{log.path}: no torque (effort) was recorded, so nothing can be estimated or compared")
