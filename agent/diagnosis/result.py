"""The result of a diagnosis, by the definitions of docs/diagnosis.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from agent.diagnosis.answer import (
    Cause,
    DiagnosisResult,
    FoldNames,
    JointShare,
    NextExperiment,
    PathGap,
    TorqueGap,
    WaterfallStep,
)
from agent.diagnosis.gap.held_torque import HeldTorque
from agent.diagnosis.gap.motion_gap import MotionGap
from agent.diagnosis.gap.regimes import regimes, share_intervals
from agent.diagnosis.gap.torque_gap import HeldOutGap, held_out_gap
from agent.diagnosis.hypotheses.finding import Finding
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.hypotheses.testability import effects_of_path, not_testable
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.simulator_file.calibration import ReleasedSimulator, causes_of_steps, waterfall
from agent.diagnosis.sizes import intervals
from agent.diagnosis.verdict import causes_of, settle, with_path
from agent.model import CATALOGUE, PAYLOAD
from agent.robot import error_units
from agent.simulators import servo_stiffness

_WHEN_UNKNOWN = "slow single-joint ramps both ways on {joints}, then the same at full speed, each twice"
#: In the warning of a gap that no effect explains better than what differs on a healthy arm.
LARGE_ERROR = "times the model's own"
_MUCH = 0.3  # of the gap of the joint that has most: a joint that is worth a motion of its own


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything a report shows: the answer, the finding, the data, and the gaps of torque and path.

    `calibrated`: of a simulator's file, what of its numbers was moved; `held`: a torque that stands still where most of
    the gap is.
    """

    answer: DiagnosisResult
    finding: Finding
    dataset: Dataset
    motion: MotionGap | None
    gap: HeldOutGap
    calibrated: ReleasedSimulator | None = None
    held: HeldTorque | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What limits the conclusions."""
        return self.answer.warnings

    @cached_property
    def result(self) -> dict[str, Any]:
        """The answer as plain data, with the 95 % intervals of every cause's parameters."""
        return {**self.answer.to_dict(), "intervals": intervals(self.finding)}


def build(
    dataset: Dataset,
    finding: Finding,
    gap: HeldOutGap,
    search: Search,
    motion: MotionGap | None,
    warnings: Sequence[str],
    calibrated: ReleasedSimulator | None = None,
    held: HeldTorque | None = None,
) -> Diagnosis:
    """Figures held out, shares, regimes and what is not testable.

    `held`: the torque that stands still where most of the gap is.
    `calibrated`: of a simulator whose parameters were moved, if any; causes are judged by the gap that is left then,
    and all figures are of the gap of the simulator as given.
    """
    robot = dataset.robot
    if dataset.given and calibrated is None and not finding.causes:
        warnings = (*warnings, *_without_cause(dataset, gap, finding.verdict))
        gap = gap.unclosed
    causes, verdict, closure = causes_of(dataset, finding, gap), finding.verdict, gap.closure
    if motion is not None and motion.described:
        of_path = [name for name in effects_of_path() if name in search.allowed][:1]
        verdict, closure = with_path(verdict, closure, motion.closure, bool(of_path))
        causes += tuple(_path_cause(name, motion) for name in of_path)
    verdict, causes = settle(verdict, causes, closure)
    steps: tuple[WaterfallStep, ...] = ()
    if calibrated is not None:
        dataset = replace(dataset, residual=calibrated.given.residual)
        gap = held_out_gap(dataset, finding.fit)
        closure = gap.closure if closure is None or gap.closure is not None else closure
        of_all = {(cause.effect, cause.joints): cause for cause in causes_of(dataset, finding, gap)}
        same = (of_all.get((cause.effect, cause.joints), cause) for cause in causes)
        causes = tuple(
            replace(cause, closure=other.closure, closure_of_joints=other.closure_of_joints)
            for cause, other in zip(causes, same, strict=True)
        )
        steps = waterfall(calibrated, finding, gap)
        by_numbers = 0.0 if causes or not calibrated.groups or gap.closure is None else gap.closure
        if by_numbers > 0 and (verdict == "no_gap" or by_numbers > 1 - LIMITS.least_share):
            kept = settle("explained", causes_of_steps(calibrated, steps, by_numbers), by_numbers)
            if kept[1]:
                warnings = (*warnings, _left_by_numbers(dataset, gap)) if verdict == "unknown" else warnings
                verdict, causes = kept
    elif causes and finding.causes:
        steps = waterfall(ReleasedSimulator(dataset, dataset, ()), finding, gap)
    sliding = {joint.name for joint in robot.joints if joint.prismatic}
    causes = tuple(replace(cause, slides=bool(cause.joints) and sliding.issuperset(cause.joints)) for cause in causes)
    where = _where(dataset, gap)
    warnings = (*warnings, *(_of_mass(dataset) if verdict == "unknown" else ()))
    answer = DiagnosisResult(
        verdict,
        TorqueGap(
            robot.joint_names,
            tuple(error_units(robot)),
            tuple(gap.before.tolist()),
            tuple(gap.after.tolist()),
            None if gap.floor is None else tuple(gap.floor.tolist()),
        ),
        _path_gap(motion),
        closure,
        where,
        causes,
        tuple(not_testable(dataset, search)),
        next_experiment(causes, verdict, where, finding.zero_known)
        if held is None
        else NextExperiment((), held.motion),
        _folds(dataset),
        (*(() if held is None else (held.text,)), *warnings),
        steps,
        "servos" if any(servo_stiffness(log.metadata) is not None for log in dataset.logs) else "motors",
    )
    return Diagnosis(answer, finding, dataset, motion, gap, calibrated, held)


