"""The result of a diagnosis, by the definitions of docs/diagnosis.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from agent.diagnosis.document import (
    Cause,
    DiagnosisResult,
    FoldNames,
    JointShare,
    NextExperiment,
    NextKind,
    PathGap,
    Rejected,
    TorqueGap,
)
from agent.diagnosis.gap.adequacy import remainders
from agent.diagnosis.gap.motion_gap import MotionGap
from agent.diagnosis.gap.regime_shares import regimes, share_intervals
from agent.diagnosis.gap.stuck_torque import StuckTorque
from agent.diagnosis.gap.torque_gap import HeldOutGap
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.hypotheses.testability import not_testable, power, smallest_sizes
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.simulator_file.explanation import Explanation
from agent.diagnosis.simulator_file.released_numbers import ReleasedSimulator
from agent.diagnosis.simulator_file.servo_table import servo_table
from agent.diagnosis.sizes import intervals
from agent.diagnosis.verdict import Verdict
from agent.model import CATALOGUE, PAYLOAD
from agent.robot import error_units, position_units

_WHEN_UNKNOWN = "slow single-joint ramps both ways on {joints}, then the same at full speed, each twice"
#: Next motion where those of a model's fit, often of one joint each, leave its torque open.
_TOGETHER = "motions in which the joints move together, like those of these logs, with a healthy arm"


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything a report shows: the document, the finding, the data, and the gaps of torque and path.

    `released`: of a simulator's file, what of its numbers was moved; `stuck_torque`: where most of the gap is.
    """

    document: DiagnosisResult
    selected: SelectedCauses
    dataset: Dataset
    motion: MotionGap | None
    gap: HeldOutGap
    released: ReleasedSimulator | None = None
    stuck_torque: StuckTorque | None = None

    @property
    def verdict(self) -> str:
        """The verdict of `decide_verdict`."""
        return self.document.verdict

    @property
    def warnings(self) -> tuple[str, ...]:
        """What limits the conclusions."""
        return self.document.warnings

    @cached_property
    def result(self) -> dict[str, Any]:
        """The document as plain data, with the 95 % intervals of every cause's parameters; numbers have ranges."""
        joints = self.dataset.robot.joint_names
        places = [(c.effect.name, tuple(joints[j] for j in c.joints)) for c in self.selected.causes]
        by_cause = dict(zip(places, intervals(self.selected), strict=True))
        per_cause = [by_cause.get((cause.effect, cause.joints), {}) for cause in self.document.causes]
        return {**self.document.to_dict(), "intervals": per_cause}


def build(
    explanation: Explanation,
    verdict: Verdict,
    motion: MotionGap | None,
    warnings: Sequence[str],
    stuck_torque: StuckTorque | None = None,
) -> Diagnosis:
    """Write down a verdict: figures of the gap of the model as given, shares, regimes and what is not testable.

    `stuck_torque`: the torque that stands still where most of the gap is.
    """
    dataset, selected, gap = explanation.dataset, explanation.selected, explanation.as_given
    closure = gap.closure if explanation.of_file and gap.closure is not None else verdict.closure
    where, causes = _where(dataset, gap), _with_figures(explanation, verdict.causes)
    smallest = smallest_sizes(dataset, explanation.search.evidence)
    document = DiagnosisResult(
        verdict.name,
        TorqueGap(
            dataset.robot.joint_names,
            tuple(error_units(dataset.robot) if dataset.servos is None else position_units(dataset.robot)),
            tuple(gap.before.tolist()),
            tuple(gap.after.tolist()),
            None if gap.floor is None else tuple(gap.floor.tolist()),
            dataset.of,
        ),
        _path_gap(motion),
        closure,
        where,
        causes,
        tuple(not_testable(dataset, explanation.search, smallest)),
        next_experiment(causes, verdict.name, where, selected.zero_known, bool(dataset.open_joints.any()))
        if stuck_torque is None
        else NextExperiment((), stuck_torque.motion, NextKind.REPEAT),
        _folds(dataset),
        (*(() if stuck_torque is None else (stuck_torque.text,)), *warnings, *_warnings(explanation, verdict)),
        explanation.steps,
        tuple(
            Rejected(effect, tuple(dataset.robot.joint_names[j] for j in joints), why)
            for (effect, joints), why in selected.rejected
        ),
        ()
        if verdict.name == "no_gap"
        else tuple(remainders(dataset, gap if dataset.servos is None else explanation.gap)),
        tuple(power(dataset, explanation.search, smallest)),
        _large_error(explanation),
        dataset.model_error,
        **({} if dataset.servos is None else servo_table(explanation)),
    )
    return Diagnosis(
        document, selected, dataset, motion, gap, explanation.released if explanation.of_file else None, stuck_torque
    )


