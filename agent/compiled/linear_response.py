"""The steps of a linear system that changes with time, for many inputs at once."""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled


@compiled("f8[:,:,::1](f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], i8, i8, i8)")
def stepped(
    system: np.ndarray, entry: np.ndarray, inputs: np.ndarray, first: int, every: int, outputs: int
) -> np.ndarray:
    """(R, `outputs`, K) first outputs of x ← A x + B u from x = 0 on. S steps have S + 1 states.

    Args:
        system: A (S, m, m) of each step.
        entry: B (S, m, J).
        inputs: u (S, J, K).
        first: state that is returned first.
        every: states from one that is returned to the next.
        outputs: number of states' entries that are returned.
    """
    steps, size, columns = len(system), system.shape[1], inputs.shape[2]
    answers = np.zeros(((steps - first) // every + 1, outputs, columns))
    state, before = np.zeros((size, columns)), np.zeros((size, columns))
    row = 1 if first == 0 else 0
    for k in range(steps):
        state, before = before, state
        for i in range(size):
            for c in range(columns):
                state[i, c] = 0.0
            for j in range(size):
                factor = system[k, i, j]
                for c in range(columns):
                    state[i, c] += factor * before[j, c]
            for j in range(entry.shape[2]):
                factor = entry[k, i, j]
                for c in range(columns):
                    state[i, c] += factor * inputs[k, j, c]
        if k + 1 == first + row * every:
            answers[row] = state[:outputs]
            row += 1
    return answers
