"""Which set-points would separate what position logs leave open: the expected log Bayes factor of a cause and rival.

Let a cause be true as found. Its rival, with all numbers of joints and servos, leaves on old and new motion together

    E = ½ aᵀ (S − S D (Dᵀ S D + R)⁻¹ Dᵀ S) a,

with S the information of the positions, a the cause, D what the rival and the numbers can do, R their prior (as
`agent.experiment.scorer` for torque). The factor is about normal with mean E and variance 2 E.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from agent.diagnosis.diagnosis import Diagnosis
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.position_logs.linear_rows import model_columns
from agent.diagnosis.position_logs.stretch import CommandedStretch, LinearisedMotion
from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.simulator_file.parameter_groups import NumberGroup, NumberKind, groups_of
from agent.diagnosis.simulator_file.servo_table import servo_numbers
from agent.model import CATALOGUE, FileNumbers
from agent.simulators import FreeSimulator, RecordedCommand, Simulator

_FLAT = 1e-6  # of the information on an effect's parameter: its prior
#: Kinds of numbers that an effect is, by `Effect.numbers`.
_KINDS: dict[FileNumbers | None, tuple[str, ...]] = {
    FileNumbers.FRICTION: (NumberKind.FRICTION, NumberKind.ROTOR),
    FileNumbers.LINKS: (NumberKind.LINK,),
    FileNumbers.LOAD: (NumberKind.LOAD,),
    FileNumbers.GAIN: (NumberKind.GAIN,),
    FileNumbers.DELAY: (NumberKind.DELAY, NumberKind.OWN_DELAY),
    FileNumbers.OFFSET: (NumberKind.OFFSET,),
    FileNumbers.SPRING: (NumberKind.SPRING,),
}


@dataclass(frozen=True, eq=False)
class Separation:
    """A pair that the logs leave open, `names` of its effects, and the probability of the right answer.

    That is `before` any further motion, and `after` each.
    """

    cause: str
    rival: str
    names: tuple[str, str]
    before: float
    after: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class _Side:
    """One of a pair: groups of numbers, or a candidate with its parameters as found (None: not found)."""

    effect: str
    text: str
    groups: tuple[NumberGroup, ...]
    form: Candidate | None
    values: np.ndarray | None


def separations(
    diagnosis: Diagnosis, simulator: Simulator, motions: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> list[Separation]:
    """What each motion, times (S,) [s] and set-points (S, n), would tell of the pairs that are open.

    Args:
        diagnosis: diagnosis of position logs.
        simulator: the file as given.
        motions: by name: times (S,) [s] and set-points (S, n) [rad or m].
    """
    pairs = list(_pairs(diagnosis))
    lines = {name: _line(diagnosis, simulator, *motion) for name, motion in motions.items()} if pairs else {}
    result = []
    for first, second in pairs:
        forms = [side.form for side in (first, second) if side.form is not None]
        old = _of_logs(diagnosis, forms)
        right = {
            name: _right(diagnosis, first, second, old + _of_motion(diagnosis, *line, forms))
            for name, line in lines.items()
        }
        before = _right(diagnosis, first, second, old)
        result.append(Separation(first.text, second.text, (first.effect, second.effect), before, right))
    return result


def _pairs(diagnosis: Diagnosis) -> Iterator[tuple[_Side, _Side]]:
    for cause in diagnosis.document.causes:
        first = _side(diagnosis, cause.effect, cause.joints)
        for rival in cause.equivalent_to:
            second = _side(diagnosis, rival.effect, rival.joints)
            if first is not None and second is not None:
                yield first, second


def _side(diagnosis: Diagnosis, effect: str, joints: Sequence[str]) -> _Side | None:
    robot, released = diagnosis.dataset.robot, diagnosis.released
    place = effect, tuple(robot.joint_names.index(name) for name in joints)
    text = f"{effect} on {', '.join(joints)}" if joints else effect
    for cause, values in zip(diagnosis.selected.causes, diagnosis.selected.fit.values, strict=True):
        if cause.key == place:
            return _Side(effect, text, (), cause, values)
    for form in (form for hypothesis in diagnosis.selected.hypotheses for form in hypothesis.effects):
        if form.key == place:
            return _Side(effect, text, (), form, None)
    numbers = CATALOGUE[effect].numbers
    groups = tuple(
        group
        for group in (() if released is None else groups_of(released.given))
        if group.kind in _KINDS.get(numbers, ())
        and (not joints or group.joint in place[1])
        and (numbers != FileNumbers.LOAD or group.joint == robot.load_link)
    )
    return _Side(effect, text, groups, None, None) if groups else None


def _right(diagnosis: Diagnosis, first: _Side, second: _Side, information: np.ndarray) -> float:
    """Probability that the right one of a pair leads by as much as a rival may not."""
    assert diagnosis.released is not None
    p, size = len(diagnosis.dataset.stored_covariance), len(information)
    place = {side: len(side.form.names) if side.form is not None else 0 for side in (first, second)}
    true, columns, prior = np.zeros(size), [], []
    if first.form is None:
        span = np.hstack([group.directions for group in first.groups])
        true[:p] = span @ np.linalg.lstsq(span, diagnosis.released.moved.fit.change, rcond=1e-9)[0]
    elif first.values is not None:
        true[p : p + place[first]] = first.values
    first_keys = {group.key for group in first.groups}
    drives = [group for group in groups_of(diagnosis.released.given) if not group.moves_links]
    for group in {g.key: g for g in (*drives, *second.groups)}.values():
        if group.key not in first_keys:
            columns.append(np.vstack([group.directions, np.zeros((size - p, group.directions.shape[1]))]))
            prior += [1.0] * group.directions.shape[1]
    if second.form is not None:
        free = np.eye(size)[:, p + place[first] : p + place[first] + place[second]]
        columns.append(free)
        prior += [_FLAT * float(column @ information @ column) + 1e-300 for column in free.T]
    others = np.hstack(columns)
    cross, matrix = others.T @ information @ true, others.T @ information @ others + np.diag(prior)
    unit = 1 / np.sqrt(np.diag(matrix))
    taken = cross @ (unit * np.linalg.solve(matrix * np.outer(unit, unit), unit * cross))
    gain = max(0.5 * float(true @ information @ true - taken), 1e-9)
    return float(ndtr((gain + np.log(LAW.unlikely)) / np.sqrt(2 * gain)))


def _of_logs(diagnosis: Diagnosis, forms: Sequence[Candidate]) -> np.ndarray:
    """Information of the logs on the model's parameters and the forms'."""
    rows = diagnosis.dataset.fit.rows
    blocks = [
        np.hstack([part[:, :-1], *(form.blocks.get(j, np.zeros((len(part), len(form.names)))) for form in forms)])
        for j, part in enumerate(rows)
    ]
    return np.asarray(sum(block.T @ block for block in blocks) / (diagnosis.dataset.rate * LIMITS.row_correlation_time))


def _of_motion(
    diagnosis: Diagnosis, line: LinearisedMotion, numbers: np.ndarray, forms: Sequence[Candidate]
) -> np.ndarray:
    """The same of a further motion."""
    columns = [model_columns(line, diagnosis.dataset.fit.reference, numbers)]
    signals = replace(line.signals, through_play=line.through_play)
    for form in forms:
        form.effect.prepare([signals], [(form.joints, form.settings)])
        if (responses := form.effect.in_positions(signals, form.joints, form.settings)) is None:
            columns.append(line.response.of_torque(form.effect.columns(signals, form.joints, form.settings)))
        else:
            moved = np.zeros((*columns[0].shape[:2], len(form.names)))
            for joint, block in responses.items():
                moved[:, joint] = block
            columns.append(moved)
    rows = np.concatenate(columns, axis=2) / diagnosis.dataset.fit.sigma.min(axis=0)[:, None]
    rate = 1 / float(np.median(np.diff(line.stretch.time)))
    flat = rows.reshape(-1, rows.shape[2])
    return np.asarray(flat.T @ flat / max(rate * LIMITS.row_correlation_time, 1.0))


def _line(
    diagnosis: Diagnosis, simulator: Simulator, time: np.ndarray, set_points: np.ndarray
) -> tuple[LinearisedMotion, np.ndarray]:
    """The simulated motion of the corrected numbers under set-points, linearised, and its columns of these numbers."""
    assert diagnosis.released is not None
    change = diagnosis.released.moved.fit.change
    numbers = servo_numbers(diagnosis.dataset, diagnosis.released.groups, change).possible
    servos = diagnosis.dataset.servos
    assert servos is not None
    free, begins = (
        FreeSimulator(replace(simulator.arm, model=servos.simulation.arm.model)),
        np.append(set_points[0], np.zeros(set_points.shape[1])),
    )
    if np.any(servos.simulation.arm.impedance > simulator.arm.impedance):
        free = free.holding()
    command = RecordedCommand(time, set_points, True)
    stretch = CommandedStretch(len(diagnosis.dataset.logs), time, set_points, command, begins)
    motion = stretch.run(free, numbers)
    assert motion is not None
    line = stretch.linearised(free, numbers, motion, diagnosis.dataset.fit.reference)
    return line, line.number_columns(free, numbers)
