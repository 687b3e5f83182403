"""Whether causes explain what they claim: what they leave of held-out motion has to look like a healthy arm's.

Log evidence compares effects of the catalogue with each other. It cannot tell that all of them are wrong. Held-out
errors can, whatever the effect (Kennedy and O'Hagan, J. R. Statist. Soc. B 63, 2001).

Whether a joint errs by more than a healthy one is asked of its error over the noise level σ:

| question | limit | asked for |
| --- | --- | --- |
| more than usual, in all rows | `Fit.beyond_usual`, 2 σ | the joints of a gap, of a cause or of a number |
| in motion, as given and refitted | `Adequacy.exceeds`, 2 σ | a gap without causes |
| in the rows of the search | `SelectedCauses.errs_beyond_usual`, 4 σ² | whether an arm may be healthy |
| no chance, with friction of another day | `errs_beyond_chance`, 3 σ | a gap that no effect explains |
| no chance, of positions | `Fit.beyond_chance`, 3 σ | the same |
| more than causes may leave | `Adequacy.remainder_sizes`, 1 | whether they explain what they claim |

They differ in what else errs. A joint is named with its rests, where its weight shows. A gap is said in motion only,
and if the model errs as given and refitted: stiction and few motions err by more. The search has no held-out error yet.
A gap without an effect is the likeliest false alarm, so it may be no chance. Causes err by their formulas too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property

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


class Adequacy:
    """What the causes that a fit has chosen explain of held-out motion, and what they leave.

    Parameters
    ----------
    fit : Fit
        With the causes as its chosen effects.
    gap : HeldOutGap
        That of `fit`.
    causes : sequence of Candidate, optional
        None where the model alone is judged.
    """

    def __init__(self, fit: Fit, gap: HeldOutGap, causes: Sequence[Candidate] = ()):
        self.fit, self.gap, self.causes = fit, gap, causes

    @classmethod
    def of(cls, selected: SelectedCauses, gap: HeldOutGap) -> Adequacy:
        """That of selected causes, by the gap that their fit leaves, or that of a file as it was given."""
        return cls(selected.fit, gap, selected.causes)

    @cached_property
    def taken_out(self) -> list[np.ndarray]:
        """Per cause the error (S', n) [N·m] without it."""
        return [self.fit.held_out(without=number) for number in range(len(self.causes))]

    @cached_property
    def closed_alone(self) -> float:
        """Part of the gap that the causes close, without the change of the model's parameters.

        A model that was fitted to the same logs trades with them freely, and its part is not separated.
        """
        if not self.fit.keeps_parameters:
            return self.gap.closure or 0.0
        error = self.fit.held_out()
        return self.gap.closure_without(error + sum(rows - error for rows in self.taken_out)) or 0.0

    @cached_property
    def explained_part(self) -> float | None:
        """Part of the gap that the causes explain; None where there is nothing to close.

        The model's parameters change with them. Where that is worse for motion held out, on joints that no cause has,
        what the causes close alone counts.
        """
        return None if self.gap.closure is None else max(self.gap.closure, self.closed_alone)

    @cached_property
    def errors_while_moving(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) errors [N·m] before and after the causes while the joint moves; zero where it never does."""
        count = np.maximum(self._moving.sum(axis=0), 1)
        before, after = (
            np.sqrt(np.sum(np.where(self._moving, error, 0.0) ** 2, axis=0) / count)
            for error in (self.gap.error_before, self.gap.error_after)
        )
        return before, after

    @cached_property
    def _moving(self) -> np.ndarray:
        """(S', n) bool: rows that count."""
        return ~self.fit.near_rest & ~np.isnan(self.gap.error_after)

    @cached_property
    def remainder_sizes(self) -> np.ndarray:
        """(n,) error that causes leave while the joint moves, over what a healthy arm leaves.

        That is the model's own error, what the formula of a certain cause misses (5 % of the squared error), and what
        the uncertainty of the fitted parameters makes of the motion that is held out. 1 is the limit.
        """
        before, after = self.errors_while_moving
        limit = (LARGEST_ERROR * self.fit.sigma.min(axis=0)) ** 2 + _prediction_variance(self.fit, self._moving)
        return np.asarray(after / np.sqrt(limit + LIMITS.negligible * before**2))

    def exceeds(self, times: float = LIMITS.usual_error) -> bool:
        """Whether a joint errs by as many `times` a model's own error, as given and also if its parameters move."""
        return bool((np.minimum(*self.errors_while_moving) >= times * self.fit.sigma.min(axis=0)).any())

    def shortfalls(self, irreplaceable: Callable[[int], bool]) -> list[str]:
        """Per cause why it does not explain what it claims; empty where it does.

        Of a model that was fitted to the same logs only their remainder counts. It does not count for a cause, by
        number, that is `irreplaceable`: the formula of a play or of an elastic gear misses more than 5 %, but nothing
        smooth could replace it.
        """
        if not self.causes or self.gap.closure is None:
            return [""] * len(self.causes)
        trades, reasons = self.fit.keeps_parameters and len(self.causes) > 1, []
        for number, (candidate, rows) in enumerate(zip(self.causes, self.taken_out, strict=True)):
            joint = self.main_joint(candidate.joints or candidate.blocks, rows)
            # more than all of them together
            if trades and (self.gap.closure_without(rows) or 0.0) > self.closed_alone / LIMITS.explained:
                reasons.append("it and another cause cancel each other")
            elif self.remainder_sizes[joint] > 1 and not irreplaceable(number):
                name = self.fit.reference.robot.joint_names[joint]
                times = f"{self.remainder_sizes[joint]:.1f} times"
                reasons.append(f"it leaves {times} what a healthy arm may leave on {name}")
            else:
                reasons.append("")
        return reasons

    def main_joint(self, joints: Iterable[int], taken_out: np.ndarray) -> int:
        """The one of some joints on which a cause explains most; `taken_out` (S', n) [N·m] is the error without it."""
        change, indices = rms(self.gap.beyond(taken_out)) ** 2 - rms(self.gap.error_after) ** 2, list(joints)
        return indices[int(np.argmax(change[indices] / self.fit.sigma.min(axis=0)[indices] ** 2))]


def errs_beyond_chance(dataset: Dataset, searched: SelectedCauses) -> bool:
    """Return whether a joint errs by more than chance, whatever friction may differ by from day to day.

    A model of one log does not tell by how much it errs on other motions.
    """
    if not dataset.has_reference or len(dataset.model.provenance.get("logs", ())) < 2:
        return False
    another_day = dataset.fit.with_prior(searched.evidence.prior)
    return Adequacy(another_day, held_out_gap(dataset, another_day)).exceeds(LIMITS.significant_deviations)


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


def remainders(dataset: Dataset, gap: HeldOutGap) -> Iterator[Remainder]:
    """What causes leave on the joints where it is more than a healthy arm leaves, largest first."""
    sizes = Adequacy(dataset.fit, gap).remainder_sizes
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
