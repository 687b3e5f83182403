"""External force over a segment of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from agent.model.effects.effect import Columns, Effect, FitContext
from agent.model.signals import MotionSignals, NominalModel

_DURATIONS = (0.3, 0.4, 0.55, 0.75, 1.0, 1.35, 1.8, 2.4, 3.2, 4.2)  # s
_STARTS = 0.05  # s
_EDGE = 0.15  # of the duration, at either end
_USUAL, _STANDS_OUT = 0.9, 3.0  # quantile of all windows of a length, and how far above it a contact is
_ALONE = 2.0  # times the window at the same place of another cycle


class Contact(Effect):
    """τ = −Jᵀ F over one segment of time in each of some logs, F constant but for its edges: a force on the tip."""

    name = "contact"
    family = "load"
    scope = "arm"
    formula = "−J(q)ᵀ · F · window(t)"
    source = "Haddadin, De Luca, Albu-Schäffer, IEEE Trans. Robotics 33 (2017)"
    signature = "residual in one segment of time that does not come back with the next cycle"
    confused_with = ()
    phrase = "something pushed the arm for a while"
    look_at = "what the arm touched at that time: a person, a fixture, a caught hose"
    residual_driven = True
    complexity_surcharge = 1
    once = True

    def settings(self, survey: FitContext, joints: tuple[int, ...]) -> list[dict[str, float]]:
        """Where three force components leave least: single windows, then one in each of several logs.

        A model's own error makes windows too. A contact stands out from the other segments of its length, and does
        not come back at the same place of the next cycle.
        """
        sums = [_Sums.of(*parts) for parts in zip(survey.signals, survey.residuals, survey.sigmas, strict=True)]
        found: list[tuple[float, int, float, float]] = []
        for duration in _DURATIONS:
            gains = [part.gains(duration) for part in sums]
            every = np.concatenate([gain for _, gain in gains])
            usual = float(np.quantile(every, _USUAL)) if len(every) else 0.0
            for signals, (starts, gain) in zip(survey.signals, gains, strict=True):
                if len(gain) == 0:
                    continue
                best = int(np.argmax(gain))
                again = _elsewhere_in_cycle(signals.cycle_starts, starts, gain, best)
                if gain[best] > max(_STANDS_OUT * usual, _ALONE * again):
                    found.append((float(gain[best]), signals.log_index, float(starts[best]), duration))
        found.sort(reverse=True)
        best_of: dict[int, tuple[float, float]] = {}
        for _, log, start, lasting in found:
            best_of.setdefault(log, (start, lasting))
        first = found[0][0] if found else 0.0
        settings = [_windows([(log, start, long)]) for gain, log, start, long in found[:4] if gain > 0.5 * first]
        entries = [(log, *window) for log, window in best_of.items()]
        return settings + [_windows(entries[:count]) for count in range(2, len(entries) + 1)]

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        logs = [key.removeprefix("start_") for key in settings if key.startswith("start_")]
        return tuple(f"force_{axis}_{log}" for log in logs for axis in "xyz")

    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        n = signals.q.shape[1]
        logs = [int(key.removeprefix("start_")) for key in settings if key.startswith("start_")]
        block = np.zeros((len(signals.time), n, 3 * len(logs)))
        if signals.log_index in logs:
            at = 3 * logs.index(signals.log_index)
            start, lasting = (settings[f"{key}_{signals.log_index}"] for key in ("start", "duration"))
            duration = lasting / (1 - _EDGE)
            since = signals.time - start + 0.5 * (duration - lasting)
            window = np.clip(np.minimum(since, duration - since) / (_EDGE * duration), 0, 1)
            inside = window > 0
            if inside.any():
                transposed = np.swapaxes(signals.jacobian[inside], 1, 2)
                block[inside, :, at : at + 3] = -transposed * window[inside, None, None]
        return {joint: block[:, joint] for joint in range(n)}

    def reported(
        self, reference: NominalModel, settings: Mapping[str, float], values: Mapping[str, float]
    ) -> dict[str, float]:
        """Of each push the link (counted from 1; it is the last), force [N, base frame], log, start and end [s]."""
        found: dict[str, float] = {}
        for number, log in enumerate((key[6:] for key in settings if key.startswith("start_")), start=1):
            of_push = {"link": float(reference.robot.dof)}
            of_push |= {f"force_{axis}": values[f"force_{axis}_{log}"] for axis in "xyz"}
            start = settings[f"start_{log}"]
            of_push |= {"log": float(log), "start": start, "end": start + settings[f"duration_{log}"]}
            found |= {key if number == 1 else f"{key}_{number}": value for key, value in of_push.items()}
        return found


@dataclass(frozen=True, eq=False)
class _Sums:
    """Running sums over the rows of a motion: time (S',), moments of a force's columns (S', 3, 3), with the error."""

    time: np.ndarray
    gram: np.ndarray
    side: np.ndarray

    @classmethod
    def of(cls, signals: MotionSignals, residual: np.ndarray, sigma: np.ndarray) -> _Sums:
        columns = -signals.jacobian[signals.kept] / sigma[:, None]
        gram = np.cumsum(np.einsum("san,sbn->sab", columns, columns), axis=0)
        side = np.cumsum(np.einsum("san,sn->sa", columns, residual / sigma), axis=0)
        return cls(signals.time[signals.kept], gram, side)

    def gains(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """(K,) starts [s] of all windows of a duration, and (K,) what a force in each would take away."""
        starts = np.arange(self.time[0], self.time[-1] - duration, _STARTS)
        if len(starts) == 0:
            return starts, starts
        first = np.searchsorted(self.time, starts)
        last = np.minimum(np.searchsorted(self.time, starts + duration), len(self.time) - 1)
        gram = self.gram[last] - self.gram[first]
        gram += 1e-6 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
        side = self.side[last] - self.side[first]
        return starts, np.einsum("ka,ka->k", side, np.linalg.solve(gram, side[:, :, None])[:, :, 0])


def _elsewhere_in_cycle(cycle_starts: Sequence[float], starts: np.ndarray, gain: np.ndarray, best: int) -> float:
    """Largest gain at the same place, give or take half a step, of another cycle; nought where there is none."""
    edges = np.asarray(cycle_starts, dtype=float)
    here = int(np.searchsorted(edges, starts[best] + 1e-9)) - 1
    if len(edges) < 2 or here < 0:
        return 0.0
    places = np.delete(edges, here) + starts[best] - edges[here]
    return max((float(gain[np.abs(starts - at) < 2 * _STARTS].max(initial=0.0)) for at in places), default=0.0)


def _windows(entries: list[tuple[int, float, float]]) -> dict[str, float]:
    """Settings of one window (log, start, duration) in each of some logs."""
    named = (((f"start_{log}", start), (f"duration_{log}", lasting)) for log, start, lasting in entries)
    return {key: value for pair in named for key, value in pair}
