"""Selection by held-out error: the estimator, the prior of the links, the friction terms, and the cut-off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agent.estimation.normal_equations import clear_gain, log_evidence, predicts_better
from agent.estimation.partition import Partition
from agent.estimation.prior import DESCRIPTION, EITHER, SIZE, Prior
from agent.estimation.problem import Estimate, Problem
from agent.estimation.signals.observation import Observation
from agent.model import FrictionTerm, Reversal
from agent.robot import LINK_PARAMETERS

_METHOD_GAIN = 0.02  # of the squared error held out
_NOT_PHYSICAL = 3.0  # times the error of the first estimator, from which on a consistent fit is a sign of wrong data


def best_estimate(estimates: dict[str, Estimate]) -> tuple[str, Estimate]:
    """Name and estimate of the best of several estimators by name, with the reason in its note.

    The first is the reference. Another estimator replaces it only if its weighted squared error on the held-out folds
    is lower by 2 % and by two standard errors of that gain, and its error in all joints' torque is not larger. A much
    larger error of `consistent`, one of them, reveals data that no arm can produce.
    """
    first = next(iter(estimates))
    weights = estimates[first].weights
    errors = {name: np.sum(weights * estimate.held_out, axis=(1, 2)) for name, estimate in estimates.items()}
    reference = estimates[first].held_out
    better = [
        n for n, estimate in estimates.items() if predicts_better(reference, estimate.held_out, weights, _METHOD_GAIN)
    ]
    best = min(better, key=lambda name: errors[name].sum(), default=first)
    table = ", ".join(f"{name} {np.sqrt(error.sum() / errors[first].sum()):.3f}" for name, error in errors.items())
    reason = f"It predicts held-out segments clearly better than {first}"
    if not better:
        reason = "No other method lowers the held-out error enough"
    notes = [f"Method: {best}. {reason} (held-out error relative to {first}: {table}).", estimates[best].note]
    if errors["consistent"].sum() > _NOT_PHYSICAL**2 * errors[first].sum():
        notes.append(
            "No bodies with mass and no friction that brakes explain these torques nearly as well: are signs and units "
            "of torques, gear ratios and gravity right?"
        )
    return best, replace(estimates[best], note=" ".join(part for part in notes if part))


_LINK_GAIN = 0.05  # of the squared error held out
_SAME_MASS = 1e-6  # relative difference of masses that are the same


def choose_links(problem: Problem) -> Problem:
    """The same problem with the prior of the links that predicts held-out segments, and the weight it has then.

    Both are compared under the weights of the open hypothesis: residuals of a wrong prior would hide it.

    Public descriptions often hold placeholders, every link of 1 kg or 3 kg, and a prior that is wrong and sure of
    itself spoils the estimate in silence. So there are two hypotheses: links near the description's, and links of
    which nothing is known but what the torques could hold. The description is believed where segments held out are
    clearly predicted better with it, and not where they are clearly predicted worse. Mostly they are predicted
    alike: what is held out of a motion asks for nothing that the rest of it leaves open, other motions do. Then the
    evidence decides (MacKay, Neural Computation 4, 1992): a description that is right in the directions that the
    data tell is likely to be right in those that they leave open, a placeholder is far off in the former. Links
    that most have the mass of another one are certainly placeholders.
    """
    opened = problem.with_links(SIZE).with_own_prior_weight()
    if are_placeholders(problem.observation.rigid.dynamics.standard_parameters()):
        return opened
    weights = opened.weights()
    described = opened.with_links(DESCRIPTION)
    error, other = (np.sum(weights * each.held_out(weights), axis=(1, 2)) for each in (opened, described))
    gain = error - other
    if gain.sum() > _LINK_GAIN * error.sum() and clear_gain(gain):
        return described.with_own_prior_weight()
    if -gain.sum() > _LINK_GAIN * error.sum() and clear_gain(-gain):
        return opened
    if described.log_evidence(weights) > opened.log_evidence(weights):
        return described.with_own_prior_weight()
    return replace(opened, links=EITHER)


def are_placeholders(standard: np.ndarray) -> bool:
    """Whether links (10 n,) have no mass, or most have the mass of another link: such values are placeholders."""
    mass = np.sort(standard[:: len(LINK_PARAMETERS)])
    if mass[-1] <= 0:
        return True
    same = np.diff(mass) <= _SAME_MASS * mass[-1]
    shared = np.append(same, False) | np.append(False, same)
    return bool(2 * shared.sum() > len(mass))


_SPEEDS = (2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 3e-2)  # of the highest speed of the axle
_TRAVELS = (1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # of the range the axle moves over
_FADINGS = (3e-3, 1e-2, 3e-2, 0.1, 0.3)  # of the highest speed
_FINER = ((0.55, 0.75, 1.0, 1.35, 1.8), (0.92, 1.0, 1.09))  # of the scale found before
_TERM_GAIN = 0.02
_VERY_STRONG = 5.0  # logarithm of a Bayes factor
_EVERYWHERE = ("quadratic", "offset")  # besides Coulomb and viscous friction


def paper_terms(reversals: Sequence[Reversal], further: Sequence[str] = ("quadratic",)) -> tuple[FrictionTerm, ...]:
    """The paper's three terms for every axle, with a reversal each; with "offset" as `further`, those of most tools."""
    return _terms_of([[reversal] for reversal in reversals], further)


