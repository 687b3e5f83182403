"""Set-points that excite an arm under position servos: steps with rests, a chirp, slow reversals under gravity.

Steps separate delay and damping, a chirp separates damping and armature. Slow reversals in several postures show
friction and, by the droop under known masses, the servos' gains. Each motion has all three, so any can be held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.core import InputError
from agent.simulators import FreeSimulator, RecordedCommand, Simulator, mujoco_package

STEPS, CHIRP, REVERSALS = "steps", "chirp", "reversals"
#: Kinds of excitation, in the order of a motion.
EXCITATIONS = (STEPS, CHIRP, REVERSALS)
_SECONDS = 10.0  # of each kind in a motion
_MOTIONS = 2
_FREQUENCIES = 0.2, 3.0  # Hz of a chirp: hobby servos have their corner between
_FADE = 0.5  # s at either end of a chirp
_PERIOD = 2.0  # s between slow reversals
_FASTEST = 2.0  # rad/s or m/s of the command
_SHARE_OF_TORQUE = 0.5  # of its limit, that damping may take at the highest speed
_UNLIMITED = 0.5 * np.pi  # rad either side of the start, for a joint without limits
_MARGIN = 0.05  # of the range at either end that stays free
_SHARES = (1.0, 0.6, 0.35, 0.2)  # of the amplitudes: the largest that keeps all limits is taken
_LIMITED = 0.02  # of the samples that a servo may be at its limit
_LOOKED_AT = 0.05  # s between postures that are checked for contacts


@dataclass(frozen=True, eq=False)
class SetPointLimits:
    """Of n joints: least and largest set-point (n,) [rad or m], where motions start, and the highest speed [/s]."""

    low: np.ndarray
    high: np.ndarray
    start: np.ndarray
    speed: np.ndarray

    @property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) each: the ends of the ranges, of which a part stays free."""
        rim = _MARGIN / (1 - 2 * _MARGIN) * (self.high - self.low)
        return self.low - rim, self.high + rim

    @classmethod
    def of(cls, simulator: FreeSimulator) -> SetPointLimits:
        """Those of a file: ranges of joints and controls, the keyframe `home` or the middle, and what servos can do.

        At the highest speed, damping takes half of the servo's torque limit.
        """
        model, names, servos = simulator.model, simulator.arm.file_joints, simulator.servos
        joints = [model.joint(name) for name in names]
        addresses = [int(joint.qposadr[0]) for joint in joints]
        keys = [k for k in range(model.nkey) if model.key(k).name == "home"]
        start = (model.key_qpos[keys[0]] if keys else model.qpos0)[addresses].astype(float)
        limited = np.array([bool(model.jnt_limited[joint.id]) for joint in joints])
        ends = np.array([model.jnt_range[joint.id] for joint in joints])
        low, high = np.where(limited, ends[:, 0], -np.inf), np.where(limited, ends[:, 1], np.inf)
        low, high = np.maximum(low, servos.least), np.minimum(high, servos.most)
        bounded = np.isfinite(low) & np.isfinite(high)
        low = np.where(np.isfinite(low), low, start - _UNLIMITED)
        high = np.where(np.isfinite(high), high, start + _UNLIMITED)
        if not keys:
            start = np.where(bounded, 0.5 * (low + high), start)
        torque = np.minimum(np.abs(servos.low), np.abs(servos.high))
        damping = np.maximum(simulator.numbers.damping, 1e-9)
        speed = np.minimum(_SHARE_OF_TORQUE * torque / damping, _FASTEST)
        rim = _MARGIN * (high - low)
        return cls(low + rim, high - rim, np.clip(start, low + rim, high - rim), speed)


@dataclass(frozen=True, eq=False)
class SetPointMotion:
    """Set-points (S, n) [rad or m] at times (S,) [s]; `kinds` names the excitations in it."""

    name: str
    kinds: tuple[str, ...]
    time: np.ndarray
    set_points: np.ndarray


