"""Position servos of a simulator's file: the torque that they give at set-points and states.

A MuJoCo `position` actuator, or a `general` one with affine bias, has the force f = g u + b₀ + b₁ l + b₂ l̇ on
l = gear · q. A control in the joint's unit (g = −b₁) is its set-point, r = u / gear, and the servo stands off it by
b₀ / −b₁ gear. A control of another unit has its zero in b₀: there r is where the servo gives no force at standstill. So
f = −b₁ gear (r + offset − q) + b₂ gear q̇, clamped to `forcerange`; the joint has gear · f, clamped to
`actuatorfrcrange`. A `velocity` actuator on the same joint, whose set-point is zero, is the servo's damping and
counts in its limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_SAME = 1e-6  # numerical: relative, between a gain and kp of one unit


@dataclass(frozen=True, eq=False)
class PositionServos:
    """τ = clip(k (clip(r) + offset − q) − d q̇) of n joints, arrays (n,), on the joint side.

    stiffness k [N·m/rad], damping d [N·m·s/rad]; low, high [N·m] the least and largest torque; least, most [rad] of the
    set-points; `control` (n, 2): the control of the file's actuator is control₀ + control₁ r, `gear` (n,) its gear;
    `actuators` and `inputs` (n,) are the indices of actuators and of their controls in the compiled model; `delay` (n,)
    [s] of the actuators, `interpolations` (n,) between its samples (0: none, 1: linear, 2: cubic), `step` [s] of the
    simulation, `offset` (n,) [rad] at which a servo stands off its set-point.
    """

    stiffness: np.ndarray
    damping: np.ndarray
    low: np.ndarray
    high: np.ndarray
    least: np.ndarray
    most: np.ndarray
    control: np.ndarray
    gear: np.ndarray
    actuators: tuple[int, ...]
    inputs: tuple[int, ...]
    delay: np.ndarray
    interpolations: tuple[int, ...]
    step: float
    offset: np.ndarray

    @property
    def in_unit(self) -> np.ndarray:
        """(n,) bool: controls in the unit of the joint, whose bias is an offset and not the zero of a unit."""
        return np.asarray(self.control[:, 1] == self.gear)

    def torque(self, set_points: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """(S, n) [N·m] before it is clamped."""
        return np.asarray(
            self.stiffness * (np.clip(set_points, self.least, self.most) + self.offset - q) - self.damping * qd,
            dtype=float,
        )

    def parameters(self, joint: int) -> tuple[float, list[float]]:
        """Gain and bias (b₀, b₁, b₂) of the actuator of a joint."""
        gear, (first, slope) = self.gear[joint], self.control[joint]
        kp, kv = self.stiffness[joint] / gear**2, self.damping[joint] / gear**2
        gain = kp * gear / slope
        bias = float(-gain * first + kp * gear * self.offset[joint])
        return float(gain), [bias + 0.0, float(-kp), float(-kv) + 0.0]

    def controls(self, set_points: np.ndarray) -> np.ndarray:
        """(S, n) controls of the file's actuators at set-points (S, n)."""
        return np.asarray(self.control[:, 0] + self.control[:, 1] * set_points)


def position_servos(mujoco: Any, model: Any, joints: Sequence[int]) -> PositionServos | str:
    """The servos of a compiled model's joints, or a reason for the user why they cannot be used."""
    if np.any(model.body_gravcomp):
        return "it compensates gravity (gravcomp), so that its servos do not carry the weight"
    numbers, actuators = np.empty((len(joints), 11)), []
    for k, joint in enumerate(joints):
        servo = _servo(mujoco, model, int(joint))
        if isinstance(servo, str):
            return servo
        actuators.append(servo[0])
        numbers[k] = servo[1]
    inputs = getattr(model, "actuator_ctrladr", np.arange(model.nu))
    history = getattr(model, "actuator_history", np.zeros((model.nu, 2)))
    ports = tuple(int(inputs[actuator]) for actuator in actuators)
    stiffness, damping, low, high, least, most = numbers.T[:6]
    control, gear, delay, offset = numbers[:, 6:8], *numbers[:, 8:].T
    return PositionServos(
        stiffness,
        damping,
        low,
        high,
        least,
        most,
        control,
        gear,
        tuple(actuators),
        ports,
        delay,
        tuple(int(history[actuator, 1]) for actuator in actuators),
        float(model.opt.timestep),
        offset,
    )


