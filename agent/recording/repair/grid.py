"""The even grid behind stamps that jitter: at what rate samples were taken, and the number of each.

A node that stamps on arrival is late by another amount each time, although it samples evenly. Stamps in order then give
each sample its number on the grid, however large the jitter: numbers rise by at least one from row to row, as near to
the stamps as they can.
"""

from __future__ import annotations

import numpy as np

_BEGIN = 200  # samples of the first line
_CLEAR = 0.25  # of a period: every interval that is off by less tells how many samples it holds
_LOOKED_AT = 20_000  # samples that give its rate
_SEARCHED = 0.25  # of the rate, to either side
_FINE = 16  # parts of a period in which stamps are counted
_NOISE = 4.0  # times the amplitude of random phases: by chance one rate in a million has as much
_ABOUT, _FEWEST = 50, 100  # neighbours that show the usual power: part of the rate, and frequencies at least
_DOUBT, _AROUND, _ROUNDS = 4, 9, 2  # rows by which the index of a missing sample may be wrong, rows around it, rounds
_DEGREE = 5
_FAR = 8  # rows by which it may be wrong where the rows around stay rough
_ROUGH = 10.0  # mean squared distance from the quintic, in noise: more is no noise


def grid_rate(stamps: np.ndarray, rate: float) -> float | None:
    """Rate [Hz], near `rate`, of the even grid behind jittering stamps (S,) [s]; None where there is no grid.

    At that rate |mean exp(2πj f t)| has its peak (Rayleigh's test). Intervals that vary freely keep no phase, but they
    also make a hump about their mean rate, so a grid has to stand out of the frequencies next to it.
    """
    stamps = stamps[:_LOOKED_AT] - stamps[0]
    size = 4 * int(_FINE * rate * stamps[-1] + 1)
    if size > 400 * _FINE * len(stamps):
        return None  # mostly gaps
    counts = np.bincount((stamps * rate * _FINE).astype(int), minlength=size)
    power = np.abs(np.fft.rfft(counts) / len(stamps)) ** 2
    first, stop = (int(factor * size / _FINE) for factor in (1 - _SEARCHED, 1 + _SEARCHED))
    best = first + int(np.argmax(power[first:stop]))
    about = max(size // _FINE // _ABOUT, _FEWEST)
    noise = max(float(np.median(power[max(best - about, 1) : best + about])) / np.log(2), 1 / len(stamps))
    return best * _FINE * rate / size if power[best] > _NOISE**2 * noise else None


def sample_numbers(stamps: np.ndarray, rate: float) -> np.ndarray:
    """(S,) numbers, from 0 and rising, of sorted stamps (S,) [s] on a grid of about `rate` [Hz].

    A rate that is off by 1e-4 is half a period off after 5000 samples. So the rate is that at which the stamps keep
    their phase best: of those that `grid_rate` looks at, of twice as many near that one, and so on. Where they keep
    none, it is that of a line through the numbers, of the first 200 and of twice as many again and again. Elsewhere
    that would not do: with stamps that are late, numbers slip with its rate.
    """
    time = stamps - stamps[0]
    steps = np.diff(time) * rate
    whole = np.round(steps)
    if np.all((np.abs(steps - whole) < _CLEAR) & (whole > 0)):
        return np.append(0.0, np.cumsum(whole))
    if (grid := grid_rate(time, rate)) is None:
        return _along_lines(time, rate)
    size = min(_LOOKED_AT, len(time))
    while True:
        rates = grid + 0.5 / time[size - 1] * np.linspace(-1, 1, 2 * _FINE + 1)
        turns = [np.exp(2j * np.pi * trial * time[:size]).mean() for trial in rates]
        best = int(np.argmax(np.abs(turns)))
        grid = float(rates[best])
        if size == len(time):
            break
        size = min(2 * size, len(time))
    periods = grid * time - np.angle(turns[best]) / (2 * np.pi)
    rows = np.arange(len(periods))
    smooth = _not_falling(periods - rows)
    late = np.angle(np.exp(2j * np.pi * smooth).mean()) / (2 * np.pi)  # on average, a part of a period
    number = rows + np.round(smooth - late)
    return np.asarray(number - number[0])


def _along_lines(time: np.ndarray, rate: float) -> np.ndarray:
    """(S,) numbers of stamps (S,) [s] from 0 on, each nearest to the line through those before."""
    size, slope = _BEGIN, 1 / rate
    intercept = np.angle(np.exp(2j * np.pi * rate * time[:size]).mean()) / (2 * np.pi * rate)
    while True:
        periods = (time[:size] - intercept) / slope
        rows = np.arange(len(periods))
        number = np.round(periods)
        if not np.all(np.diff(number) > 0):
            number = rows + np.round(_not_falling(periods - rows))
        if size >= len(time):
            return np.asarray(number - number[0])
        slope, intercept = line(number, time[:size])
        size *= 2


def _not_falling(values: np.ndarray) -> np.ndarray:
    """The (S,) that do not fall and are nearest to values (S,) in least squares.

    Numbers rise by at least one from row to row. So minus the row's own number they must not fall, and the nearest such
    numbers are these, rounded (isotonic regression).
    """
    from scipy.optimize import isotonic_regression  # slow to load

    return np.asarray(isotonic_regression(values).x)


def settled(number: np.ndarray, periods: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(S,) the numbers with each missing sample where positions are smoothest and stamps least off.

    Jitter hides the index of a missing sample by a few rows. Positions are near a quintic through nine rows to either
    side; a cubic would not follow a start at 50 rad/s². Two adjacent missing samples hide each other's index: if moving
    one leaves the rows rough, both are moved, or one is moved further.

    Args:
        number: (S,) of the samples.
        periods: (S,) stamps in periods.
        position: (S, n).
    """
    if len(number) < _AROUND:
        return number
    number = number.copy()
    relative = number - number[0], periods - periods[0]
    spread = max(float(np.std(relative[0] - relative[1])), 1e-3)
    noise = np.median(np.abs(np.diff(position, 4, axis=0)), axis=0) / 5.6  # of white noise σ: √70 σ · 0.67
    steps = np.abs(np.diff(position, axis=0))
    noise = np.maximum(noise, 1e-3 * np.std(np.diff(position, axis=0), axis=0))
    # the median is zero for a joint that mostly stays on one count; then a step of one count is the noise
    noise = np.maximum(noise, np.min(np.where(steps > 0, steps, np.inf), axis=0, initial=np.inf) / np.sqrt(12))
    noise = np.where(np.isfinite(noise), noise, 0.0)
    moving = noise > 0
    scaled = position[:, moving] / noise[moving]
    tried: set[tuple[int, bytes]] = set()
    for _ in range(_ROUNDS):
        for hole in np.flatnonzero(np.diff(number) > 1).tolist():
            first, stop = max(hole - _AROUND, 0), min(hole + _AROUND + 2, len(number))
            rows, stamps, row, before = scaled[first:stop], periods[first:stop], hole - first, number[first:stop]
            if (hole, before.tobytes()) in tried:
                continue  # as it was in the round before, which left it so
            trials = _moved(before, row)
            if not len(trials):
                continue
            costs = _costs(trials, rows, stamps, spread)
            if costs.min() > _ROUGH * rows.size:
                further = [_moved(before, row, _FAR)]
                for other in np.flatnonzero(np.diff(before) > 1).tolist():
                    if other != row:
                        further.append(_moved(before, other, _FAR))
                        further += [_moved(trial, row) for trial in _moved(before, other)]
                trials = np.concatenate([trials, *further])
                costs = np.append(costs, _costs(trials[len(costs) :], rows, stamps, spread))
            best = trials[int(np.argmin(costs))]
            if np.array_equal(best, before):
                tried.add((hole, before.tobytes()))
            number[first:stop] = best
    return number


def _costs(trials: np.ndarray, rows: np.ndarray, stamps: np.ndarray, spread: float) -> np.ndarray:
    """(T,) of numbers (T, S): squared distance of rows (S, n) from a quintic, and of stamps (S,) from even ones."""
    offsets = (trials - trials[:, [trials.shape[1] // 2]]) / _AROUND
    basis = np.linalg.qr(offsets[:, :, None] ** np.arange(_DEGREE, -1, -1))[0]
    rough = np.sum(rows**2) - np.sum((np.swapaxes(basis, 1, 2) @ rows) ** 2, axis=(1, 2))
    return rough + np.var(trials - stamps, axis=1) * len(rows) / spread**2


def _moved(number: np.ndarray, hole: int, most: int = _DOUBT) -> np.ndarray:
    """(T, S) the numbers (S,) with a sample that is missing after row `hole` missing some rows earlier or later."""
    if number[hole + 1] - number[hole] <= 1:
        return np.empty((0, len(number)))
    row = np.arange(len(number))
    shift = np.arange(-min(most, hole), min(most, len(number) - hole - 2) + 1)[:, None]
    earlier, later = (row <= hole) & (row > hole + shift), (row > hole) & (row <= hole + shift)
    return number + earlier - later


def line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and intercept of the line through points (S,) in least squares."""
    middle, height = x.mean(), y.mean()
    centred = x - middle
    slope = float(centred @ (y - height) / (centred @ centred))
    return slope, float(height - slope * middle)
