"""Lost and repeated samples, by the numbers that the controller gives them."""

from __future__ import annotations

import numpy as np

#: Missing samples that may still come; older ones count as lost for good.
_REMEMBERED = 256


class SequenceCheck:
    """Follows the sequence numbers of a stream that should count up by one.

    A missing sample that comes late is kept. One that was there before is a repetition. A counter that starts anew
    while controller time goes on is a restart: nothing counts as lost, and nothing is left out.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self._next: int | None = None
        self._time = -np.inf
        self._missing: list[int] = []

    def take(self, sequence: np.ndarray, time: np.ndarray) -> np.ndarray:
        """(K,) mask of the samples to keep, from their sequence numbers and controller times (K,) [s]."""
        numbers = np.asarray(sequence, np.int64)
        if len(numbers) and np.array_equal(numbers, np.arange(len(numbers)) + (self._next or numbers[0])):
            self._next, self._time = int(numbers[-1]) + 1, float(time[-1])
            return np.ones(len(numbers), bool)
        return np.array([self._take(*row) for row in zip(numbers.tolist(), time.tolist(), strict=True)], bool)

    def _take(self, number: int, now: float) -> bool:
        expected = number if self._next is None else self._next
        if number in self._missing and now <= self._time:
            self._missing.remove(number)
            self.lost -= 1
            return True
        if number < expected and now <= self._time:
            self.repeated += 1
            return False
        if number < expected:
            self._missing = []
        elif number > expected:
            self.lost += number - expected
            late = range(max(expected, number - _REMEMBERED), number)
            self._missing = [*self._missing, *late][-_REMEMBERED:]
        self._next, self._time = number + 1, now
        return True