def _terms_of(reversals: Sequence[Sequence[Reversal]], further: Sequence[str]) -> tuple[FrictionTerm, ...]:
    """For every axle Coulomb friction with each of its reversals, viscous friction and `further` terms."""
    return tuple(
        term
        for axle, grid in enumerate(reversals)
        for term in (
            *(FrictionTerm(axle, "coulomb", reversal) for reversal in grid),
            FrictionTerm(axle, "viscous"),
            *(FrictionTerm(axle, form) for form in further),
        )
    )


def select_friction_terms(observation: Observation, partition: Partition) -> Problem:
    """The problem of fitting the terms that held-out error selects.

    Every axle starts with the paper's three terms and a torque offset. How its sliding reverses is learned: from a
    grid of transition speeds and of presliding travels, then from two finer ones around the best. Then offsets go,
    one at a time, where leaving folds out shows that it is better without: by at least 2 % of the joint's squared
    error, and by more than the scatter of that gain between folds. Further terms come one at a time per axle where
    the same shows that they predict better; instead of the scatter, which five folds of one motion have by chance,
    very strong evidence does (a Bayes factor of e⁵: Kass and Raftery, J. Am. Stat. Assoc. 90, 1995). Offsets do
    not have to, because in a small motion they look like gravity: held-out parts of it cannot show that there is one,
    and gravity instead of an offset would predict other postures wrong.

    Trying a column is cheap: with A the normal matrix of the terms taken, the candidate c changes the estimate
    along d = [-A⁻¹ a_c, 1] only, and the held-out error is a parabola in that step.
    """
    n = observation.robot.dof
    coupling = observation.robot.coupling
    fastest = np.max([np.abs(s.motion.qd @ coupling.T).max(axis=0) for s in observation.segments], axis=0)
    fastest = np.maximum(fastest, 1e-6 * observation.robot.max_velocity)
    axles = (segment.motion.q @ coupling.T for segment in observation.segments)
    ends = np.array([(positions.min(axis=0), positions.max(axis=0)) for positions in axles])
    travelled = np.maximum(ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0), 1e-6)
    grids = [
        [
            Reversal(),
            *(Reversal("speed", float(speed * fastest[axle])) for speed in _SPEEDS),
            *(Reversal("travel", float(travel * travelled[axle])) for travel in _TRAVELS),
        ]
        for axle in range(n)
    ]
    wide = Problem.pose(observation, partition, _terms_of(grids, _EVERYWHERE))
    sharp = np.array([k for k, term in enumerate(wide.terms) if term.reversal in (None, Reversal())])
    links = choose_links(wide.select(sharp)).links
    problem, reversals = _best_reversals(wide.with_links(links))
    problem = problem.with_own_prior_weight()
    for factors in _FINER:
        grids = [[replace(r, scale=r.scale * factor) for factor in factors] if r.scale else [r] for r in reversals]
        terms = _terms_of(grids, _EVERYWHERE)
        finer = Problem.pose(observation, partition, terms, prior_weight=problem.prior_weight, links=links)
        problem, reversals = _best_reversals(finer)

    weights = problem.weights()
    problem = _without_offsets(problem, weights)
    load = problem.solve(weights)[: observation.rigid.count]
    names_kept = {term.name for term in problem.terms}
    everywhere = (term for term in paper_terms(reversals, _EVERYWHERE) if term.name in names_kept)
    candidates = (term for axle in range(n) for term in _candidates(axle, reversals[axle], float(fastest[axle])))
    wide = Problem.pose(
        observation, partition, (*everywhere, *candidates), load, problem.prior_weight, keep=True, links=links
    )
    return wide.select(_forward_selection(wide, weights, len(problem.terms)))


