"""Positions and commands of one stretch of a log, and the simulated motion on the same instants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from agent.core import InputError
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.position_logs.response import LinearResponse
from agent.diagnosis.rows.rounding import rounding_step
from agent.model import MotionSignals, NominalModel
from agent.recording import Log
from agent.robot import ParameterLayout
from agent.simulators import FreeMotion, FreeSimulator, PositionServos, RecordedCommand, ServoNumbers

_STEP = 5e-3  # numerical: s, at most, between the instants of the linearised motion
_LATER = 5e-4  # numerical: s, by which a command is moved to tell what a delay changes; of the steps of gears, at most
_FAR = 1.5  # rad or m from the set-points in the middle: they are of another unit or zero


@dataclass(frozen=True, eq=False)
class CommandedStretch:
    """One stretch of a log without a gap: time (S,) [s] of its frames, position (S, n), the command, and its start.

    `start` (2n,): position and speed at its first frame. The first `unsettled` frames are simulated and not judged: how
    play, bristles and rings stand when a log begins is not known. The recorder cuts the `wanted` command to within
    `nearest` [rad or m] of the positions.
    """

    log_index: int
    time: np.ndarray
    position: np.ndarray
    wanted: RecordedCommand
    start: np.ndarray
    unsettled: int = 0
    nearest: float = np.inf

    def cut(self, nearest: float) -> CommandedStretch:
        """The stretch whose commands were cut to within `nearest` [rad or m] of the positions on their way."""
        return replace(self, nearest=nearest)

    @cached_property
    def command(self) -> RecordedCommand:
        """The command as it was sent."""
        clipped = np.clip(self.wanted.set_points, self.position - self.nearest, self.position + self.nearest)
        return replace(self.wanted, set_points=clipped)

    @cached_property
    def cut_change(self) -> RecordedCommand:
        """Change of the command that was sent with `nearest`."""
        lag = self.wanted.set_points - self.position
        return replace(self.wanted, set_points=np.where(np.abs(lag) > self.nearest, np.sign(lag), 0.0))

    @property
    def judged(self) -> slice:
        """The frames whose positions are compared."""
        return slice(self.unsettled, None)

    def run(self, simulator: FreeSimulator, numbers: ServoNumbers) -> FreeMotion | None:
        """The free motion over this stretch."""
        q, qd = np.split(self.start, 2)
        return simulator.run(numbers, self.command, (float(self.time[0]), q, qd), float(self.time[-1]))

    @cached_property
    def frames(self) -> int:
        """Frames that make a row: those of the time between independent rows."""
        return max(1, round(LIMITS.row_correlation_time / float(np.median(np.diff(self.time)))))

    def averaged(self, frames: np.ndarray) -> np.ndarray:
        """(R, …) means over the frames of each row, of the judged frames (S', …)."""
        count = len(frames) // self.frames
        return np.asarray(frames[: count * self.frames].reshape(count, self.frames, *frames.shape[1:]).mean(axis=1))

    @property
    def grid(self) -> tuple[np.ndarray, int]:
        """Instants (T,) [s] on and between the frames, of which every m-th is a frame; m."""
        every = max(1, int(np.ceil(np.median(np.diff(self.time)) / _STEP)))
        frames = np.arange(len(self.time)) * every
        return np.interp(np.arange(frames[-1] + 1), frames, self.time), every

    def linearised(
        self, simulator: FreeSimulator, numbers: ServoNumbers, motion: FreeMotion, reference: NominalModel
    ) -> LinearisedMotion:
        """The motion on the grid, with its linear response."""
        time, every = self.grid
        on = {
            name: np.stack(
                [np.interp(time, motion.time, column) for column in getattr(motion, name).T.astype(float)], axis=1
            )
            for name in ("q", "qd", "qdd", "torque", "stuck", "limited")
        }
        command = self.command.between(_around(time), numbers.delay)
        grid_motion = FreeMotion(
            time, on["q"], on["qd"], on["qdd"], on["torque"], command, on["stuck"] > 0.5, on["limited"] > 0.5
        )
        state = (time, grid_motion.q, grid_motion.qd, grid_motion.qdd)
        kept = slice(self.unsettled * every, None, every)
        signals = MotionSignals(reference, *state, self.log_index, kept)
        response = LinearResponse.along(signals, grid_motion, numbers, simulator.servos.damping, simulator.creep)
        return LinearisedMotion(self, grid_motion, signals, response, numbers, simulator.servos)


@dataclass(frozen=True, eq=False)
class LinearisedMotion:
    """A simulated motion over a stretch on its grid, and how it answers to a torque."""

    stretch: CommandedStretch
    motion: FreeMotion
    signals: MotionSignals
    response: LinearResponse
    numbers: ServoNumbers
    servos: PositionServos

    def number_columns(self, simulator: FreeSimulator, numbers: ServoNumbers) -> np.ndarray:
        """(S', n, 7 n + 1) change of the judged positions with each number, kind by kind as in `ServoNumbers.table`.

        The last is how near the recorder cuts commands to the positions.
        """
        m, servos, n = self.motion, simulator.servos, self.motion.q.shape[1]
        free = ~m.limited
        edges = _around(m.time)
        earlier, later = (self.stretch.command.between(edges, numbers.delay + sign * _LATER) for sign in (-1, 1))
        asked = np.clip(m.command, servos.least, servos.most)
        by_delay = numbers.kp * (earlier - later) / (2 * _LATER) * free
        by_kp, by_offset = -(asked + numbers.offset - m.q) * free, -numbers.kp * free
        turned = m.q - simulator.arm.rest
        parts = (m.qdd, m.qd, np.sign(m.qd) * ~m.stuck, by_kp, turned, by_delay, by_offset)
        columns = np.zeros((len(self.stretch.time[self.stretch.judged]), n, len(parts) * n + 1))
        for j in range(n):
            block = np.column_stack([part[:, j] for part in parts])
            columns[:, :, j:-1:n] = self.response.of_torque({j: block})
        if self.stretch.nearest < np.inf:
            wider = -numbers.kp * self.stretch.cut_change.between(edges, numbers.delay) * free
            columns[:, :, -1:] = self.response.of_torque({j: wider[:, j : j + 1] for j in range(n)})
        return columns

    def through_play(self, joint: int, stiffness: np.ndarray, gap: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """(S', K) change of the judged positions of a joint whose servo reads its link, behind K gears with play.

        Stiffness [N·m/rad], gap [rad] and damping ratio of the link (K,). What a gear without play makes is taken off.
        """
        from agent.compiled import servo_through_play

        m, signals, numbers = self.motion, self.signals, self.numbers
        mass = signals.mass[:, joint, joint]
        slope = signals.link_slope[:, joint, joint]
        along = m.torque, signals.link_load, m.qd, ~m.limited
        torque, load, speed, pulls = (part[:, joint].astype(float) for part in along)
        damping_of_servo = min(float(self.servos.damping[joint]), float(numbers.damping[joint]))
        kinds = numbers.kp, numbers.damping - damping_of_servo, numbers.friction, numbers.armature
        kp, viscous, friction, armature = (float(kind[joint]) for kind in kinds)
        limits = float(self.servos.low[joint]), float(self.servos.high[joint])
        servo = np.array([kp, damping_of_servo, viscous, friction, armature, *limits])
        substeps = max(2, int(np.ceil(np.median(np.diff(m.time)) / _LATER)))
        damper = 2 * damping * np.sqrt(stiffness * mass.mean())
        responses = servo_through_play(
            np.stack([torque, load, speed, mass, slope, pulls]),
            servo,
            np.concatenate([stiffness, stiffness]),
            np.concatenate([damper, damper]),
            np.concatenate([gap, np.zeros(len(gap))]),
            float(np.median(np.diff(m.time))) / substeps,
            substeps,
        )
        with_play, without = np.split(responses, 2)
        return np.asarray((with_play - without).T[signals.kept])

    @property
    def rows(self) -> slice:
        """Those of the instants that are in the middle of a row."""
        stretch, every = self.stretch, self.stretch.grid[1]
        count = (len(stretch.time) - stretch.unsettled) // stretch.frames
        first = (stretch.unsettled + (stretch.frames - 1) // 2) * every
        return slice(first, first + count * stretch.frames * every, stretch.frames * every)

    def load_columns(self, shape: np.ndarray) -> np.ndarray:
        """(S', n, K) change of the judged positions with a load: what its link gains, `shape` (10, K), per unit."""
        robot = self.signals.reference.robot
        torque = self.signals.standard[:, :, ParameterLayout.of(robot).link(robot.load_link)] @ shape
        return self.response.of_torque({j: torque[:, j] for j in range(robot.dof)})


def _around(time: np.ndarray) -> np.ndarray:
    """(T + 1,) edges of intervals around times (T,)."""
    edges = np.append(time, 2 * time[-1] - time[-2])
    return np.asarray(edges - 0.5 * np.diff(edges, append=2 * edges[-1] - edges[-2]))


def stretches_of(logs: Sequence[Log], held: bool, settling: float = 0.0) -> tuple[CommandedStretch, ...]:
    """The stretches of logs in which positions and commands can be compared; short ones are left out.

    The first `settling` [s] of each are not judged.

    Raises:
        InputError: no set-points, set-points that are the positions themselves, or of another unit, zero or arm.
    """
    stretches = []
    for index, log in enumerate(logs):
        r = _set_points(log)
        complete = np.all(np.isfinite(r), axis=1)
        for start, stop in log.segments:
            rows = np.flatnonzero(complete[start:stop]) + start
            if len(rows) < LIMITS.min_samples or len(rows) < stop - start - 2:
                continue
            t, q = log.t[rows], log.position[rows]
            steps = np.array([rounding_step(column) for column in q.T])
            moves = np.abs(q[1] - q[0]) > 1.5 * steps  # derived: half way between one step of rounding and two
            speed = np.where(moves, q[1] - q[0], 0.0) / (t[1] - t[0])
            command, begins = RecordedCommand(t, r[rows], held), np.concatenate([q[0], speed])
            stretch = CommandedStretch(index, t, q, command, begins, int(np.searchsorted(t, t[0] + settling)))
            if len(t) - stretch.unsettled >= LIMITS.min_samples * stretch.frames:
                stretches.append(stretch)
    if not stretches:
        raise InputError(
            f"{logs[0].path}: no stretch of {LIMITS.min_samples * LIMITS.row_correlation_time:g} s after the servos "
            "have settled has positions and set-points on the same stamps; record longer, and record what "
            "was commanded together with the positions"
        )
    return tuple(stretches)


def _set_points(log: Log) -> np.ndarray:
    r, q = log.reference_position, log.position
    if r is None:
        raise InputError(
            f"{log.path}: neither torque (effort) nor set-points (/joint_references) were recorded: one of them is "
            "needed, torque as current times torque constant, or set-points for the servos of the simulator's file"
        )
    complete = np.all(np.isfinite(r), axis=1)
    names, moving = np.array(log.joint_names), np.ptp(q, axis=0) > LIMITS.least_travel
    if not complete.any():
        raise InputError(f"{log.path}: no sample has a set-point at its stamp; record them on the positions' stamps")
    copied = moving & np.all(r[complete] == q[complete], axis=0)
    if copied.any():
        raise InputError(
            f"{log.path}: the set-points of {', '.join(names[copied])} are the measured positions themselves, so they "
            "say nothing about the servo: record what was commanded"
        )
    lag = np.median(np.abs(r - q)[complete], axis=0)
    if np.any(lag > _FAR):
        k = int(np.argmax(lag))
        raise InputError(
            f"{log.path}: {names[k]} is {lag[k]:.3g} rad or m from its set-points in the middle: they are of another "
            "unit, zero or arm than its positions"
        )
    return r


def lost_frames(stretches: Sequence[CommandedStretch], residuals: Sequence[np.ndarray]) -> int:
    """How many frames are missing without a gap in the stamps: from there on positions follow another set-point.

    A lost frame moves the command by one step against the positions for good; the residual shifts by the speed of the
    command times one frame. Counted are shifts of the best lag between parts of a stretch of at least half a frame.
    """
    count = 0
    for stretch, residual in zip(stretches, residuals, strict=True):
        frame = float(np.median(np.diff(stretch.time)))
        speed = np.gradient(stretch.position, stretch.time, axis=0)[stretch.judged]
        lags = []
        for part in np.array_split(np.arange(len(residual)), LIMITS.log_parts):
            energy = float(np.sum(speed[part] ** 2))
            lags.append(float(np.sum(residual[part] * speed[part])) / energy if energy > 0 else 0.0)
        count += sum(abs(b - a) > 0.5 * frame for a, b in pairwise(lags))
    return count