def _servo(mujoco: Any, model: Any, joint: int) -> tuple[int, tuple[float, ...]] | str:
    """The actuator of one joint, and its numbers of `PositionServos` (11,)."""
    name = model.joint(joint).name
    at_joint = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
    affine, fixed = int(mujoco.mjtBias.mjBIAS_AFFINE), int(mujoco.mjtGain.mjGAIN_FIXED)
    on_joint = [
        a
        for a in range(len(model.actuator_trntype))
        if model.actuator_trntype[a] in at_joint and _of(model, a) == joint
    ]
    own = [a for a in on_joint if model.actuator_biastype[a] == affine and model.actuator_biasprm[a, 1] < 0]
    if not own:
        tendons = (
            a
            for a in range(len(model.actuator_trntype))
            if model.actuator_trntype[a] == int(mujoco.mjtTrn.mjTRN_TENDON)
        )
        pulled = next((a for a in tendons if joint in pulled_joints(mujoco, model, _of(model, a))), None)
        if pulled is not None:
            return f"{name} is driven through a tendon ({model.actuator(pulled).name or pulled!r})"
        return f"{name} has no position actuator" + (" (what drives it holds no position)" if on_joint else "")
    a, gear = own[0], float(model.actuator_gear[own[0], 0])
    others = [b for b in on_joint if b != a and model.actuator_biastype[b] != int(mujoco.mjtBias.mjBIAS_NONE)]
    brakes = [_brake(mujoco, model, b) for b in others]
    if None in brakes:
        return f"{name} has several actuators with a force of their own that are no position and velocity of one servo"
    delay = float(np.ravel(getattr(model, "actuator_delay", np.zeros(model.nu))[a])[0])
    if model.actuator_gaintype[a] != fixed or model.actuator_dyntype[a] != int(mujoco.mjtDyn.mjDYN_NONE):
        return f"the actuator of {name} has a gain or filter of its own"
    gain, (b0, b1, b2) = float(model.actuator_gainprm[a, 0]), model.actuator_biasprm[a, :3].tolist()
    if model.opt.disableactuator >> int(model.actuator_group[a]) & 1:
        return f"the actuator of {name} is disabled (actuatorgroupdisable)"
    if gain <= 0 or gear == 0:
        return f"the actuator of {name} has no gain or gear"
    in_unit = bool(np.isclose(gain, -b1, rtol=_SAME, atol=0.0))
    control = np.array([0.0, gear] if in_unit else [-b0 / gain, -b1 * gear / gain])
    offset = -b0 / (b1 * gear) if in_unit else 0.0
    ranges = [np.array([-np.inf, np.inf])]
    if model.actuator_forcelimited[a]:
        ranges.append(np.sort(gear * model.actuator_forcerange[a]))
    if model.jnt_actfrclimited[joint]:
        ranges.append(model.jnt_actfrcrange[joint])
    asked = np.array([-np.inf, np.inf])
    if model.actuator_ctrllimited[a]:
        asked = np.sort((model.actuator_ctrlrange[a] - control[0]) / control[1])
    low, high = max(float(part[0]) for part in ranges), min(float(part[1]) for part in ranges)
    damping = -b2 * gear**2 + sum(filter(None, brakes))
    return a, (-b1 * gear**2, damping, low, high, *asked, *control, gear, delay, offset)


def _brake(mujoco: Any, model: Any, actuator: int) -> float | None:
    """Damping [N·m·s/rad] that a velocity actuator adds to its joint; None for another kind."""
    b0, b1, b2 = model.actuator_biasprm[actuator, :3].tolist()
    plain = (
        model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        and model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
    )
    if not plain or b0 or b1 or b2 > 0:
        return None
    disabled = model.opt.disableactuator >> int(model.actuator_group[actuator]) & 1
    return 0.0 if disabled else float(-b2 * model.actuator_gear[actuator, 0] ** 2)


def _of(model: Any, actuator: int) -> int:
    return int(model.actuator_trnid[actuator, 0])


def pulled_joints(mujoco: Any, model: Any, tendon: int) -> list[int]:
    """Joints that a fixed tendon pulls at."""
    parts = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    return [int(model.wrap_objid[w]) for w in parts if model.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_JOINT)]
