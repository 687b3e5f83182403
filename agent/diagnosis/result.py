"""The result of a diagnosis, by the definitions of CONTRACTS.md, 6."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agent.diagnosis.dataset import Dataset
from agent.diagnosis.evidence import share_intervals
from agent.diagnosis.finding import Finding
from agent.diagnosis.gap import SMALL, Gap, held_out_gap
from agent.diagnosis.motion_gap import MotionGap
from agent.diagnosis.procedure import Search
from agent.diagnosis.regimes import regimes
from agent.diagnosis.verdict import CLOSES, settle
from agent.model.effects import CATALOGUE, Effect
from agent.robot.torque_figures import error_units

SCHEMA = "diagnosis/1"
# Set-points are numbers, not measurements: where they differ, only a log that misplaces them in time speaks against it.
_SET_POINTS_AS_RECORDED = 0.97


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything a report shows: the result as plain data, the finding, the data, and what to warn about."""

    result: dict[str, Any]
    finding: Finding
    dataset: Dataset
    motion: MotionGap | None
    warnings: tuple[str, ...]
    gap: Gap


def build(
    dataset: Dataset, finding: Finding, gap: Gap, search: Search, motion: MotionGap | None, warnings: Sequence[str]
) -> Diagnosis:
    """Figures held out, shares, regimes and what is not testable."""
    robot, names = dataset.robot, dataset.robot.joint_names
    causes, verdict, closure = _causes(dataset, finding, gap), finding.verdict, gap.closure
    if motion is not None and motion.described:
        of_path = [name for name in _of_path() if name in search.allowed]
        if of_path and verdict == "no_gap":  # the gap that there is, is that of the path
            verdict, closure = "explained", motion.closure
        elif verdict == "no_gap":
            verdict = "unknown"
        causes += [_path_cause(name, motion) for name in of_path[:1]]
    verdict, causes = settle(verdict, causes, closure)
    result = {
        "schema": SCHEMA,
        "verdict": verdict,
        "gap": {
            "joints": list(names),
            "units": error_units(robot),
            "before": _plain(gap.before),
            "after": _plain(gap.after),
            "floor": _plain(gap.floor),
        },
        "motion_gap": _motion_part(motion, robot.dof),
        "closure": closure,
        "where": _where(dataset, gap),
        "causes": causes,
        "not_testable": not_testable(dataset, search),
        "next_experiment": next_experiment(causes, verdict),
        "folds": _fold_names(dataset),
        "warnings": list(warnings),
    }
    return Diagnosis(result, finding, dataset, motion, tuple(warnings), gap)


def judge(dataset: Dataset, search: Search, finding: Finding) -> tuple[Finding, Gap]:
    """A finding as far as its figures on motion held out bear it out, and these figures."""
    while True:
        gap = held_out_gap(dataset, finding.fit)
        if not finding.causes:
            return finding, gap
        if finding.verdict == "explained" and gap.closure is not None and gap.closure < CLOSES:
            finding = finding.doubted()
        causes = _causes(dataset, finding, gap)
        verdict, kept = settle(finding.verdict, causes, gap.closure)
        if not kept or gap.hardly_closed:
            nothing = verdict == "no_gap" or gap.largest < SMALL
            finding = finding.without_causes("no_gap" if nothing else "unknown", search.fit)
        elif len(kept) < len(causes):
            finding = finding.only([k for k, cause in enumerate(causes) if cause in kept], search.fit)
        else:
            return replace(finding, verdict=verdict), gap


def _of_path() -> list[str]:
    """Effects that show in the set-points and not in torque."""
    return [name for name, effect in CATALOGUE.items() if effect.shows_in == "path"]


def _path_cause(name: str, motion: MotionGap) -> dict[str, Any]:
    return {
        "effect": name,
        "joints": [],
        "closure": motion.closure,
        "probability": _SET_POINTS_AS_RECORDED,
        "parameters": {"rate": motion.rate, "shift": motion.shift, "blend": motion.blend},
        "equivalent_to": [],
    }


