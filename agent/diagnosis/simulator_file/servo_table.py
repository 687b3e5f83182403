"""Numbers of joints and servos that position logs give, with 95 % intervals: what `servo` of a result holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import ndtri

from agent.diagnosis.document import Cause
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.simulator_file.explanation import Explanation
from agent.diagnosis.simulator_file.released_numbers import (
    GAIN,
    Group,
    doubtful_gains,
    drive_groups,
    released_fit,
)
from agent.diagnosis.sizes import jackknife
from agent.model import CATALOGUE

#: Kinds of numbers, in the order of a result.
SERVO_NUMBERS = ("kp", "damping", "armature", "friction", "delay_s")
#: Those of a cause, by what the cause changes in a file.
_NUMBERS_OF = {GAIN: ("kp",), "friction": ("damping", "friction")}


def servo_table(found: Explanation) -> dict[str, Any]:
    """`servo` and `scale_from` of a result: value, low and high of each number and joint; None where a class is known.

    The interval is the wider of the posterior's with all drives free, and of what leaving motions out, and halves of
    them, gives (delete-a-group jackknife), about the value and that with all drives free: a number that was left as
    the file has it is no better known than one that was not. A joint whose gain positions do not tell has ratios only,
    and no numbers.

    A simulation in steps of h does not tell more: a command arrives within ± h / 2, and implicit damping d, as in the
    file's simulator, counts as h d of inertia. An arm, and a simulator with explicit damping, may have as much more.
    """
    dataset, fit = found.dataset, found.selected.fit
    names, servos = dataset.robot.joint_names, dataset.servos
    assert servos is not None
    doubtful = doubtful_gains(dataset)
    values = servo_numbers(dataset, found.released.groups, fit.fitted()[0])
    drives = drive_groups(dataset)
    wide = released_fit(dataset, drives).with_chosen(fit.chosen)
    inverse, _ = wide.solve(np.ones(wide.cells, dtype=bool))
    p = len(dataset.held)
    spread = float(ndtri((1 + LAW.certain) / 2)) * _deviations(dataset, drives, inverse[:p, :p])
    for folds in (wide.folds, wide.single):
        without = [servo_numbers(dataset, drives, wide.fitted(fold)[0]) for fold in folds]
        spread = np.maximum(spread, jackknife(np.stack(without)))
    spread[-1] += 0.5 * servos.step
    free = servo_numbers(dataset, drives, wide.fitted()[0])
    low, high = np.minimum(values, free) - spread, np.maximum(values, free) + spread
    more = {"delay_s": np.full(len(names), servos.later), "armature": servos.step * values[1]}
    table: dict[str, tuple[tuple[float, float, float] | None, ...]] = {}
    for kind, row, least, most in zip(SERVO_NUMBERS, values, low, high, strict=True):
        above = more.get(kind, np.zeros(len(names)))
        table[kind] = tuple(
            None
            if kind != "delay_s" and k in doubtful
            else (float(row[k]), float(max(least[k], 0.0)), float(most[k] + above[k]))
            for k in range(len(names))
        )
    scale = "kp" if servos.kp_known else "none" if len(doubtful) == len(names) else "gravity"
    return {"servo": table, "scale_from": scale}


def differing(found: Explanation, causes: Sequence[Cause]) -> list[Cause]:
    """The causes but gains and frictions of a joint all of whose intervals hold the file's own numbers."""
    table, names = servo_table(found)["servo"], found.dataset.robot.joint_names
    assert found.dataset.servos is not None
    own = dict(zip(SERVO_NUMBERS, found.dataset.servos.file, strict=True))

    def differs(cause: Cause) -> bool:
        kinds = _NUMBERS_OF.get(CATALOGUE[cause.effect].numbers, ())
        known = [(table[kind][joint], own[kind][joint]) for kind in kinds for joint in map(names.index, cause.joints)]
        return not known or any(value is None or not value[1] <= file <= value[2] for value, file in known)

    return [cause for cause in causes if differs(cause)]


def servo_numbers(dataset: Dataset, groups: Sequence[Group], change: np.ndarray) -> np.ndarray:
    """(5, n) in the order of `SERVO_NUMBERS`: those of the file, moved by a change (p,)."""
    servos, model = dataset.servos, dataset.model
    assert servos is not None
    n, b = len(servos.kp), len(model.independent)
    moved = np.zeros(n)
    coefficients = _inverse(groups) @ change if groups else np.zeros(0)
    at = 0
    for group in groups:
        if group.kind == "rotor inertia":
            moved[group.joint] = coefficients[at] * group.scale[0] * dataset.robot.gear_ratios[group.joint] ** 2
        at += group.directions.shape[1]
    friction = change[b : b + 2 * n]
    first = len(model.values)
    return servos.file + np.stack(
        [change[first : first + n], friction[1::2], moved, friction[::2], change[first + n : first + 2 * n]]
    )


def _deviations(dataset: Dataset, groups: Sequence[Group], covariance: np.ndarray) -> np.ndarray:
    """(5, n) standard deviations, from the covariance (p, p) of the change."""
    servos, b = dataset.servos, len(dataset.model.independent)
    assert servos is not None
    n, first = len(servos.kp), len(dataset.model.values)
    own = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rotors = np.zeros(n)
    inverse, at = _inverse(groups), 0
    for group in groups:
        if group.kind == "rotor inertia":
            size = group.scale[0] * dataset.robot.gear_ratios[group.joint] ** 2
            rotors[group.joint] = size * np.sqrt(max(float(inverse[at] @ covariance @ inverse[at]), 0.0))
        at += group.directions.shape[1]
    friction = own[b : b + 2 * n]
    return np.stack([own[first : first + n], friction[1::2], rotors, friction[::2], own[first + n : first + 2 * n]])


def _inverse(groups: Sequence[Group]) -> np.ndarray:
    """(k, p) coefficients of the groups' directions in a change of the parameters."""
    directions = np.hstack([group.directions for group in groups])
    size = np.sqrt(np.sum(directions**2, axis=1))
    unit = np.where(size > 0, 1 / np.maximum(size, 1e-300), 0.0)
    return np.asarray(np.linalg.pinv(unit[:, None] * directions, rcond=1e-9) * unit)
