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

from agent.diagnosis.document import Cause, EffectPlace, WaterfallStep
from agent.diagnosis.gap.regime_shares import resampled
from agent.diagnosis.gap.torque_gap import HeldOutGap, rms
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.rows.dataset import Dataset, precision_of
from agent.diagnosis.rows.fit import Fit
from agent.model import CATALOGUE, IdentifiedModel, NominalModel
from agent.robot import ParameterLayout

#: Names of effects by the numbers of a file that they change; the built-in ones last.
_NAMES = {effect.numbers: effect.name for effect in reversed([*CATALOGUE.values()])}
_ZERO = "zero of the joint"
_HELD = 1e-6  # of the stored covariance: the model's parameters stay where they are
#: The remaining gap, as the last step.
REMAINDER = "remainder"
#: Kinds of groups of servos.
GAIN, BEND, OFFSET, DELAY = "servo gain", "bend of damping", "offset of set-points", "delay of the command"
#: How much more than that of the arm.
OWN_DELAY = "own delay"
OWN_PARAMETERS = "the model's own parameters"
#: Kinds of groups of links: ten numbers of one, or the mass and first moments of a load at the last.
LINK, LOAD = "link inertia", "load"


@dataclass(frozen=True, eq=False)
class Group:
    """Parameters released together: `kind` (friction, rotor inertia, of links or of servos), joint from 0
    (-1: of all), directions (p, k).

    `scale` (k,) are the physical parameters' sizes, standard ones or friction's, of which the directions are images.
    """

    kind: str
    joint: int
    directions: np.ndarray
    scale: np.ndarray

    @property
    def moves_links(self) -> bool:
        """Whether its parameters are inertias of links."""
        return self.kind in (LINK, LOAD)

    def text(self, names: Sequence[str]) -> str:
        """Name of the step."""
        if self.kind == LOAD:
            return f"{self.kind} at the link of {names[self.joint]}"
        return f"{self.kind} of {names[self.joint]}" if self.joint >= 0 else self.kind


@dataclass(frozen=True, eq=False)
class ReleasedSimulator:
    """A simulator's data before and after its parameters are released, and the groups in the order found.

    Effects are looked for at the numbers as moved: a friction that differs by direction is a part of the friction that
    there is, not of what the file says, which is often none.
    """

    given: Dataset
    moved: Dataset
    groups: tuple[Group, ...]

    @property
    def parts(self) -> frozenset[tuple[str, int]]:
        """Kind and joint of each group."""
        return frozenset((group.kind, group.joint) for group in self.groups)

    def released_in(self, dataset: Dataset) -> Fit:
        """The same numbers released in other data of the same simulator."""
        return released_fit(dataset, self.groups) if self.groups else dataset.fit

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
    pool = pool if kinds is None else [group for group in pool if group.kind in (*kinds, DELAY)]
    if dataset.servos is not None:
        return _with_released(dataset, _stepwise_groups(dataset, pool, causes))
    chosen: list[Group] = []
    fit = dataset.fit.with_chosen(causes)
    least = LIMITS.least_gain * float(fit.count.sum())
    while pool:
        tried = [released_fit(dataset, [*chosen, group]).with_chosen(causes) for group in pool]
        gains = [fit.error(fit.transient) - other.error(fit.transient) for other in tried]
        if max(gains) < least:
            break
        best = next(k for k, gain in enumerate(gains) if LIMITS.alike * gain >= max(gains))
        chosen.append(pool.pop(best))
        fit = tried[best]
        for group in chosen[:-1]:  # what was taken for it before may be needed no more, as a link further out
            others = [other for other in chosen if other is not group]
            without = released_fit(dataset, others).with_chosen(causes)
            if without.error(without.transient) - fit.error(fit.transient) < least:
                chosen, fit = others, without
    return _with_released(dataset, chosen)


