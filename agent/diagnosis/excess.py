"""How far the error of each joint is over the background, whether that has a size, and where an effect has it."""

from __future__ import annotations

import warnings

import numpy as np

from agent.diagnosis.candidate import Candidate, HeldOutScore
from agent.diagnosis.dataset import stiction
from agent.diagnosis.fit import Fit
from agent.diagnosis.isolability import plausible
from agent.diagnosis.limits import DecisionLimits


def joint_energy(fit: Fit, single: bool | None = None) -> np.ndarray:
    """(n,) mean of (e / σ)² held out; by `single` folds if so, else by those that the chosen effects are judged by."""
    error = fit.rests.whitened_all(fit.out_of_fold(fit.once if single is None else single) / fit.sigma)
    return np.nanmean(error**2, axis=0)


def over_background(fit: Fit) -> np.ndarray:
    """(n,) energy of each joint over the background, in the logs where it is over it."""
    energy = fit.rests.whitened_all(fit.out_of_fold() / fit.sigma) ** 2
    log = np.concatenate([np.full(len(s.time[s.kept]), s.log_index) for s in fit.signals])
    total = np.zeros(energy.shape[1])
    for number in np.unique(log):
        total += np.maximum(np.nansum(energy[log == number] - 1, axis=0), 0)
    return total


def put_elsewhere(fit: Fit, score: HeldOutScore) -> float:
    """Σ e² / σ² that an effect adds on the joints beside the one where it gains most; below nought where it takes away.

    A force or a body pulls at all joints below it. One that is fitted to what a single joint has, as a sensor that
    holds its value, puts torque on the others that nobody measured. Rows of guards are in no fit, and do not count.
    """
    joints = list(score.candidate.blocks)
    if len(joints) < 2:
        return 0.0
    before = np.concatenate(fit.residuals)
    after = np.concatenate(fit.with_chosen((*fit.chosen, score.candidate)).residuals)
    gained = np.sum(((before**2 - after**2) / fit.sigma**2)[fit.cell >= 0][:, joints], axis=0)
    return float(gained.max() - gained.sum())


def largest_torque(fit: Fit, score: HeldOutScore) -> float:
    """Root mean square torque of an effect over nominal, on the joint and log where it is largest."""
    largest = 0.0
    for joint, block in score.candidate.blocks.items():
        torque = block @ score.values * fit.sigma[:, joint] / fit.reference.scale[joint]
        largest = max(largest, float(np.sqrt(np.mean(torque**2))))
        if score.candidate.effect.once:
            inside = np.abs(torque) > 0
            largest = max(largest, float(np.sqrt(np.mean(torque[inside] ** 2))) if inside.any() else 0.0)
    return largest


def possible_together(fit: Fit) -> bool:
    """Whether the parameters of all chosen effects, fitted together, can be true: one may turn to cancel another."""
    chosen = zip(fit.chosen, fit.values, strict=True)
    return all(plausible(HeldOutScore(candidate, 0.0, 0.0, values)) for candidate, values in chosen)


def closed_excess(limits: DecisionLimits, base: Fit, fit: Fit) -> float:
    """How much of the excess over the background of a fit without effects is gone; 1 where there was none to speak of.

    Before and after are held out alike, or what the model's numbers gain between other folds would be the effects'.
    """
    before, after = joint_energy(base, fit.once), joint_energy(fit)
    excess = np.sum(np.maximum(before - 1, 0))
    left = np.sum(np.maximum(after - 1, 0) * (after > 1 + 0.5 * limits.excess_energy))
    return float(1 - left / excess) if excess > 0.1 else float(left < 0.1)


def exact_but_for_more(limits: DecisionLimits, base: Fit, fit: Fit, cause: Candidate) -> bool:
    """Whether a cause of an exact form, with no other on its joint, leaves a part of what a fit without effects has
    there: no form of it errs, so there is more, and that may be all."""
    joints = list(cause.blocks)
    others = (set(c.blocks) for c in fit.chosen if c.place != cause.place)
    if not cause.effect.exact or any(not other.isdisjoint(joints) for other in others):
        return False
    before, after = (float(np.sum(np.maximum(joint_energy(one, fit.once)[joints] - 1, 0))) for one in (base, fit))
    return after > (1 - limits.good_fit[0]) * before


def noticed(
    limits: DecisionLimits, at_rest: np.ndarray, fit: Fit, least: float | None = None, allow_stiction: bool = False
) -> np.ndarray:
    """(n,) joints whose gap has a size: `least` over the background in motion, or the reported size in all rows.

    `at_rest` (S', n): rows that are no motion. `allow_stiction`: around a reversal only an error beyond what dry
    friction leaves open, as it may stick there. An effect that explains such an error may be named; an error that
    nothing explains has to show elsewhere too. What a rest has beyond twice the Coulomb level no dry friction holds.
    """
    least = limits.practical_torque if least is None else least
    background = fit.sigma.min(axis=0) / fit.reference.scale  # where the joint moves
    left = fit.out_of_fold() / fit.reference.scale
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a joint that always rests has no mean
        square = np.nanmean(np.where(at_rest, np.nan, left) ** 2, axis=0)
        if allow_stiction:
            near = np.where(fit.near_rest & ~at_rest & np.isfinite(left), 1.0, np.nan)
            share = np.nansum(near, axis=0) / np.sum(np.isfinite(left) & ~at_rest, axis=0)
            around = np.nanmean(near * left**2, axis=0)
            stuck = np.minimum(around, np.nanmean(near * (fit.sigma / fit.reference.scale) ** 2, axis=0))
            square = np.maximum(square - np.nan_to_num(share * np.maximum(stuck - background**2, 0)), 0)
        moving = np.sqrt(square)
    clear = (moving > limits.clear_of_background * background) & (moving**2 > background**2 + least**2)
    energy = joint_energy(fit)
    over = np.sqrt(np.maximum(energy - 1, 0)) * background
    held = np.maximum(fit.sigma, 2 * stiction(fit.reference)) / fit.reference.scale
    beyond = np.sqrt(np.nanmean(np.where(at_rest, np.maximum(left**2 - held**2, 0.0), 0.0 * left), axis=0))
    over = np.maximum(over, beyond)
    return clear | ((energy > 1 + limits.excess_energy) & (over > limits.unexplained_torque))