def _without_offsets(problem: Problem, weights: np.ndarray) -> Problem:
    """The problem without the offsets whose removal clearly improves the held-out prediction."""
    while True:
        error = np.sum(weights * problem.held_out(weights), axis=(1, 2))
        least = _TERM_GAIN * error.sum() / problem.observation.robot.dof
        better = []
        for k, term in enumerate(problem.terms):
            if term.form == "offset":
                without = problem.select(np.delete(np.arange(len(problem.terms)), k))
                gain = error - np.sum(weights * without.held_out(weights), axis=(1, 2))
                if gain.sum() > least and clear_gain(gain):
                    better.append((float(gain.sum()), k, without))
        if not better:
            return problem
        problem = max(better)[2]


def _candidates(axle: int, reversal: Reversal, fastest: float) -> list[FrictionTerm]:
    return [
        FrictionTerm(axle, "viscous_asymmetry"),
        FrictionTerm(axle, "load", reversal),
        *(FrictionTerm(axle, "stribeck", reversal, fastest * fading) for fading in _FADINGS),
    ]


def _best_reversals(problem: Problem) -> tuple[Problem, list[Reversal]]:
    """One reversal per axle, by the residual it leaves, axle after axle, two rounds.

    Returns the problem with just these, and the reversals with their scales where a parabola through the error of the
    neighbours has its minimum.
    """
    forms = [term.form for term in problem.terms]
    fixed = [k for k, form in enumerate(forms) if form != "coulomb"]
    options = {
        axle: np.array([k for k, t in enumerate(problem.terms) if t.axle == axle and t.form == "coulomb"])
        for axle in range(problem.observation.robot.dof)
    }
    base = problem.observation.rigid.count
    choice = {axle: int(indices[0]) for axle, indices in options.items()}
    reversals = {}
    for _ in range(2):
        fit = problem.select(np.array(sorted([*fixed, *choice.values()])))
        total = problem.moments.weighted(fit.weights())
        for axle, indices in options.items():
            chosen = [*fixed, *(k for a, k in choice.items() if a != axle)]
            others = np.concatenate([np.arange(base), base + np.array(chosen)])
            error = _trial(total, total, problem.prior, fit.prior_weight, others, base + indices)[1]
            choice[axle] = int(indices[np.argmin(error)])
            reversals[axle] = _between([problem.terms[k].reversal or Reversal() for k in indices], error)
    return problem.select(np.array(sorted([*fixed, *choice.values()]))), list(reversals.values())


def _between(grid: list[Reversal], error: np.ndarray) -> Reversal:
    """The best of a grid, its scale where a parabola through it and its neighbours has its minimum."""
    best = int(np.argmin(error))
    around = grid[max(best - 1, 0) : best + 2]
    if len(around) < 3 or len({reversal.kind for reversal in around}) > 1 or around[0].scale == 0:
        return grid[best]
    x = np.log([reversal.scale for reversal in around])
    bend, slope, _ = np.polyfit(x - x[1], error[best - 1 : best + 2], 2)
    if bend <= 0:
        return grid[best]
    return Reversal(grid[best].kind, float(np.exp(np.clip(x[1] - slope / (2 * bend), x[0], x[2]))))


def _trial(
    train: np.ndarray, test: np.ndarray, prior: Prior, prior_weight: float, selected: np.ndarray, candidates: np.ndarray
) -> tuple[float, np.ndarray]:
    """Squared error on `test` of the selected columns fitted on `train`, and with each candidate (c,) besides."""
    matrix = train[:-1, :-1] + prior_weight * prior.precision
    right = train[:-1, -1] + prior_weight * prior.precision @ prior.mean
    scale = 1 / np.sqrt(np.diag(matrix))
    a = matrix[np.ix_(selected, selected)] * np.outer(scale[selected], scale[selected])
    b = np.column_stack([matrix[np.ix_(selected, candidates)], right[selected]]) * scale[selected][:, None]
    solved = scale[selected][:, None] * np.linalg.solve(a, b)
    along, fit = solved[:, :-1], solved[:, -1]
    curvature = matrix[candidates, candidates] - np.sum(matrix[np.ix_(selected, candidates)] * along, axis=0)
    slope = right[candidates] - matrix[np.ix_(candidates, selected)] @ fit
    step = slope / np.maximum(curvature, 1e-9 * matrix[candidates, candidates])

    # gradient of half the error in every column, the torque's included
    residual = test[:, selected] @ fit - test[:, -1]
    error = fit @ residual[selected] - residual[-1]
    inner = test[np.ix_(selected, selected)] @ along
    bend = np.sum(along * inner, axis=0) - 2 * np.sum(along * test[np.ix_(selected, candidates)], axis=0)
    bend = bend + test[candidates, candidates]
    lean = residual[candidates] - residual[selected] @ along
    return float(error), error + 2 * step * lean + step**2 * bend