def _with_figures(explanation: Explanation, causes: Sequence[Cause]) -> tuple[Cause, ...]:
    """Causes with their part of the gap of the model as given, and whether their joints slide."""
    figures = explanation.causes_as_given if explanation.of_file else ()
    by_cause = {(cause.effect, cause.joints): cause for cause in figures}
    same = [by_cause.get((cause.effect, cause.joints), cause) for cause in causes]
    sliding = {joint.name for joint in explanation.dataset.robot.joints if joint.prismatic}
    return tuple(
        replace(
            cause,
            closure=figure.closure,
            closure_of_joints=figure.closure_of_joints,
            slides=bool(cause.joints) and sliding.issuperset(cause.joints),
        )
        for cause, figure in zip(causes, same, strict=True)
    )


def _warnings(explanation: Explanation, verdict: Verdict) -> Iterator[str]:
    """What is left of the gap where no effect is named, and what is taken for known and may be what nobody explains."""
    dataset, selected, gap = explanation.dataset, explanation.selected, explanation.as_given
    names, usual = dataset.robot.joint_names, dataset.model.held_out_rmse
    if explanation.of_file and selected.leaves_gap and verdict.causes and not selected.causes:
        yield (
            f"corrected simulator parameters leave {100 * (1 - gap.absorbed):.1f} % of the gap, and no known effect "
            "explains it; compared with a usual simulator it is largest on "
            f"{names[int(np.argmax(gap.rmse_after / usual))]}"
        )
    unnamed = not explanation.of_file and dataset.has_reference and not selected.causes
    if unnamed and not dataset.open_joints.any() and (absorbed := explanation.gap.absorbed) > 1 - LIMITS.explained:
        yield (
            f"the model's own parameters explain {100 * absorbed:.0f} % of the squared error within their "
            "uncertainty: estimate it again with motions like these"
        )
    if _large_error(explanation):
        error = dataset.fit.error_ratio(gap.rmse_before)
        yield (
            f"the error of {names[int(error.argmax())]} is {error.max():.1f} times the model's own, which may differ "
            "from day to day on a healthy arm: record more logs, or estimate the model again"
        )
    for log in dataset.logs if verdict.name == "unknown" else ():
        if load := log.metadata.get(PAYLOAD):
            yield f"{log.name} says that {load} were at the flange: if they were not, the gap may be that"


def _large_error(explanation: Explanation) -> bool:
    """Whether a joint errs by more than usual of a model of other logs, and no effect explains that better than what
    differs on a healthy arm."""
    dataset, selected = explanation.dataset, explanation.selected
    if explanation.of_file or not dataset.has_reference or selected.causes or selected.leaves_gap:
        return False
    error = dataset.fit.error_ratio(explanation.as_given.rmse_before)
    return not dataset.open_joints.any() and bool(error.max() > LIMITS.usual_error)


def _where(dataset: Dataset, gap: HeldOutGap) -> tuple[JointShare, ...]:
    raw = gap.error_before / gap.unit
    floor = np.zeros(raw.shape[1]) if gap.floor is None else gap.floor
    excess = np.maximum(gap.before**2 - floor**2, 0)
    if excess.sum() <= 0:
        excess = gap.before**2 + 1e-300
    share = excess / excess.sum()
    interval = share_intervals(raw, floor, dataset.fit.segment_of_row)
    return tuple(
        JointShare(
            dataset.robot.joint_names[joint],
            float(share[joint]),
            (float(interval[joint][0]), float(interval[joint][1])),
            regimes(dataset, raw[:, joint], joint, float(floor[joint])),
        )
        for joint in np.argsort(-share, kind="stable")
    )


def _path_gap(motion: MotionGap | None) -> PathGap:
    if motion is None:
        return PathGap()
    floor = None if motion.floor is None else tuple(motion.floor.tolist())
    return PathGap(tuple(motion.before.tolist()), tuple(motion.after.tolist()), floor)


def next_experiment(
    causes: Sequence[Cause],
    verdict: str,
    where: Sequence[JointShare],
    zero_known: bool = False,
    open_model: bool = False,
) -> NextExperiment | None:
    """A motion that would tell the first cause from what equals it, or more of the joints `where` most of the gap is;
    None where nothing is open. `zero_known`: there was a log with the drives off. `open_model`: the model's fit
    leaves open the torque of these motions."""
    if verdict == "unknown" and open_model:
        return NextExperiment((), _TOGETHER, NextKind.TOGETHER)
    if verdict == "unknown":
        joints = [entry.joint for entry in where if entry.share > LIMITS.majority * where[0].share]
        return NextExperiment((), _WHEN_UNKNOWN.format(joints=", ".join(joints)))
    if verdict != "ambiguous" or not causes:
        return None
    pair = (causes[0].effect, *(entry.effect for entry in causes[0].equivalent_to[:1]))
    experiment = min(CATALOGUE[name].experiment for name in pair)
    on_brakes = bool(experiment.brakes) and not zero_known
    motion = experiment.with_brakes if on_brakes else experiment.motion
    motion = motion.replace("this joint", " and ".join(causes[0].joints) or "each joint")
    return NextExperiment(pair, motion, drives_off=on_brakes)


def _folds(dataset: Dataset) -> tuple[FoldNames, ...]:
    names = [fold.name for fold in dataset.fit.folds]
    return tuple(FoldNames(name, tuple(other for other in names if other != name)) for name in names)
