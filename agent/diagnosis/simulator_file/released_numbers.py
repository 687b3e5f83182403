"""Corrects the numbers of a nominal simulator before effects are added: friction, rotors and links, step by step.

A simulator's file holds its parameters as exact, and most are a little wrong at once. So groups of them, the friction
of one axle, one rotor, one link, are released one after the other, each time the one that takes most from the held-out
error (forward selection), until none gains what an effect would have to (`least_gain`). Beside effects that were found
they are chosen anew: what was moved in an effect's stead need not move then. A released group G has the
prior covariance G Gᵀ: friction and rotors that would take all of the joint's torque, a link half of itself
(`NominalModel.prior_std`). Every figure is of motion that the released parameters were not fitted to.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.rows.dataset import Dataset, precision_of
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.simulator_file.parameter_groups import NumberGroup, NumberKind, groups_of
from agent.model import IdentifiedModel, NominalModel
from agent.robot import ParameterLayout


@dataclass(frozen=True, eq=False)
class ReleasedSimulator:
    """A simulator's data before and after its parameters are released, and the groups in the order found.

    Effects are looked for at the numbers as moved: a friction that differs by direction is a part of the friction that
    there is, not of what the file says, which is often none.
    """

    given: Dataset
    moved: Dataset
    groups: tuple[NumberGroup, ...]

    @property
    def parts(self) -> frozenset[tuple[NumberKind, int]]:
        """Kind and joint of each group."""
        return frozenset(group.key for group in self.groups)

    @property
    def along_groups(self) -> Fit:
        """The fit with the numbers released, whose other numbers are no parameters where positions are judged."""
        if self.given.servos is None or not self.groups:
            return self.moved.fit
        return self.given.fit.along(np.hstack([group.directions for group in self.groups]))

    @property
    def model(self) -> IdentifiedModel:
        """The simulator's, its numbers as moved before any effect."""
        given = self.given.model
        return replace(given, values=given.values + self.moved.fit.change[: len(given.values)])


def release(
    dataset: Dataset, causes: Sequence[Candidate] = (), links: bool = True, kinds: Collection[str] | None = None
) -> ReleasedSimulator:
    """Release group after group while that gains; without `links`, friction, rotors and servos only, or `kinds` alone.

    The delay of a command is free from the start: no file of a simulator knows that of a recorder.

    The choice of numbers includes the effects of `causes`. The numbers are then moved without them, as the start of the
    search.
    """
    pool = [group for group in groups_of(dataset) if links or not group.moves_links]
    pool = pool if kinds is None else [group for group in pool if group.kind in (*kinds, NumberKind.DELAY)]
    if dataset.servos is not None:
        return _with_released(dataset, stepwise_groups(dataset, pool, causes))
    chosen: list[NumberGroup] = []
    fit = dataset.fit.with_chosen(causes)
    least = LIMITS.least_gain * float(fit.count.sum())
    while pool:
        tried = [released_fit(dataset, [*chosen, group]).with_chosen(causes) for group in pool]
        gains = [fit.error - other.error for other in tried]
        if max(gains) < least:
            break
        best = next(k for k, gain in enumerate(gains) if gain >= (1 - LIMITS.least_share) * max(gains))
        chosen.append(pool.pop(best))
        fit = tried[best]
        for group in chosen[:-1]:  # what was taken for it before may be needed no more, as a link further out
            others = [other for other in chosen if other is not group]
            without = released_fit(dataset, others).with_chosen(causes)
            if without.error - fit.error < least:
                chosen, fit = others, without
    return _with_released(dataset, chosen)


