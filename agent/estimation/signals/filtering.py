"""From a log to smooth motion, and the one zero-phase filter that torque and regressor share.

Two stages (AIM 2013, section III), both as a real response in the frequency domain, hence zero phase:

1. Positions are smoothed by L(f) = ½ erfc((|f| - f_m) / (√2 w)), which is 1 within 4e-5 up to `pass_edge`, well above
   the cut-off; velocity and acceleration are (2πjf) L and (2πjf)² L of the same positions: no difference scheme, no
   error where the filter passes. Torque columns are built from these signals: a friction law needs the reversal as
   sharp as the data has it.
2. The Butterworth filter run forward and backward, |H(f)|² = 1 / (1 + (tan(πf/f_s) / tan(πf_c/f_s))^(2 order)): order 8
   falls like order 16 and is at -6 dB at the cut-off. It acts on the measured torque and on every column or prediction
   alike, so that the torque equation holds after it as before.

Beyond its ends a signal goes on by point reflection; what the ends can still disturb is dropped. The kernel of L is a
sinc under a Gaussian and that of |H|² decays exponentially, so nothing reaches further in than that.

Velocities of noisy positions are quietened: a wide band where the joint turns fast, a narrow one where it creeps.

Friction depends on the sign of a velocity that may be far below the noise of a differentiated position: positions
rounded to 1e-4 rad make a resting joint reverse hundreds of times a second. Here the velocity is taken from a family of
bands, each half as wide as the one before, and at every sample from the narrowest one that no wider one contradicts by
more than their noise (Lepski, Theory Probab. Appl. 35, 1991; intersection of confidence intervals: Goldenshluger and
Nemirovski, Math. Methods Statist. 6, 1997). Without noise that is the widest, so exact positions lose nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from agent.core import InputError
from agent.estimation.signals.clock import SampleClock
from agent.recording import Log

_NARROWEST = 1.5  # Hz
_CONFIDENCE = 3.0  # standard deviations by which two bands may differ
_AUDIBLE = 6e-4  # of the highest speed, in a band of 100 Hz: less noise is left alone
_SPECTRUM = 1024  # samples, of the spectrum
_TOP = 0.4  # of the sampling rate: no motion is beyond


def quiet_velocity(
    position: np.ndarray,
    rate: float,
    velocity: np.ndarray,
    stop_edge: float,
    narrower: Callable[[float, np.ndarray], np.ndarray],
) -> np.ndarray:
    """(S, n) velocity; `velocity` is that of the widest band, which ends at `stop_edge` [Hz].

    `position` (P, n) at `rate` [Hz] tells the noise; narrower(factor, joints) gives the velocity (S, k) of some joints
    in a band `factor` times as wide.
    """
    if len(position) < 2 * _SPECTRUM:
        return velocity
    # noise of density 2 σ² / f_s, differentiated, in a band of 100 Hz
    noise = np.sqrt(8 * np.pi**2 / 3 * white_noise(position) * 100.0**3 / rate)
    deviation = noise * (stop_edge * 5 / 6 / 100.0) ** 1.5  # up to the middle of the band's edge
    fastest = np.abs(velocity).max(axis=0)
    noisy = np.flatnonzero((noise > _AUDIBLE * fastest) & (fastest > 0))
    if len(noisy) == 0:
        return velocity
    chosen = velocity.copy()
    bands = [(velocity[:, noisy], deviation[noisy])]
    agrees = np.ones((len(velocity), len(noisy)), dtype=bool)
    factor = 0.5
    while factor * stop_edge >= _NARROWEST:
        band, own = narrower(factor, noisy), deviation[noisy] * factor**1.5
        for wider, theirs in bands:
            agrees &= np.abs(band - wider) <= _CONFIDENCE * (own + theirs)
        if not agrees.any():
            break
        chosen[:, noisy] = np.where(agrees, band, chosen[:, noisy])
        bands.append((band, own))
        factor /= 2
    return chosen


def white_noise(position: np.ndarray) -> np.ndarray:
    """(n,) variance of what is white in positions (S, n), by their spectrum where no motion is."""
    step = np.diff(position, axis=0)  # so that what a motion leaves of its ends in the spectrum is little
    window = np.hanning(_SPECTRUM)[:, None]
    pieces = [step[first : first + _SPECTRUM] for first in range(0, len(step) - _SPECTRUM + 1, _SPECTRUM // 2)]
    power = np.mean([np.abs(np.fft.rfft(piece * window, axis=0)) ** 2 for piece in pieces], axis=0)
    frequency = np.fft.rfftfreq(_SPECTRUM)
    top = frequency > _TOP
    response = 4 * np.sin(np.pi * frequency[top]) ** 2 * np.sum(window**2)
    return np.median(power[top] / response[:, None], axis=0)


DEFAULT_CUTOFF = 30.0
_Responses = Callable[[np.ndarray], list[np.ndarray]]  # over frequency [Hz]
#: Longest gap that is bridged, in periods of the cut-off: signals in the passband change little within one.
_BRIDGED = 1.0
_FAR = 1e9  # of the cut-off: beyond it nothing passes, and a power of it would overflow
_HALF_BAND = 4.0  # half of a transition band, in standard deviations of the Gaussian that makes it
_PIECE = 30_000  # samples worked on at a time
_BRAKED = 1e-4, 1e-9  # rad or m, and N·m or N, by which neither position nor torque of a braked joint changes
_TOGETHER = 16  # signals transformed at a time, so that they stay in the cache


@dataclass(frozen=True)
class FilterSettings:
    """Settings of the user; None is chosen from the data. Frequencies in Hz.

    cutoff: -6 dB point of the zero-phase filter (30 Hz, lower where the sampling rate is too low for it).
    order: of the Butterworth filter, before it runs forward and backward.
    """

    cutoff: float | None = None
    order: int = 8


@dataclass(frozen=True, eq=False)
class Motion:
    """One segment of a log without gaps, on an even grid. S samples, n joints, joint side, SI.

    time (S,) [s] of the log; q, qd, qdd (S, n) smoothed up to `pass_edge` [Hz]; torque (S, n) before the filter, or
    None; set_points (S, n) of the controller, smoothed alike, or None; `cutoff` [Hz], `order`, `edge` (samples dropped
    at either end) and `step` belong to `low_pass`; `log` is the file's name, `cycle_starts` [s] are the log's.
    """

    log: str
    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    torque: np.ndarray | None
    set_points: np.ndarray | None
    cycle_starts: tuple[float, ...]
    rate: float
    cutoff: float
    order: int
    pass_edge: float
    edge: int
    step: int

    @property
    def braked(self) -> np.ndarray:
        """(n,) joints at standstill with constant torque: a brake holds them, and no measured torque says with what."""
        assert self.torque is not None
        least = zip((self.q, self.torque), _BRAKED, strict=True)
        return np.asarray(np.all([np.ptp(values, axis=0) <= limit for values, limit in least], axis=0))

    def low_pass(self, signals: np.ndarray, every: int = 1) -> np.ndarray:
        """(S, m) signals of this motion → (S', m) filtered at the cut-off, edges dropped, every `step`-th sample.

        Signals of the samples `thinned(every)` alone do as well. Fastest where a signal's samples lie one after the
        other in memory; so they do in what it returns.
        """

        def response(frequency: np.ndarray) -> list[np.ndarray]:
            return [_butterworth(self.rate, self.cutoff, self.order, float(frequency[1]), len(frequency))]

        first, stop = self.edge // every, -(-(len(self.time) - self.edge - self.edge % every) // every)
        return _respond(signals, self.rate / every, response, slice(first, stop, self.step // every))[0]

    @property
    def kept(self) -> slice:
        """Samples of `time`, `q`, … that `low_pass` returns."""
        return slice(self.edge, len(self.time) - self.edge, self.step)

    @property
    def fewest(self) -> int:
        """The largest k for which what is smooth in the motion, as columns of rigid bodies are, may be computed for
        `thinned(k)` alone: nothing of it comes down below twice the cut-off."""
        lowest = 1.5 * self.pass_edge + 3 * self.cutoff
        return max(k for k in range(1, self.step + 1) if k == 1 or (self.step % k == 0 and self.rate / k >= lowest))

    def thinned(self, every: int) -> slice:
        """Every k-th sample, those of `kept` among them; `every` divides `step`."""
        return slice(self.edge % every, None, every)


@lru_cache(maxsize=16)
def _butterworth(rate: float, cutoff: float, order: int, spacing: float, count: int) -> np.ndarray:
    """(K,) response of the filter run forward and backward, at `count` frequencies a `spacing` [Hz] apart from 0 on.

    Kept, as columns of one motion are filtered some at a time.
    """
    warped = np.tan(np.pi * np.minimum(spacing * np.arange(count) / rate, 0.5)) / np.tan(np.pi * cutoff / rate)
    return np.asarray(1 / (1 + np.minimum(warped, _FAR) ** (2 * order)))


def motions(log: Log, settings: FilterSettings, reduce: bool = True) -> Iterator[Motion]:
    """Smooth motion of every segment of a log that is long enough to filter.

    With `reduce`, the rates before and after the filter are cut to what the cut-off needs; else every sample is kept.

    Args:
        log: positions, and torque and set-points if it has them.
        settings: cut-off and order of the torque filter.
        reduce: whether rates are cut to what the cut-off needs.

    Raises:
        InputError: no segment is longer than the filter's edges, or the sampling rate is too low for the cut-off.
    """
    cutoff = resolve_cutoff(log, settings)
    flat, stop = bands(log.sample_rate, cutoff)
    edge = _edge_time(cutoff, flat, stop)
    needed = _needed(cutoff, edge)
    long_enough, short = _segments(log, cutoff, needed)
    if not long_enough:
        longest = max((log.t[b - 1] - log.t[a] for a, b in short), default=0.0)
        raise InputError(
            f"{log.path}: the longest segment without a gap is {longest:.2f} s; a cut-off of {cutoff:g} Hz "
            f"needs {needed:.2f} s. Record longer, or raise the cut-off"
        )
    for first, last in long_enough:
        clock = SampleClock.of(log, first, last)
        every = max(1, int(clock.rate / (16 * cutoff))) if reduce else 1
        working = clock.rate / every
        margin = int(np.ceil(edge * working))
        step = max(1, int(working / (4 * cutoff))) if reduce else 1
        for piece in log.scratch.each(_pieces(-(-clock.size // every), margin, step)):
            grid = slice(piece.start * every, min(piece.stop * every, clock.size))
            position, torque, set_points = clock.signals(grid)
            smooth = partial(_smooth, rate=clock.rate, band=(flat, stop), every=every)
            q, qd, qdd = smooth(position, orders=(0, 1, 2))
            qd = quiet_velocity(position, clock.rate, qd, stop, partial(_velocity, smooth, position))
            if torque is not None and every > 1:
                (torque,) = smooth(torque, orders=(0,))
            if set_points is not None:
                (set_points,) = smooth(set_points, orders=(0,))
            yield Motion(
                log=log.name,
                time=clock.time(grid)[::every],
                q=q,
                qd=qd,
                qdd=qdd,
                torque=torque,
                set_points=set_points,
                cycle_starts=log.cycle_starts,
                rate=working,
                cutoff=cutoff,
                order=settings.order,
                pass_edge=flat,
                edge=margin,
                step=step,
            )


def used_text(log: Log, settings: FilterSettings) -> str:
    """Text for people: the number of samples of a log that remain after a filter, and the dropped ones."""
    cutoff = resolve_cutoff(log, settings)
    edge = _edge_time(cutoff, *bands(log.sample_rate, cutoff))
    long_enough, short = _segments(log, cutoff, _needed(cutoff, edge))
    stamps = [log.t[a:b] for a, b in long_enough]
    used = sum(int(np.count_nonzero(np.abs(t - (t[0] + t[-1]) / 2) <= (t[-1] - t[0]) / 2 - edge)) for t in stamps)
    text = f"{log.name}: {used} of {len(log.t)} samples used"
    if len(short) or len(long_enough) > 1:
        text += f", of {len(long_enough)} of {len(long_enough) + len(short)} segments between gaps"
    if short:
        longest = max(float(log.t[b - 1] - log.t[a]) for a, b in short)
        first = float(log.t[short[0][0]])
        text += (
            f"; {sum(b - a for a, b in short)} samples are in segments too short to be filtered at {cutoff:g} Hz "
            f"(the first at {first:.3f} s, the longest of {longest:.2f} s) and left out"
        )
    return text


def _segments(log: Log, cutoff: float, needed: float) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Segments between gaps, first and last sample: those longer than what is `needed` [s], and the others."""
    segments = log.bridged(_BRIDGED / cutoff)
    long_enough = [(a, b) for a, b in segments if log.t[b - 1] - log.t[a] > needed]
    return long_enough, [segment for segment in segments if segment not in long_enough]


def _needed(cutoff: float, edge: float) -> float:
    """Shortest segment [s] that is filtered."""
    return 2 * edge + 3 / cutoff


def _pieces(size: int, margin: int, step: int) -> Iterator[slice]:
    """Cut a long segment for the sake of memory, overlapping by the edges so that every sample is kept once."""
    count = -(-(size - 2 * margin) // _PIECE)
    length = -(-(size - 2 * margin) // (count * step)) * step
    for first in range(0, size - 2 * margin, length):
        yield slice(first, min(first + length, size - 2 * margin) + 2 * margin)


def resolve_cutoff(log: Log, settings: FilterSettings) -> float:
    """The cut-off [Hz] for a log: what was asked for, or 30 Hz where the sampling rate allows it.

    Raises:
        InputError: the sampling rate cannot carry the cut-off asked for.
    """
    highest = 0.35 * log.sample_rate
    if settings.cutoff is None:
        return min(DEFAULT_CUTOFF, float(f"{0.3 * log.sample_rate:.3g}"))
    if not 0 < settings.cutoff <= highest:
        raise InputError(
            f"{log.path}: a cut-off of {settings.cutoff:g} Hz does not fit a sampling rate of {log.sample_rate:g} Hz; "
            f"choose one between 0 and {highest:.4g} Hz"
        )
    return settings.cutoff


def smooth_and_differentiate(
    position: np.ndarray, rate: float, pass_edge: float, stop_edge: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Low-pass an evenly sampled (S, n) signal; returns it and its first and second derivative.

    Flat up to `pass_edge`, nothing from `stop_edge` on [Hz].

    Args:
        position: (S, n) evenly sampled.
        rate: of the samples [Hz].
        pass_edge: up to where the filter is flat [Hz].
        stop_edge: from where it passes nothing [Hz].
    """
    q, qd, qdd = _smooth(position, rate, (pass_edge, stop_edge), 1, (0, 1, 2))
    return q, qd, qdd


def _velocity(
    smooth: Callable[..., list[np.ndarray]], position: np.ndarray, factor: float, joints: np.ndarray
) -> np.ndarray:
    """(S, k) of some joints, smoothed in a band `factor` times as wide."""
    return smooth(position[:, joints], orders=(1,), factor=factor)[0]


def _smooth(
    position: np.ndarray,
    rate: float,
    band: tuple[float, float],
    every: int,
    orders: tuple[int, ...],
    factor: float = 1.0,
) -> list[np.ndarray]:
    """Derivatives of these orders, 0 to 2, smoothed as by `smooth_and_differentiate`; the band [Hz] times `factor`."""
    flat, stop = factor * band[0], factor * band[1]
    middle, width = (flat + stop) / 2, (stop - flat) / (2 * _HALF_BAND)

    def responses(frequency: np.ndarray) -> list[np.ndarray]:
        argument = (frequency - middle) / (np.sqrt(2) * width)
        smooth = 0.5 * np.fromiter(map(math.erfc, argument), float, len(argument))
        derivatives = smooth, 2j * np.pi * frequency * smooth, -((2 * np.pi * frequency) ** 2) * smooth
        return [derivatives[order] for order in orders]

    return [np.ascontiguousarray(signal) for signal in _respond(position, rate, responses, slice(0, None, every))]


def _respond(signals: np.ndarray, rate: float, responses: _Responses, window: slice) -> list[np.ndarray]:
    """Apply responses over frequency [Hz] to (S, m) signals continued by point reflection, and return `window` of each.

    The spectrum is cut at the new Nyquist frequency where `window` takes every k-th sample, so only responses that pass
    nothing beyond it may be decimated.
    """
    size, count = len(signals), signals.shape[1]
    first, stop, step = window.indices(size)
    reduced = next_fast_len((size + 2 * min(size - 1, int(rate))) // step + 1, real=True)
    length = reduced * step
    before = min(size - 1, (length - size) // 2)
    after = min(size - 1, length - size - before)
    frequency = np.fft.rfftfreq(length, 1 / rate)[: reduced // 2 + 1]
    precision = np.float32 if signals.dtype == np.float32 else np.float64
    gains = [(response / step).astype(np.result_type(response[:0] * precision(1))) for response in responses(frequency)]
    results = [np.empty((count, -(-(stop - first) // step)), dtype=precision) for _ in gains]
    # sample `first` comes first in the transform, what precedes it wraps around
    extended = np.zeros((min(_TOGETHER, count), length), dtype=precision)
    for start in range(0, count, _TOGETHER):
        part = signals[:, start : start + _TOGETHER]
        rows = extended[: part.shape[1]]
        rows[:, : size - first] = part[first:].T
        rows[:, size - first : size - first + after] = 2 * part[-1][:, None] - part[-2 : -after - 2 : -1].T
        rows[:, length - first :] = part[:first].T
        rows[:, length - first - before : length - first] = 2 * part[0][:, None] - part[before:0:-1].T
        spectrum = rfft(rows, axis=1)[:, : len(frequency)]
        for result, gain in zip(results, gains, strict=True):
            result[start : start + _TOGETHER] = irfft(spectrum * gain, reduced, axis=1)[:, : result.shape[1]]
    return [result.T for result in results]


def bands(rate: float, cutoff: float) -> tuple[float, float]:
    """Highest frequency at which the smoothing is flat at a sampling rate, and lowest at which it passes nothing."""
    stop = min(4.5 * cutoff, 0.47 * rate)
    return max(stop * 2 / 3, 1.15 * cutoff), stop


def _edge_time(cutoff: float, pass_edge: float, stop_edge: float) -> float:
    """Time dropped at either end [s]: the reach of the smoothing kernel, and four periods of the cut-off.

    By then the Butterworth kernel has fallen to under 1 %; what it adds of the reflected ends is the same in torque and
    columns.
    """
    spread = _HALF_BAND / (np.pi * (stop_edge - pass_edge))
    return 2.5 * spread + 4 / cutoff
