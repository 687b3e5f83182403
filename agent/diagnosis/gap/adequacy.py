"""Whether causes explain what they claim: what they leave of held-out motion has to look like a healthy arm's.

Log evidence compares effects of the catalogue with each other. It cannot tell that all of them are wrong. Held-out
errors can, whatever the effect (Kennedy and O'Hagan, J. R. Statist. Soc. B 63, 2001).

Whether a joint errs by more than a healthy one is asked in three ways, of its held-out error over the noise level σ:

| question | limit | who asks |
| --- | --- | --- |
| more than usual | 2 σ, `Fit.beyond_usual` | whether there is a gap, and which joints a cause needs |
| no chance | 3 σ, `Fit.beyond_chance` and `errs_beyond_chance` | whether a gap that nobody explains is said |
| more than causes may leave | `remainder_sizes` over 1 | whether the causes explain what they claim |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from scipy.special import chdtri

from agent.diagnosis.document import Remainder
from agent.diagnosis.gap.regime_shares import regimes
from agent.diagnosis.gap.torque_gap import HeldOutGap, held_out_gap, rms
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.noise_model import smooth_parts
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.rows.joined import joined

#: Times its held-out error that a model errs on healthy motion, except in a rare case. That error comes from few logs:
#: its square, over what the model errs by, is χ² with `nu` degrees of freedom, over `nu`.
LARGEST_ERROR = float(np.sqrt(LAW.nu / chdtri(LAW.nu, 1 - LAW.unlikely)))


def remainder_sizes(fit: Fit, gap: HeldOutGap) -> np.ndarray:
    """(n,) error that causes leave while the joint moves, over what a healthy arm leaves.

    That is the model's own error, what the formula of a certain cause misses (5 % of the squared error), and what the
    uncertainty of the fitted parameters makes of the motion that is held out. 1 is the limit.
    """
    before, after = _while_moving(fit, gap)
    limit = (LARGEST_ERROR * fit.sigma.min(axis=0)) ** 2 + _prediction_variance(fit, _moving(fit, gap))
    return np.asarray(after / np.sqrt(limit + LIMITS.negligible * before**2))


def exceeds(fit: Fit, gap: HeldOutGap, times: float = LIMITS.usual_error) -> bool:
    """Return whether a joint errs by as many `times` a model's own error, as given and also if its parameters move."""
    return bool((np.minimum(*_while_moving(fit, gap)) >= times * fit.sigma.min(axis=0)).any())


def errs_beyond_chance(dataset: Dataset, searched: SelectedCauses) -> bool:
    """Return whether a joint errs by more than chance, whatever friction may differ by from day to day.

    A model of one log does not tell by how much it errs on other motions.
    """
    if not dataset.has_reference or len(dataset.model.provenance.get("logs", ())) < 2:
        return False
    another_day = dataset.fit.with_prior(searched.evidence.prior)
    return exceeds(another_day, held_out_gap(dataset, another_day), LIMITS.significant_deviations)


def _while_moving(fit: Fit, gap: HeldOutGap) -> tuple[np.ndarray, np.ndarray]:
    """(n,) errors [N·m] before and after the causes while the joint moves; zero where it never does."""
    moving = _moving(fit, gap)
    count = np.maximum(moving.sum(axis=0), 1)
    before, after = (
        np.sqrt(np.sum(np.where(moving, e, 0.0) ** 2, axis=0) / count) for e in (gap.error_before, gap.error_after)
    )
    return before, after


def _moving(fit: Fit, gap: HeldOutGap) -> np.ndarray:
    """(S', n) bool: rows that count."""
    return ~fit.near_rest & ~np.isnan(gap.error_after)


def _prediction_variance(fit: Fit, moving: np.ndarray) -> np.ndarray:
    """(n,) mean square [N²·m²] by which uncertain parameters err on held-out rows: x H⁻¹ xᵀ, in units of σ².

    A spring that was fitted over half of the range says little about the other half. `moving` (S', n) rows count.
    """
    variances = np.zeros(len(fit.rows))
    if not fit.chosen:
        return variances
    for joint in {joint for candidate in fit.chosen for joint in candidate.blocks}:
        parts, indices = [fit.rows[joint][:, :-1]], [fit.parameter_index[joint]]
        for candidate, span in zip(fit.chosen, fit.spans, strict=True):
            if joint in candidate.blocks:
                parts.append(candidate.blocks[joint])
                indices.append(np.arange(span.start, span.stop))
        columns, places = np.hstack(parts), np.concatenate(indices)
        variance = np.zeros(len(columns))
        for fold in fit.test_folds:
            inverse = fit.solve(fold.train)[0][np.ix_(places, places)]
            test = np.isin(fit.cell_of_row, np.flatnonzero(fold.test))
            variance[test] = np.einsum("si,ij,sj->s", columns[test], inverse, columns[test], optimize=True)
        here = moving[:, joint]
        variances[joint] = float(np.mean(variance[here] * fit.sigma[here, joint] ** 2)) if here.any() else 0.0
    return variances


