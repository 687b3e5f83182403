"""What each step of an explanation closes of the held-out gap: released numbers first, then effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.core import and_list
from agent.diagnosis.document import WaterfallStep
from agent.diagnosis.gap.regime_shares import resampled
from agent.diagnosis.gap.torque_gap import HeldOutGap, rms
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import precision_of
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.simulator_file.released_numbers import ReleasedSimulator, released_fit

_FIXED = 1e-6  # of the stored covariance: the model's parameters stay where they are
#: The remaining gap, as the last step.
REMAINDER = "remainder"
OWN_PARAMETERS = "the model's own parameters"


def waterfall(released: ReleasedSimulator, selected: SelectedCauses, gap: HeldOutGap) -> tuple[WaterfallStep, ...]:
    """Part of the held-out gap that each released group, then each effect, closes: alone, and in the order found.

    Where a simulator is far off, a number alone may make the rest worse: steps are one until they close something.

    Of a model that nothing is released of, the effects come first, with its numbers as they are. What its own
    parameters close after that, within their stored uncertainty and also on other joints, is a step of its own.

    `gap` is that of the simulator as given, with everything found; empty where there is nothing to close.
    """
    if gap.closure is None:
        return ()
    names, dataset = released.given.robot.joint_names, released.given
    fits = [released_fit(dataset, released.groups[: k + 1]) for k in range(len(released.groups))]
    alone = [released_fit(dataset, [group]).held_out() for group in released.groups]
    texts = [group.text(names) for group in released.groups]
    plain, moved = dataset.fit, dataset.fit.with_chosen(selected.causes)
    if not released.groups and dataset.has_reference:  # a model fitted to the same logs has no own numbers to keep
        held = plain.with_prior(precision_of(_FIXED * dataset.stored_covariance))
        by_effects, by_both = (_absorbed(gap, fit) for fit in (held.with_chosen(selected.causes), moved))
        plain = held if by_both - by_effects >= LIMITS.least_share else plain
    last = fits[-1] if fits else plain
    for k, candidate in enumerate(selected.causes):
        fits.append(last.with_chosen(selected.causes[: k + 1]))
        alone.append(plain.with_chosen((candidate,)).held_out())
        texts.append(candidate.text(names))
    if plain is not dataset.fit:
        fits.append(moved)
        alone.append(dataset.fit.held_out())
        texts.append(OWN_PARAMETERS)
    stages = [fit.held_out() for fit in fits]
    errors = [gap.error_before, *(gap.beyond(stage) for stage in (*stages, *alone))]
    energy = np.stack([_energy(error / gap.unit, dataset.fit.segment_of_row) for error in errors])
    floor = 0.0 if gap.floor is None else float(np.mean(gap.floor**2))
    rows = _energy(np.isfinite(gap.error_before).astype(float), dataset.fit.segment_of_row)
    draws = resampled(energy.shape[1])
    whole = energy.sum(axis=1) / rows.sum()
    drawn = energy @ draws.T / (rows @ draws.T)  # (stages, draws)

    size, drawn = whole[0] - floor, drawn[:, drawn[0] > floor]
    count, first, steps = len(texts), 0, []

    def closing(begin: int, end: int) -> tuple[float, tuple[float, float]]:
        """Part of the gap that is closed between two stages, and its interval."""
        drawn_parts = (drawn[begin] - drawn[end]) / (drawn[0] - floor)
        low, high = np.quantile(drawn_parts, LAW.interval)
        return float((whole[begin] - whole[end]) / size), (float(low), float(high))

    while first < count:
        ends = range(first + 1, count + 1)
        end = next((end for end in ends if closing(first, end)[1][1] >= 0), count)
        by_itself = float((whole[0] - whole[count + end]) / size)
        steps.append(
            WaterfallStep(and_list(texts[first:end]), closing(first, end)[0], by_itself, closing(first, end)[1])
        )
        first = end
    if len(steps) < count:
        steps = [replace(step, alone=None) for step in steps]
    closed, (low, high) = closing(0, count)
    return (*steps, WaterfallStep(REMAINDER, 1 - closed, None, (1 - high, 1 - low)))


def _absorbed(gap: HeldOutGap, fit: Fit) -> float:
    return replace(gap, after=rms(gap.beyond(fit.held_out())) / gap.unit).absorbed


def _energy(rows: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(blocks,) sum of squares of (S', n), guards left out."""
    return np.bincount(block, np.nansum(rows**2, axis=1))
