"""The simulator's file that a diagnosis asks for: its numbers moved as far as the fit moved them, and the effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agent.diagnosis.diagnosis import Diagnosis
from agent.diagnosis.gap.torque_gap import rms
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.simulator_file.reversals import reversals_as_effects
from agent.diagnosis.simulator_file.servo_torque import at_gains
from agent.model import IdentifiedModel
from agent.simulators import Correction, Released, Simulator, correct


def corrected(diagnosis: Diagnosis, simulator: Simulator, without: int | None = None) -> Correction:
    """What the simulator's numbers should be, by all logs or by all but one (`without`)."""
    fit, names = diagnosis.finding.fit, simulator.arm.joint_names
    change, fitted = fit.fitted(None if without is None else fit.folds[without])
    if simulator.servos is not None:
        change, fitted = _at_own_gains(diagnosis, change, fitted, without)
    b = len(simulator.model.independent)
    weight = fit.gram[:, :b, :b].sum(axis=0) / fit.repeat
    closes = {step.step: step.closes for step in diagnosis.document.waterfall}

    def reason(step: str) -> str:
        return f"{step}: closes {100 * closes[step]:.1f} % of the held-out gap" if step in closes else step

    released = Released()
    for group in diagnosis.released.groups if diagnosis.released else ():
        into = {"friction": released.friction, "rotor inertia": released.rotors, "link inertia": released.links}
        into[group.kind][group.joint] = reason(group.text(names))
    effects, reasons = [], {}
    for candidate, values in zip(fit.chosen, fitted, strict=True):
        reasons[candidate.effect.name, tuple(names[j] for j in candidate.joints)] = reason(candidate.text(names))
        effects.append(candidate.part_of_model(values, names))
    reversing = reversals_as_effects(diagnosis.dataset.model, change)
    effects += reversing
    reasons |= {(one.effect, one.joints): "how friction reverses" for one in reversing}
    inertia = np.mean([np.diagonal(s.mass, axis1=1, axis2=2).mean(axis=0) for s in fit.signals], axis=0)
    unexplained = fit.error(fit.once) / fit.repeat
    found = correct(simulator, change, weight, unexplained, inertia, effects, released, reasons)
    given, gap = diagnosis.dataset.model, diagnosis.gap
    model = replace(
        found.model,
        cutoff=given.cutoff,
        order=given.order,
        residual_rmse=gap.after * gap.unit,
        held_out_rmse=gap.after * gap.unit,
        weights=1 / np.stack([np.maximum(gap.after * gap.unit, 1e-9) ** 2] * 2),
    )
    return replace(found, model=model)


def supported_correction(diagnosis: Diagnosis, simulator: Simulator) -> Correction:
    """The correction; none, with a note, where it does not lower the error of the corrected file itself."""
    found = corrected(diagnosis, simulator)
    if simulator.servos is not None or not ((diagnosis.released and diagnosis.released.groups) or found.effects):
        return found
    before, after = held_out_errors(diagnosis, simulator)
    unit = diagnosis.gap.unit
    if np.mean((after / unit) ** 2) < np.mean((before / unit) ** 2):
        return found
    worst = int(np.argmax((after - before) / unit))
    note = (
        "nothing is corrected: on motion that was held out, the corrected file would err more than the one given "
        f"({simulator.arm.joint_names[worst]}: {before[worst]:.3g} before, {after[worst]:.3g} after)"
    )
    zero, count = np.zeros(len(simulator.model.values)), len(simulator.model.independent)
    none = correct(simulator, zero, np.eye(count), 1.0, found.inertia, (), Released(), {})
    return replace(none, notes=(*none.notes, note))


def held_out_errors(diagnosis: Diagnosis, simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """(n,) RMS error [N·m] of the simulator as given and as it would be written, on motion that was held out.

    Of the arm that the file can say, with its effects: bodies that could exist, no friction below zero, friction that
    reverses at once. What the fit gains and these lose is no gain.
    """
    fit, dataset = diagnosis.finding.fit, diagnosis.dataset
    given, left = diagnosis.gap.raw, np.full(diagnosis.gap.raw.shape, np.nan)
    as_given = _predicted(fit, simulator.model)
    for number, fold in enumerate(fit.folds):
        rows = np.isin(fit.cell, np.flatnonzero(fold.test))
        fixed = _predicted(fit, corrected(diagnosis, simulator, number).model)
        left[rows] = (dataset.residual + as_given - fixed)[rows]
    left = np.where(np.isnan(given), np.nan, left)
    return rms(given), rms(diagnosis.gap.beyond(left))


def _predicted(fit: Fit, model: IdentifiedModel) -> np.ndarray:
    """(S', n) torque [N·m] of a model on the fit's motions, filtered alike."""
    parts = (s.low_pass(model.predict(s.q, s.qd, s.qdd, s.time)) for s in fit.signals)
    return np.concatenate(list(parts))


def _at_own_gains(
    diagnosis: Diagnosis, change: np.ndarray, fitted: Sequence[np.ndarray], without: int | None
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Numbers and effects fitted anew to the torque of servos that have the gains found.

    Beside another gain they were fitted to a torque of the file's, as many times too large as its gain is.
    """
    fit, released = diagnosis.finding.fit, diagnosis.released
    gains = {
        k: 1 + values[candidate.names.index(candidate.effect.scales_report)]
        for k, (candidate, values) in enumerate(zip(fit.chosen, fitted, strict=True))
        if candidate.effect.scales_report is not None
    }
    if not gains or released is None:
        return change, list(fitted)
    given, factors = released.given, np.ones(diagnosis.dataset.robot.dof)
    for k, scale in gains.items():
        factors[fit.chosen[k].joints[0]] /= scale
    logs = at_gains(given.logs, factors)
    data = assemble(given.robot, given.model, logs, given.cutoff, released.model)
    moved = released.released_in(data).seen_from(fit.reference)
    others = [(c.effect, c.joints, c.settings) for k, c in enumerate(fit.chosen) if k not in gains]
    again = moved.with_chosen(moved.candidates(others))
    change, found = again.fitted(None if without is None else again.folds[without])
    left = iter(found)
    return change, [values if k in gains else next(left) for k, values in enumerate(fitted)]
