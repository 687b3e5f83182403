"""Figures of one machine from run to run, as arrays: what each follows anyway, and the likeliest change beside it.

Nothing is decided here. Of the changes that are tried (a drift along time or along the number of runs, a step after
every run) the likeliest is reported, with its p-value; alternatives have paid for their
number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from agent.runs.changes import Background, line, sizes_of_change
from agent.runs.warm_up import common_rate, warm_up_response

_SEGMENT = 3  # runs on either side of a step


@dataclass(frozen=True, eq=False)
class FrictionSeries:
    """Friction of one machine in runs of one program: R runs, K levels (an axle at a speed), n axles.

    times (R,) [d]; `axles` the axle of every level; values, deviations (R, K) [N·m], the latter from run to run; rates,
    rate_stds (R, n) [1/s]: relative change of friction while a run lasted and its deviation, NaN where unknown.
    """

    times: np.ndarray
    axles: tuple[int, ...]
    values: np.ndarray
    deviations: np.ndarray
    rates: np.ndarray
    rate_stds: np.ndarray

    def backgrounds(self) -> Iterator[tuple[int, Background]]:
        """What every level that has a logarithm follows besides its own change: the warm-up all axles share."""
        usable = np.all(self.values > 0, axis=0)
        logs = np.log(np.where(self.values > 0, self.values, 1.0))
        centred = logs - np.median(logs, axis=0)
        levels = np.flatnonzero(usable)
        rate = Background(common_rate(self.rates, self.rate_stds))
        found: dict[int, Background] = {}
        for k in levels:
            axle = self.axles[k]
            if axle not in found:
                others = [m for m in levels if self.axles[m] != axle]
                found[axle] = rate
                if len({self.axles[m] for m in others}) >= 3:  # else wear of one would be half of the others' median
                    scatter = np.median(self.deviations[:, others] / self.values[:, others])
                    noise = np.pi / 2 * float(scatter) ** 2 / len(others)  # of a median
                    answer = warm_up_response(self.rates, axle)
                    found[axle] = Background(np.median(centred[:, others], axis=1), *answer, noise)
            yield int(k), found[axle]


@dataclass(frozen=True, eq=False)
class SeriesChange:
    """The likeliest change of a series: `kind` drift or step, after run `place`, of `size` over the whole window with
    its `deviation`; `shape` (R,) is 1 from end to end; `probability` that chance does as much. `drift` is the size of
    what is linear in time, with its deviation, whatever the likeliest is."""

    kind: str
    place: int
    size: float
    deviation: float
    probability: float
    shape: np.ndarray
    drift: float
    drift_deviation: float


def find_change(y: np.ndarray, times: np.ndarray, background: Background) -> SeriesChange:
    """The likeliest change of y (R,) beside its background."""
    number = np.arange(len(y))
    places = np.arange(_SEGMENT, len(y) - _SEGMENT + 1)
    # age wears, and so does use
    shapes = np.vstack([line(times), line(number), (number >= places[:, None]) - 0.5])
    sizes, deviations, p_values = sizes_of_change(y, background, shapes)
    paid = p_values * 2 * np.repeat([2, len(places)], [2, len(places)])
    best = int(np.argmin(paid))
    kind, place = ("drift", 1) if best < 2 else ("step", int(places[best - 2]))
    p_value = min(1.0, float(paid[best]))
    size, deviation = float(sizes[best]), float(deviations[best])
    return SeriesChange(kind, place, size, deviation, p_value, shapes[best], float(sizes[0]), float(deviations[0]))