def _stepwise_groups(dataset: Dataset, pool: Sequence[Group], causes: Sequence[Candidate]) -> list[Group]:
    """Groups of which none can go back to the file's numbers, and to which none can be added (stepwise selection).

    Each number has to gain: a link has ten, and links together only scale all else. From all groups on, many gains may
    replace a load; from none on, a load that cancels a missing friction is not seen. So both starts are tried, and the
    better result is taken. Last, a joint's friction and rotor go if its servo's gain alone does as well: they show
    as ratios to it.
    """
    fit = dataset.fit.with_chosen(causes)
    least, p = LIMITS.least_gain * float(fit.count.sum()), len(dataset.held)
    parts = [(fold.train, fit.gram[fold.test].sum(axis=0)) for fold in fit.folds]
    known = [(fit.gram[train].sum(axis=0) / fit.rows_per_independent, test) for train, test in parts]

    def error(groups: Sequence[Group]) -> float:
        prior = fit.prior.copy()
        prior[:p, :p] = precision_of(dataset.held + sum(group.directions @ group.directions.T for group in groups))
        total = 0.0
        for train, test in known:
            matrix = train[:-1, :-1] + prior
            unit = 1 / np.sqrt(np.diag(matrix))
            solution = unit * np.linalg.solve(matrix * np.outer(unit, unit), unit * train[:-1, -1])
            extended = np.append(solution, -1.0)
            total += float(extended @ test @ extended)
        return total + least * sum(group.directions.shape[1] for group in groups)

    def stepwise(chosen: list[Group]) -> tuple[float, list[Group]]:
        best = error(chosen)
        while True:
            fewer = [[g for g in chosen if g is not dropped] for dropped in reversed(chosen) if dropped.kind != DELAY]
            more = [[*chosen, added] for added in pool if added not in chosen]
            errors = [error(groups) for groups in (*fewer, *more)]
            step = int(np.argmin(errors)) if errors else 0
            if not errors or errors[step] > best or (errors[step] == best and step >= len(fewer)):
                return best, chosen
            best, chosen = errors[step], (*fewer, *more)[step]

    starts = [list(pool), [group for group in pool if group.kind == DELAY]]
    best, chosen = min(map(stepwise, starts), key=lambda entry: entry[0])
    for gain in (group for group in pool if group.kind == GAIN and group not in chosen):
        others = [g for g in chosen if g.joint != gain.joint or g.kind not in ("friction", "rotor inertia")]
        if len(others) < len(chosen) - 1 and (swapped := error([*others, gain])) < best:
            chosen, best = [*others, gain], swapped
    ordered: list[Group] = []
    while chosen:  # the one that leaves least next to those before it: a delay alone may leave more than the file
        ordered.append(min(chosen, key=lambda group: error([*ordered, group])))
        chosen = [group for group in chosen if group is not ordered[-1]]
    return ordered


def release_all(dataset: Dataset) -> ReleasedSimulator:
    """Release every group, so that no choice among them stands between a search and its effects."""
    return _with_released(dataset, groups_of(dataset))


def _with_released(dataset: Dataset, groups: Sequence[Group]) -> ReleasedSimulator:
    fit = released_fit(dataset, groups) if groups else dataset.fit
    unexplained = fit.out_of_fold()
    residual = np.where(np.isnan(unexplained), dataset.residual, unexplained)
    released = ReleasedSimulator(dataset, replace(dataset, fit=fit, residual=residual), tuple(groups))
    if not groups or dataset.servos is not None:  # positions are linear about numbers that were fitted already
        return released
    return replace(released, moved=replace(released.moved, fit=fit.with_reference(NominalModel(released.model))))


