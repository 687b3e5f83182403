"""The observation: measured torque and regressor columns of all logs, filtered alike, ready for any fit.

Rows of joint i hold only what acts on it, so each joint has its own narrow matrix: the base parameters of its own and
of outer links, and the friction of the axles coupled to it. Blocks of 60 s bound the memory of everything but the
result, which is a few times the cut-off in rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from agent.errors import InputError
from agent.estimation.filtering import FilterSettings, Motion, motions, resolve_cutoff
from agent.estimation.friction_terms import AxleMotion, FrictionTerm, axle_columns
from agent.recording.log import Log
from agent.robot import RobotDescription

if TYPE_CHECKING:
    from agent.robot.dynamics import Dynamics

_CHUNK = 4096


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
        from agent.robot.drivetrain import rotor_regressor

        links = self.independent[self.independent < 10 * self.robot.dof]
        rotors = self.independent[len(links) :] - 10 * self.robot.dof
        columns = np.empty((*q.shape, self.count))
        for first in range(0, len(q), _CHUNK):
            part = slice(first, first + _CHUNK)
            columns[part, :, : len(links)] = self.dynamics.regressor(q[part], qd[part], qdd[part])[:, :, links]
            columns[part, :, len(links) :] = rotor_regressor(self.robot, qdd[part])[:, :, rotors]
        return columns

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """(S, n) [N·m] for base parameters (b,)."""
        torque = np.empty(q.shape)
        for first in range(0, len(q), _CHUNK):
            part = slice(first, first + _CHUNK)
            torque[part] = self.columns(q[part], qd[part], qdd[part]) @ parameters
        return torque


@dataclass(frozen=True, eq=False)
class Observation:
    """All logs, filtered. Columns of any friction term, or of anything else computed from the motions, can be added."""

    robot: RobotDescription
    rigid: RigidBodies
    stretches: tuple[Stretch, ...]

    def joint_columns(
        self, stretch: Stretch, terms: tuple[FrictionTerm, ...], rigid_parameters: np.ndarray | None = None
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per joint: indices into [base parameters, terms] and the filtered columns (S', len(indices)).

        `rigid_parameters` (b,) give the load where a term needs it.
        """
        motion = stretch.motion
        load = None
        if any(term.form == "load" for term in terms):
            assert rigid_parameters is not None
            load = self.rigid.torque(motion.q, motion.qd, motion.qdd, rigid_parameters)
        axles_moving = AxleMotion.of(self.robot, motion.q, motion.qd, load)
        friction = motion.low_pass(axle_columns(terms, axles_moving)) if terms else np.empty((len(stretch.torque), 0))
        coupling = self.robot.coupling
        axles = np.array([term.axle for term in terms], dtype=int)
        result = []
        for joint, support in enumerate(self.rigid.support):
            share = coupling[axles, joint]
            felt = np.flatnonzero(share)
            columns = np.hstack([stretch.rigid[joint], friction[:, felt] * share[felt]])
            result.append((np.concatenate([support, self.rigid.count + felt]), columns))
        return result


def observe(rigid: RigidBodies, logs: Sequence[Log], settings: FilterSettings) -> Observation:
    """Filter logs into an observation, all with the cut-off that the slowest sampling allows unless it is given.

    Raises:
        InputError: a log without torque, with other joints than the robot, or too short for the filter.
    """
    for log in logs:
        check_log(rigid.robot, log)
    settings = replace(settings, cutoff=min(resolve_cutoff(log, settings) for log in logs))
    stretches = []
    for index, log in enumerate(logs):
        stretches += [filtered(rigid, index, motion) for motion in motions(log, settings)]
    return Observation(rigid.robot, rigid, tuple(stretches))


def filtered(rigid: RigidBodies, log_index: int, motion: Motion) -> Stretch:
    """Regressor columns of one motion and its torque, through the same filter."""
    assert motion.torque is not None
    columns = rigid.columns(motion.q, motion.qd, motion.qdd)
    narrow = [columns[:, joint, support] for joint, support in enumerate(rigid.support)]
    blocks = motion.low_pass(np.hstack([*narrow, motion.torque, motion.qd]))
    *per_joint, torque, speed = np.split(blocks, np.cumsum([b.shape[1] for b in (*narrow, motion.torque)]), axis=1)
    return Stretch(
        log_index=log_index,
        motion=motion,
        time=motion.time[motion.kept],
        speed=speed,
        torque=torque,
        rigid=tuple(np.ascontiguousarray(block) for block in per_joint),
    )


def check_log(robot: RobotDescription, log: Log) -> None:
    """Raise InputError unless a log has torque for exactly the robot's joints."""
    if log.joint_names != robot.joint_names:
        raise InputError(
            f"{log.path}: its joints are {', '.join(log.joint_names)}; those of {robot.name} are "
            f"{', '.join(robot.joint_names)}"
        )
    if log.effort is None:
        raise InputError(f"{log.path}: no torque (effort) was recorded, so nothing can be estimated or compared")
