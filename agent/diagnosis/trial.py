"""A structure that somebody else chose, fitted to the data of a diagnosis: what it closes, fold by fold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.diagnosis.candidate import Candidate
from agent.diagnosis.gap import held_out_gap
from agent.diagnosis.result import Diagnosis
from agent.model import CATALOGUE, Effect

_FACTORS = (1.25, 1.1, 1.05)


class Trial:
    """Effects put where one wants them, on the logs and against the model of a diagnosis."""

    def __init__(self, diagnosis: Diagnosis):
        self._dataset, self._gap = diagnosis.dataset, diagnosis.result["gap"]
        self._fit, self._unit = diagnosis.dataset.fit, diagnosis.gap.unit

    @property
    def worst_joint(self) -> str:
        """Where the error before is largest."""
        return self._gap["joints"][int(np.argmax(self._gap["before"]))]

    def parameter_counts(self, joint: str) -> dict[str, int]:
        """Number of parameters of every effect that may sit on a joint and repeats, in the first form to be tried."""
        place = (self._dataset.robot.joint_names.index(joint),)
        found = {}
        for name, effect in CATALOGUE.items():
            if effect.scope == "joint" and not effect.once and place in effect.places(self._dataset.robot):
                settings = effect.settings(self._fit, place)
                if settings:
                    found[name] = effect.n_parameters(settings[0])
        return found

    def best(self, effect: str | Effect, joints: Sequence[str], beside: Sequence[Candidate] = ()) -> Candidate | None:
        """An effect on named joints with the nonlinear parameters that predict best beside others.

        None where it cannot sit there, or nothing can be tried on these motions.
        """
        kind = CATALOGUE[effect] if isinstance(effect, str) else effect
        robot = self._dataset.robot
        wanted = {robot.joint_names.index(name) for name in joints}
        places = [place for place in kind.places(robot) if set(place) == wanted]
        if not places:
            return None
        fit, place = self._fit.with_chosen(beside), places[0]
        scores = fit.score(fit.candidates([(kind, place, settings) for settings in kind.settings(fit, place)]))
        if not scores:
            return None
        best = max(scores, key=lambda score: score.gain)
        reversing = [(kind, place, own) for own in kind.reversing(fit, place, best.candidate.settings)]
        best = max([best, *fit.score(fit.candidates(reversing))], key=lambda score: score.gain)
        for factor in _FACTORS:
            now = best.candidate.settings
            finer = [(kind, place, near) for near in kind.nearby(now, factor)]
            best = max([best, *fit.score(fit.candidates(finer))], key=lambda score: score.gain)
        return best.candidate

    def n_parameters(self, chosen: Sequence[Candidate]) -> int:
        """Number of parameters of what `best` found."""
        return sum(candidate.effect.n_parameters(candidate.settings) for candidate in chosen)

    def closure(self, chosen: Sequence[Candidate]) -> float | None:
        """(B² − A²) / (B² − F²) of these effects, as a diagnosis that names them has it."""
        return held_out_gap(self._dataset, self._fit.with_chosen(chosen), self._unit).closure