def groups_of(dataset: Dataset) -> list[Group]:
    """All groups of numbers that may be released, the plainer kinds first.

    Of links the outermost comes first: what is mounted there counts with it.
    """
    model, reference = dataset.model, dataset.fit.reference
    layout, base = ParameterLayout.of(dataset.robot), len(model.independent)
    torque = np.sqrt(np.mean(np.concatenate([s.predicted[s.kept] for s in dataset.fit.signals]) ** 2, axis=0))
    stiffness = 1.0 if dataset.servos is None else dataset.servos.kp
    torque = np.maximum(torque, stiffness * np.sqrt(np.mean(dataset.residual**2, axis=0)))
    speed = np.maximum(np.sqrt(np.mean(dataset.speed**2, axis=0)), 1e-9)
    scale = reference.prior_std.copy()
    acceleration = np.concatenate([s.qdd[s.kept] for s in dataset.fit.signals])
    fast = np.maximum(np.sqrt(np.mean(acceleration**2, axis=0)), 1e-9)
    # a file's rotor may be wrong by any factor, and of a wrist's inertia it is nearly all
    scale[layout.rotors] = np.maximum(scale[layout.rotors], torque / fast / dataset.robot.gear_ratios**2)
    size = len(dataset.fit.precision)
    friction: list[Group] = []
    rotors: list[Group] = []
    links: list[Group] = []
    for joint in range(dataset.robot.dof):
        own = [k for k, term in enumerate(model.terms) if term.axle == joint]
        columns = np.zeros((size, len(own)))
        for column, k in enumerate(own):
            level = torque[joint] if model.terms[k].form == "coulomb" else torque[joint] / speed[joint]
            columns[base + k, column] = level
        friction.append(Group("friction", joint, columns, columns[[base + k for k in own], range(len(own))]))
        for kind, place, groups in (
            ("rotor inertia", slice(layout.rotors.start + joint, layout.rotors.start + joint + 1), rotors),
            (LINK, layout.link(joint), links),
        ):
            directions = np.zeros((size, place.stop - place.start))
            directions[:base] = model.projection[:, place] * scale[place]
            if np.any(np.abs(directions) > 1e-12):
                groups.append(Group(kind, joint, directions, scale[place]))
    return [*friction, *_of_servos(dataset), *rotors, *_loads(dataset), *reversed(links)]


def _loads(dataset: Dataset) -> list[Group]:
    """A load at the last link, where positions are judged: next to gains, which it resembles, a link has too many
    numbers."""
    if (servos := dataset.servos) is None:
        return []
    model, last = dataset.model, dataset.robot.load_link
    directions = np.zeros((len(servos.covariance), servos.load.shape[1]))
    directions[: len(model.independent)] = (
        model.projection[:, ParameterLayout.of(dataset.robot).link(last)] @ servos.load
    )
    return [Group(LOAD, last, directions, servos.load[range(4), range(4)])]


def _of_servos(dataset: Dataset) -> list[Group]:
    """The gain of each servo, which may be wrong by any factor, its offset, and what the recorder does to commands."""
    if (servos := dataset.servos) is None:
        return []
    n, first = len(servos.kp), len(dataset.model.values)
    gains = np.zeros((n, len(servos.covariance), 1))
    gains[np.arange(n), first + np.arange(n), 0] = servos.kp
    late = np.zeros((len(servos.covariance), 2 if servos.cut else 1))
    late[-n:, 0] = servos.delay
    late[first + n, 1:] = servos.cut
    free, size = () if servos.kp_known else range(n), np.array([servos.delay])
    own = servos.delay * np.eye(len(late))[-n:, :, None]
    return [
        *(Group(GAIN, j, gains[j], servos.kp[j : j + 1]) for j in free),
        *_offsets(dataset),
        Group(DELAY, -1, late, np.ones(late.shape[1])),
        *(Group(OWN_DELAY, j, own[j], size) for j in (() if servos.one_delay else range(n))),
    ]


def _offsets(dataset: Dataset, share: float = 1.0) -> list[Group]:
    """How far each servo stands off its set-points: by up to a `share` of its torque; none where torque is judged.

    A control of a unit of its own has its zero there instead.
    """
    if (servos := dataset.servos) is None:
        return []
    n, size = len(servos.kp), len(servos.covariance)
    columns = share * np.eye(size)[size - 2 * n : size - n] * servos.offset[:, None]
    return [Group(OFFSET, j, columns[j][:, None], share * servos.offset[j : j + 1]) for j in servos.with_offset]


def drive_groups(dataset: Dataset, released: Collection[tuple[str, int]] = ()) -> list[Group]:
    """Friction, rotor and servo of every joint, the delay, and bends: all groups without links.

    Of offsets the usual ones but where they are `released`, by kind and joint: those are as large as the logs say.
    """
    groups = [group for group in groups_of(dataset) if not group.moves_links and group.kind != OFFSET]
    small = [group for group in usual_offsets(dataset) if (group.kind, group.joint) not in released]
    large = [group for group in _offsets(dataset) if (group.kind, group.joint) in released]
    return [*groups, *small, *large, *damping_bends(dataset)]


def usual_offsets(dataset: Dataset) -> list[Group]:
    """Offsets that a right file may have: as little of the torque as it misses anyway."""
    return _offsets(dataset, LIMITS.least_error)