def stepwise_groups(dataset: Dataset, pool: Sequence[NumberGroup], causes: Sequence[Candidate]) -> list[NumberGroup]:
    """Groups of which none can go back to the file's numbers, and to which none can be added (stepwise selection).

    Each number has to gain: a link has ten, and links together only scale all else. From all groups on, many gains may
    replace a load; from none on, a load that cancels a missing friction is not seen. So both starts are tried, and the
    better result is taken. Last, a joint's friction and rotor go if its servo's gain alone does as well: they show
    as ratios to it.
    """
    place, end, columns = dict[tuple[str, int], np.ndarray](), 0, [np.zeros((len(dataset.stored_covariance), 0))]
    for group in pool:
        place[group.key] = np.arange(end, end := end + group.directions.shape[1])
        columns.append(group.directions)
    fit = dataset.fit.along(np.hstack(columns)).with_chosen(causes)
    least, effects = LIMITS.least_gain * float(fit.count.sum()), np.arange(end, fit.size)
    parts = [(fit.gram[fold.train].sum(axis=0), fit.gram[fold.test].sum(axis=0)) for fold in fit.folds]
    moments = [(train / fit.rows_per_independent, test) for train, test in parts]

    def error(groups: Sequence[NumberGroup]) -> float:
        moving = np.concatenate([*(place[group.key] for group in groups), effects])
        total, square, judged = 0.0, np.ix_(moving, moving), np.append(moving, fit.size)
        for train, test in moments:
            matrix = train[square] + fit.prior[square]
            unit = 1 / np.sqrt(np.diag(matrix))
            solution = unit * np.linalg.solve(matrix * np.outer(unit, unit), unit * train[moving, -1])
            extended = np.append(solution, -1.0)
            total += float(extended @ test[np.ix_(judged, judged)] @ extended)
        return total + least * (len(moving) - len(effects))

    def stepwise(chosen: list[NumberGroup]) -> tuple[float, list[NumberGroup]]:
        best = error(chosen)
        while True:
            fewer = [
                [g for g in chosen if g is not dropped]
                for dropped in reversed(chosen)
                if dropped.kind != NumberKind.DELAY
            ]
            more = [[*chosen, added] for added in pool if added not in chosen]
            errors = [error(groups) for groups in (*fewer, *more)]
            step = int(np.argmin(errors)) if errors else 0
            if not errors or errors[step] > best or (errors[step] == best and step >= len(fewer)):
                return best, chosen
            best, chosen = errors[step], (*fewer, *more)[step]

    starts = [list(pool), [group for group in pool if group.kind == NumberKind.DELAY]]
    best, chosen = min(map(stepwise, starts), key=lambda entry: entry[0])
    for gain in (group for group in pool if group.kind == NumberKind.GAIN and group not in chosen):
        others = [g for g in chosen if g.joint != gain.joint or g.kind not in (NumberKind.FRICTION, NumberKind.ROTOR)]
        if len(others) < len(chosen) - 1 and (swapped := error([*others, gain])) < best:
            chosen, best = [*others, gain], swapped
    ordered: list[NumberGroup] = []
    while chosen:  # the one that leaves least next to those before it: a delay alone may leave more than the file
        ordered.append(min(chosen, key=lambda group: error([*ordered, group])))
        chosen = [group for group in chosen if group is not ordered[-1]]
    return ordered


def release_all(dataset: Dataset) -> ReleasedSimulator:
    """Release every group, so that no choice among them stands between a search and its effects."""
    return _with_released(dataset, groups_of(dataset))


def _with_released(dataset: Dataset, groups: Sequence[NumberGroup]) -> ReleasedSimulator:
    fit = released_fit(dataset, groups) if groups else dataset.fit
    unexplained = fit.held_out()
    residual = np.where(np.isnan(unexplained), dataset.residual, unexplained)
    released = ReleasedSimulator(dataset, replace(dataset, fit=fit, residual=residual), tuple(groups))
    if not groups or dataset.servos is not None:  # positions are linear about numbers that were fitted already
        return released
    return replace(released, moved=replace(released.moved, fit=fit.with_reference(NominalModel(released.model))))


def released_fit(dataset: Dataset, groups: Sequence[NumberGroup]) -> Fit:
    """The rows with groups of numbers released."""
    covariance = dataset.stored_covariance + sum(group.directions @ group.directions.T for group in groups)
    return dataset.fit.with_prior(precision_of(covariance))


def gained_parameters(released: ReleasedSimulator, group: NumberGroup) -> dict[str, float]:
    """What the last link gained, as parameters of a load; empty of a link whose mass gained less than its prior
    deviation, and of others."""
    given = released.given
    if not group.moves_links or group.joint != given.robot.load_link:
        return {}
    directions = np.hstack([group.directions for group in released.groups])
    start = next(k for k, column in enumerate(directions.T) if np.array_equal(column, group.directions[:, 0]))
    coefficients = np.linalg.lstsq(directions, released.moved.fit.change, rcond=1e-9)[0][start:]
    names = ("mass", *(f"moment_{k}" for k in "xyz"), *(f"inertia_{k}" for k in ("xx", "xy", "yy", "xz", "yz", "zz")))
    if group.kind == NumberKind.LOAD and given.servos is not None:
        return dict(zip(names, map(float, given.servos.prior.load @ coefficients[:4]), strict=True))
    prior_std = given.fit.reference.prior_std[ParameterLayout.of(given.robot).link(group.joint)]
    gained = coefficients[:10] * prior_std
    return dict(zip(names, map(float, gained), strict=True)) if gained[0] > prior_std[0] else {}


def delay_of(released: ReleasedSimulator, change: np.ndarray, group: NumberGroup) -> float:
    """The delay [s] of the joint of a group, by which a change (p,) differs from the file, or that of the arm."""
    assert released.given.servos is not None
    delays = change[released.given.servos.layout.delay]
    with_own = [other.joint for other in released.groups if other.kind == NumberKind.OWN_DELAY]
    of_arm = np.setdiff1d(np.arange(len(delays)), with_own)
    return float(delays[group.joint] if group.joint >= 0 else delays[of_arm].mean() if len(of_arm) else delays.mean())


def gained_load(released: ReleasedSimulator) -> np.ndarray:
    """(10,) parameters that the last link gains by a load of positions."""
    loads = [
        list(gained_parameters(released, group).values()) for group in released.groups if group.kind == NumberKind.LOAD
    ]
    return np.array(loads[0]) if loads else np.zeros(10)