def _without_cause(dataset: Dataset, gap: HeldOutGap, verdict: str) -> Iterator[str]:
    if gap.absorbed > 1 - LIMITS.explained:
        yield (
            f"the model's own parameters explain {100 * gap.absorbed:.0f} % of the squared error within their "
            "uncertainty: estimate it again with motions like these"
        )
    error = gap.before * gap.unit / dataset.model.held_out_rmse
    if verdict == "no_gap" and error.max() > LIMITS.usual_error:
        name = dataset.robot.joint_names[int(error.argmax())]
        yield (
            f"the error of {name} is {error.max():.1f} {LARGE_ERROR}, which may differ from day to day on a "
            "healthy arm: record more logs, or estimate the model again"
        )


def _left_by_numbers(dataset: Dataset, gap: HeldOutGap) -> str:
    worst = int(np.argmax(gap.after * gap.unit / dataset.model.held_out_rmse))
    return (
        f"corrected simulator parameters leave {100 * (1 - gap.absorbed):.1f} % of the gap, and no known effect "
        f"explains it; compared with a usual simulator it is largest on {dataset.robot.joint_names[worst]}"
    )


def _path_cause(name: str, motion: MotionGap) -> Cause:
    parameters = {"rate": motion.rate, "shift": motion.shift, "blend": motion.blend}
    return Cause(name, (), motion.closure, LIMITS.path_probability, parameters)


def _of_mass(dataset: Dataset) -> Iterator[str]:
    """What is taken for known, and may be what nobody explains."""
    for log in dataset.logs:
        if load := log.metadata.get(PAYLOAD):
            yield f"{log.name} says that {load} were at the flange: if they were not, the gap may be that"


def _where(dataset: Dataset, gap: HeldOutGap) -> tuple[JointShare, ...]:
    raw = gap.raw / gap.unit
    floor = np.zeros(raw.shape[1]) if gap.floor is None else gap.floor
    excess = np.maximum(gap.before**2 - floor**2, 0)
    if excess.sum() <= 0:
        excess = gap.before**2 + 1e-300
    share = excess / excess.sum()
    interval = share_intervals(raw, floor, dataset.fit.block)
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
    causes: Sequence[Cause], verdict: str, where: Sequence[JointShare], zero_known: bool = False
) -> NextExperiment | None:
    """A motion that would tell the first cause from what equals it, or more of the joints `where` most of the gap is;
    None where nothing is open. `zero_known`: there was a log with the drives off."""
    if verdict == "unknown":
        joints = [entry.joint for entry in where if entry.share > _MUCH * where[0].share]
        return NextExperiment((), _WHEN_UNKNOWN.format(joints=", ".join(joints)))
    if verdict != "ambiguous" or not causes:
        return None
    pair = (causes[0].effect, *(entry.effect for entry in causes[0].equivalent_to[:1]))
    experiment = min(CATALOGUE[name].experiment for name in pair)
    motion = experiment.motion if zero_known else experiment.with_brakes
    return NextExperiment(pair, motion.replace("this joint", " and ".join(causes[0].joints) or "each joint"))


def _folds(dataset: Dataset) -> tuple[FoldNames, ...]:
    names = [fold.name for fold in dataset.fit.folds]
    return tuple(FoldNames(name, tuple(other for other in names if other != name)) for name in names)