@dataclass(frozen=True, eq=False)
class SetPointPlan:
    """Motions that keep all limits in the simulation of the file.

    Attributes
    ----------
    joints : names of n joints.
    limits : what they keep.
    share : of the full amplitudes.
    reached : (2, n) least and largest simulated position [rad or m].
    fastest : (n,) highest simulated speed [rad/s or m/s].
    torque : (n,) largest share of the servo's torque limit.
    """

    joints: tuple[str, ...]
    limits: SetPointLimits
    motions: tuple[SetPointMotion, ...]
    share: float
    reached: np.ndarray
    fastest: np.ndarray
    torque: np.ndarray


def plan_set_points(simulator: Simulator, rate: float, kinds: Sequence[str] = EXCITATIONS) -> SetPointPlan:
    """The motions with the largest amplitudes that keep all limits, at `rate` [Hz].

    Args:
        simulator: file with position servos.
        rate: of the set-points [Hz].
        kinds: of motion, each in both motions.

    Raises:
        InputError: the file has no position servos, or no motion keeps all limits.
    """
    free = FreeSimulator(simulator.arm)
    limits = SetPointLimits.of(free)
    why = ""
    for share in _SHARES:
        motions = excitation(limits, rate, share, kinds)
        plan = _simulated(free, simulator.arm.joint_names, limits, motions, share)
        if isinstance(plan, SetPointPlan):
            return plan
        why = plan
    raise InputError(
        f"{simulator.arm.path}: no motion from its start keeps all limits, not even a small one: {why}. Give the file "
        "a keyframe `home` with a posture that has room around it"
    )


def excitation(
    limits: SetPointLimits, rate: float, share: float = 1.0, kinds: Sequence[str] = EXCITATIONS
) -> tuple[SetPointMotion, ...]:
    """Two motions, each with all `kinds` and from the start back to it; the second goes the other way.

    Args:
        limits: of position, speed and acceleration per joint.
        rate: of the set-points [Hz].
        share: of the largest amplitude.
        kinds: of motion.
    """
    motions = []
    for number in range(_MOTIONS):
        sign = 1.0 if number % 2 == 0 else -1.0
        makers = {STEPS: _steps, CHIRP: _chirp, REVERSALS: _reversals}
        parts = [makers[kind](limits, rate, share, sign) for kind in kinds]
        rows = np.clip(limits.start + np.concatenate(parts), limits.low, limits.high)
        motions.append(SetPointMotion(f"motion_{number + 1}", tuple(kinds), np.arange(len(rows)) / rate, rows))
    return tuple(motions)


def _steps(limits: SetPointLimits, rate: float, share: float, sign: float) -> np.ndarray:
    """(S, n) away from the start and back, joint by joint, each followed by a rest."""
    n, time = len(limits.low), np.arange(round(_SECONDS * rate)) / rate
    size = share * np.minimum(0.15 * (limits.high - limits.low), 0.3 * limits.speed)
    steps, each = np.zeros((len(time), n)), _SECONDS / n
    for j in range(n):
        since = time - j * each
        ramp = size[j] / limits.speed[j]
        steps[:, j] = size[j] * np.clip(np.minimum(since, 0.5 * each - since) / ramp + 0.5, 0.0, 1.0)
    return sign * steps * _faded(time)


def _chirp(limits: SetPointLimits, rate: float, share: float, sign: float) -> np.ndarray:
    """(S, n) all joints at once through all frequencies, every other one downwards, a tenth of the range or slower."""
    time = np.arange(round(_SECONDS * rate)) / rate
    low, high = _FREQUENCIES
    growth = np.log(high / low) / _SECONDS
    frequency = low * np.exp(growth * time)
    angle = 2 * np.pi * (frequency - low) / growth
    columns = []
    for j, (reach, speed) in enumerate(zip(limits.high - limits.low, limits.speed, strict=True)):
        wave = np.sin(angle + j) * np.minimum(0.05 * reach, speed / (2 * np.pi * frequency))
        columns.append(wave[::-1] if (j % 2) ^ (sign < 0) else wave)
    return share * np.stack(columns, axis=1) * _faded(time)