def _forward_selection(problem: Problem, weights: np.ndarray, count: int) -> np.ndarray:
    """The first `count` terms and what else lowers held-out error; at most one per axle and round, each form once."""
    partition, prior, prior_weight = problem.partition, problem.prior, problem.prior_weight
    base, axles = problem.observation.rigid.count, np.array([term.axle for term in problem.terms])
    names = [term.name for term in problem.terms]
    folds = range(partition.folds)
    train = [problem.moments.weighted(weights, partition.training(fold)) for fold in folds]
    test = [problem.moments.weighted(weights, partition.fold == fold) for fold in folds]
    total = problem.moments.weighted(weights)

    def evidence(columns: np.ndarray) -> float:
        own = np.append(columns, len(total) - 1)
        return log_evidence(total[np.ix_(own, own)], prior.select(columns), prior_weight)

    selected = list(range(count))
    while True:
        present = {names[k] for k in selected}
        free = np.array([k for k, name in enumerate(names) if name not in present], dtype=int)
        columns = np.concatenate([np.arange(base), base + np.array(selected)])
        trials = [_trial(a, b, prior, prior_weight, columns, base + free) for a, b in zip(train, test, strict=True)]
        gains = np.array([before - after for before, after in trials])
        mean = gains.sum(axis=0)
        least = _TERM_GAIN * sum(before for before, _ in trials) / (1 + axles.max())
        worth = (mean > least) & clear_gain(gains)
        for k in np.flatnonzero((mean > least) & ~worth):
            worth[k] = evidence(np.append(columns, base + free[k])) - evidence(columns) > _VERY_STRONG
        if not worth.any():
            return np.array(sorted(selected, key=lambda k: (axles[k], k)))
        for axle in np.unique(axles[free[worth]]):
            options = np.flatnonzero(worth & (axles[free] == axle))
            selected.append(int(free[options[np.argmax(mean[options])]]))


_NOT_WORSE = 1.25  # J over its least value, mean of the joints
LOWEST = 10.0  #: Hz; friction at reversals needs as much
_SPECTRUM = 2.0  # s, of a spectrum


def predictive_cutoff(problem: Problem, parameters: np.ndarray) -> tuple[float, int] | None:
    """A lower cut-off [Hz] that predicts better, and the joint that asks most for it; None where this one will do.

    `parameters` (p,) are those of a first fit with the same terms.

    Positions differentiated twice carry noise that grows with frequency, and from some frequency on a prediction
    made of them is further from the measured torque than no prediction at all. With R(f) the spectrum of the
    residual of a first fit and P(f) that of the measured torque, a prediction cut off at f_c leaves

        J(f_c) = ∫ R df up to f_c + ∫ P df beyond,

    whose minimum is the best cut-off for a joint (the ideal low-pass filter of Wiener's problem). The highest
    cut-off is taken that is not clearly worse than the best one on the mean of the joints: a higher one loses
    nothing there, and friction at reversals needs it. No inertia of the description enters. The first fit is made
    at the lowest cut-off: at a higher one the noise would pull its inertias towards zero and so hide itself (errors
    in variables).
    """
    motion = problem.observation.segments[0].motion
    residuals = problem.residuals(parameters)
    torques = [segment.torque for segment in problem.observation.segments]
    length = min(max(len(torque) for torque in torques), int(_SPECTRUM * motion.rate / motion.step))
    frequency = np.fft.rfftfreq(length, motion.step / motion.rate)
    band = frequency <= motion.cutoff
    mean = np.concatenate(torques).mean(axis=0)
    residual = _power(residuals, length)[band]
    measured = _power([torque - mean for torque in torques], length)[band]
    beyond = np.cumsum(measured[::-1], axis=0)[::-1] - measured
    cost = np.cumsum(residual, axis=0) + beyond
    worse = cost / np.maximum(cost.min(axis=0), 1e-300)
    allowed = np.flatnonzero((worse.mean(axis=1) <= _NOT_WORSE * worse.mean(axis=1).min()) | (frequency[band] < LOWEST))
    cutoff = max(float(f"{frequency[allowed[-1]]:.2g}"), LOWEST)
    if cutoff > 0.95 * motion.cutoff:
        return None
    return cutoff, int(np.argmax(worse[-1]))


def _power(signals: list[np.ndarray], length: int) -> np.ndarray:
    """(F, n) power over frequency of signals (S', n), Welch's mean over pieces; shorter segments are padded."""
    total: np.ndarray | float = 0.0
    for signal in signals:
        size = min(len(signal), length)
        window = np.hanning(size)[:, None]
        for first in range(0, len(signal) - size + 1, max(size // 2, 1)):
            total = total + np.abs(np.fft.rfft(signal[first : first + size] * window, length, axis=0)) ** 2
    return np.asarray(total)
