"""From a log to smooth motion, and the one zero-phase filter that torque and regressor share.

Two stages (AIM 2013, section III; CONTRACTS.md, 5):

1. Positions are smoothed and differentiated by one convolution each. The kernel is an ideal low-pass windowed by a
   Gaussian, k(t) = 2 f sinc(2 f t) exp(-t² / 2 s²); velocity and acceleration use its exact derivatives k'(t) and
   k''(t). All three share one magnitude response, an error function in frequency that is 1 within 4e-5 up to
   `pass_edge`, well above the cut-off, so that differentiation costs nothing where the filter passes. Torque columns
   are built from these signals: a friction law needs the reversal as sharp as the data has it.
2. The zero-phase Butterworth filter (forward and backward, so that an order of 8 acts as 16 and the cut-off lies at
   -6 dB) at the cut-off, on the measured torque and on every column or prediction alike. As it is linear, the torque
   equation holds after it as before. Its edges are dropped, then the rate is reduced.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from agent.errors import InputError
from agent.recording.log import Log

DEFAULT_CUTOFF = 30.0
_GAUSS = 4.0  # width of half a transition band, in standard deviations of the Gaussian


@dataclass(frozen=True)
class FilterSettings:
    """What a user may ask for; None is chosen from the data. Frequencies in Hz.

    cutoff: -6 dB point of the zero-phase filter (30 Hz, lower where the sampling rate is too low for it).
    order: of the Butterworth filter, before it runs forward and backward.
    smoothing: up to where the smoothing of positions is flat.
    """

    cutoff: float | None = None
    order: int = 8
    smoothing: float | None = None


@dataclass(frozen=True, eq=False)
class Motion:
    """One stretch of a log without gaps, on an even grid. S samples, n joints, joint side, SI.

    time (S,) [s] of the log; q, qd, qdd (S, n) smoothed up to `pass_edge` [Hz]; torque (S, n) as measured or None;
    `cutoff` [Hz], `order` and `edge` (samples dropped at either end) belong to `low_pass`; `log` is the file's name.
    """

    log: str
    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    torque: np.ndarray | None
    rate: float
    cutoff: float
    order: int
    pass_edge: float
    edge: int
    step: int

    def low_pass(self, signals: np.ndarray) -> np.ndarray:
        """(S, …) samples of this motion → (S', …) filtered at the cut-off, edges dropped, every `step`-th sample."""
        from scipy.signal import butter, sosfiltfilt

        sections = butter(self.order, self.cutoff, fs=self.rate, output="sos")
        filtered = sosfiltfilt(sections, signals, axis=0, padlen=min(self.edge, len(signals) - 1))
        return filtered[self.kept]

    @property
    def kept(self) -> slice:
        """Samples of `time`, `q`, … that `low_pass` returns."""
        return slice(self.edge, len(self.time) - self.edge, self.step)


def motions(log: Log, settings: FilterSettings, reduce: bool = True) -> Iterator[Motion]:
    """Smooth motion of every stretch of a log that is long enough to filter.

    With `reduce`, the rates before and after the filter are cut to what the cut-off needs; else every sample is kept.

    Raises:
        InputError: no stretch is longer than the filter's edges, or the sampling rate is too low for the cut-off.
    """
    cutoff = resolve_cutoff(log, settings)
    found = False
    for start, stop in log.segments:
        motion = _motion(log, start, stop, cutoff, settings, reduce)
        if motion is not None:
            found = True
            yield motion
    if not found:
        longest = max((stop - start for start, stop in log.segments), default=0) / log.sample_rate
        needed = 2 * _edge_time(cutoff, *_bands(log, cutoff, settings)) + 1 / cutoff
        raise InputError(
            f"{log.path}: the longest stretch without a gap is {longest:.2f} s; a cut-off of {cutoff:g} Hz "
            f"needs {needed:.2f} s. Record longer, or raise the cut-off"
        )


def resolve_cutoff(log: Log, settings: FilterSettings) -> float:
    """The cut-off [Hz] for a log: what was asked for, or 30 Hz where the sampling rate allows it.

    Raises:
        InputError: the sampling rate cannot carry the cut-off asked for.
    """
    highest = 0.35 * log.sample_rate
    if settings.cutoff is None:
        return min(DEFAULT_CUTOFF, round(0.3 * log.sample_rate, 3))
    if not 0 < settings.cutoff <= highest:
        raise InputError(
            f"{log.path}: a cut-off of {settings.cutoff:g} Hz does not fit a sampling rate of {log.sample_rate:g} Hz; "
            f"choose one between 0 and {highest:.4g} Hz"
        )
    return settings.cutoff


def _bands(log: Log, cutoff: float, settings: FilterSettings) -> tuple[float, float]:
    """Up to where the smoothing is flat, and from where it passes nothing [Hz]."""
    stop = min(4.5 * cutoff, log.sample_rate / 2)
    flat = max(stop * 2 / 3, 1.15 * cutoff)
    if settings.smoothing is not None:
        flat = settings.smoothing
        stop = min(1.5 * flat, log.sample_rate / 2)
        if not 1.15 * cutoff <= flat <= 0.4 * log.sample_rate:
            raise InputError(
                f"{log.path}: positions smoothed at {flat:g} Hz: between 1.15 times the cut-off ({1.15 * cutoff:g} Hz) "
                f"and 0.4 times the sampling rate ({0.4 * log.sample_rate:g} Hz) is possible"
            )
    return flat, stop


def _kernel_time(flat: float, stop: float) -> float:
    """Half length of the smoothing kernel [s]: 4.5 standard deviations of its Gaussian."""
    return 5.0 * 2 * _GAUSS / (2 * np.pi * (stop - flat))


def _edge_time(cutoff: float, flat: float, stop: float) -> float:
    """What is dropped at either end [s]: the kernel, and six periods of the cut-off for the Butterworth filter."""
    return _kernel_time(flat, stop) + 6 / cutoff


def _motion(log: Log, start: int, stop: int, cutoff: float, settings: FilterSettings, reduce: bool) -> Motion | None:
    flat, stopped = _bands(log, cutoff, settings)
    rate = log.sample_rate
    if (stop - start) / rate <= 2 * _edge_time(cutoff, flat, stopped) + 1 / cutoff:
        return None
    time, position, torque = _even(log, start, stop)
    rate = (len(time) - 1) / (time[-1] - time[0])
    first = max(1, int(rate / (16 * cutoff))) if reduce else 1
    q, qd, qdd = smooth_and_differentiate(position, rate, flat, stopped)
    if first > 1 and torque is not None:
        torque = smooth_and_differentiate(torque, rate, flat, stopped)[0]
    working = rate / first
    return Motion(
        log=log.name,
        time=time[::first],
        q=q[::first],
        qd=qd[::first],
        qdd=qdd[::first],
        torque=None if torque is None else torque[::first],
        rate=working,
        cutoff=cutoff,
        order=settings.order,
        pass_edge=flat,
        edge=int(np.ceil(_edge_time(cutoff, flat, stopped) * working)),
        step=max(1, int(working / (4 * cutoff))) if reduce else 1,
    )


def smooth_and_differentiate(
    position: np.ndarray, rate: float, pass_edge: float, stop_edge: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Low-pass an evenly sampled (S, n) signal; returns it with its first and second derivative, (S, n) each.

    Flat up to `pass_edge`, nothing from `stop_edge` on [Hz]. Beyond the ends the signal goes on by point reflection.
    """
    from scipy.signal import oaconvolve

    middle, width = (pass_edge + stop_edge) / 2, (stop_edge - pass_edge) / (2 * _GAUSS)
    half = min(int(np.ceil(_kernel_time(pass_edge, stop_edge) * rate)), len(position) - 1)
    t = np.arange(-half, half + 1) / rate
    spread = 1 / (2 * np.pi * width)
    window = np.exp(-0.5 * (t / spread) ** 2)
    window_1 = -t / spread**2 * window
    window_2 = (t**2 / spread**4 - 1 / spread**2) * window
    omega = 2 * np.pi * middle
    sine, cosine = np.sin(omega * t), np.cos(omega * t)
    with np.errstate(divide="ignore", invalid="ignore"):
        ideal = np.where(t == 0, omega, sine / t) / np.pi
        ideal_1 = np.where(t == 0, 0.0, (omega * cosine - sine / t) / t) / np.pi
        ideal_2 = (
            np.where(t == 0, -(omega**3) / 3, (-(omega**2) * sine - 2 * (omega * cosine - sine / t) / t) / t) / np.pi
        )
    kernel = ideal * window
    kernel_1 = ideal_1 * window + ideal * window_1
    kernel_2 = ideal_2 * window + 2 * ideal_1 * window_1 + ideal * window_2
    # truncation must not leave a slope or a constant behind
    kernel = kernel / kernel.sum()
    kernel_1 = kernel_1 / rate
    kernel_2 = kernel_2 / rate - kernel_2.sum() / rate * kernel

    start, end = 2 * position[0] - position[half:0:-1], 2 * position[-1] - position[-2 : -half - 2 : -1]
    extended = np.concatenate([start, position, end])
    smooth, first, second = (
        oaconvolve(extended, k[:, None], mode="valid", axes=0) for k in (kernel, kernel_1, kernel_2)
    )
    return smooth, first, second


def _even(log: Log, start: int, stop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Time, position and torque of one stretch on an even grid.

    Uneven stamps mean either an uneven sampling or a late stamp on an even one. The position tells: sampled evenly it
    is smooth in the sample number, else it is smooth in the stamps.
    """
    stamps, position = log.t[start:stop], log.position[start:stop]
    torque = None if log.effort is None else log.effort[start:stop]
    grid = np.linspace(stamps[0], stamps[-1], len(stamps))
    uneven = np.max(np.abs(stamps - grid)) * (len(stamps) - 1) / (stamps[-1] - stamps[0])
    if uneven < 1e-3:
        return grid, position, torque
    from scipy.interpolate import CubicSpline

    resampled = CubicSpline(stamps, position)(grid)
    if _roughness(position) <= _roughness(resampled):
        slope, intercept = np.polyfit(np.arange(len(stamps)), stamps, 1)
        return intercept + slope * np.arange(len(stamps)), position, torque
    return grid, resampled, None if torque is None else CubicSpline(stamps, torque)(grid)


def _roughness(position: np.ndarray) -> float:
    return float(np.sum(np.diff(position, 4, axis=0) ** 2))