def damping_bends(dataset: Dataset) -> list[Group]:
    """How much damping of each joint bends with speed, as grease does: no file has it, and no arm is without.

    A straight line takes a bend for Coulomb friction. None where torque is judged.
    """
    if (servos := dataset.servos) is None:
        return []
    n, size = len(servos.kp), len(servos.covariance)
    speed = np.maximum(np.sqrt(np.mean(dataset.speed**2, axis=0)), 1e-9)
    viscous = [group.scale[-1] / speed[group.joint] for group in groups_of(dataset) if group.kind == "friction"]
    columns = np.eye(size)[size - 3 * n : size - 2 * n] * np.array(viscous)[:, None]
    return [Group(BEND, j, columns[j][:, None], np.array(viscous[j : j + 1])) for j in range(n)]


def open_numbers(dataset: Dataset) -> list[Group]:
    """Bends and usual offsets, and the delay where logs of positions leave open how the command was held: a right file
    may differ."""
    late = [group for group in _of_servos(dataset) if group.kind == DELAY]
    usual = [*damping_bends(dataset), *usual_offsets(dataset)]
    return [*usual, *(late if dataset.servos is not None and dataset.servos.later else ())]


def released_fit(dataset: Dataset, groups: Sequence[Group]) -> Fit:
    """The rows with groups of numbers released."""
    covariance = dataset.held + sum(group.directions @ group.directions.T for group in groups)
    return dataset.fit.with_prior(precision_of(covariance))


def waterfall(released: ReleasedSimulator, selected: SelectedCauses, gap: HeldOutGap) -> tuple[WaterfallStep, ...]:
    """Part of the held-out gap that each released group, then each effect, closes: alone, and in the order found.

    Where a simulator is far off, a number alone may make the rest worse: steps are one until they close something.

    Of a model that nothing is released of, the effects come first, with its numbers as they are. What its own
    parameters close after that, within their stored uncertainty and also on other joints, is a step of its own.

    `gap` is that of the simulator as given, with everything found; empty where there is nothing to close.
    """
    if gap.closure is None:
        return ()
    names, dataset = released.given.robot.joint_names, released.given
    fits = [released_fit(dataset, released.groups[: k + 1]) for k in range(len(released.groups))]
    alone = [released_fit(dataset, [group]).out_of_fold() for group in released.groups]
    texts = [group.text(names) for group in released.groups]
    plain, moved = dataset.fit, dataset.fit.with_chosen(selected.causes)
    if not released.groups and dataset.given:  # a model fitted to the same logs has no own numbers to keep
        held = plain.with_prior(precision_of(_HELD * dataset.held))
        by_effects, by_both = (_absorbed(gap, fit) for fit in (held.with_chosen(selected.causes), moved))
        plain = held if by_both - by_effects >= LIMITS.least_share else plain
    last = fits[-1] if fits else plain
    for k, candidate in enumerate(selected.causes):
        fits.append(last.with_chosen(selected.causes[: k + 1]))
        alone.append(plain.with_chosen((candidate,)).out_of_fold(candidate.transient))
        texts.append(candidate.text(names))
    if plain is not dataset.fit:
        fits.append(moved)
        alone.append(dataset.fit.out_of_fold())
        texts.append(OWN_PARAMETERS)
    stages = [fit.out_of_fold(fit.transient) for fit in fits]
    errors = [gap.error_before, *(gap.beyond(stage) for stage in (*stages, *alone))]
    energy = np.stack([_energy(error / gap.unit, dataset.fit.block) for error in errors])
    floor = 0.0 if gap.floor is None else float(np.mean(gap.floor**2))
    rows = _energy(np.isfinite(gap.error_before).astype(float), dataset.fit.block)
    draws = resampled(energy.shape[1])
    whole = energy.sum(axis=1) / rows.sum()
    drawn = energy @ draws.T / (rows @ draws.T)  # (stages, draws)

    size, drawn = whole[0] - floor, drawn[:, drawn[0] > floor]
    count, at, steps = len(texts), 0, []

    def closing(begin: int, end: int) -> tuple[float, tuple[float, float]]:
        """Part of the gap that is closed between two stages, and its interval."""
        drawn_parts = (drawn[begin] - drawn[end]) / (drawn[0] - floor)
        low, high = np.quantile(drawn_parts, (1 - LAW.certain, LAW.certain))
        return float((whole[begin] - whole[end]) / size), (float(low), float(high))

    while at < count:
        ends = range(at + 1, count + 1)
        end = next((end for end in ends if closing(at, end)[1][1] >= 0), count)
        by_itself = float((whole[0] - whole[count + end]) / size)
        steps.append(WaterfallStep(_joined(texts[at:end]), closing(at, end)[0], by_itself, closing(at, end)[1]))
        at = end
    if len(steps) < count:
        steps = [replace(step, alone=None) for step in steps]
    closed, (low, high) = closing(0, count)
    return (*steps, WaterfallStep(REMAINDER, 1 - closed, None, (1 - high, 1 - low)))


