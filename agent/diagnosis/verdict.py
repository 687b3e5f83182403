"""Checks of a verdict on held-out figures: a verdict that fails one is withdrawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import isfinite

import numpy as np

from agent.diagnosis.answer import Cause, EffectPlace
from agent.diagnosis.gap.torque_gap import HeldOutGap, held_out_gap
from agent.diagnosis.hypotheses.finding import Finding
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.rows.fit import Fit


def judge(dataset: Dataset, finding: Finding, plain: Fit, unit: np.ndarray | None = None) -> tuple[Finding, HeldOutGap]:
    """Return the part of a finding that its held-out figures support, and these figures.

    `plain` is the fit without effects, `unit` that of `held_out_gap`. If the causes close less than `explained` needs,
    another cause may exist: the likeliest one is named with the first.
    """
    while True:
        gap = held_out_gap(dataset, finding.fit, unit)
        if not finding.causes:
            return finding, gap
        if finding.verdict == "explained" and (gap.closure or 0.0) < LIMITS.explained:
            finding = finding.with_runner_up()
        causes = causes_of(dataset, finding, gap)
        verdict, kept = settle(finding.verdict, causes, gap.closure)
        if not kept:  # held out, they explain at most the model's own error, unless the gap exceeds that by far
            finding = finding.without_causes("unknown" if finding.exceeded else "no_gap", plain)
        elif len(kept) < len(causes):
            finding = finding.only([k for k, cause in enumerate(causes) if cause in kept], plain)
        else:
            return replace(finding, verdict=verdict), gap


def causes_of(dataset: Dataset, finding: Finding, gap: HeldOutGap) -> tuple[Cause, ...]:
    """Return the causes of a finding with their figures."""
    fit, joints = finding.fit, dataset.robot.joint_names
    taken_out = [fit.out_of_fold(fit.once, number) for number in range(len(finding.causes))]
    parts = zip(finding.causes, taken_out, fit.values, finding.rivals, finding.probability, strict=True)
    return tuple(
        Cause(
            candidate.effect.name,
            tuple(joints[j] for j in candidate.joints),
            gap.closure_without(left),
            probability,
            candidate.effect.reported(
                fit.reference, _floats(candidate.settings.items()), _floats(zip(candidate.names, values, strict=True))
            ),
            tuple(EffectPlace(name, tuple(joints[j] for j in there)) for name, there in rivals),
            gap.closure_on(candidate.joints, left) if candidate.joints else None,
        )
        for candidate, left, values, rivals, probability in parts
    )


def _floats(pairs: Iterable[tuple[str, float]]) -> dict[str, float]:
    return {name: float(value) for name, value in pairs}


def with_path(
    verdict: str, closure: float | None, closure_of_path: float | None, named: bool
) -> tuple[str, float | None]:
    """Return verdict and gap explained if the executed path is not the planned one: the path may cause the gap.

    `named`: whether the effect of the path may be.
    """
    if verdict != "no_gap":
        return verdict, closure
    return ("explained", closure_of_path) if named else ("unknown", closure)


def has_size(cause: Cause) -> bool:
    """Return whether a cause has finite parameters, not all zero, and closes a part of the gap or of its joints'."""
    values = cause.parameters.values()
    if cause.closure is None or not isfinite(cause.closure):
        return False
    of_joints = cause.closure if cause.closure_of_joints is None else cause.closure_of_joints
    return max(cause.closure, of_joints) >= LIMITS.least_share and all(map(isfinite, values)) and any(values)


def settle(verdict: str, causes: Sequence[Cause], closure: float | None) -> tuple[str, tuple[Cause, ...]]:
    """Return the verdict that the figures allow, and the causes that may be named with it.

    - `explained` closes three quarters of the gap;
    - an `ambiguous` verdict has a rival of the first cause;
    - `unknown` and `no_gap` have no causes; without anything to close (None) there is no gap;
    - a cause without a size is dropped.
    """
    if verdict in ("no_gap", "unknown"):
        return verdict, ()
    if closure is None:
        return "no_gap", ()
    left = tuple(cause for cause in causes if has_size(cause))
    if not left:
        return "unknown", ()
    if left[0].equivalent_to:
        return "ambiguous", left
    if verdict == "ambiguous":  # what was equalled was another cause, which has no size: the rest stands by itself
        verdict = "explained"
    return ("explained", left) if closure >= LIMITS.explained else ("unknown", ())
