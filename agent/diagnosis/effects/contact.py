"""External force over a stretch of time."""

import numpy as np

from agent.diagnosis.effects.effect import Effect

_DURATIONS = (0.3, 0.4, 0.55, 0.75, 1.0, 1.35, 1.8, 2.4, 3.2, 4.2)  # s
_STARTS = 0.05  # s
_EDGE = 0.15  # of the duration, at either end


class Contact(Effect):
    """τ = −Jᵀ F over one stretch of time in each of some logs, F constant but for its edges: a force on the tip."""

    name = "contact"
    scope = "arm"
    formula = "−J(q)ᵀ · F · window(t)"
    source = "Haddadin, De Luca, Albu-Schäffer, IEEE Trans. Robotics 33 (2017)"
    signature = "residual in one stretch of time that does not come back with the next cycle"
    confused_with = ()
    look_at = "what the arm touched at that time: a person, a fixture, a caught hose"
    once = True

    def settings(self, survey, joints):
        """Where three force components leave least: single windows, then one in each of several logs."""
        found = []
        for signals, residual, sigma in zip(survey.signals, survey.residuals, survey.sigmas, strict=True):
            time = signals.time[signals.kept]
            columns = -signals.jacobian[signals.kept] / sigma[:, None]
            target = residual / sigma
            grams = np.cumsum(np.einsum("san,sbn->sab", columns, columns), axis=0)
            right = np.cumsum(np.einsum("san,sn->sa", columns, target), axis=0)
            for duration in _DURATIONS:
                starts = np.arange(time[0], time[-1] - duration, _STARTS)
                if len(starts) == 0:
                    continue
                first = np.searchsorted(time, starts)
                last = np.minimum(np.searchsorted(time, starts + duration), len(time) - 1)
                gram = grams[last] - grams[first]
                gram += 1e-6 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
                side = right[last] - right[first]
                gain = np.einsum("ka,ka->k", side, np.linalg.solve(gram, side[:, :, None])[:, :, 0])
                best = int(np.argmax(gain))
                found.append((float(gain[best]), signals.log_index, float(starts[best]), duration))
        found.sort(reverse=True)
        best: dict[int, tuple[float, float]] = {}
        for _, log, start, long in found:
            best.setdefault(log, (start, long))
        first = found[0][0] if found else 0.0
        settings = [_windows([(log, start, long)]) for gain, log, start, long in found[:4] if gain > 0.5 * first]
        entries = [(log, *window) for log, window in best.items()]
        return settings + [_windows(entries[:count]) for count in range(2, len(entries) + 1)]

    def names(self, settings):
        logs = [key.removeprefix("start_") for key in settings if key.startswith("start_")]
        return tuple(f"force_{axis}_{log}" for log in logs for axis in "xyz")

    def columns(self, signals, joints, settings):
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


def _windows(entries: list[tuple[int, float, float]]) -> dict[str, float]:
    """Settings of one window (log, start, duration) in each of some logs."""
    named = (((f"start_{log}", start), (f"duration_{log}", lasting)) for log, start, lasting in entries)
    return {key: value for pair in named for key, value in pair}
