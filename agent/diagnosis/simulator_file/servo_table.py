"""Numbers of joints and servos that position logs give, with 95 % intervals: what `servo` of a result holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import ndtri

from agent.diagnosis.document import Cause
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.simulator_file.explanation import Explanation
from agent.diagnosis.simulator_file.parameter_groups import NumberGroup, NumberKind, drive_groups
from agent.diagnosis.simulator_file.released_numbers import released_fit
from agent.diagnosis.sizes import jackknife
from agent.model import CATALOGUE, FileNumbers
from agent.simulators import KINDS, ServoNumbers

#: Keys of a result, in its order: kinds of numbers, the delay with its unit.
SERVO_NUMBERS = ("kp", "damping", "armature", "friction", "delay_s", "offset")
#: Those of a cause, by what the cause changes in a file; of a gain that positions do not tell, all that it scales.
_NUMBERS_OF: dict[FileNumbers | None, tuple[str, ...]] = {
    FileNumbers.GAIN: ("kp",),
    FileNumbers.FRICTION: ("damping", "friction"),
    FileNumbers.DELAY: ("delay",),
    FileNumbers.OFFSET: ("offset",),
}
_LEAST_GAIN = 1e-9  # numerical: N·m/rad
_RATIOS = ("damping", "armature", "friction")
_OF_GAIN = ("kp", *_RATIOS)
#: Rows of a table: the gain's, and (7, 1) whether one is `_OF_GAIN`.
_GAIN, _SCALES = KINDS.index("kp"), np.isin(KINDS, _OF_GAIN)[:, None]


def doubtful_gains(explanation: Explanation) -> tuple[int, ...]:
    """Joints whose servo gain positions do not tell: another gain is another friction, damping and rotor together.

    Everything over kp shows; known masses under gravity set its scale, and where they are weak, the model's own error
    does. Gains that the interval allows have to be alike. None where torque is judged.
    """
    if explanation.dataset.servos is None:
        return ()
    values, low, high = _intervals(explanation)
    return tuple(np.flatnonzero(high.kp - low.kp > 2 * LIMITS.least_share * values.kp).tolist())


def servo_table(explanation: Explanation) -> dict[str, Any]:
    """`servo` and `scale_from` of a result: value, low and high of each number and joint; None where a class is known.

    The interval is the wider of the posterior's with all drives free, and of what leaving motions out, and halves of
    them, gives (delete-a-group jackknife), about the value and that with all drives free: a number that was left as
    the file has it is no better known than one that was not. Offsets are as large as the logs allow in their own
    intervals, and as small as a right file's in those of the others. A joint whose gain positions do not tell has no
    numbers. What is told of it, `servo_over_kp`, is there if any has none: damping [s], armature [s²] and friction
    [rad] over kp.

    A simulation in steps of h does not tell more: a command arrives within ± h / 2, and damping d is worth ± h d / 2 of
    inertia, by whether it is implicit or explicit in it.
    """
    dataset, names = explanation.dataset, explanation.dataset.robot.joint_names
    servos = dataset.servos
    assert servos is not None
    doubtful = doubtful_gains(explanation)
    values, low, high = _intervals(explanation)
    _, least, most = _intervals(explanation, large=[(NumberKind.OFFSET, joint) for joint in servos.prior.with_offset])
    low, high = replace(low, offset=least.offset), replace(high, offset=most.offset)
    of_step = 0.5 * servos.simulation.step * values.damping
    low, high = replace(low, armature=low.armature - of_step), replace(high, armature=high.armature + of_step)
    table: dict[str, tuple[tuple[float, float, float] | None, ...]] = {}
    for key in SERVO_NUMBERS:
        kind, unknown = key.removesuffix("_s"), doubtful if key in _OF_GAIN else ()
        ends = np.stack([getattr(numbers, kind) for numbers in (values, low, high)], axis=1)
        table[key] = tuple(None if k in unknown else _possible(kind, *ends[k]) for k in range(len(names)))
    scale = "kp" if servos.prior.kp_known else "none" if len(doubtful) == len(names) else "gravity"
    document: dict[str, Any] = {"servo": table, "scale_from": scale}
    if doubtful:
        ratios = np.stack([numbers.table for numbers in _intervals(explanation, over_gain=True)], axis=2)
        document["servo_over_kp"] = {
            kind: tuple(_possible(kind, *row) for row in ratios[KINDS.index(kind)]) for kind in _RATIOS
        }
    return document


def _possible(kind: str, value: float, low: float, high: float) -> tuple[float, float, float]:
    """A number and its interval, of which nothing is below zero but an offset.

    The interval of an estimate below zero moves up with it to zero: cut off, it could have no width.
    """
    least = -np.inf if kind == "offset" else 0.0
    shift = max(least - float(value), 0.0)
    return float(value) + shift, max(float(low) + shift, least), float(high) + shift


def _intervals(
    explanation: Explanation, over_gain: bool = False, large: Sequence[tuple[NumberKind, int]] = ()
) -> tuple[ServoNumbers, ServoNumbers, ServoNumbers]:
    """Value, low and high of the numbers, with all drives free and links that moved.

    Offsets that were not moved are as small as a right file's, but for those that are `large`, by kind and joint.

    The delay's holds both ways in which the command may have been held. Numbers over the gain of their joint are
    x / k ≈ r + (Δx - r Δk) / k about those that the rows are linear about, so that any gain along them is one ratio.
    """
    dataset, fit = explanation.dataset, explanation.selected.fit
    assert dataset.servos is not None
    groups = drive_groups(dataset, {*explanation.released.parts, *large})
    drives = [*groups, *(group for group in explanation.released.groups if group.moves_links)]
    linear_at = servo_numbers(dataset, drives, dataset.servos.fitted).table

    def form(numbers: np.ndarray) -> np.ndarray:
        if not over_gain:
            return numbers
        ratios, change = _over_gain(linear_at), numbers - linear_at
        moved = (change - ratios * change[_GAIN]) / np.maximum(linear_at[_GAIN], _LEAST_GAIN)
        return np.where(_SCALES, ratios + moved, numbers)

    values = servo_numbers(dataset, explanation.released.groups, fit.fitted()[0]).table
    wide = released_fit(dataset, drives).with_chosen(fit.chosen)
    free = servo_numbers(dataset, drives, wide.fitted()[0]).table
    p, normal = len(dataset.stored_covariance), float(ndtri((1 + LAW.confidence) / 2))
    covariance = explanation.evidence.covariance(wide)
    spread = normal * _deviations(dataset, drives, covariance[:p, :p], free, form)
    for folds in (wide.folds, wide.segment_folds):
        without = [form(servo_numbers(dataset, drives, wide.fitted(fold)[0]).table) for fold in folds]
        spread = np.maximum(spread, jackknife(np.stack(without)))
    delay = KINDS.index("delay")
    spread[delay] += 0.5 * dataset.servos.simulation.step
    values, free = form(values), form(free)
    low, high = np.minimum(values, free) - spread, np.maximum(values, free) + spread
    low[delay] += min(dataset.servos.later, 0.0)
    high[delay] += max(dataset.servos.later, 0.0)
    return ServoNumbers.of_table(values), ServoNumbers.of_table(low), ServoNumbers.of_table(high)


def differing_causes(explanation: Explanation, causes: Sequence[Cause]) -> list[Cause]:
    """The causes but gains, frictions and delays all of whose intervals hold the file's own numbers.

    A number may differ by what a right file is expected to leave, `LIMITS.least_error` of its joint's torque. Where
    positions do not tell the gain, ratios to it are compared: another gain is another friction, damping and rotor.
    """
    dataset, names = explanation.dataset, explanation.dataset.robot.joint_names
    assert dataset.servos is not None
    doubtful, file = doubtful_gains(explanation), dataset.servos.file.table
    usual = LIMITS.least_error * _whole_torque(dataset)

    def holds(form: Callable[[np.ndarray], np.ndarray], over_gain: bool) -> np.ndarray:
        _, low, high = (numbers.table for numbers in _intervals(explanation, over_gain))
        allowed = np.abs(form(file + usual) - form(file))
        return np.asarray((low - allowed <= form(file)) & (form(file) <= high + allowed))

    agree, ratios_agree = holds(np.asarray, over_gain=False), holds(_over_gain, over_gain=True)

    def differs(cause: Cause) -> bool:
        numbers = CATALOGUE[cause.effect].numbers
        kinds = _NUMBERS_OF.get(numbers, ())
        agreeing = []
        for joint in map(names.index, cause.joints or names):
            open_gain = joint in doubtful
            holding = (ratios_agree if open_gain else agree)[:, joint]
            of_joint = _RATIOS if open_gain and numbers == FileNumbers.GAIN else kinds
            agreeing += [bool(holding[KINDS.index(kind)]) for kind in of_joint]
        return not agreeing or not all(agreeing)

    return [cause for cause in causes if differs(cause)]


def _over_gain(numbers: np.ndarray) -> np.ndarray:
    """Numbers (7, n) but stiffness, delay and offset over the gain of their joint."""
    return np.where(_SCALES, numbers / np.maximum(numbers[_GAIN], _LEAST_GAIN), numbers)


def _whole_torque(dataset: Dataset) -> np.ndarray:
    """(7, n) of each number what would take all of its joint's torque; of a delay nothing."""
    whole = ServoNumbers.of_table(np.zeros((len(KINDS), dataset.robot.dof)))
    for group in drive_groups(dataset):
        if group.kind == NumberKind.FRICTION:
            whole.friction[group.joint], whole.damping[group.joint] = group.scale
        elif group.kind == NumberKind.GAIN:
            whole.kp[group.joint] = group.scale[0]
        elif group.kind == NumberKind.ROTOR:
            whole.armature[group.joint] = group.scale[0] * dataset.robot.gear_ratios[group.joint] ** 2
    assert dataset.servos is not None
    return replace(whole, offset=dataset.servos.prior.offset).table


