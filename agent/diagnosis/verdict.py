"""The rules of the verdict (docs/diagnosis.md), all of them: nothing leaves the procedure that breaks one.

A search says what equals what (`named`), or that nothing may be named (`abstained`). `judge` takes away what the
figures on motion held out do not bear out, the path adds its own (`with_path`), and `settle` holds the promises last.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from math import isfinite

import numpy as np

from agent.diagnosis.answer import Cause, EffectPlace
from agent.diagnosis.dataset import Dataset
from agent.diagnosis.finding import Finding
from agent.diagnosis.fit import Fit
from agent.diagnosis.gap import HeldOutGap, held_out_gap
from agent.diagnosis.limits import LIMITS, DecisionLimits
from agent.simulators import SIMULATOR


def abstained(matters: bool) -> str:
    """Where nothing may be named: there is a gap all the same, or none."""
    return "unknown" if matters else "no_gap"


def named(equalled: bool) -> str:
    """Where causes are named: whether something equals the first. One that fits doubtfully is only less probable."""
    return "ambiguous" if equalled else "explained"


def judge(dataset: Dataset, finding: Finding, plain: Fit, unit: np.ndarray | None = None) -> tuple[Finding, HeldOutGap]:
    """A finding as far as its figures on motion held out bear it out, and these figures; `plain`: without effects.

    `unit` is that of `held_out_gap`.
    """
    while True:
        gap = held_out_gap(dataset, finding.fit, unit)
        if not finding.causes:
            return finding, gap
        little = gap.closure is not None and gap.closure < dataset.limits.explained
        unsure = finding.probability[0] < dataset.limits.sure_probability
        if finding.verdict == "explained" and (little or unsure):
            finding = finding.with_uncertain_form()
        causes = causes_of(dataset, finding, gap)
        verdict, kept = settle(finding.verdict, causes, gap.closure, dataset.limits)
        if not kept or gap.hardly_closed:
            matters = verdict != "no_gap" and finding.matters and not gap.small
            finding = finding.without_causes(abstained(matters), plain)
        elif len(kept) < len(causes):
            finding = finding.only([k for k, cause in enumerate(causes) if cause in kept], plain)
        else:
            return replace(finding, verdict=verdict), gap


def causes_of(dataset: Dataset, finding: Finding, gap: HeldOutGap) -> tuple[Cause, ...]:
    """The causes of a finding with their figures."""
    fit, joints = finding.fit, dataset.robot.joint_names
    taken_out = [fit.out_of_fold(fit.once, number) for number in range(len(finding.causes))]
    parts = zip(finding.causes, taken_out, fit.values, finding.rivals, finding.probability, strict=True)
    # parts of one motion are too much alike to bear out what hardly closes anything
    by_joint = dataset.model.method == SIMULATOR or (len(finding.causes) > 1 and len(dataset.logs) > 1)
    return tuple(
        Cause(
            candidate.effect.name,
            tuple(joints[j] for j in candidate.joints),
            gap.closure_without(left),
            probability,
            candidate.effect.reported(
                fit.reference,
                _floats(candidate.settings.items()),
                _floats(zip(candidate.names, values, strict=True)),
            ),
            tuple(EffectPlace(name, tuple(joints[j] for j in there)) for name, there in rivals),
            gap.closure_on(candidate.joints, left) if by_joint and candidate.joints else None,
        )
        for candidate, left, values, rivals, probability in parts
    )


def _floats(pairs: Iterable[tuple[str, float]]) -> dict[str, float]:
    return {name: float(value) for name, value in pairs}


def with_path(
    verdict: str, closure: float | None, closure_of_path: float | None, named: bool
) -> tuple[str, float | None]:
    """Verdict and closure where the executed path is not the planned one: the gap that there is may be the path's.

    `named`: whether the effect of the path may be.
    """
    if verdict != "no_gap":
        return verdict, closure
    return ("explained", closure_of_path) if named else ("unknown", closure)


def has_size(cause: Cause, limits: DecisionLimits = LIMITS) -> bool:
    """Whether a cause has parameters, finite and not all zero, and closes a part of its gap by itself.

    It may be small beside others, and not on its own joints.
    """
    values = cause.parameters.values()
    if cause.closure is None or not isfinite(cause.closure):
        return False
    of_joints = cause.closure_of_joints
    closes = cause.closure >= limits.least_share or (of_joints is not None and of_joints >= limits.least_closure)
    return closes and all(map(isfinite, values)) and any(values)


def _cancel(one: Cause, other: Cause, limits: DecisionLimits) -> bool:
    far_more = all((cause.closure or 0.0) > limits.cancelling for cause in (one, other))
    return far_more and not set(one.joints).isdisjoint(other.joints)


def settle(
    verdict: str, causes: Sequence[Cause], closure: float | None, limits: DecisionLimits = LIMITS
) -> tuple[str, tuple[Cause, ...]]:
    """The verdict that the figures allow, and the causes that may be named with it.

    - `explained` has causes, and they close three quarters of the gap;
    - `ambiguous` has causes that close a good part of it, and something that equals the first;
    - `unknown` and `no_gap` have none, and where there is nothing to close (None) there is no gap;
    - a cause without a size is none, and two of one joint are none that each close far more than there is: together
      they make a shape that neither has.
    """
    if verdict in ("no_gap", "unknown"):
        return verdict, ()
    if closure is None:
        return "no_gap", ()
    if any(_cancel(one, other, limits) for one, other in combinations(causes, 2)):
        return "unknown", ()
    left = tuple(cause for cause in causes if has_size(cause, limits))
    if not left or not closure >= limits.least_closure:  # not a number is not enough either
        return "unknown", ()
    if left[0].equivalent_to:
        return "ambiguous", left
    return ("explained", left) if verdict == "explained" and closure >= limits.explained else ("unknown", ())
