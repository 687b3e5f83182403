"""Diagnosis of a simulator file: its expected error, which of its numbers move, and the remaining gap.

The file stores no held-out error. The error that a model usually leaves on such logs replaces it: the same share of
torque as without a model (`LIMITS.unknown_error`). The error is smaller if the moved numbers leave less on most
joints; a joint that then stands out has a gap that numbers do not close.

Three explanations are compared, the simplest first. The numbers are right and one effect explains the gap; or friction
and rotors are moved, with effects; or links are moved too. The first that stands against those that move more numbers
is taken (`Explanation.holds_against`): it leaves hardly more, or no more at all where its effects may replace a change
of links. With links, numbers are chosen in two ways: without an effect, or with the effects that are found while all
numbers are free, as numbers chosen without an effect move in its stead. Of the two the one with fewer effects is taken
if it leaves hardly more, else the one that leaves less. Where positions are judged, the one with fewest parameters is
taken: gains of servos imitate effects, and effects friction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from agent.core import InputError
from agent.diagnosis.document import Cause, WaterfallStep
from agent.diagnosis.gap.adequacy import Adequacy
from agent.diagnosis.gap.torque_gap import HeldOutGap, held_out_gap, rms
from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.search import Search
from agent.diagnosis.hypotheses.selected_causes import SelectedCauses
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.rows.dataset import Dataset, assemble, expected_error
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.simulator_file.parameter_groups import NumberKind
from agent.diagnosis.simulator_file.released_numbers import ReleasedSimulator, release, release_all
from agent.diagnosis.simulator_file.reversals import with_reversals
from agent.diagnosis.simulator_file.waterfall import waterfall
from agent.diagnosis.verdict import causes_of, keep_supported, name_causes
from agent.estimation import FilterSettings, resolve_cutoff
from agent.model import BELOW_ZERO, CATALOGUE, FileNumbers, IdentifiedModel
from agent.recording import Log
from agent.robot import RobotDescription

#: Effects that are the file's numbers under another name.
_NUMBERS = tuple(
    name for name, effect in CATALOGUE.items() if effect.numbers in (FileNumbers.FRICTION, FileNumbers.LINKS)
)
#: Effects that do not show in motion, or are numbers of servos there.
_NO_MOTION = tuple(
    name
    for name, effect in CATALOGUE.items()
    if effect.transient or effect.numbers in (FileNumbers.GAIN, FileNumbers.OFFSET, FileNumbers.DELAY)
)
#: The effect that is links which weigh otherwise.
_LINKS = next(name for name, effect in CATALOGUE.items() if effect.numbers == FileNumbers.LINKS)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A finding with its data, the search that made it, and the gap that is left.

    Of a model that is no simulator's file, nothing is `released`.
    """

    released: ReleasedSimulator
    search: Search
    selected: SelectedCauses
    gap: HeldOutGap

    @property
    def of_file(self) -> bool:
        """Whether the model is a simulator's file."""
        return self.released.given.model.of_file

    @cached_property
    def dataset(self) -> Dataset:
        """The data with what was moved, and the residual of the model as it was given."""
        return replace(self.released.moved, residual=self.released.given.residual)

    @cached_property
    def as_given(self) -> HeldOutGap:
        """The gap of the model as it was given."""
        if self.of_file:
            return held_out_gap(self.dataset, self.selected.fit)
        return self.gap.unclosed if self.dataset.has_reference and not self.selected.causes else self.gap

    @cached_property
    def evidence(self) -> Evidence:
        """The evidence of the logs on all parameters of the model; that of the search is on those that moved."""
        return Evidence(self.released.given.fit, self.search.usual)

    @cached_property
    def causes_as_given(self) -> tuple[Cause, ...]:
        """The causes, with their parts of that gap."""
        return causes_of(self.dataset, self.selected, Adequacy.of(self.selected, self.as_given))

    @cached_property
    def steps(self) -> tuple[WaterfallStep, ...]:
        """What each released number and each cause closes of that gap."""
        explains = self.of_file or self.selected.causes
        return waterfall(self.released, self.selected, self.as_given) if explains else ()

    def holds_against(self, best: float, enough: float) -> bool:
        """Whether its causes hold against an explanation that moves more numbers and leaves `best`.

        Its causes may leave `enough` times as much. A load may leave only what chance explains, as any effect where
        gains of servos may be wrong, and other effects that may be links nothing more.
        """
        if _may_be_links(self.selected.causes):
            return self.remaining_error <= best
        like_load = any(candidate.effect.numbers == FileNumbers.LOAD for candidate in self.selected.causes)
        if like_load or self.released.moved.servos is not None:
            return (1 - LIMITS.least_share) * self.remaining_error <= best
        return self.remaining_error - best <= enough

    @property
    def parameters(self) -> int:
        """How many numbers of the file move, but the delay, and parameters its effects have."""
        moved = sum(group.directions.shape[1] for group in self.released.groups if group.kind != NumberKind.DELAY)
        effects = [(cause, cause.effect.counted(cause.settings)) for cause in self.selected.causes]
        return moved + sum(len(cause.names) + settings for cause, settings in effects)

    @property
    def remaining_error(self) -> float:
        """Mean square over joints of the remaining error."""
        return float(np.mean(self.gap.after**2))


