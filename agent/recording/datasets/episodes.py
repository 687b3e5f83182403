"""What a recorder of positions and commands leaves: episodes in its own units, before they become logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

#: Keys of the record `run`: how the arm got its command between two frames, and where the stamps come from.
HOLD, STAMPS, UNITS = "command_hold", "stamps", "units"
#: Values of them.
HELD, SMOOTH, FRAME_NUMBER = "held", "smooth", "frame_number"
_ARRAYS = ("position", "command", "velocity", "effort")


@dataclass(frozen=True, eq=False)
class Episode:
    """One motion of K frames and n columns.

    Attributes
    ----------
    name : as it is held out and reported.
    time : (K,) s.
    position : (K, n), in the recorder's unit.
    command : (K, n) set-points in that unit; None where the recorder has none.
    velocity, effort : (K, n) or None, SI.
    """

    name: str
    time: np.ndarray
    position: np.ndarray
    command: np.ndarray | None = None
    velocity: np.ndarray | None = None
    effort: np.ndarray | None = None

    @property
    def finite(self) -> np.ndarray:
        """(K,) whether a frame has its time, and a number for every joint."""
        arrays = [values for name in _ARRAYS if (values := getattr(self, name)) is not None]
        return np.all([np.isfinite(self.time), *(np.all(np.isfinite(values), axis=1) for values in arrays)], axis=0)

    def of_rows(self, rows: np.ndarray) -> Episode:
        """These frames alone, in this order."""
        return replace(self.changed(lambda values: values[rows]), time=self.time[rows])

    def changed(self, change: Callable[[np.ndarray], np.ndarray], only: tuple[str, ...] = _ARRAYS) -> Episode:
        """A copy in which the arrays (K, n) that there are have been changed alike."""
        arrays: dict[str, Any] = {name: change(values) for name in only if (values := getattr(self, name)) is not None}
        return replace(self, **arrays)


@dataclass(frozen=True, eq=False)
class Recorded:
    """Episodes of one file or folder.

    Attributes
    ----------
    joints : names of the columns; empty where the recorder names none.
    unit : `rad`; empty: it has to be found from the values.
    rate : nominal rate [Hz]; None: that of the stamps.
    facts : what the record `run` of each log says in addition.
    sha256 : of the files that were read.
    notes : what there is to say.
    """

    path: Path
    joints: tuple[str, ...]
    episodes: tuple[Episode, ...]
    unit: str = "rad"
    rate: float | None = None
    facts: dict[str, str] = field(default_factory=dict)
    sha256: str = ""
    notes: tuple[str, ...] = ()

    @property
    def columns(self) -> int:
        """Number of columns of a position."""
        return self.episodes[0].position.shape[1]

    def changed(self, change: Callable[[np.ndarray], np.ndarray], only: tuple[str, ...] = _ARRAYS) -> Recorded:
        """A copy in which the arrays (K, n) of all episodes have been changed alike."""
        return replace(self, episodes=tuple(episode.changed(change, only) for episode in self.episodes))

    def of_columns(self, columns: list[int]) -> Recorded:
        """These columns alone, in this order."""
        names = tuple(self.joints[k] for k in columns) if self.joints else ()
        return replace(self.changed(lambda values: values[:, columns]), joints=names)
