"""Entry point of a diagnosis: takes logs and a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from agent.core import InputError, keep_freed_memory, on_one_blas_thread
from agent.data_quality import spoiled
from agent.diagnosis.diagnosis import Diagnosis, build
from agent.diagnosis.gap.adequacy import Adequacy, errs_beyond_chance
from agent.diagnosis.gap.drives_off import ChannelZero, channel_zero, zero_likelihood, zero_remarks
from agent.diagnosis.gap.motion_gap import MotionGap, motion_gap
from agent.diagnosis.gap.stuck_torque import StuckTorque, stuck_torque
from agent.diagnosis.hypotheses.healthy import healthy_on
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.hypotheses.testability import effects_of_path
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.position_logs.search import search_positions, without_torque
from agent.diagnosis.rows.dataset import Dataset, assemble
from agent.diagnosis.simulator_file.explanation import Explanation, search_simulator
from agent.diagnosis.simulator_file.numbers_as_causes import causes_of_numbers
from agent.diagnosis.simulator_file.position_verdict import verdict_on_positions
from agent.diagnosis.simulator_file.released_numbers import ReleasedSimulator
from agent.diagnosis.verdict import Verdict, causes_of, decide_verdict, keep_supported, name_causes, with_numbers
from agent.estimation import beyond_fit
from agent.model import CATALOGUE, IdentifiedModel
from agent.recording import Log
from agent.robot import RobotDescription, torque_units
from agent.simulators import Simulator

_ONE_MOTION = "one motion only: held-out figures come from parts of it; another motion would be a harder test"


@on_one_blas_thread
def diagnose(
    robot: RobotDescription,
    logs: Sequence[Log],
    model: IdentifiedModel | None = None,
    cutoff: float | None = None,
    without: Sequence[str] = (),
    progress: Callable[[str], None] = lambda text: None,
    drives_off: Log | None = None,
    simulator: Simulator | None = None,
    known_kp: bool = False,
) -> Diagnosis:
    """Diagnose logs against a model, or against a model fitted to them.

    Logs without torque are judged by the free motion of the simulator that the model was read from.

    Args:
        robot: description of the arm.
        logs: to be judged; at least one.
        model: fitted to other logs, or of a simulator's file; None: one fitted to these logs.
        cutoff: of the torque filter [Hz]; None: the model's.
        without: effects to ignore.
        progress: called with what is being done.
        drives_off: log of the stationary arm on its brakes, which gives the zero of the torque channels.
        simulator: that the model was read from.
        known_kp: whether the gains of its servos are right.

    Raises:
        InputError: no logs, an unknown effect in `without`, logs that cannot be used (see `assemble`), a log with the
            drives off that has no zero (see `channel_zero`), or such a log together with a simulator file.
    """
    keep_freed_memory()
    if not logs:
        raise InputError("no logs were given, so there is nothing to diagnose")
    check_effects(without)
    zero = None if drives_off is None else channel_zero(robot, drives_off, model)
    logs, repeated = _distinct(logs)
    motion, stuck = motion_gap(logs), None
    if simulator is not None and without_torque(simulator, logs):
        positions = search_positions(simulator, logs, without, progress, known_kp)
        one_motion = (_ONE_MOTION,) if len(logs) == 1 else ()
        warnings = (*repeated, *positions.warnings, *_path_warnings(motion), *one_motion)
        return build(positions.explanation, _verdict(positions.explanation, motion), motion, warnings)
    if model is not None and model.of_file:
        explanation = search_simulator(robot, model, logs, cutoff, without, progress)
    else:
        progress("filtering, and fitting the model in every fold" if model is None else "filtering")
        explanation, stuck = _explain_torque(assemble(robot, model, logs, cutoff), model, without, progress, zero)
    dataset = explanation.dataset
    of_zero = () if zero is None else zero_remarks(dataset, explanation.selected, zero)
    out_of_range = beyond_fit(dataset.model, [(s.q[s.kept], s.qd[s.kept]) for s in dataset.fit.signals])
    of_logs = _warnings(robot, logs, model is not None)
    warnings = (*repeated, *of_zero, *of_logs, *_of_model(dataset), *out_of_range, *_path_warnings(motion))
    return build(explanation, _verdict(explanation, motion), motion, warnings, stuck)


def _explain_torque(
    dataset: Dataset,
    model: IdentifiedModel | None,
    without: Sequence[str],
    progress: Callable[[str], None],
    zero: ChannelZero | None,
) -> tuple[Explanation, StuckTorque | None]:
    """The causes of a gap in torque; none where a channel stands still, which is returned too."""
    observed = None if zero is None else zero_likelihood(zero, dataset.model)
    healthy = None if model is None else healthy_on(dataset.fit, model, without)
    search = Search(dataset.fit, without, progress, observed=observed, healthy=healthy)
    searched = search.run()
    selected = replace(name_causes(searched, errs_beyond_chance(dataset, searched)), zero_known=zero is not None)
    if (stuck := stuck_torque(dataset, selected.fit)) is not None:
        selected = selected.without_causes(leaves_gap=True)
    return Explanation(ReleasedSimulator(dataset, dataset, ()), search, *keep_supported(dataset, selected)), stuck


def _verdict(explanation: Explanation, motion: MotionGap | None) -> Verdict:
    """The verdict on causes, executed path and moved numbers of a simulator's file."""
    dataset, selected, as_given = explanation.dataset, explanation.selected, explanation.as_given
    if dataset.servos is not None:
        return verdict_on_positions(explanation)
    gap = explanation.gap if explanation.of_file else as_given
    adequacy = Adequacy.of(selected, gap)
    causes = causes_of(dataset, selected, adequacy)
    numbers = causes_of_numbers(explanation.released, selected, as_given)
    of_path = [name for name in effects_of_path() if name in explanation.search.allowed]
    path = None if motion is None else motion.causes(of_path)
    judged = not np.any(dataset.open_joints & dataset.fit.beyond_usual(gap.rmse_before))
    verdict = decide_verdict(selected, causes, adequacy.explained_part, path, numbers, as_given.closure or 0.0, judged)
    return with_numbers(verdict, explanation.causes_as_given, numbers) if explanation.of_file else verdict