def _reversals(limits: SetPointLimits, rate: float, share: float, sign: float) -> np.ndarray:
    """(S, n) slowly to one side and back, with small reversals all the way."""
    time = np.arange(round(_SECONDS * rate)) / rate
    columns = []
    for j, (reach, speed) in enumerate(zip(limits.high - limits.low, limits.speed, strict=True)):
        far = min(0.25 * reach, 0.7, 0.1 * speed * _SECONDS)
        side = sign * (-1.0) ** j * far * np.clip(2.5 * np.minimum(time, time[-1] - time) / _SECONDS, 0.0, 1.0)
        phase = time / (_PERIOD * (1 + 0.1 * j)) % 1.0
        columns.append(side + min(0.03 * reach, 0.1) * (np.abs(4 * ((phase + 0.75) % 1.0) - 2) - 1))
    return share * np.stack(columns, axis=1) * _faded(time)


def _faded(time: np.ndarray) -> np.ndarray:
    """(S, 1) from 0 to 1 and back, smoothly."""
    ends = np.clip(np.minimum(time, time[-1] - time) / _FADE, 0.0, 1.0)
    return np.asarray(np.sin(0.5 * np.pi * ends)[:, None] ** 2)


def _simulated(
    free: FreeSimulator,
    names: tuple[str, ...],
    limits: SetPointLimits,
    motions: tuple[SetPointMotion, ...],
    share: float,
) -> SetPointPlan | str:
    """The plan, or which limit the simulated arm breaks."""
    zero = np.zeros(len(limits.start))
    runs = []
    for motion in motions:
        command = RecordedCommand(motion.time, motion.set_points, held=True)
        moved = free.run(free.numbers, command, (0.0, limits.start, zero), float(motion.time[-1]))
        if moved is None:
            return "the simulation blows up"
        runs.append(moved)
    q, qd, torque, limited = (
        np.concatenate([getattr(simulated, part) for simulated in runs]) for part in ("q", "qd", "torque", "limited")
    )
    low, high = limits.whole
    outside = np.any((q < low) | (q > high), axis=0)
    if outside.any():
        return f"{names[int(np.argmax(outside))]} leaves its range"
    often = limited.mean(axis=0)
    if often.max() > _LIMITED:
        return (
            f"the servo of {names[int(np.argmax(often))]} is at its torque limit {100 * often.max():.0f} % of the time"
        )
    for simulated in runs:
        if touching := _contact(free, simulated.q[:: max(1, round(_LOOKED_AT / free.step))], limits.start):
            return touching
    most = np.minimum(np.abs(free.servos.low), np.abs(free.servos.high))
    reached = np.stack([q.min(axis=0), q.max(axis=0)])
    return SetPointPlan(
        names, limits, motions, share, reached, np.abs(qd).max(axis=0), np.abs(torque).max(axis=0) / most
    )


def _contact(free: FreeSimulator, postures: np.ndarray, start: np.ndarray) -> str:
    """Which bodies touch on the way that do not at the start; empty where none do."""
    mujoco = mujoco_package()
    model, data = free.model, mujoco.MjData(free.model)
    addresses = [int(model.joint(name).qposadr[0]) for name in free.arm.file_joints]

    def touching(posture: np.ndarray) -> set[tuple[str, str]]:
        data.qpos[addresses] = posture
        mujoco.mj_fwdPosition(model, data)
        bodies = [[model.body(model.geom_bodyid[g]).name for g in pair.geom] for pair in data.contact if pair.dist < 0]
        return {(min(pair), max(pair)) for pair in bodies}

    usual = touching(start)
    for posture in postures:
        if new := touching(posture) - usual:
            return "{} touches {}".format(*min(new))
    return ""
