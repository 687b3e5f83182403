"""The samples that a controller keeps for whoever missed them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from fake_controller.execution import Slice

RING = 100_000  # samples


@dataclass(frozen=True, eq=False)
class Recorded:
    """Consecutive samples from sequence number `first` on, with their controller times (K,) [ns]."""

    first: int
    time_ns: np.ndarray
    samples: Slice


@dataclass
class Ring:
    """The last `RING` samples of a motion."""

    size: int = 0
    parts: deque[Recorded] = field(default_factory=deque)

    def append(self, part: Recorded) -> None:
        """Keep it; the oldest make room."""
        self.parts.append(part)
        self.size += len(part.samples)
        while self.size > RING:
            self.size -= len(self.parts.popleft().samples)

    def find(self, first: int) -> Recorded | None:
        """The part that has sample `first`, or the earliest after it."""
        return next((part for part in self.parts if part.first + len(part.samples) > first), None)