def _joined(texts: Sequence[str]) -> str:
    return " and ".join(part for part in (", ".join(texts[:-1]), texts[-1]) if part)


def _absorbed(gap: HeldOutGap, fit: Fit) -> float:
    return replace(gap, after=rms(gap.beyond(fit.out_of_fold(fit.transient))) / gap.unit).absorbed


def _energy(rows: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(blocks,) sum of squares of (S', n), guards left out."""
    return np.bincount(block, np.nansum(rows**2, axis=1))


def _load(released: ReleasedSimulator, group: Group) -> dict[str, float]:
    """What the last link gained, as parameters of a load; empty of a link whose mass gained less than its prior
    deviation, and of others."""
    given = released.given
    if not group.moves_links or group.joint != given.robot.load_link:
        return {}
    directions = np.hstack([group.directions for group in released.groups])
    start = next(k for k, column in enumerate(directions.T) if np.array_equal(column, group.directions[:, 0]))
    coefficients = np.linalg.lstsq(directions, released.moved.fit.change, rcond=1e-9)[0][start:]
    names = ("mass", *(f"moment_{k}" for k in "xyz"), *(f"inertia_{k}" for k in ("xx", "xy", "yy", "xz", "yz", "zz")))
    if group.kind == LOAD and given.servos is not None:
        return dict(zip(names, map(float, given.servos.load @ coefficients[:4]), strict=True))
    prior_std = given.fit.reference.prior_std[ParameterLayout.of(given.robot).link(group.joint)]
    gained = coefficients[:10] * prior_std
    return dict(zip(names, map(float, gained), strict=True)) if gained[0] > prior_std[0] else {}


def delay_of(released: ReleasedSimulator, change: np.ndarray, group: Group) -> float:
    """The delay [s] of the joint of a group, by which a change (p,) differs from the file, or that of the arm."""
    late = change[-len(released.given.fit.rows) :]
    own = [other.joint for other in released.groups if other.kind == OWN_DELAY]
    of_arm = np.setdiff1d(np.arange(len(late)), own)
    return float(late[group.joint] if group.joint >= 0 else late[of_arm].mean() if len(of_arm) else late.mean())


def gained_load(released: ReleasedSimulator) -> np.ndarray:
    """(10,) parameters that the last link gains by a load of positions."""
    loads = [list(_load(released, group).values()) for group in released.groups if group.kind == LOAD]
    return np.array(loads[0]) if loads else np.zeros(10)


def _on_joint(released: ReleasedSimulator, group: Group, causes: Sequence[Candidate], gap: HeldOutGap) -> float | None:
    """What a group closes of its own joints' error that all others leave; None where torque is judged."""
    if released.given.servos is None:
        return None
    of_arm = group.joint < 0 or group.moves_links
    joints = range(len(released.given.fit.rows)) if of_arm else (group.joint,)
    others = released_fit(released.given, [g for g in released.groups if g is not group]).with_chosen(causes)
    return gap.closure_on(joints, others.out_of_fold(others.transient))


def _like_offset(
    released: ReleasedSimulator, causes: Sequence[Candidate], group: Group, gap: HeldOutGap
) -> tuple[EffectPlace, ...]:
    """What a servo that stands off its set-points may be instead: friction that differs by direction, as by
    definition, and what leaves as little in its stead: another zero of the joint, or a load."""
    names, joint = released.given.robot.joint_names, group.joint
    others = [other for other in released.groups if other is not group]
    zero = CATALOGUE[_NAMES[_ZERO]]
    loads = [entry for entry in _loads(released.given) if (entry.kind, entry.joint) not in released.parts]

    def as_little(fit: Fit) -> bool:
        error = rms(gap.beyond(fit.out_of_fold(fit.transient)))[joint]
        return bool(error <= LIMITS.alike * (gap.after * gap.unit)[joint])

    fit = released_fit(released.given, others)
    with_zero = fit.with_chosen((*causes, *fit.candidates([(zero, (joint,), {})])))
    loaded = released_fit(released.given, [*others, *loads]).with_chosen(causes)
    alike = [EffectPlace(name, (names[joint],)) for name in CATALOGUE[_NAMES[OFFSET]].structurally_equivalent]
    alike += [EffectPlace(zero.name, (names[joint],))] if as_little(with_zero) else []
    alike += [EffectPlace(_NAMES["load"], ())] if loads and as_little(loaded) else []
    return tuple(alike)


def _may_be_load(released: ReleasedSimulator, causes: Sequence[Candidate], gap: HeldOutGap) -> bool:
    """Whether gains of several servos at once may be a load that all of them carry, as it leaves as little instead."""
    if sum(group.kind == GAIN for group in released.groups) < 2 or released.given.servos is None:
        return False
    known = released.parts
    pool = [group for group in groups_of(released.given) if group.kind not in (GAIN, LINK)]
    pool = [group for group in pool if group.kind != OFFSET or (group.kind, group.joint) in known]
    fit = released_fit(released.given, _stepwise_groups(released.given, pool, causes)).with_chosen(causes)
    error = rms(gap.beyond(fit.out_of_fold(fit.transient))) / gap.unit
    return bool(np.mean(error**2) <= LIMITS.alike * np.mean(gap.after**2))


def likely_effects_on(released: ReleasedSimulator, selected: SelectedCauses, group: Group) -> list[str]:
    """Effects on a group's joint that the likeliest hypothesis has next to it, too small to be needed: the numbers may
    have moved for these. None where torque is judged."""
    if released.given.servos is None:
        return []
    named = {cause.key for cause in selected.causes}
    likeliest = selected.hypotheses[0].places
    return [name for name, joints in likeliest if joints == (group.joint,) and (name, joints) not in named]


def _without(released: ReleasedSimulator, groups: Sequence[Group], causes: Sequence[Candidate]) -> np.ndarray:
    """(S', n) held-out error where some groups stay as the file has them, and everything else is fitted again."""
    others = [group for group in released.groups if not any(group is kept for kept in groups)]
    fit = released_fit(released.given, others).with_chosen(causes)
    return fit.out_of_fold(fit.transient)


def _groups_that_cause(
    released: ReleasedSimulator, causes: Sequence[Candidate], gap: HeldOutGap, doubted: Collection[int]
) -> list[Group]:
    """The released groups that may be a cause: all where torque is judged.

    Not numbers of a joint without which, taken back one after the other, it errs no more than a right file does, nor of
    `doubted` joints, which have a remainder, nor a delay or links without which no joint errs more, or that close most
    on a doubted one.
    """
    if released.given.servos is None:
        return list(released.groups)
    fit, kept = released.given.fit, list[Group]()
    late = [group for group in released.groups if group.kind == DELAY]
    for of_arm in filter(None, (late, [group for group in released.groups if group.moves_links])):
        without = rms(gap.beyond(_without(released, of_arm, causes)))
        closed = (without**2 - (gap.after * gap.unit) ** 2) / fit.sigma.min(axis=0) ** 2
        if (without >= fit.usual_error).any() and int(np.argmax(closed)) not in doubted:
            kept += of_arm
    for joint in sorted(set(range(len(fit.rows))) - set(doubted)):
        own = [group for group in released.groups if group.joint == joint and not group.moves_links]
        spared: list[Group] = []
        while own:  # of numbers that stand in for each other one has to be wrong, not all
            errors = [rms(gap.beyond(_without(released, [*spared, group], causes))) for group in own]
            least = min(range(len(own)), key=lambda k: float(errors[k][joint]))
            if (errors[least] >= fit.usual_error)[joint]:
                break
            spared.append(own.pop(least))
        kept += own
    return [group for group in released.groups if any(group is other for other in kept)]


def causes_of_numbers(
    released: ReleasedSimulator,
    selected: SelectedCauses,
    gap: HeldOutGap,
    doubtful: Collection[int] = (),
    doubted: Collection[int] = (),
) -> tuple[Cause, ...]:
    """The released groups in the vocabulary of effects, what closes most first.

    Of joints with `doubtful` gains, another gain is another friction; `doubted` ones have a remainder.
    As of every cause, what it closes is what is lost when these numbers alone stay as the file has them and everything
    else is fitted again, not what they close by themselves, of which others would take a part. `gap` is that of the
    simulator as given.
    """
    model, names = released.given.model, released.given.robot.joint_names
    base, change = len(model.independent), released.moved.fit.change
    probability = LAW.certain * min(gap.closure or 0.0, 1.0)
    causes = list[Cause]()
    like_load = (EffectPlace(_NAMES["load"], ()),) if _may_be_load(released, selected.causes, gap) else ()

    def closes(*groups: Group) -> float | None:
        part = gap.closure_without(_without(released, groups, selected.causes))
        # positions are linear about the fitted numbers: without its delay a command is further off than the arm goes
        return part if part is None or released.given.servos is None else min(part, 1.0)

    bodies: list[Group] = []
    for group in _groups_that_cause(released, selected.causes, gap, doubted):
        joint = () if group.joint < 0 else (names[group.joint],)
        if load := _load(released, group):
            like_links = (EffectPlace(_NAMES["links"], ()),)
            own_part = _on_joint(released, group, selected.causes, gap)
            causes.append(Cause(_NAMES["load"], (), closes(group), probability, load, like_links, own_part))
        elif group.kind == "friction":
            own = {term.form: float(change[base + k]) for k, term in enumerate(model.terms) if term.axle == group.joint}
            parameters = {f"{form}_change": value for form, value in own.items()}
            equal = (EffectPlace(_NAMES[GAIN], joint),) if group.joint in doubtful else ()
            equal = (*equal, *(EffectPlace(name, joint) for name in likely_effects_on(released, selected, group)))
            own_part = _on_joint(released, group, selected.causes, gap)
            causes.append(Cause(_NAMES["friction"], joint, closes(group), probability, parameters, equal, own_part))
        elif group.kind == GAIN and released.given.servos is not None:
            kp, more = released.given.servos.kp[group.joint], float(change[len(model.values) + group.joint])
            parameters = {"scale_error": float(kp / (kp + more) - 1)}
            equal = (*like_load, *((EffectPlace(_NAMES["friction"], joint),) if group.joint in doubtful else ()))
            own_part = _on_joint(released, group, selected.causes, gap)
            causes.append(Cause(_NAMES[GAIN], joint, closes(group), probability, parameters, equal, own_part))
        elif group.kind == OFFSET and released.given.servos is not None:
            parameters = {"set_point_offset": float(released.given.servos.offsets(change)[group.joint])}
            alike = _like_offset(released, selected.causes, group, gap)
            own_part = _on_joint(released, group, selected.causes, gap)
            causes.append(Cause(_NAMES[OFFSET], joint, closes(group), probability, parameters, alike, own_part))
        elif group.kind in (DELAY, OWN_DELAY):
            own_part, delay = _on_joint(released, group, selected.causes, gap), delay_of(released, change, group)
            causes.append(Cause(_NAMES[DELAY], joint, closes(group), probability, {"delay": delay}, (), own_part))
        else:
            bodies.append(group)
    if bodies:
        known = np.abs(change[:base]) > LIMITS.deviations * model.standard_deviations[:base]
        torque = (
            change[:base] ** 2 * np.diagonal(released.given.fit.gram.sum(axis=0))[:base]
        )  # what makes most is first
        parameters = {model.names[k]: float(change[k]) for k in np.argsort(-torque) if known[k]}
        last = any(group.kind == LINK and group.joint == released.given.robot.load_link for group in bodies)
        as_load = (EffectPlace(_NAMES["load"], ()),) if last and released.given.servos is not None else ()
        causes.append(Cause(_NAMES["links"], (), closes(*bodies), probability, parameters, as_load))
    return tuple(sorted(causes, key=lambda cause: -(cause.closure or 0.0)))
