"""The verdict of a diagnosis: `name_causes` and `keep_supported` choose its causes, `decide_verdict` says it of
torque, `decide_by_position` of positions. `with_numbers` adds a file's numbers.

| verdict | condition |
| --- | --- |
| `explained` | causes, the executed path or a simulator's numbers explain three quarters of the gap |
| `ambiguous` | the same, but the first cause has rivals; or causes explain less, so one is assumed (`keep_supported`) |
| `unknown` | there is a gap, and nothing that may be named explains it |
| `unknown` | also where none shows, but these motions leave the torque of a joint open that the model was fitted to |
| `no_gap` | there is none beyond the noise model, nor an error that is no chance |

Causes pass two checks before: they are probable (`name_causes`), and they explain motion that their fit did not see
(`keep_supported`). Of positions, `verdict_on_positions` says what has a size.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np

from agent.diagnosis.document import Cause, NamedEffect
from agent.diagnosis.gap.adequacy import Adequacy
from agent.diagnosis.gap.torque_gap import HeldOutGap, held_out_gap
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset


@dataclass(frozen=True)
class Verdict:
    """A verdict, the causes it names, and the part of the gap that they explain (None: nothing to explain)."""

    name: str
    causes: tuple[Cause, ...]
    closure: float | None


def decide_verdict(
    selected: SelectedCauses,
    causes: Sequence[Cause],
    closure: float | None,
    path: Sequence[Cause] | None = None,
    numbers: Sequence[Cause] = (),
    by_numbers: float = 0.0,
    judged: bool = True,
) -> Verdict:
    """Return the verdict on all that is known of a gap.

    Parameters
    ----------
    `selected`, `causes`, `closure`
        What `name_causes` and `keep_supported` leave of a finding, its causes, and the part of the gap that they close,
        held out.
    path : sequence of Cause, optional
        A rate, delay or rounding that all motions share, if the executed path is not the planned one; empty if it may
        not be named.
    `numbers`, `by_numbers`
        Moved numbers of a simulator as causes, and the part of the gap that they close.
    judged : bool
        Whether the model's own uncertainty on these motions is small enough to find no gap.
    """
    if (by_effects := _verdict_by(causes, closure)) is not None:
        return replace(by_effects, causes=(*by_effects.causes, *filter(has_size, path or ())))
    if path and not selected.leaves_gap and (by_path := _verdict_by(path, path[0].closure)) is not None:
        return by_path
    gap = selected.leaves_gap or path is not None
    enough = by_numbers > (1 - LIMITS.least_share if gap else 0.0)
    if enough and (of_file := _verdict_by(numbers, by_numbers)) is not None:
        return of_file
    return Verdict("unknown" if gap or not judged else "no_gap", (), closure)


def decide_by_position(
    causes: Sequence[Cause], numbers: Sequence[Cause], closure: float | None, beyond_chance: bool
) -> Verdict:
    """Return the verdict on positions: effects and moved numbers that have a size, what closes most first.

    Most of the gap of a file is often its missing delay, so an effect has its size in what numbers leave. Together they
    have a size too: numbers that moved along a direction that the motion does not tell may close nothing. A gap is
    where a joint errs `beyond_chance`: no baseline says what of each effect a healthy arm has.
    """
    sized = tuple(sorted((*causes, *numbers), key=lambda cause: -(cause.closure or 0.0)))
    if sized and closure is not None and closure >= LIMITS.least_share:
        if sized[0].equivalent_to:
            return Verdict("ambiguous", sized, closure)
        if closure >= LIMITS.explained:
            return Verdict("explained", sized, closure)
    return Verdict("unknown" if beyond_chance else "no_gap", (), closure)


def with_numbers(verdict: Verdict, causes_as_given: Sequence[Cause], numbers: Sequence[Cause]) -> Verdict:
    """The verdict with the numbers of a simulator's file among its causes, what closes most first.

    A file without friction is wrong in its friction, whatever else is found next to it. `causes_as_given` are its
    effects with their parts of the gap of the file as it was given.
    """
    if not causes_as_given or not verdict.causes:
        return verdict
    closures = {(cause.effect, cause.joints): cause.closure for cause in causes_as_given}
    effects = [replace(c, closure=closures.get((c.effect, c.joints), c.closure)) for c in verdict.causes]
    causes = tuple(sorted([*effects, *filter(has_size, numbers)], key=lambda cause: -(cause.closure or 0.0)))
    return Verdict("ambiguous" if causes[0].equivalent_to else "explained", causes, verdict.closure)


def _verdict_by(causes: Sequence[Cause], closure: float | None) -> Verdict | None:
    """Return the verdict by the causes that have a size; None if they may not be named, or predict no better."""
    sized = tuple(filter(has_size, causes))
    if closure is None or closure <= 0 or not sized:
        return None
    if sized[0].equivalent_to:
        return Verdict("ambiguous", sized, closure)
    return Verdict("explained", sized, closure) if closure >= LIMITS.explained else None


def has_size(cause: Cause) -> bool:
    """Return whether a cause has finite parameters, not all zero, and closes a part of the gap or of its joints'."""
    values = cause.parameters.values()
    if cause.closure is None:
        return False
    closes = (cause.closure, cause.closure if cause.closure_of_joints is None else cause.closure_of_joints)
    return max(closes) >= LIMITS.least_share and all(map(isfinite, (*closes, *values))) and any(values)


