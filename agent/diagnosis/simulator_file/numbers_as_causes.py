"""Released numbers in the vocabulary of effects: which of them are causes, and what may stand in their stead."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from agent.diagnosis.document import Cause, NamedEffect
from agent.diagnosis.gap.torque_gap import HeldOutGap, rms
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.simulator_file.parameter_groups import NumberGroup, NumberKind, groups_of, load_groups
from agent.diagnosis.simulator_file.released_numbers import (
    ReleasedSimulator,
    delay_of,
    gained_parameters,
    released_fit,
    stepwise_groups,
)
from agent.model import CATALOGUE, FileNumbers, ModelEffect

#: Names of effects by the numbers of a file that they change; the built-in ones last.
NAMES = {effect.numbers: effect.name for effect in reversed([*CATALOGUE.values()])}


def causes_of_numbers(
    released: ReleasedSimulator,
    selected: SelectedCauses,
    gap: HeldOutGap,
    open_gains: Collection[int] = (),
    joints_with_remainder: Collection[int] = (),
) -> tuple[Cause, ...]:
    """The released groups in the vocabulary of effects, what closes most first.

    Of joints with `open_gains`, another gain is another friction.
    As of every cause, what it closes is what is lost when these numbers alone stay as the file has them and everything
    else is fitted again, not what they close by themselves, of which others would take a part. `gap` is that of the
    simulator as given.
    """
    names, probability = released.given.robot.joint_names, LAW.confidence * min(gap.closure or 0.0, 1.0)
    like_load = (NamedEffect(NAMES[FileNumbers.LOAD], ()),) if _may_be_load(released, selected.causes, gap) else ()

    def closes(*groups: NumberGroup) -> float | None:
        part = gap.closure_without(_without(released, groups, selected.causes))
        # positions are linear about the fitted numbers: without its delay a command is further off than the arm goes
        return part if part is None or released.given.servos is None else min(part, 1.0)

    causes, bodies = list[Cause](), list[NumberGroup]()
    for group in _groups_that_cause(released, selected.causes, gap, joints_with_remainder):
        if group.kind in (NumberKind.LINK, NumberKind.ROTOR) and not gained_parameters(released, group):
            bodies.append(group)
            continue
        joint = () if group.joint < 0 or group.moves_links else (names[group.joint],)
        for effect, parameters in _as_effects(released, group):
            equal = _in_its_stead(released, selected, gap, group, like_load, group.joint in open_gains)
            own_part = _on_joint(released, group, selected.causes, gap)
            causes.append(Cause(effect, joint, closes(group), probability, parameters, equal, own_part))
    if bodies:
        last = any(group.kind == NumberKind.LINK and group.joint == released.given.robot.load_link for group in bodies)
        as_load = (NamedEffect(NAMES[FileNumbers.LOAD], ()),) if last and released.given.servos is not None else ()
        parameters = _links(released)
        causes.append(Cause(NAMES[FileNumbers.LINKS], (), closes(*bodies), probability, parameters, as_load))
    return tuple(sorted(causes, key=lambda cause: -(cause.closure or 0.0)))


def _as_effects(released: ReleasedSimulator, group: NumberGroup) -> list[tuple[str, dict[str, float]]]:
    """A group as an effect with its parameters; none of a spring that pushes."""
    model, change, servos = released.given.model, released.moved.fit.change, released.given.servos
    if group.moves_links:
        return [(NAMES[FileNumbers.LOAD], gained_parameters(released, group))]
    if group.kind == NumberKind.FRICTION:
        terms = [k for k, term in enumerate(model.terms) if term.axle == group.joint]
        base = len(model.independent)
        return [
            (NAMES[FileNumbers.FRICTION], {f"{model.terms[k].form}_change": float(change[base + k]) for k in terms})
        ]
    assert servos is not None
    if group.kind == NumberKind.SPRING:
        springs = springs_as_effects(released.given, [group], change)
        return [(spring.effect, dict(spring.parameters)) for spring in springs]
    if group.kind == NumberKind.GAIN:
        scale = servos.file.kp[group.joint] / servos.gains(change)[group.joint]
        return [(NAMES[FileNumbers.GAIN], {"scale_error": float(scale - 1)})]
    if group.kind == NumberKind.OFFSET:
        return [(NAMES[FileNumbers.OFFSET], {"set_point_offset": float(servos.offsets(change)[group.joint])})]
    return [(NAMES[FileNumbers.DELAY], {"delay": delay_of(released, change, group)})]


def _in_its_stead(
    released: ReleasedSimulator,
    selected: SelectedCauses,
    gap: HeldOutGap,
    group: NumberGroup,
    like_load: tuple[NamedEffect, ...],
    open_gain: bool,
) -> tuple[NamedEffect, ...]:
    """Effects that may be the cause instead of a group of which another gain is another friction (`open_gain`)."""
    joint = (released.given.robot.joint_names[group.joint],)
    if group.moves_links:
        return (NamedEffect(NAMES[FileNumbers.LINKS], ()),)
    if group.kind == NumberKind.FRICTION:
        names = [*([NAMES[FileNumbers.GAIN]] if open_gain else []), *likely_effects_on(released, selected, group)]
        return tuple(NamedEffect(name, joint) for name in names)
    if group.kind == NumberKind.GAIN:
        return (*like_load, *([NamedEffect(NAMES[FileNumbers.FRICTION], joint)] if open_gain else []))
    if group.kind == NumberKind.SPRING:
        return tuple(NamedEffect(name, joint) for name in CATALOGUE[NAMES[FileNumbers.SPRING]].structurally_equivalent)
    return _like_offset(released, selected.causes, group, gap) if group.kind == NumberKind.OFFSET else ()


def _links(released: ReleasedSimulator) -> dict[str, float]:
    """Changes of base parameters by more than chance, what makes most of the torque first."""
    model, base = released.given.model, len(released.given.model.independent)
    change = released.moved.fit.change[:base]
    significant = np.abs(change) > LIMITS.significant_deviations * model.standard_deviations[:base]
    torque = change**2 * np.diagonal(released.given.fit.gram.sum(axis=0))[:base]
    return {model.names[k]: float(change[k]) for k in np.argsort(-torque) if significant[k]}


def springs_as_effects(dataset: Dataset, groups: Sequence[NumberGroup], change: np.ndarray) -> list[ModelEffect]:
    """Springs of groups, by which a change (p,) differs from the file, as effects; of one that pushes none."""
    if (servos := dataset.servos) is None:
        return []
    stiffer, names = change[servos.layout.stiffness], dataset.robot.joint_names
    return [
        ModelEffect(
            NAMES[FileNumbers.SPRING],
            (names[j],),
            {"constant": float(-stiffer[j] * servos.simulation.arm.rest[j]), "stiffness": float(stiffer[j])},
        )
        for j in (group.joint for group in groups if group.kind == NumberKind.SPRING)
        if stiffer[j] > 0
    ]


def _groups_that_cause(
    released: ReleasedSimulator, causes: Sequence[Candidate], gap: HeldOutGap, joints_with_remainder: Collection[int]
) -> list[NumberGroup]:
    """The released groups that may be a cause: all where torque is judged.

    Not numbers of a joint without which, taken back one after the other, it errs no more than a right file does, nor of
    `joints_with_remainder`, nor a delay or links without which no joint errs more, or that close most
    on such a one.
    """
    if released.given.servos is None:
        return list(released.groups)
    fit, causing = released.given.fit, list[NumberGroup]()
    delays = [group for group in released.groups if group.kind == NumberKind.DELAY]
    for of_arm in filter(None, (delays, [group for group in released.groups if group.moves_links])):
        without = rms(gap.beyond(_without(released, of_arm, causes)))
        closed = (without**2 - gap.rmse_after**2) / fit.sigma.min(axis=0) ** 2
        if fit.beyond_usual(without).any() and int(np.argmax(closed)) not in joints_with_remainder:
            causing += of_arm
    for joint in sorted(set(range(len(fit.rows))) - set(joints_with_remainder)):
        of_joint = [group for group in released.groups if group.joint == joint and not group.moves_links]
        spared: list[NumberGroup] = []
        while of_joint:  # of numbers that stand in for each other one has to be wrong, not all
            errors = [rms(gap.beyond(_without(released, [*spared, group], causes))) for group in of_joint]
            least = min(range(len(of_joint)), key=lambda k: float(errors[k][joint]))
            if fit.beyond_usual(errors[least])[joint]:
                break
            spared.append(of_joint.pop(least))
        causing += of_joint
    return [group for group in released.groups if any(group is other for other in causing)]


def _without(released: ReleasedSimulator, groups: Sequence[NumberGroup], causes: Sequence[Candidate]) -> np.ndarray:
    """(S', n) held-out error where some groups stay as the file has them, and everything else is fitted again."""
    others = [group for group in released.groups if not any(group is left_out for left_out in groups)]
    fit = released_fit(released.given, others).with_chosen(causes)
    return fit.held_out()


def _on_joint(
    released: ReleasedSimulator, group: NumberGroup, causes: Sequence[Candidate], gap: HeldOutGap
) -> float | None:
    """What a group closes of its own joints' error that all others leave; None where torque is judged."""
    if released.given.servos is None:
        return None
    of_arm = group.joint < 0 or group.moves_links
    joints = range(len(released.given.fit.rows)) if of_arm else (group.joint,)
    others = released_fit(released.given, [g for g in released.groups if g is not group]).with_chosen(causes)
    return gap.closure_on(joints, others.held_out())


def _like_offset(
    released: ReleasedSimulator, causes: Sequence[Candidate], group: NumberGroup, gap: HeldOutGap
) -> tuple[NamedEffect, ...]:
    """What a servo that stands off its set-points may be instead: friction that differs by direction, as by
    definition, and what leaves as little in its stead: another zero of the joint, or a load."""
    names, joint = released.given.robot.joint_names, group.joint
    others = [other for other in released.groups if other is not group]
    zero = CATALOGUE[NAMES[FileNumbers.ZERO]]
    loads = [entry for entry in load_groups(released.given) if entry.key not in released.parts]

    def as_little(fit: Fit) -> bool:
        error = rms(gap.beyond(fit.held_out()))[joint]
        return bool(error <= LIMITS.equal_ratio * gap.rmse_after[joint])

    fit = released_fit(released.given, others)
    with_zero = fit.with_chosen((*causes, *fit.candidates([(zero, (joint,), {})])))
    loaded = released_fit(released.given, [*others, *loads]).with_chosen(causes)
    effects = [
        NamedEffect(name, (names[joint],)) for name in CATALOGUE[NAMES[FileNumbers.OFFSET]].structurally_equivalent
    ]
    effects += [NamedEffect(zero.name, (names[joint],))] if as_little(with_zero) else []
    effects += [NamedEffect(NAMES[FileNumbers.LOAD], ())] if loads and as_little(loaded) else []
    return tuple(effects)


def _may_be_load(released: ReleasedSimulator, causes: Sequence[Candidate], gap: HeldOutGap) -> bool:
    """Whether gains of several servos at once may be a load that all of them carry, as it leaves as little instead."""
    if sum(group.kind == NumberKind.GAIN for group in released.groups) < 2 or released.given.servos is None:
        return False
    moved = released.parts
    pool = [group for group in groups_of(released.given) if group.kind not in (NumberKind.GAIN, NumberKind.LINK)]
    pool = [group for group in pool if group.kind != NumberKind.OFFSET or group.key in moved]
    fit = released_fit(released.given, stepwise_groups(released.given, pool, causes)).with_chosen(causes)
    error = rms(gap.beyond(fit.held_out())) / gap.unit
    return bool((1 - LIMITS.least_share) * np.mean(error**2) <= np.mean(gap.after**2))


def likely_effects_on(released: ReleasedSimulator, selected: SelectedCauses, group: NumberGroup) -> list[str]:
    """Effects on a group's joint that the likeliest hypothesis has next to it, too small to be needed: the numbers may
    have moved for these. None where torque is judged."""
    if released.given.servos is None:
        return []
    named = {cause.key for cause in selected.causes}
    likeliest = selected.hypotheses[0].effect_keys
    return [name for name, joints in likeliest if joints == (group.joint,) and (name, joints) not in named]