def _may_be_links(causes: Sequence[Candidate]) -> bool:
    """Whether an effect may stand in for links that weigh otherwise: a torque over position, and no load."""
    effects = [candidate.effect for candidate in causes]
    return any(e.numbers != FileNumbers.LOAD and (e.family == "load" or _LINKS in e.confused_with) for e in effects)


def with_expected_error(model: IdentifiedModel, logs: Sequence[Log], share: float | None = None) -> IdentifiedModel:
    """The model with a held-out error (n,) [N·m], a `share` of the logs' torque, and a cut-off that suits them.

    Raises:
        InputError: a log without torque.
    """
    for log in logs:
        if log.effort is None:
            raise InputError(
                f"{log.path}: no torque (effort) was recorded, and a simulator is judged by it; of servos that report "
                "none, record the current times the torque constant of the joint"
            )
    torque = np.concatenate([log.effort for log in logs if log.effort is not None])
    error = expected_error(model.robot, torque, LIMITS.unknown_error if share is None else share)
    settings = FilterSettings()
    cutoff = min(resolve_cutoff(log, settings) for log in logs)
    return replace(
        model,
        cutoff=cutoff,
        order=settings.order,
        residual_rmse=error,
        held_out_rmse=error,
        weights=1 / np.stack([error**2] * 2),
    )


def search_simulator(
    robot: RobotDescription,
    model: IdentifiedModel,
    logs: Sequence[Log],
    cutoff: float | None,
    without: Sequence[str],
    progress: Callable[[str], None],
) -> Explanation:
    """Return the simplest of the three explanations that closes as much as any.

    Raises:
        InputError: logs that cannot be used (see `assemble`).
    """
    progress("moving friction, rotors and links of the simulator, step by step")
    dataset = assemble(robot, with_expected_error(model, logs), logs, cutoff)
    model = replace(model, terms=with_reversals(dataset).terms)
    dataset = assemble(robot, with_expected_error(model, logs), logs, cutoff)
    first = release(dataset)
    if first.groups:  # wrong masses look like friction that reverses late, so that is learnt again without them
        terms = with_reversals(replace(first.moved, model=first.model)).terms
        expected = with_expected_error(replace(model, terms=terms), logs, _expected(dataset, first.moved.residual))
        dataset = assemble(robot, expected, logs, cutoff, replace(first.model, terms=terms))
    return explain_rows(dataset, without, progress)


def explain_rows(dataset: Dataset, without: Sequence[str], progress: Callable[[str], None]) -> Explanation:
    """The simplest of the three explanations of the rows of a simulator that closes as much as any."""
    unit, model = dataset.fit.reference.scale, dataset.model
    search = partial(_search_with, model, without, progress, unit)
    as_is, drives, everything = release(dataset, kinds=()), release(dataset, links=False), release(dataset)
    enough = LIMITS.least_share * float(np.mean(held_out_gap(as_is.moved, as_is.moved.fit, unit).before ** 2))
    moves = len(everything.groups) > len(as_is.groups)
    searches = [search(as_is, most=1 if moves else LAW.max_effects)]
    if len(as_is.groups) < len(drives.groups) < len(everything.groups):
        searches.append(search(drives))
    if moves:
        progress("choosing which numbers of the simulator move, with the effects found")
        others = release(dataset, search(release_all(dataset)).selected.causes)
        pair = [search(others), *([search(everything)] if everything.parts != others.parts else [])]
        least = min(entry.remaining_error for entry in pair)
        most = least if dataset.servos is not None else least + enough  # of positions nearly all of the gap is delay
        close = (entry for entry in pair if entry.remaining_error <= most)
        searches.append(min(close, key=lambda entry: (len(entry.selected.causes), entry.remaining_error)))
    best = min(entry.remaining_error for entry in searches)
    single = [
        k for k, entry in enumerate(searches[:-1]) if entry.selected.causes and (k or len(entry.selected.causes) == 1)
    ]
    chosen = next((searches[k] for k in single if searches[k].holds_against(best, enough)), searches[-1])
    if dataset.servos is not None:
        holding = (entry for entry in searches if entry.holds_against(best, enough))
        chosen = min(holding, key=lambda entry: entry.parameters)
    for number in range(len(chosen.selected.causes)):
        if replacing_numbers(chosen, number, unit) is not None:
            chosen = replace(chosen, selected=chosen.selected.with_rival(number, (_LINKS, ())))
    return chosen


