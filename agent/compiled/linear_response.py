"""The motion of a linear arm that changes with time, for many inputs at once."""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled


@compiled("f8[:,:,::1](f8[:,:,::1], f8[:,:,::1], f8[::1], f8[:,:,::1], i8, i8)")
def stepped(
    system: np.ndarray, entry: np.ndarray, half: np.ndarray, inputs: np.ndarray, first: int, every: int
) -> np.ndarray:
    """(R, n, K) positions of v ← A [q, v] + B u, q ← q + h/2 (v + v before), from rest on. S steps have S + 1 states.

    Args:
        system: A (S, n, 2n) of each step.
        entry: B (S, n, J).
        half: h/2 (S,).
        inputs: u (S, J, K).
        first: state that is returned first.
        every: states from one that is returned to the next.
    """
    steps, n, joints, columns = len(system), system.shape[1], inputs.shape[1], inputs.shape[2]
    answers = np.zeros(((steps - first) // every + 1, n, columns))
    place, speed, after = np.zeros((n, columns)), np.zeros((n, columns)), np.zeros((n, columns))
    row = 1 if first == 0 else 0
    for k in range(steps):
        for i in range(n):
            of = after[i]
            of[:] = 0.0
            for j in range(n):
                by_place, by_speed, q, v = system[k, i, j], system[k, i, n + j], place[j], speed[j]
                for c in range(columns):
                    of[c] += by_place * q[c] + by_speed * v[c]
            for j in range(joints):
                factor, u = entry[k, i, j], inputs[k, j]
                for c in range(columns):
                    of[c] += factor * u[c]
        for i in range(n):
            for c in range(columns):
                place[i, c] += half[k] * (speed[i, c] + after[i, c])
        speed, after = after, speed
        if k + 1 == first + row * every:
            answers[row] = place
            row += 1
    return answers
