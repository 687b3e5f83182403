"""The observation: measured torque and regressor columns of all logs, filtered alike, ready for any fit.

Rows of joint i hold only what acts on it, so each joint has its own narrow matrix: the base parameters of its own and
of outer links, and the friction of the axles coupled to it. Long logs are cut in pieces whose columns wait on disk.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agent.core import InputError
from agent.estimation.signals.filtering import FilterSettings, Motion, motions, resolve_cutoff
from agent.model import AxleMotion, FrictionTerm, axle_columns
from agent.recording import Log, Scratch
from agent.robot import RigidBodies, RobotDescription

#: Part of the recorded time, or of what another cut-off leaves, that a filter has to leave.
ENOUGH_TIME = 0.8


@dataclass(frozen=True, eq=False)
class Segment:
    """One motion, filtered: S' samples. torque (S', n); rigid: per joint (S', b_i) of its base-parameter columns.

    `log_index` counts logs, `speed` (S', n) is the joints' speed at the same samples. `share` (S', n), 1 if None,
    multiplies rows of a fit; below 1 they are those of a held joint.
    """

    log_index: int
    motion: Motion
    time: np.ndarray
    speed: np.ndarray
    torque: np.ndarray
    rigid: tuple[np.ndarray, ...]
    share: np.ndarray | None = None

    @property
    def held(self) -> np.ndarray:
        """(S', n) bool."""
        return np.zeros(self.speed.shape, dtype=bool) if self.share is None else self.share < 1


@dataclass(frozen=True, eq=False)
class Segments(Sequence[Segment]):
    """Segments whose arrays `scratch` owns: going over them gives the memory of each back."""

    items: tuple[Segment, ...]
    scratch: Scratch = field(default_factory=Scratch)

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: Any) -> Any:
        return self.items[index]

    def __iter__(self) -> Iterator[Segment]:
        return self.scratch.each(self.items)


@dataclass(frozen=True, eq=False)
class Observation:
    """All logs, filtered. Columns of any friction term, or of anything else computed from the motions, can be added.

    `noisy` is the joint whose spectrum lowered the cut-off.
    """

    robot: RobotDescription
    rigid: RigidBodies
    segments: Segments
    noisy: int | None = None

    @property
    def seconds(self) -> float:
        """Time [s] that the filter leaves."""
        return sum(len(segment.time) * segment.motion.step / segment.motion.rate for segment in self.segments.items)

    def joint_columns(
        self, segment: Segment, terms: tuple[FrictionTerm, ...], rigid_parameters: np.ndarray | None = None
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per joint: indices into [base parameters, terms] and the filtered columns (S', len(indices)).

        `rigid_parameters` (b,) give the load where a term needs it.
        """
        friction = self.friction(segment, terms, rigid_parameters)
        return [(index, rows[:, :-1]) for index, rows in self.joint_rows(segment, terms, friction)]

    def friction(
        self, segment: Segment, terms: tuple[FrictionTerm, ...], rigid_parameters: np.ndarray | None = None
    ) -> np.ndarray:
        """(S', T) each term's torque on its own axle, filtered; `rigid_parameters` as in `joint_columns`."""
        motion = segment.motion
        if not terms:
            return np.empty((len(segment.torque), 0))
        load = None
        if any(term.form == "load" for term in terms):
            assert rigid_parameters is not None
            load = self.rigid.torque(motion.q, motion.qd, motion.qdd, rigid_parameters)
        return motion.low_pass(axle_columns(terms, AxleMotion.of(self.robot, motion.q, motion.qd, load)))

    def joint_rows(
        self, segment: Segment, terms: tuple[FrictionTerm, ...], friction: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Joint after joint: indices (c,) into [base parameters, terms], and (S', c + 1): these columns, the torque.

        `friction` (S', T) is that of the terms on their axles. Both are multiplied by the rows' share.
        """
        coupling = self.robot.coupling
        axles = np.array([term.axle for term in terms], dtype=int)
        for joint, support in enumerate(self.rigid.support):
            share = coupling[axles, joint]
            felt = np.flatnonzero(share)
            base = len(support)
            rows = np.empty((base + len(felt) + 1, len(segment.torque))).T
            rows[:, :base] = segment.rigid[joint]
            np.multiply(friction[:, felt], share[felt], out=rows[:, base:-1])
            rows[:, -1] = segment.torque[:, joint]
            if segment.share is not None:
                rows *= segment.share[:, joint, None]
            yield np.concatenate([support, self.rigid.count + felt]), rows


def observe(rigid: RigidBodies, logs: Sequence[Log], settings: FilterSettings) -> Observation:
    """Filter logs into an observation, all with the cut-off that the slowest sampling allows, unless it is given.

    Args:
        rigid: bodies whose columns are taken.
        logs: with torque.
        settings: cut-off, if given, and order of the filter.

    Raises:
        InputError: a log without torque, with other joints than the robot, or too short for the filter.
    """
    for log in logs:
        check_log(rigid.robot, log)
    settings = replace(settings, cutoff=min(resolve_cutoff(log, settings) for log in logs))
    scratch = Scratch()
    segments = []
    for index, log in enumerate(logs):
        segments += [filtered(rigid, index, motion, scratch) for motion in motions(log, settings)]
    return Observation(rigid.robot, rigid, Segments(tuple(segments), scratch))


def filtered(rigid: RigidBodies, log_index: int, motion: Motion, scratch: Scratch) -> Segment:
    """Regressor columns of one motion and its torque, through the same filter; unfiltered torque is not kept.

    Those of a joint that its brake holds are zero.
    """
    assert motion.torque is not None
    braked = motion.braked
    signals = scratch.keep(motion.low_pass(np.hstack([np.where(braked, 0.0, motion.torque), motion.qd])))
    torque, speed = np.split(signals, 2, axis=1)
    q, qd, qdd = (scratch.keep(values) for values in (motion.q, motion.qd, motion.qdd))
    set_points = None if motion.set_points is None else scratch.keep(motion.set_points)
    return Segment(
        log_index=log_index,
        motion=replace(motion, q=q, qd=qd, qdd=qdd, set_points=set_points, torque=None),
        time=motion.time[motion.kept],
        speed=speed,
        torque=torque,
        rigid=tuple(
            np.zeros_like(columns) if still else columns
            for columns, still in zip(rigid_columns(rigid, motion, scratch), braked, strict=True)
        ),
    )


def rigid_columns(rigid: RigidBodies, motion: Motion, scratch: Scratch) -> tuple[np.ndarray, ...]:
    """Per joint (S', b_i): the filtered columns of the base parameters that act on it."""
    every = motion.fewest
    thinned = motion.thinned(every)
    acting = rigid.acting(motion.q[thinned], motion.qd[thinned], motion.qdd[thinned])
    columns = scratch.keep(motion.low_pass(acting, every))
    return tuple(np.split(columns, np.cumsum([len(support) for support in rigid.support])[:-1], axis=1))


def check_log(robot: RobotDescription, log: Log) -> None:
    """Raise InputError unless a log has torque, not all of it zero, for exactly the robot's joints."""
    if log.joint_names != robot.joint_names:
        raise InputError(
            f"{log.path}: its joints are {', '.join(log.joint_names)}; those of {robot.name} are "
            f"{', '.join(robot.joint_names)}"
        )
    if log.effort is None:
        whose = f" of {', '.join(log.without_effort)}" if 0 < len(log.without_effort) < len(log.joint_names) else ""
        raise InputError(f"{log.path}: no torque (effort){whose} was recorded, so nothing can be estimated or compared")
    if not any(log.effort[part].any() for part in log.scratch.parts(len(log.effort))):
        raise InputError(f"{log.path}: the torque is zero throughout; is its channel recorded, is its map right?")