def _search_with(
    model: IdentifiedModel,
    without: Sequence[str],
    progress: Callable[[str], None],
    unit: np.ndarray,
    released: ReleasedSimulator,
    most: int = LAW.max_effects,
) -> Explanation:
    """Search with the moved numbers. If any moved, effects that equal numbers are left out: they would compete."""
    moved = released.moved
    left_out = (_NUMBERS if released.groups else (), _NO_MOTION if moved.servos is not None else ())
    search = Search(released.along_groups, (*without, *left_out[0], *left_out[1]), progress, most=most)
    searched = search.run()
    searched = replace(searched, plain=moved.fit, fit=moved.fit.with_chosen(searched.causes))
    selected = name_causes(searched)
    if hunting := [
        k for k in range(len(searched.causes)) if not selected.causes and _is_limit_cycle(moved, searched, k)
    ]:
        selected = searched.keeping(hunting, leaves_gap=True)
    selected, gap = keep_supported(moved, selected, unit)
    large = [k for k in range(len(selected.causes)) if _exceeds_expected_error(moved, selected, gap, k)]
    possible = [k for k in large if _possible(model, selected.fit, k)]
    if len(possible) < len(selected.causes):
        selected = selected.keeping(possible) if possible else selected.without_causes(leaves_gap=bool(large))
        selected, gap = keep_supported(moved, selected, unit)
    return Explanation(released, search, selected, gap)


def _exceeds_expected_error(dataset: Dataset, selected: SelectedCauses, gap: HeldOutGap, number: int) -> bool:
    """Whether the arm errs by more than with a right file without causes; positions on the joints of a cause, and
    without this one alone too.

    With torque a small effect may be named next to a large one, and in positions a servo that `_is_limit_cycle`.
    """
    if dataset.servos is None:
        return bool(dataset.fit.beyond_usual(gap.rmse_before).any())
    if _is_limit_cycle(dataset, selected, number):
        return True
    without = rms(gap.beyond(selected.fit.held_out(without=number)))
    joints = list(selected.causes[number].joints) or slice(None)
    return bool(dataset.fit.beyond_usual(np.minimum(without, gap.rmse_before))[joints].any())


def _is_limit_cycle(dataset: Dataset, selected: SelectedCauses, number: int) -> bool:
    """Whether a cause is a servo that hunts in a play: now and then, never twice alike, and as nothing smooth does.

    So it may be less than an error of friction on the whole, and its form leaves more than that of other effects.
    """
    twists = dataset.servos is not None and "twist" in selected.causes[number].effect.shapes
    return twists and selected.probability[number] >= LAW.sure and selected.irreplaceable(number)


def replacing_numbers(entry: Explanation, number: int, unit: np.ndarray) -> ReleasedSimulator | None:
    """Numbers that, with the other causes, leave as little without this cause (by number); None if there are none.

    Only causes that may be links are checked: a wrong weight of some or all links is more likely.
    """
    causes = entry.selected.causes
    if not (causes[number].effect.numbers == FileNumbers.LOAD or _may_be_links([causes[number]])):
        return None
    others = (*causes[:number], *causes[number + 1 :])
    chosen = release(entry.released.given, others)
    remaining = _remaining_error_with(chosen, others, unit)
    return chosen if (1 - LIMITS.least_share) * remaining <= entry.remaining_error else None


def _remaining_error_with(chosen: ReleasedSimulator, causes: Sequence[Candidate], unit: np.ndarray) -> float:
    """Mean square over joints that numbers and effects leave; the effects are computed at these numbers."""
    fit = chosen.moved.fit
    forms = fit.candidates([(cause.effect, cause.joints, cause.settings) for cause in causes])
    return float(np.mean(held_out_gap(chosen.moved, fit.with_chosen(forms), unit).after ** 2))


def _possible(given: IdentifiedModel, fit: Fit, number: int) -> bool:
    """Whether an effect is admissible with the numbers fitted with it: its size, and no friction below zero."""
    candidate, (change, effects) = fit.chosen[number], fit.fitted()
    values = dict(zip(candidate.names, map(float, effects[number]), strict=True))
    base = len(given.independent)
    before, level = fit.reference.model.values[base:], (given.values + change[: len(given.values)])[base:]
    of_joints = [k for k, term in enumerate(given.terms) if term.axle in candidate.joints]
    drives = all(level[k] >= -BELOW_ZERO * abs(before[k]) for k in of_joints)
    sized = all(values[name] > 0 for name in candidate.effect.sizes)
    return drives and sized and candidate.effect.plausible(candidate.settings, values)


def _expected(dataset: Dataset, residual: np.ndarray) -> float:
    """Remaining share of torque on a usual joint, of errors (S', n) [N·m]; the same is expected of other joints."""
    error = np.sqrt(np.nanmean(residual**2, axis=0))
    torque = np.concatenate([log.effort for log in dataset.logs if log.effort is not None])
    return LIMITS.expected_share(error / np.maximum(np.std(torque, axis=0), 1e-9))
