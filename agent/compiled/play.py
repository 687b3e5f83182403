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
