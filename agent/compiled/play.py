"""A link that its motor drives through a spring with play: the steps of its integration."""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled

_FORGETTING = 4.0  # power of the time gone with which the start is forgotten
_TOGETHER = 64  # links that take their steps side by side: their states stay in the fastest cache


@compiled(
    "Tuple((f4[:,::1], f4[:,::1], f4[:,::1]))"
    "(f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, i8, f8)"
)
def driven_through_play(
    impulse: np.ndarray,
    slope: np.ndarray,
    mobility: np.ndarray,
    column: np.ndarray,
    followed: np.ndarray,
    spring: np.ndarray,
    loss: np.ndarray,
    half: np.ndarray,
    twist: np.ndarray,
    step: float,
    substeps: int,
    period: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(K, S) what K links take of their load [N·m], the change of their speed [rad/s²] and the twist [rad], per sample.

    Args:
        impulse: (S, M) what pushes in a step.
        slope: (S, M) by how much less it is for a twist of one, at most half the spring's.
        mobility: (S, M) one over the inertia.
        column: (K,) which of the M columns are a link's.
        followed: (K,) largest mobility that the steps can follow.
        spring: (K,) impulse of a step per twist beyond half the play.
        loss: (K,) part of the speed's momentum that damping takes in a step while the teeth touch, which they always do
            without play.
        half: (K,) half the play [rad].
        twist: (K,) at the start, which is a guess. A link is damped so that it forgets it with the fourth power of the
            time gone, or critically, as long as that is more than its own damping.
        step: [s].
        substeps: steps in a sample.
        period: of the samples [s].
    """
    samples, count = len(impulse), len(column)
    torque, second = np.empty((count, samples), np.float32), np.empty((count, samples), np.float32)
    twisted = np.empty((count, samples), np.float32)
    pushed, fallen, kept, moved, momentum, angle, before, speed = np.zeros((8, _TOGETHER))
    has_play = False
    for k in range(count):
        has_play |= half[k] > 0
    for first in range(0, count, _TOGETHER):
        wide = min(_TOGETHER, count - first)
        momentum[:], speed[:] = 0.0, 0.0
        angle[:wide] = twist[first : first + wide]
        for s in range(samples):
            for k in range(wide):
                inverse = min(mobility[s, column[first + k]], followed[first + k])
                pushed[k] = impulse[s, column[first + k]]
                most = 0.5 * spring[first + k]
                fallen[k] = min(max(slope[s, column[first + k]], -most), most)
                taken = loss[first + k] * inverse
                critical = 2.0 * np.sqrt(step * spring[first + k] * inverse)
                forgetting = min(critical, 2.0 * _FORGETTING * step / ((s + 1) * period))
                kept[k] = 1.0 - min(max(taken, forgetting), 1.0)
                moved[k] = inverse
                before[k] = momentum[k]
            for _ in range(substeps):
                if has_play:
                    for k in range(wide):
                        at, end, p = angle[k], half[first + k], momentum[k]
                        beyond = at - min(max(at, -end), end)
                        p = (
                            (p * kept[k] if beyond != 0 else p)
                            + pushed[k]
                            - at * fallen[k]
                            - beyond * spring[first + k]
                        )
                        momentum[k] = p
                        angle[k] = at + step * moved[k] * p
                else:
                    for k in range(wide):
                        at = angle[k]
                        p = momentum[k] * kept[k] + pushed[k] - at * (fallen[k] + spring[first + k])
                        momentum[k] = p
                        angle[k] = at + step * moved[k] * p
            for k in range(wide):
                torque[first + k, s] = (momentum[k] - before[k]) / period + angle[k] * fallen[k] / step
                fast = momentum[k] * moved[k]
                second[first + k, s] = (fast - speed[k]) / period
                speed[k] = fast
                twisted[first + k, s] = angle[k]
    return torque, second, twisted


@compiled("f8[:,::1](f8[:,::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, i8)")
def servo_through_play(
    motion: np.ndarray,
    servo: np.ndarray,
    stiffness: np.ndarray,
    damper: np.ndarray,
    gap: np.ndarray,
    step: float,
    substeps: int,
) -> np.ndarray:
    """(K, S) by how much a joint moves otherwise [rad] whose servo reads the link, behind K gears with play.

    Motor and link are two bodies; teeth push and never pull. The link's load is that of the motion without play, and
    friction holds the motor where it can. Semi-implicit steps, each with the motion straight between samples.

    Args:
        motion: (6, S) torque of the servo, load and speed of the link, inertia of the link, slope of its load, and 1
            where the servo is not at its limit, along the motion without play.
        servo: gain, its part of the damping, damping and Coulomb friction of the motor, its inertia, least and largest
            torque.
        stiffness: (K,) of the teeth [N·m/rad].
        damper: (K,) while they touch [N·m·s/rad].
        gap: (K,) [rad].
        step: [s].
        substeps: steps in a sample.
    """
    count, samples = len(gap), motion.shape[1]
    kp, kv, viscous, coulomb, rotor, low, high = servo
    moved = np.zeros((count, samples))
    for g in range(count):
        spring, half = stiffness[g], 0.5 * gap[g]
        least = step * max(step * spring, damper[g])  # the lightest body that the steps can follow
        inertia = max(rotor, least)
        grip = step * coulomb / (inertia + step * viscous)
        load = motion[1, 0]
        lead = load / spring + (half if load >= 0 else -half)
        away, rate, lead_rate, turning = 0.0, 0.0, 0.0, motion[2, 0]
        for s in range(samples - 1):
            moved[g, s] = away
            mass, slope, pulls = max(motion[3, s], least), motion[4, s], motion[5, s]
            for i in range(substeps):
                middle = (i + 0.5) / substeps
                torque = motion[0, s] + middle * (motion[0, s + 1] - motion[0, s])
                load = motion[1, s] + middle * (motion[1, s + 1] - motion[1, s])
                speed = motion[2, s] + (i + 1.0) / substeps * (motion[2, s + 1] - motion[2, s])
                passed = 0.0
                if lead > half:
                    passed = max(spring * (lead - half) + damper[g] * lead_rate, 0.0)
                elif lead < -half:
                    passed = min(spring * (lead + half) + damper[g] * lead_rate, 0.0)
                torque = min(max(torque - pulls * (kp * away + kv * rate), low), high)
                turning = (turning * inertia + step * (torque - passed)) / (inertia + step * viscous)
                turning = np.sign(turning) * max(abs(turning) - grip, 0.0)
                rate += step * (passed - load - slope * away) / mass
                away += step * rate
                lead_rate = turning - speed - rate
                lead += step * lead_rate
        moved[g, samples - 1] = away
    return moved