def check_effects(names: Sequence[str]) -> None:
    """Raises:
    InputError: a name that is not in the vocabulary.
    """
    for name in names:
        if name not in CATALOGUE:
            raise InputError(f"--without {name}: no such effect; known are {', '.join(CATALOGUE)}")


def _path_warnings(motion: MotionGap | None) -> Iterator[str]:
    if motion is not None and motion.notable and not motion.described:
        yield (
            f"the executed path is not the planned one: they differ by up to {1e3 * motion.before.max():.2g} mrad or "
            "mm RMS. No rate, delay or rounding of practical size common to all motions explains it. Compare the "
            "controller's FLY and ramp settings with the recipe's, or learn them (agent learn-interpolator). Torque is "
            "judged on the executed motion"
        )


def _distinct(logs: Sequence[Log]) -> tuple[list[Log], list[str]]:
    """Drop logs that repeat another sample by sample, with a warning for each: they would test nothing."""
    distinct: list[Log] = []
    warnings = []
    for log in logs:
        same = (other for other in distinct if _samples(other) == _samples(log))
        if (first := next(same, None)) is None:
            distinct.append(log)
        else:
            warnings.append(f"{log.path} holds the same samples as {first.path} and is left out")
    return distinct, warnings


def _samples(log: Log) -> tuple[bytes, bytes]:
    return log.position.tobytes(), b"" if log.effort is None else log.effort.tobytes()


def _of_model(dataset: Dataset) -> Iterator[str]:
    """Warning about a large error of the model itself: smaller effects are not visible."""
    if dataset.open_joints.any():
        units = torque_units(dataset.robot)
        names = dataset.robot.joint_names
        sizes = (f"{names[k]} {dataset.open_error[k]:.3g} {units[k]}" for k in np.flatnonzero(dataset.open_joints))
        yield (
            "the motions of the model's fit leave the torque in these logs open (standard deviation): "
            f"{', '.join(sizes)}. Smaller gaps may not show there"
        )
    share = dataset.model_error
    if share is not None and share > LIMITS.weak_model:
        yield (
            f"the model errs by {100 * share:.0f} % of the torque on held-out parts of its own data: "
            "smaller gaps do not show"
        )


def _warnings(robot: RobotDescription, logs: Sequence[Log], has_reference: bool) -> Iterator[str]:
    """Warnings that limit the conclusions."""
    if len(logs) == 1:
        yield _ONE_MOTION
    if not has_reference:
        yield "no model was given: only what a model fitted to these logs cannot absorb is seen as a gap"
    yield from map(str, spoiled(robot, logs))
    stationary = [
        name
        for joint, name in enumerate(robot.joint_names)
        if all(np.ptp(log.position[:, joint]) <= LIMITS.least_travel for log in logs)
    ]
    if stationary:
        yield f"only the weight of a joint that never moves can be judged: {', '.join(stationary)}"