def _causes(dataset: Dataset, finding: Finding, gap: Gap) -> list[dict[str, Any]]:
    """The causes of a finding as the result has them."""
    fit, names = finding.fit, dataset.robot.joint_names
    single = any(c.effect.once for c in fit.chosen)
    causes = []
    for number, (candidate, values, rivals, probability) in enumerate(
        zip(finding.causes, fit.values, finding.rivals, finding.probability, strict=True)
    ):
        causes.append(
            {
                "effect": candidate.effect.name,
                "joints": [names[j] for j in candidate.joints],
                "closure": gap.closure_without(fit.out_of_fold(single, number)),
                "probability": probability,
                "parameters": {
                    **{name: float(value) for name, value in candidate.settings.items()},
                    **{name: float(value) for name, value in zip(candidate.names, values, strict=True)},
                },
                "equivalent_to": [{"effect": name, "joints": [names[j] for j in joints]} for name, joints in rivals],
            }
        )
    return causes


def _plain(values: np.ndarray | None) -> list[float] | None:
    return None if values is None else [float(value) for value in values]


def _where(dataset: Dataset, gap: Gap) -> list[dict[str, Any]]:
    raw = gap.raw / gap.unit
    floor = np.zeros(raw.shape[1]) if gap.floor is None else gap.floor
    excess = np.maximum(gap.before**2 - floor**2, 0)
    if excess.sum() <= 0:
        excess = gap.before**2 + 1e-300
    share = excess / excess.sum()
    interval = share_intervals(raw, floor, dataset.fit.block)
    return [
        {
            "joint": dataset.robot.joint_names[joint],
            "share": float(share[joint]),
            "interval": [float(edge) for edge in interval[joint]],
            "regimes": regimes(dataset, raw[:, joint], joint, float(floor[joint])),
        }
        for joint in np.argsort(-share, kind="stable")
    ]


def _motion_part(motion: MotionGap | None, n: int) -> dict[str, Any]:
    if motion is None:
        return {"before": None, "after": None, "floor": None}
    return {"before": _plain(motion.before), "after": _plain(motion.after), "floor": _plain(motion.floor)}


def not_testable(dataset: Dataset, search: Search) -> list[dict[str, Any]]:
    """Effects whose practical size would not be found on these motions, and why."""
    robot = dataset.robot
    names = robot.joint_names
    assert search.null is not None
    tried: dict = {}
    for candidate in search.tried:
        tried.setdefault(candidate.place, []).append(candidate)
    result = []
    for name, effect in CATALOGUE.items():
        if name not in search.allowed or effect.shows_in == "path":
            continue
        for joints in effect.places(robot):
            candidates = tried.get((name, joints), [])
            where = ", ".join(names[j] for j in joints) or None
            if not candidates:
                still = [names[j] for j in joints if not search.moves[j]]
                why = f"{', '.join(still)} never moves in these logs" if still else effect.why_absent
                if why:
                    result.append({"effect": name, "joint": where, "why": why})
                continue
            if effect.once:
                continue
            size = min(search.null.minimum_detectable_size(candidate, search.least) for candidate in candidates)
            if size > 1:
                result.append({"effect": name, "joint": where, "why": _why_small(effect, size, dataset.given)})
    if all(log.planned_position is None or log.reference_position is None for log in dataset.logs):
        why = "the logs lack planned or executed set-points"
        result += [{"effect": name, "joint": None, "why": why} for name in _of_path()]
    return result


def _why_small(effect: Effect, size: float, given: bool) -> str:
    """`size` in practical sizes: the smallest that would be found."""
    if not given:
        return "no model was given: the fit to these logs absorbs it"
    found = "none of any size" if size * effect.practical > 5 else f"from {100 * size * effect.practical:.1f} % on"
    return (
        f"on these motions it would be found {found} of nominal torque (1 % false alarms, 80 % power), and it matters "
        f"from {100 * effect.practical:.1f} % on"
    )


def next_experiment(causes: Sequence[dict[str, Any]], verdict: str) -> dict[str, Any] | None:
    """A motion that would tell the first cause from what equals it; None where nothing is open."""
    if verdict == "unknown":
        return {
            "separates": [],
            "motion": "slow single-joint ramps both ways on the joints named, then the same at full speed, each twice",
        }
    if verdict != "ambiguous" or not causes:
        return None
    pair = [causes[0]["effect"], *(entry["effect"] for entry in causes[0]["equivalent_to"][:1])]
    return {"separates": pair, "motion": min(CATALOGUE[name].experiment for name in pair).motion}


def _fold_names(dataset: Dataset) -> list[dict[str, Any]]:
    names = [fold.name for fold in dataset.fit.folds]
    return [{"held_out": name, "fitted_on": [other for other in names if other != name]} for name in names]
