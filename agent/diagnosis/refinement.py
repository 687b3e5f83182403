"""Nonlinear parameters of the leading forms, more finely than a catalogue can try them everywhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from agent.diagnosis.candidate import Candidate, HeldOutScore, Where
from agent.diagnosis.fit import Fit
from agent.diagnosis.isolability import best_by_place, plausible
from agent.diagnosis.limits import DecisionLimits

_FACTORS = (1.25, 1.1, 1.04, 1.015)


def refined(
    fit: Fit, best: Mapping[Where, HeldOutScore], leaders: Sequence[HeldOutScore], limits: DecisionLimits
) -> tuple[dict[Where, HeldOutScore], list[Candidate]]:
    """The best of every place with those of the `leaders`, best first, refined, and all forms made for that.

    A form gets a reversal of its own only where that gains clearly more, as it has two parameters more.
    """
    best = dict(best)
    wanted = []
    for score in leaders:
        effect, joints = score.candidate.effect, score.candidate.joints
        wanted += [(effect, joints, own) for own in effect.reversing(fit, joints, score.candidate.settings)]
    made = fit.candidates(wanted)
    for place, score in best_by_place(fit.score(made)).items():
        if plausible(score) and best[place].gain < (1 - limits.equal_gain) * score.gain:
            best[place] = score
    for factor in _FACTORS:
        if factor < 1.1:
            leaders = [s for s in leaders if best[s.candidate.place].gain > 0.5 * leaders[0].gain]
        wanted = []
        for place in (s.candidate.place for s in leaders):
            effect, joints = best[place].candidate.effect, place[1]
            wanted += [(effect, joints, near) for near in effect.nearby(best[place].candidate.settings, factor)]
        finer = fit.candidates(wanted)
        made += finer
        for score in fit.score(finer):
            if plausible(score) and score.gain > best[score.candidate.place].gain:
                best[score.candidate.place] = score
    return best, made