def shortfalls(
    fit: Fit, gap: HeldOutGap, causes: Sequence[Candidate], irreplaceable: Callable[[int], bool]
) -> list[str]:
    """Return per cause why it does not explain what it claims; empty where it does.

    `gap` is that of `fit`, whose chosen effects are the `causes`. Of a model that was fitted to the same logs only
    their remainder counts. It does not count for a cause, by number, that is `irreplaceable`: the formula of a play or
    of an elastic gear misses more than 5 %, but nothing smooth could replace it.
    """
    if not causes or gap.closure is None:
        return [""] * len(causes)
    taken_out = [fit.held_out(without=number) for number in range(len(causes))]
    closed, sizes = closed_alone(fit, gap, len(causes)), remainder_sizes(fit, gap)
    reasons = []
    for number, (candidate, rows) in enumerate(zip(causes, taken_out, strict=True)):
        joint = main_joint(fit, gap, candidate.joints or candidate.blocks, rows)
        trades = fit.keeps_parameters and len(causes) > 1
        if trades and (gap.closure_without(rows) or 0.0) > closed / LIMITS.explained:  # than all of them together
            reasons.append("it and another cause cancel each other")
        elif sizes[joint] > 1 and not irreplaceable(number):
            name = fit.reference.robot.joint_names[joint]
            reasons.append(f"it leaves {sizes[joint]:.1f} times what a healthy arm may leave on {name}")
        else:
            reasons.append("")
    return reasons


def closed_alone(fit: Fit, gap: HeldOutGap, count: int) -> float:
    """Part of the gap that the `count` chosen effects of a fit close, without the change of the model's parameters.

    A model that was fitted to the same logs trades with them freely, and its part is not separated.
    """
    if not fit.keeps_parameters:
        return gap.closure or 0.0
    error = fit.held_out()
    without = error + sum(fit.held_out(without=number) - error for number in range(count))
    return gap.closure_without(without) or 0.0


def explained_part(fit: Fit, gap: HeldOutGap, count: int) -> float | None:
    """Part of the gap that the `count` chosen effects of a fit explain; None where there is nothing to close.

    The model's parameters change with them. Where that is worse for motion held out, on joints that no cause has, what
    the causes close alone counts.
    """
    return None if gap.closure is None else max(gap.closure, closed_alone(fit, gap, count))


def main_joint(fit: Fit, gap: HeldOutGap, joints: Iterable[int], taken_out: np.ndarray) -> int:
    """The one of some joints on which a cause explains most; `taken_out` (S', n) [N·m] is the error without it."""
    change, indices = rms(gap.beyond(taken_out)) ** 2 - rms(gap.error_after) ** 2, list(joints)
    return indices[int(np.argmax(change[indices] / fit.sigma.min(axis=0)[indices] ** 2))]


def remainders(dataset: Dataset, gap: HeldOutGap) -> Iterator[Remainder]:
    """What causes leave on the joints where it is more than a healthy arm leaves, largest first."""
    sizes = remainder_sizes(dataset.fit, gap)
    for joint in np.argsort(-sizes, kind="stable").tolist():
        if sizes[joint] > 1:
            shares = regimes(dataset, gap.error_after[:, joint], joint)
            name = dataset.robot.joint_names[joint]
            yield Remainder(name, float(sizes[joint]), shares, _follows(dataset, gap.error_after[:, joint], joint))


def _follows(dataset: Dataset, error: np.ndarray, joint: int) -> dict[str, float]:
    """Share of the squared error (S',) that a smooth function of each state of the joint explains."""
    q, qd, qdd = (joined(dataset.fit.signals, name)[:, joint] for name in ("q", "qd", "qdd"))
    good = np.isfinite(error)
    parts = smooth_parts(q[good], qd[good], qdd[good], dataset.time[good], dataset.log[good])
    whole = float(np.sum(error[good] ** 2))
    return {name: 1 - float(np.sum(_residual(columns, error[good]) ** 2)) / whole for name, columns in parts.items()}


def _residual(columns: np.ndarray, error: np.ndarray) -> np.ndarray:
    return np.asarray(error - columns @ np.linalg.lstsq(columns, error, rcond=1e-9)[0])
