"""The search for causes: single effects first, then what is left, then pairs; abstention where nothing fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.diagnosis.effects import CATALOGUE, Effect
from agent.diagnosis.evidence import Null, null_gains
from agent.diagnosis.fit import Candidate, Fit, Score

#: All in units of the background energy of all rows, Σ e² / σ² of a model that is right.
LEAST_GAIN = 0.02  # an effect must gain as much to be named
LEAST_SHARE = 0.35  # of what is still unexplained, for every further effect
CLOSES = 0.75  # of the excess over the background, or the cause is unknown
FITS = 0.95  # of it, or the form of a cause is not beyond doubt
EXCESS = 0.6  # over the background on one joint before something counts as unexplained
NEAR = 0.04  # of what is explained: of forms this close the simplest is taken, unless the best one fits far better
NEAR_FLOOR = 0.02
ALIKE = 0.003  # of what is explained: forms this close cannot be told apart, however well the better one fits
STANDS_OUT = 0.25  # of its gain must be energy over the background on its joints, log by log
PRACTICAL = 0.005  # of nominal, root mean square: a smaller effect, or gap over the background, does not matter
UNFIT = 0.5  # of what a cause leaves, explained by a shape of its own kind
MOST = 3
_FIRSTS = 4

#: One physical change comes before a general refit, a torque of its own before a shape that could be anything.
_PLAIN_FIRST = {"inertial_mismatch": 8, "dress_pack": 1, "thermal_friction": 1, "contact": 1}


@dataclass(frozen=True, eq=False)
class Step:
    """One scan: what was chosen before it, the best score of every place, and which of them could be named."""

    chosen: tuple[Candidate, ...]
    error: float
    scores: tuple[Score, ...]
    eligible: tuple[Score, ...]


@dataclass(frozen=True, eq=False)
class Finding:
    """The outcome: the fit with its causes, who equals whom, how much of the excess is closed, and the steps.

    `rivals[k]` are places that the data cannot tell from cause k, `chance[k]` is how often anything gains as much as it
    where there is nothing (see `evidence`), `lead[k]` how many margins the best place outside its class falls behind.
    """

    verdict: str
    fit: Fit
    causes: tuple[Candidate, ...]
    rivals: tuple[tuple[tuple[str, tuple[int, ...]], ...], ...]
    chance: tuple[float, ...]
    lead: tuple[float, ...]
    closed: float
    steps: tuple[Step, ...]

    @property
    def probability(self) -> tuple[float, ...]:
        """Of each cause's class."""
        return tuple(_probability(lead, self.closed) for lead in self.lead)


