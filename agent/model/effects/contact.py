"""External force over a segment of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from agent.model.effects.contact_place import place_of
from agent.model.effects.contact_windows import PushedWindow, Windows, strongest
from agent.model.effects.effect import Columns, Effect, FitContext
from agent.model.signals import MotionSignals, NominalModel

_EDGE = 0.15  # of the duration, at either end
_LINKS = 3  # tried as the one that all pushes are on


class Contact(Effect):
    """τ = −J_lᵀ F over one segment of time or several, F constant but for its edges, at one place of link l each.

    That is its far end, unless another place of the link leaves less.
    """

    name = "contact"
    family = "load"
    scope = "arm"
    formula = "−J_l(q)ᵀ · F · window(t), l any link"
    source = "Haddadin, De Luca, Albu-Schäffer, IEEE Trans. Robotics 33 (2017)"
    signature = "residual in one segment of time that does not come back with the next cycle"
    confused_with = ()
    phrase = "something pushed the arm for a while"
    look_at = "what the arm touched at that time: a person, a fixture, a caught hose"
    residual_driven = True
    once = True

    def settings(self, context: FitContext, joints: tuple[int, ...]) -> list[dict[str, float]]:
        """Where three force components leave least: the strongest windows that do not overlap, fewest first.

        All on the link that explains most, or each on its own; and each at the far end of its link, or where it fits.
        A model's own error and what drifts make windows too: a contact stands out from the other segments of its
        length, those before and after it above all, and does not come back at the same place of the next cycle.
        """
        dof = context.reference.robot.dof
        motions = list(zip(context.signals, context.residuals_as_given, context.sigmas, strict=True))
        windows = [window for link in range(dof) for part in motions for window in Windows.of(link, *part)]
        found = [strongest([w for w in windows if w.link == link]) for link in range(dof)]
        found = sorted(found, key=lambda pushes: -sum(push.gain for push in pushes))[:_LINKS]
        sets = [pushes for pushes in (*found, strongest(windows)) if pushes]
        tried = [_settings(pushes[:count]) for pushes in sets for count in range(1, len(pushes) + 1)]
        tried += [_settings(pushes, [place_of(push, motions) for push in pushes]) for pushes in sets]
        return list({str(entry): entry for entry in tried}.values())

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        return tuple(f"force_{axis}_{number}" for number in _numbers(settings) for axis in "xyz")

    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        n = signals.q.shape[1]
        numbers = _numbers(settings)
        block = np.zeros((len(signals.time), n, 3 * len(numbers)))
        for place, number in enumerate(numbers):
            log, link, start, lasting = (settings[f"{key}_{number}"] for key in ("log", "link", "start", "duration"))
            if signals.log_index != log:
                continue
            duration = lasting / (1 - _EDGE)
            since = signals.time - start + 0.5 * (duration - lasting)
            window = np.clip(np.minimum(since, duration - since) / (_EDGE * duration), 0, 1)
            inside = window > 0
            at = [settings.get(f"{axis}_{number}", 0.0) for axis in "xyz"]
            pushed = np.swapaxes(signals.pushed(int(link) - 1, inside, at), 1, 2)
            block[inside, :, 3 * place : 3 * place + 3] = -pushed * window[inside, None, None]
        return {joint: block[:, joint] for joint in range(n)}

    def prior_precision(
        self, context: FitContext, joints: tuple[int, ...], settings: Mapping[str, float]
    ) -> np.ndarray | None:
        """A force is as the strongest joint holds at full reach: what turns no joint is not seen, and is small."""
        usual = float(context.reference.scale.max()) / context.reference.reach
        return np.eye(len(self.names(settings))) / usual**2

    def reported(
        self, reference: NominalModel, settings: Mapping[str, float], values: Mapping[str, float]
    ) -> dict[str, float]:
        """Of each push the link (counted from 1), force [N, base frame], log (from 0), start and end [s]; and where on
        the link [m, its frame, from the far end], if elsewhere."""
        found: dict[str, float] = {}
        for number in _numbers(settings):
            start = settings[f"start_{number}"]
            of_push = {"link": settings[f"link_{number}"]}
            of_push |= {f"force_{axis}": values[f"force_{axis}_{number}"] for axis in "xyz"}
            of_push |= {"log": settings[f"log_{number}"], "start": start, "end": start + settings[f"duration_{number}"]}
            of_push |= {f"at_{axis}": settings[f"{axis}_{number}"] for axis in "xyz" if f"{axis}_{number}" in settings}
            found |= {key if number == 1 else f"{key}_{number}": value for key, value in of_push.items()}
        return found


def _settings(pushes: Sequence[PushedWindow], places: Sequence[np.ndarray | None] = ()) -> dict[str, float]:
    entries: dict[str, float] = {}
    for number, push in enumerate(pushes, start=1):
        of_push = {"log": push.log, "link": push.link + 1, "start": push.start, "duration": push.duration}
        if places and (place := places[number - 1]) is not None:
            of_push |= dict(zip("xyz", place.tolist(), strict=True))
        entries |= {f"{key}_{number}": float(value) for key, value in of_push.items()}
    return entries


def _numbers(settings: Mapping[str, float]) -> list[int]:
    """Of the pushes, from 1."""
    return [int(key.removeprefix("link_")) for key in settings if key.startswith("link_")]