def name_causes(selected: SelectedCauses, errs: bool = False) -> SelectedCauses:
    """Return what is named of the leading causes by its probability.

    None if the arm is likely healthy, if no class is sure enough, or if all causes leave too much to the noise model. A
    cause whose equal by definition was ignored is not named alone: the likeliest other one is its rival. `errs`:
    whether a joint errs by more than a healthy arm does, whatever the noise model explains of it.
    """
    exceeded = errs or selected.errs_beyond_usual
    if not exceeded and selected.healthy > 1 - LAW.confidence:
        return selected.without_causes(leaves_gap=False)
    sure = [k for k, probability in enumerate(selected.probability) if probability >= LAW.sure]
    if not sure or selected.explained_share < LIMITS.explained:
        return selected.without_causes(leaves_gap=True)
    selected = replace(selected.keeping(sure), leaves_gap=exceeded)
    unrivalled = []
    for k, cause in enumerate(selected.causes):
        if not selected.rivals[k] and not selected.ignored.isdisjoint(cause.effect.structurally_equivalent):
            selected = selected.with_runner_up(k)
            unrivalled += [] if selected.rivals[k] else [k]
    return selected.keeping(
        [k for k in range(len(selected.causes)) if k not in unrivalled], leaves_gap=exceeded or bool(unrivalled)
    )


def keep_supported(
    dataset: Dataset, selected: SelectedCauses, unit: np.ndarray | None = None
) -> tuple[SelectedCauses, HeldOutGap]:
    """Return the named causes that held-out figures support, and these figures; `unit` is that of `held_out_gap`.

    If the causes close less than `explained` needs, or the change of the model's own parameters closes more than they
    do, another cause may exist: the likeliest one is named with the first. Causes that leave more than a healthy arm
    leaves are no explanation (`shortfalls`), and those that others replace name nothing (`drop_replaceable`): what is
    left is judged again. If nothing else is left, the causes explained at most the model's own error, unless a
    joint `exceeds` that by far.
    """
    dropped = bool(selected.causes)
    while True:
        gap = held_out_gap(dataset, selected.fit, unit)
        adequacy = Adequacy.of(selected, gap)
        if not selected.causes:
            leaves_gap = selected.leaves_gap or (dropped and adequacy.exceeds())
            return replace(selected, leaves_gap=leaves_gap), gap
        closed = gap.closure or 0.0
        if not selected.rivals[0] and (closed < LIMITS.explained or adequacy.closed_alone < LIMITS.majority * closed):
            selected = selected.with_runner_up()
        if (fewer := drop_replaceable(selected, adequacy)) is not None:
            selected = fewer
            continue
        causes = causes_of(dataset, selected, adequacy)
        lacking = adequacy.shortfalls(selected.irreplaceable)
        explanation = _verdict_by(causes, adequacy.explained_part)
        named = () if explanation is None else explanation.causes
        if len(named) == len(causes) and not any(lacking):
            return selected, gap
        if any(lacking):
            named, selected = causes, selected.with_rejected(lacking)
        selected = selected.keeping(
            [k for k, cause in enumerate(causes) if cause in named and not lacking[k]],
            leaves_gap=selected.leaves_gap or any(lacking),
        )


def drop_replaceable(selected: SelectedCauses, adequacy: Adequacy) -> SelectedCauses | None:
    """Return the causes without the one that the model and the others replace best; None if all are needed.

    These are fitted again without it, in the forms that they have then. What they do not close then has to be a tenth
    of the gap, or of that of its joints where no larger cause has them.
    """
    count = len(selected.causes)
    losses = []
    for number in range(count):
        others = selected.keeping([k for k in range(count) if k != number])
        remaining = others.fit.held_out()
        shares = adequacy.gap.closure_without(remaining), _closure_on_own(adequacy, number, remaining)
        losses.append((max(share or 0.0 for share in shares), number, others))
    share, _, others = min(losses)
    return others if share < LIMITS.least_share else None


def causes_of(dataset: Dataset, selected: SelectedCauses, adequacy: Adequacy) -> tuple[Cause, ...]:
    """Return the causes of a finding with their figures."""
    fit, joints = selected.fit, dataset.robot.joint_names
    parts = zip(selected.causes, adequacy.taken_out, fit.values, selected.rivals, selected.probability, strict=True)
    return tuple(
        Cause(
            candidate.effect.name,
            tuple(joints[j] for j in candidate.joints),
            adequacy.gap.closure_without(without),
            probability,
            candidate.effect.reported(
                fit.reference, _floats(candidate.settings.items()), _floats(zip(candidate.names, values, strict=True))
            ),
            tuple(NamedEffect(name, tuple(joints[j] for j in there)) for name, there in rivals),
            _closure_on_own(adequacy, number, without),
        )
        for number, (candidate, without, values, rivals, probability) in enumerate(parts)
    )


def _closure_on_own(adequacy: Adequacy, number: int, without: np.ndarray) -> float | None:
    """Part of the gap that the cause `number` alone closes, on its joints without those of larger causes.

    `without` (S', n) [N·m] is the residual of the fit without it. For an effect of the whole arm only its main joint
    counts, as most of the arm's gap may be the model's own error. None if larger causes have all of its joints.
    """
    cause, larger = adequacy.causes[number], adequacy.causes[:number]
    taken = {joint for other in larger for joint in other.joints or (() if cause.joints else other.blocks)}
    joints = [joint for joint in cause.joints or cause.blocks if joint not in taken]
    if joints and not cause.joints:
        joints = [adequacy.main_joint(joints, without)]
    return adequacy.gap.closure_on(joints, without) if joints else None


def _floats(pairs: Iterable[tuple[str, float]]) -> dict[str, float]:
    return {name: float(value) for name, value in pairs}