class Search:
    """A catalogue tried on a fit; `given`: to a model from elsewhere, whose error without an effect is known."""

    def __init__(self, fit: Fit, without: Sequence[str] = (), given: bool = True):
        self.fit, self.given = fit, given
        self.allowed = {name for name in CATALOGUE if name not in without}
        self.rows = float(fit.count.sum())
        self.pool: list[Candidate] = []
        self.tried: list[Candidate] = []
        self.null: Null | None = None
        self.least = LEAST_GAIN * self.rows
        self._scanned: dict[frozenset[Candidate], Step] = {}
        joints = range(fit.reference.robot.dof)
        self.moves = tuple(any(np.ptp(s.q[:, j]) > 1e-4 for s in fit.signals) for j in joints)

    def run(self) -> Finding:
        """Search until nothing worth naming is left."""
        base = self.fit
        before = self.joint_energy(base)
        first = self.scan(base)
        steps = [first]
        matters = self._matters(before)
        if not first.eligible and not matters:
            return Finding("no_gap", base, (), (), (), (), 0.0, tuple(steps))
        best: tuple[float, tuple[Candidate, ...]] | None = None
        for start in self._starts(first):
            chosen = self._forward((start,), steps)
            error = base.with_chosen(chosen)
            result = self._total(error)
            if best is None or best[0] - result > max(NEAR_FLOOR * self.rows, NEAR * (base.error() - best[0])):
                best = result, chosen
            if self.closed(before, error) > 0.9 and len(chosen) == 1:
                break
        abstained = "unknown" if matters else "no_gap"
        if best is None:
            return Finding(abstained, base, (), (), (), (), 0.0, tuple(steps))
        fit = base.with_chosen(self._pruned(best[1]))
        closed = self.closed(before, fit)
        if closed < CLOSES:
            return Finding(abstained, base, (), (), (), (), closed, tuple(steps))
        return self._verdict(fit, closed, steps)

    def joint_energy(self, fit: Fit) -> np.ndarray:
        """(n,) mean of (e / σ)² held out."""
        single = any(c.effect.once for c in fit.chosen)
        return np.nanmean((fit.out_of_fold(single) / fit.sigma) ** 2, axis=0)

    def _matters(self, energy: np.ndarray) -> bool:
        """Whether a joint is far above its background, in proportion and in torque."""
        background = self.fit.sigma.min(axis=0) / self.fit.reference.scale  # where the joint moves
        over = np.sqrt(np.maximum(energy - 1, 0)) * background
        return bool(np.any((energy > 1 + EXCESS) & (over > PRACTICAL)))

    def closed(self, before: np.ndarray, fit: Fit) -> float:
        """How much of the excess over the background is gone; 1 where there was none to speak of."""
        after = self.joint_energy(fit)
        excess = np.sum(np.maximum(before - 1, 0))
        left = np.sum(np.maximum(after - 1, 0) * (after > 1 + 0.5 * EXCESS))
        return float(1 - left / excess) if excess > 0.1 else float(left < 0.1)

    def scan(self, fit: Fit) -> Step:
        """Every effect everywhere, added to what is chosen; done once for the same choice."""
        key = frozenset(fit.chosen)
        if key not in self._scanned:
            self._scanned[key] = self._scan(fit)
        return self._scanned[key]

    def _scan(self, fit: Fit) -> Step:
        taken = {c.place for c in fit.chosen}
        fixed = not self.pool
        wanted = []
        for effect in CATALOGUE.values():
            for joints in effect.places(fit.reference.robot):
                if (effect.name, joints) in taken or not all(self.moves[j] for j in joints):
                    continue
                if fixed or effect.name in _RESIDUAL_DRIVEN:
                    wanted += [(effect, joints, settings) for settings in effect.settings(fit, joints)]
        new = fit.candidates(wanted)
        if fixed:
            self.pool = [c for c in new if c.effect.name not in _RESIDUAL_DRIVEN]
            pool = self.tried = new
        else:
            pool = [c for c in self.pool if c.place not in taken] + new
        best = _best_by_place(fit.score(pool))
        if fixed:
            self.null = null_gains(fit, self.tried)
            self.least = max(self.least, self.null.threshold)
        best = self._refined(fit, best)
        eligible = self._eligible(fit, best)
        return Step(fit.chosen, fit.error(), tuple(sorted(best.values(), key=lambda s: -s.gain)), eligible)

    def _refined(self, fit: Fit, best: dict) -> dict:
        """Search the nonlinear parameters of the leading places more finely."""
        leaders = sorted((s for s in best.values() if s.gain > 0.5 * LEAST_GAIN * self.rows), key=lambda s: -s.gain)[:6]
        for factor in (1.25, 1.1, 1.04, 1.015):
            if factor < 1.1:
                leaders = [s for s in leaders if best[s.candidate.place].gain > 0.5 * leaders[0].gain]
            wanted = []
            for place in (s.candidate.place for s in leaders):
                candidate = best[place].candidate
                for name in candidate.effect.refined:
                    if name not in candidate.settings:
                        continue
                    for scale in (1 / factor, factor):
                        settings = {**candidate.settings, name: candidate.settings[name] * scale}
                        wanted.append((candidate.effect, candidate.joints, settings))
            finer = fit.candidates(wanted)
            self.pool += [c for c in finer if c.effect.name not in _RESIDUAL_DRIVEN]
            for score in fit.score(finer):
                if _plausible(score) and score.gain > best[score.candidate.place].gain:
                    best[score.candidate.place] = score
        return best

    def _eligible(self, fit: Fit, best: dict) -> tuple[Score, ...]:
        """Scores that could be named: plausible, allowed, large enough, and better than their own simpler limits."""
        result = []
        over = self._over_background(fit)
        for place, score in best.items():
            name = place[0]
            effect = score.candidate.effect
            if name not in self.allowed or not _plausible(score) or score.gain < self.least:
                continue
            if self.size(fit, score) < PRACTICAL:
                continue
            repeats = self.given and not effect.once
            if repeats and np.sum(over[list(score.candidate.blocks)]) < STANDS_OUT * score.gain:
                continue  # a model that was fitted with it would look the same
            if any(self._as_good(score, limit, best) for limit in effect.limits):
                continue
            result.append(score)
        return tuple(sorted(result, key=lambda s: -s.gain))

    def _over_background(self, fit: Fit) -> np.ndarray:
        """(n,) energy of each joint over the background, in the logs where it is over it."""
        energy = (fit.out_of_fold() / fit.sigma) ** 2
        log = np.concatenate([np.full(len(s.time[s.kept]), s.log_index) for s in fit.signals])
        total = np.zeros(energy.shape[1])
        for number in np.unique(log):
            total += np.maximum(np.nansum(energy[log == number] - 1, axis=0), 0)
        return total

    def _as_good(self, score: Score, limit: str, best: dict) -> bool:
        """Whether a simpler limit of the form does as well, so that the form has nothing to show for itself."""
        joints = score.candidate.joints
        if limit == "payload" and score.candidate.settings.get("link") != self.fit.reference.robot.dof:
            return False
        places = [(limit, ())] if CATALOGUE[limit].scope != "joint" else [(limit, (j,)) for j in joints]
        simpler = [best[place] for place in places if place in best and _plausible(best[place])]
        margin = max(NEAR_FLOOR * self.rows, 0.5 * NEAR * score.gain)
        if score.candidate.effect.name == "asymmetric_friction" and limit in self.allowed:
            return False  # compared as a rival: an offset and a Coulomb asymmetry have equally many parameters
        return any(score.gain - other.gain < margin for other in simpler)

    def size(self, fit: Fit, score: Score) -> float:
        """Root mean square torque of an effect over nominal, on the joint and log where it is largest."""
        largest = 0.0
        for joint, block in score.candidate.blocks.items():
            torque = block @ score.values * fit.sigma[:, joint] / fit.reference.scale[joint]
            largest = max(largest, float(np.sqrt(np.mean(torque**2))))
            if score.candidate.effect.once:
                inside = np.abs(torque) > 0
                largest = max(largest, float(np.sqrt(np.mean(torque[inside] ** 2))) if inside.any() else 0.0)
        return largest

    def _starts(self, step: Step) -> list[Candidate]:
        """The simplest of the best, then the runners-up."""
        if not step.eligible:
            return []
        leader = self._simplest(step)
        rest = [s for s in step.eligible if s is not leader and s.gain > 0.1 * step.eligible[0].gain]
        return [leader.candidate, *(s.candidate for s in rest[: _FIRSTS - 1])]

    def _imitates(self, chosen: tuple[Candidate, ...], score: Score) -> bool:
        """Whether one of the chosen effects has a shape of the same kind on the same joint."""
        name = score.candidate.effect.name
        return any(
            c.joints == score.candidate.joints and any({name, c.effect.name} <= kind for kind in _KINDS) for c in chosen
        )

    def _near(self, step: Step) -> list[Score]:
        """Forms that do as well as the best, as far as that one fits: what it leaves on its joints is its own doubt."""
        best = step.eligible[0]
        left = self._excess(self.fit.with_chosen((*step.chosen, best.candidate)), tuple(best.candidate.blocks))
        margin = max(NEAR_FLOOR * self.rows, min(NEAR * best.gain, max(ALIKE * best.gain, left)))
        return [s for s in step.eligible if best.gain - s.gain <= margin]

    def _simplest(self, step: Step) -> Score:
        return min(self._near(step), key=lambda s: (_complexity(s.candidate), -s.gain))

    def _forward(self, chosen: tuple[Candidate, ...], steps: list[Step]) -> tuple[Candidate, ...]:
        """Add effects while they explain a good part of what is left."""
        while True:
            fit = self.fit.with_chosen(chosen)
            step = self.scan(fit)
            steps.append(step)
            if len(chosen) == MOST or not step.eligible:
                return chosen
            left = self._excess(fit)
            least = max(2 * self.least, LEAST_SHARE * left)
            worth = [s for s in step.eligible if s.gain > least and not self._imitates(chosen, s)]
            if not worth:
                return chosen
            step = Step(step.chosen, step.error, step.scores, tuple(worth))
            chosen = (*chosen, self._simplest(step).candidate)

    def _excess(self, fit: Fit, joints: Sequence[int] | None = None) -> float:
        """Energy over the background that is left, joint by joint, on all joints or some."""
        over = np.maximum(self.joint_energy(fit) - 1, 0)
        return float(np.sum(over if joints is None else over[list(joints)]) * self.rows / len(fit.rows))

    def _total(self, fit: Fit) -> float:
        single = any(c.effect.once for c in fit.chosen)
        return fit.error(single) + self.fit.error() - self.fit.error(single)

    def _pruned(self, chosen: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
        """Without what the others explain as well."""
        for candidate in chosen:
            others = tuple(c for c in chosen if c is not candidate)
            if others and self._total(self.fit.with_chosen(others)) - self._total(self.fit.with_chosen(chosen)) < max(
                self.least, 0.002 * self.fit.error()
            ):
                return self._pruned(others)
        return chosen

    def _unfit(self, fit: Fit) -> Score | None:
        """A shape of the same kind on the same joint that explains half of what a cause leaves."""
        least = max(2 * self.least, UNFIT * self._excess(fit))
        left = self.scan(fit).eligible
        return next((s for s in left if s.gain > least and self._imitates(fit.chosen, s)), None)

    def _verdict(self, fit: Fit, closed: float, steps: list[Step]) -> Finding:
        """Order causes by what is lost without each, and look for places that would do as well."""
        total = self._total(fit)
        ranked = []
        for candidate in fit.chosen:
            others = tuple(c for c in fit.chosen if c is not candidate)
            without = self.fit.with_chosen(others)
            step = self.scan(without)
            lost = self._total(without) - total
            margin = max(NEAR_FLOOR * self.rows, ALIKE * lost, self._excess(fit, tuple(candidate.blocks)))
            rivals, behind = [], np.inf
            twins = [s for s in step.scores if s.candidate.effect.name in candidate.effect.twins]
            twin = any(s.candidate.joints == candidate.joints and lost - s.gain <= margin for s in twins)
            for score in step.eligible:
                if score.candidate.place == candidate.place:
                    continue
                short = lost - score.gain
                better = short < -NEAR_FLOOR * self.rows
                equal = better or _complexity(score.candidate) <= _complexity(candidate) + 1
                if short <= margin and equal:
                    rivals.append(score.candidate.place)
                elif short > margin:
                    behind = min(behind, short / margin)
            ranked.append((lost, candidate, tuple(rivals[:2]), behind, twin))
        ranked.sort(key=lambda entry: -entry[0])
        causes = tuple(entry[1] for entry in ranked)
        rivals = [entry[2] for entry in ranked]
        odd = self._unfit(fit)
        if odd is not None:
            at = next(k for k, c in enumerate(causes) if self._imitates((c,), odd))
            rivals[at] = tuple(dict.fromkeys((odd.candidate.place, *rivals[at])))[:2]
        assert self.null is not None
        chance = tuple(self.null.chance(entry[0]) for entry in ranked)
        lead = tuple(float(entry[3]) for entry in ranked)
        doubtful = closed < FITS
        verdict = "ambiguous" if rivals[0] or ranked[0][4] or doubtful else "explained"
        return Finding(verdict, self.fit.with_chosen(causes), causes, tuple(rivals), chance, lead, closed, tuple(steps))


#: Shapes over speed and over position: two of one kind on one joint would only imitate a third.
_KINDS = (
    {
        "stribeck",
        "asymmetric_friction",
        "load_dependent_friction",
        "viscous_nonlinearity",
        "thermal_friction",
        "presliding",
        "friction_change",
        "torque_constant",
    },
    {"torque_offset", "gravity_spring", "dress_pack", "asymmetric_friction"},
    {"joint_elasticity", "backlash"},
    {"payload", "inertial_mismatch"},
)
_RESIDUAL_DRIVEN = ("torque_ripple", "contact", "payload", "time_delay", "joint_elasticity", "backlash")


def _plausible(score: Score) -> bool:
    candidate = score.candidate
    return candidate.effect.plausible(candidate.settings, dict(zip(candidate.names, score.values, strict=True)))


def _best_by_place(scores: Sequence[Score]) -> dict:
    best: dict = {}
    for score in scores:
        place = score.candidate.place
        rank = (_plausible(score), score.gain)
        if place not in best or rank > (_plausible(best[place]), best[place].gain):
            best[place] = score
    return best


def _complexity(candidate: Candidate) -> int:
    effect: Effect = candidate.effect
    return effect.freedom(candidate.settings) + _PLAIN_FIRST.get(effect.name, 0)


def _probability(behind: float, closed: float) -> float:
    """Of the class: rises with the lead over the next other form, counted in margins, and with what is closed."""
    lead = 1 - 0.5 * float(np.exp(-min(behind, 50.0) / 2))
    return float(np.clip(lead * (0.5 + 0.49 * np.clip((closed - 0.5) / 0.4, 0, 1)), 0.01, 0.99))
