"""The simulator's file that a diagnosis asks for: its numbers moved as far as the fit moved them, and the effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from agent.diagnosis.diagnosis import Diagnosis
from agent.diagnosis.gap.torque_gap import rms
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.simulator_file.numbers_as_causes import springs_as_effects
from agent.diagnosis.simulator_file.parameter_groups import NumberGroup, NumberKind, drive_groups, groups_of
from agent.diagnosis.simulator_file.released_numbers import gained_load
from agent.diagnosis.simulator_file.reversals import reversals_as_effects
from agent.diagnosis.simulator_file.servo_table import servo_numbers
from agent.model import IdentifiedModel
from agent.robot import ParameterLayout
from agent.simulators import Correction, FittedChange, PositionServos, Released, Simulator, correct, with_servos

#: Groups of one servo, in a file its actuator.
_OF_SERVO = (NumberKind.GAIN, NumberKind.OFFSET, NumberKind.OWN_DELAY)


def corrected_numbers(diagnosis: Diagnosis, simulator: Simulator, without: int | None = None) -> Correction:
    """What the simulator's numbers should be, by all logs or by all but one (`without`).

    Rows of positions are linear, and the numbers of a file that is far off may move it worse than these say. Then all
    numbers of joints and servos are those of the fit of the free motion, about which the rows are linear.

    Args:
        diagnosis: of logs against the simulator.
        simulator: the file as given.
        without: fold that is left out, from 0; None: none.
    """
    fit, names = diagnosis.selected.fit, simulator.arm.joint_names
    change, fitted = fit.fitted(None if without is None else fit.folds[without])
    b = len(simulator.model.independent)
    servos, groups = diagnosis.dataset.servos, diagnosis.released.groups if diagnosis.released else ()
    if servos is not None and _moves_worse(diagnosis, change):
        loads = (group for group in groups_of(diagnosis.dataset) if group.kind == NumberKind.LOAD)
        change, groups = servos.fitted, (*drive_groups(diagnosis.dataset), *loads)
    weight = fit.gram[:, :b, :b].sum(axis=0) / fit.rows_per_independent
    closes = {step.step: step.closes for step in diagnosis.document.waterfall}

    def reason(step: str) -> str:
        return f"{step}: closes {100 * closes[step]:.1f} % of the held-out gap" if step in closes else step

    released = Released()
    for group in groups:
        if group.kind in (*_OF_SERVO, NumberKind.DELAY, NumberKind.BEND, NumberKind.SPRING):
            continue
        into = {NumberKind.FRICTION: released.friction, NumberKind.ROTOR: released.rotors}
        into |= dict.fromkeys((NumberKind.LINK, NumberKind.LOAD), released.links)
        into[group.kind][group.joint] = reason(group.text(names))
    effects, reasons = [], {}
    for candidate, values in zip(fit.chosen, fitted, strict=True):
        reasons[candidate.effect.name, tuple(names[j] for j in candidate.joints)] = reason(candidate.text(names))
        effects.append(candidate.part_of_model(values, names))
    for spring in springs_as_effects(diagnosis.dataset, groups, change):
        effects.append(spring)
        reasons[spring.effect, spring.joints] = reason(f"{NumberKind.SPRING} of {spring.joints[0]}")
    of_model = change[: len(simulator.model.values)].copy()
    if servos is not None:  # the file's simulator adds inertia to what it says
        robot, rotors = diagnosis.dataset.robot, ParameterLayout.of(diagnosis.dataset.robot).rotors
        added = np.isin(np.arange(robot.dof), list(released.rotors)) * servos.simulation.inertia
        of_model[:b] -= simulator.model.projection[:, rotors] @ (added / robot.gear_ratios**2)
    reversing = reversals_as_effects(diagnosis.dataset.model, of_model)
    effects += reversing
    reasons |= {(effect.effect, effect.joints): "how friction reverses" for effect in reversing}
    inertia = np.mean([np.diagonal(s.mass, axis1=1, axis2=2).mean(axis=0) for s in fit.signals], axis=0)
    unexplained = fit.error / fit.rows_per_independent
    correction = correct(simulator, FittedChange(of_model, weight, unexplained, inertia), effects, released, reasons)
    given, gap = diagnosis.dataset.model, diagnosis.gap
    model = replace(
        correction.model,
        cutoff=given.cutoff,
        order=given.order,
        residual_rmse=gap.rmse_after,
        held_out_rmse=gap.rmse_after,
        weights=1 / np.stack([np.maximum(gap.rmse_after, 1e-9) ** 2] * 2),
    )
    of_servos = {names[group.joint]: reason(group.text(names)) for group in reversed(groups) if group.kind in _OF_SERVO}
    return _with_servos(replace(correction, model=model), diagnosis, change, groups, of_servos)


def _moves_worse(diagnosis: Diagnosis, change: np.ndarray) -> bool:
    """Whether the chosen numbers move the simulator worse than those of the fit of its motion, next to what a right
    file leaves; not where effects, which that fit does not have, were chosen with them.

    Nor does it have links: with links the rows, in which the motion is linear, have to promise less than it leaves.
    """
    released, dataset, servos = diagnosis.released, diagnosis.dataset, diagnosis.dataset.servos
    assert released is not None
    assert servos is not None
    if np.any(servos.gains(change) <= 0):
        return True
    if diagnosis.selected.causes:
        return False
    least, fitted = dataset.fit.sigma.min(axis=0), servos.simulation.fit_error

    def over_fit(error: np.ndarray) -> float:
        return float(np.sqrt(np.mean((np.hypot(error, least) / np.hypot(fitted, least)) ** 2)))

    if any(group.kind == NumberKind.LINK for group in released.groups):
        return over_fit(diagnosis.gap.after * diagnosis.gap.unit) > 1.0
    numbers = servo_numbers(dataset, released.groups, change).possible
    return over_fit(servos.simulation.error(numbers, gained_load(released))) > LIMITS.equal_ratio


def supported_correction(diagnosis: Diagnosis, simulator: Simulator) -> Correction:
    """The correction; none, with a note, where it does not lower the error of the corrected file itself."""
    correction = corrected_numbers(diagnosis, simulator)
    if diagnosis.dataset.servos is not None or not (
        (diagnosis.released and diagnosis.released.groups) or correction.effects
    ):
        return correction
    before, after = held_out_errors(diagnosis, simulator)
    unit = diagnosis.gap.unit
    if np.mean((after / unit) ** 2) < np.mean((before / unit) ** 2):
        return correction
    worst = int(np.argmax((after - before) / unit))
    note = (
        "nothing is corrected: on motion that was held out, the corrected file would err more than the one given "
        f"({simulator.arm.joint_names[worst]}: {before[worst]:.3g} before, {after[worst]:.3g} after)"
    )
    zero, count = np.zeros(len(simulator.model.values)), len(simulator.model.independent)
    none = correct(simulator, FittedChange(zero, np.eye(count), 1.0, correction.inertia), (), Released(), {})
    return replace(none, notes=(*none.notes, note))


def held_out_errors(diagnosis: Diagnosis, simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """(n,) RMS error [N·m] of the simulator as given and as it would be written, on motion that was held out.

    Of the arm that the file can say, with its effects: bodies that could exist, no friction below zero, friction that
    reverses at once. What the fit gains and these lose is no gain.
    """
    fit, dataset = diagnosis.selected.fit, diagnosis.dataset
    before, remaining = diagnosis.gap.error_before, np.full(diagnosis.gap.error_before.shape, np.nan)
    as_given = _predicted(fit, simulator.model)
    for number, fold in enumerate(fit.folds):
        rows = np.isin(fit.cell_of_row, np.flatnonzero(fold.test))
        fixed = _predicted(fit, corrected_numbers(diagnosis, simulator, number).model)
        remaining[rows] = (dataset.residual + as_given - fixed)[rows]
    remaining = np.where(np.isnan(before), np.nan, remaining)
    return rms(before), rms(diagnosis.gap.beyond(remaining))


def _predicted(fit: Fit, model: IdentifiedModel) -> np.ndarray:
    """(S', n) torque [N·m] of a model on the fit's motions, filtered alike."""
    parts = (s.low_pass(model.predict(s.q, s.qd, s.qdd, s.time)) for s in fit.signals)
    return np.concatenate(list(parts))


def _with_servos(
    correction: Correction,
    diagnosis: Diagnosis,
    change: np.ndarray,
    groups: Sequence[NumberGroup],
    reasons: Mapping[str, str],
) -> Correction:
    """Gains, offsets and delays moved by a `change` (p,); damping below zero comes off the servo's: both are one."""
    servos, given = diagnosis.dataset.servos, correction.given.servos
    if servos is None or not isinstance(given, PositionServos):
        return correction
    viscous = correction.given.damping + change[servos.layout.damping]
    damping = np.maximum(given.damping + np.minimum(viscous, 0.0), 0.0)
    every = np.arange(len(servos.file.kp))
    moves = {
        kind: np.isin(every, [g.joint for g in groups if g.kind == kind])
        for kind in (NumberKind.GAIN, NumberKind.OFFSET)
    }
    changed = replace(
        given,
        stiffness=np.where(moves[NumberKind.GAIN], servos.gains(change), servos.file.kp),
        damping=damping,
        delay=np.maximum(given.delay + change[servos.layout.delay], 0.0),
        offset=np.where(moves[NumberKind.OFFSET], servos.offsets(change), given.offset),
    )
    return with_servos(correction, changed, servos.simulation.arm, reasons)
