"""Lost and repeated samples, by the numbers that the controller gives them."""

from __future__ import annotations

import numpy as np

#: Holes that are remembered for samples that come late; older ones count as lost for good.
_REMEMBERED = 256


class SequenceCheck:
    """Follows the sequence numbers of a stream that should count up by one.

    A sample that fills a hole is welcome, however late. One that was there before is a repetition. A counter that
    starts anew while controller time goes on is a restart: nothing is known to be lost, and nothing is left out.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self._next: int | None = None
        self._time = -np.inf
        self._holes: list[tuple[int, int]] = []

    def take(self, sequence: np.ndarray, time: np.ndarray) -> np.ndarray:
        """(K,) mask of the samples to keep, from their sequence numbers and controller times (K,) [s]."""
        numbers = np.asarray(sequence, np.int64)
        times = np.asarray(time, float)
        keep = np.ones(len(numbers), bool)
        if len(numbers) == 0:
            return keep
        start = int(numbers[0]) if self._next is None else self._next
        if np.array_equal(numbers, np.arange(start, start + len(numbers))):
            self._next, self._time = start + len(numbers), float(times[-1])
            return keep
        for k, (number, now) in enumerate(zip(numbers.tolist(), times.tolist(), strict=True)):
            keep[k] = self._take(number, now)
        return keep

    def _take(self, number: int, now: float) -> bool:
        if self._next is None or number == self._next:
            self._next = number + 1
        elif number > self._next:
            self.lost += number - self._next
            self._holes = [*self._holes[-_REMEMBERED:], (self._next, number)]
            self._next = number + 1
        elif now > self._time:
            self._holes.clear()
            self._next = number + 1
        else:
            return self._fill(number)
        self._time = now
        return True

    def _fill(self, number: int) -> bool:
        for index, (start, stop) in enumerate(self._holes):
            if start <= number < stop:
                rest = [(start, number), (number + 1, stop)]
                self._holes[index : index + 1] = [hole for hole in rest if hole[0] < hole[1]]
                self.lost -= 1
                return True
        self.repeated += 1
        return False