def servo_numbers(dataset: Dataset, groups: Sequence[NumberGroup], change: np.ndarray) -> ServoNumbers:
    """Those of the file, moved by a change (p,)."""
    servos = dataset.servos
    assert servos is not None
    moved = np.zeros(len(servos.file.kp))
    coefficients = _inverse(groups) @ change if groups else np.zeros(0)
    first = 0
    for group in groups:
        if group.kind == NumberKind.ROTOR:
            moved[group.joint] = coefficients[first] * group.scale[0] * dataset.robot.gear_ratios[group.joint] ** 2
        first += group.directions.shape[1]
    moved_by_kind = {kind: change[place] for kind, place in servos.layout.of_numbers.items()}
    return ServoNumbers.of_table(servos.file.table + ServoNumbers(moved, **moved_by_kind).table)


def _deviations(
    dataset: Dataset,
    groups: Sequence[NumberGroup],
    covariance: np.ndarray,
    free: np.ndarray,
    form: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """(7, n) standard deviations of a form of the numbers about `free`, from the covariance (p, p) of the change."""
    base = servo_numbers(dataset, groups, np.zeros(len(covariance))).table
    moved = (servo_numbers(dataset, groups, column).table - base for column in np.eye(len(covariance)))
    slopes = np.stack([change.ravel() for change in moved], axis=1)
    of_numbers = slopes @ covariance @ slopes.T
    deviations = np.sqrt(np.maximum(np.diag(of_numbers), 0.0))
    step = np.where(deviations > 0, deviations, 1.0)
    turned = [(form(free + row.reshape(free.shape)) - form(free)).ravel() for row in np.diag(step)]
    jacobian = np.stack(turned, axis=1) / step
    variance = np.einsum("ij,jk,ik->i", jacobian, of_numbers, jacobian)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(free.shape))


def _inverse(groups: Sequence[NumberGroup]) -> np.ndarray:
    """(k, p) coefficients of the groups' directions in a change of the parameters."""
    directions = np.hstack([group.directions for group in groups])
    size = np.sqrt(np.sum(directions**2, axis=1))
    unit = np.where(size > 0, 1 / np.maximum(size, 1e-300), 0.0)
    return np.asarray(np.linalg.pinv(unit[:, None] * directions, rcond=1e-9) * unit)
