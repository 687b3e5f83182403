"""A link that its motor drives through a spring with play: the steps of its integration."""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled

_TOGETHER = 64  # links that take their steps side by side: their states stay in the fastest cache


@compiled(
    "Tuple((f4[:,::1], f4[:,::1]))"
    "(f8[:,::1], f8[:,::1], i8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, i8, f8)"
)
def driven_through_play(
    impulse: np.ndarray,
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
) -> tuple[np.ndarray, np.ndarray]:
    """(K, S) change of K links' momentum [N·m], and of their speed [rad/s²], in each sample of `period` [s].

    impulse, mobility (S, M): what pushes in a step of length `step` [s], and one over the inertia, of which link k has
    `column` k (K,), the mobility `followed` (K,) at most. spring (K,): impulse of a step per twist beyond half the play
    (K,); loss (K,): part of the speed's momentum that damping takes in a step while the teeth touch, which they always
    do where no link has play; twist (K,): at the start.
    """
    samples, count = len(impulse), len(column)
    torque, second = np.empty((count, samples), np.float32), np.empty((count, samples), np.float32)
    pushed, kept, moved, momentum, angle, before, speed = np.zeros((7, _TOGETHER))
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
                kept[k] = 1.0 - loss[first + k] * inverse
                moved[k] = inverse
                before[k] = momentum[k]
            for _ in range(substeps):
                if has_play:
                    for k in range(wide):
                        at, end, p = angle[k], half[first + k], momentum[k]
                        beyond = at - min(max(at, -end), end)
                        p = (p * kept[k] if beyond != 0 else p) + pushed[k] - beyond * spring[first + k]
                        momentum[k] = p
                        angle[k] = at + step * moved[k] * p
                else:
                    for k in range(wide):
                        at = angle[k]
                        p = momentum[k] * kept[k] + pushed[k] - at * spring[first + k]
                        momentum[k] = p
                        angle[k] = at + step * moved[k] * p
            for k in range(wide):
                torque[first + k, s] = (momentum[k] - before[k]) / period
                fast = momentum[k] * moved[k]
                second[first + k, s] = (fast - speed[k]) / period
                speed[k] = fast
    return torque, second
