"""Torque with the drives off: it is the channel's own, and tells an offset of it from friction that equals one.

A motor without current makes no torque, so what its channel shows then is its zero. An offset that a diagnosis found is
there as well, alone or with the one that the model had before; friction by direction, a spring or a hose is not.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.core import InputError
from agent.diagnosis.candidate import Candidate, HeldOutScore, Where
from agent.diagnosis.dataset import Dataset
from agent.diagnosis.finding import Finding
from agent.diagnosis.isolability import best_by_place, plausible
from agent.diagnosis.needs import Excursions
from agent.diagnosis.verdict import abstained, named
from agent.model import CATALOGUE, IdentifiedModel
from agent.recording import Log
from agent.robot import RobotDescription
from agent.simulators import SIMULATOR

_STANDS = 0.01  # rad or m: brakes give
_LEAST = 1.0  # s
_BLOCKS = 8  # whose means scatter as far as slow noise has it
_CERTAIN = 3.0  # standard errors
_NEAR, _FAR = 0.25, 0.5  # of the offset found: so near to what one story says, and so far from what the other does
_SWINGS = 0.05  # of nominal torque, standard deviation: a channel without current shows its noise
_HOLDS, _LOADED = 0.3, 0.02  # of the torque that holds the arm: so near to it; and of nominal torque, where it tells
_BEYOND = 1.0  # of nominal torque: no zero of a channel
_NOTABLE = 0.02  # of nominal torque


@dataclass(frozen=True, eq=False)
class ChannelZero:
    """`torque` (n,) [N·m] of a log with the drives off and its standard `error` (n,), both NaN where the channel is off
    too."""

    torque: np.ndarray
    error: np.ndarray


def channel_zero(robot: RobotDescription, log: Log, model: IdentifiedModel | None) -> ChannelZero:
    """The zero of every torque channel, from a log that was recorded with the drives off.

    Raises:
        InputError: the log has no torque, is short, is of an arm that moves or whose drives hold it, or the model is a
            simulator's file.
    """
    if model is not None and model.method == SIMULATOR:
        raise InputError(
            f"{log.name}: a log with the drives off tells what an offset beside an estimated model may be; beside the "
            "file of a simulator leave it out"
        )
    if log.effort is None:
        raise InputError(f"{log.name}: has no torque, so it does not say what the channels show with the drives off")
    if log.t[-1] - log.t[0] < _LEAST or len(log.t) < 2 * _BLOCKS:
        raise InputError(
            f"{log.name}: {log.t[-1] - log.t[0]:.2g} s with the drives off are too short, record {_LEAST:g} s "
            f"and {2 * _BLOCKS} samples at least"
        )
    for joint, travel in zip(robot.joints, np.ptp(log.position, axis=0), strict=True):
        if travel > _STANDS:
            unit = "m" if joint.prismatic else "rad"
            raise InputError(
                f"{log.name}: {joint.name} moves by {travel:.2g} {unit}: with the drives off the brakes hold an arm"
            )
    _check_off(robot, log, model)
    means = np.array([block.mean(axis=0) for block in np.array_split(log.effort, _BLOCKS)])
    off = np.ptp(log.effort, axis=0) == 0
    torque, error = means.mean(axis=0), means.std(axis=0, ddof=1) / np.sqrt(_BLOCKS)
    return ChannelZero(np.where(off, np.nan, torque), np.where(off, np.nan, error))


def _check_off(robot: RobotDescription, log: Log, model: IdentifiedModel | None) -> None:
    """Raises:
    InputError: torque that no drive without current shows.
    """
    assert log.effort is not None
    nominal, mean, swing = robot.nominal_torque, log.effort.mean(axis=0), log.effort.std(axis=0)
    again = "switch the drives off, let the brakes hold the arm, and record again"
    for joint, entry in enumerate(robot.joints):
        unit = "N" if entry.prismatic else "N·m"
        if swing[joint] > _SWINGS * nominal[joint]:
            raise InputError(
                f"{log.name}: the torque of {entry.name} varies by {swing[joint]:.3g} {unit} (standard deviation) "
                f"while the arm stands, which no motor without current does: {again}"
            )
        if abs(mean[joint]) > _BEYOND * nominal[joint]:
            raise InputError(
                f"{log.name}: the torque of {entry.name} is {mean[joint]:.4g} {unit}, and its nominal torque "
                f"{nominal[joint]:.4g}: that is no zero of a channel; {again}, or mend the units in its import"
            )
    if model is None:
        return
    still = np.zeros((1, robot.dof))
    torque, friction = model.predict_parts(log.position.mean(axis=0)[None], still, still)
    held = (torque - friction)[0]
    loaded = np.abs(held) > _LOADED * np.where(np.isnan(nominal), np.abs(held).max(), nominal)
    left = np.linalg.norm((mean - _known_offsets(model) - held)[loaded])
    if loaded.any() and left < _HOLDS * np.linalg.norm(held[loaded]):
        names = ", ".join(np.array(robot.joint_names)[loaded])
        raise InputError(
            f"{log.name}: the torque of {names} is what it takes to hold the arm there, so its drives are on: {again}"
        )


def with_channel_zero(
    dataset: Dataset, finding: Finding, zero: ChannelZero, without: Collection[str] = ()
) -> tuple[Finding, tuple[str, ...]]:
    """The finding where the zeros of the channels settle what equals an offset of one, and what they say.

    A log with a zero that no motion shows is not one of these motions' arm with its drives off: it settles nothing.
    `without`: effects that are not to be named.
    """
    asked = {place[1] for k in range(len(finding.causes)) if (place := _offset_of(finding, k)) is not None}
    if odd := tuple(_elsewhere(dataset, zero, asked)):
        return finding, (*odd, "a log with the drives off that is in doubt settles nothing: record it again")
    finding, said = replace(finding, zero_known=True), []
    for number in range(len(finding.causes)):
        place = _offset_of(finding, number)
        if place is not None:
            finding, text = _settled(dataset, finding, number, place, zero, without)
            said.append(text)
    nothing = (
        "nothing that was found may be an offset of a torque channel, so the log with the drives off settles nothing"
    )
    return finding, tuple(said or [nothing])


def _elsewhere(dataset: Dataset, zero: ChannelZero, asked: Collection[tuple[int, ...]]) -> Iterator[str]:
    """Channels with another zero than the model has, where no offset was found."""
    before = _known_offsets(dataset.model)
    for joint, entry in enumerate(dataset.robot.joints):
        seen, least = zero.torque[joint], _NOTABLE * dataset.fit.reference.scale[joint]
        if (joint,) not in asked and min(abs(seen), abs(seen - before[joint])) > _CERTAIN * zero.error[joint] + least:
            unit = "N" if entry.prismatic else "N·m"
            yield (
                f"with the drives off the torque of {entry.name} is {seen:.3g} {unit}, and in motion no offset of its "
                "channel was found: was it recorded on the same day, by the same channel, with the drives off?"
            )


def _offset_of(finding: Finding, number: int) -> Where | None:
    """The place in a cause's class that is an offset of the torque channel."""
    places = (finding.causes[number].place, *finding.rivals[number])
    return next((place for place in places if CATALOGUE[place[0]].adds_to_report), None)


def _settled(
    dataset: Dataset, finding: Finding, number: int, place: Where, zero: ChannelZero, without: Collection[str]
) -> tuple[Finding, str]:
    """What the zero of one channel leaves of a class that has its offset in it, and what it says."""
    (joint,) = place[1]
    slides = dataset.robot.joints[joint].prismatic
    name, unit, travelled = dataset.robot.joint_names[joint], *(("N", "m") if slides else ("N·m", "rad"))
    if np.isnan(zero.torque[joint]):
        return (
            finding,
            f"the torque channel of {name} is off with its drive, so it does not tell an offset from friction",
        )
    others = tuple(cause for k, cause in enumerate(finding.causes) if k != number)
    (offset,) = dataset.fit.candidates([(CATALOGUE[place[0]], place[1], {})])
    size = float(dataset.fit.with_chosen((*others, offset)).values[-1][0])
    before = float(_known_offsets(dataset.model)[joint])
    seen, slack = float(zero.torque[joint]), _CERTAIN * float(zero.error[joint])
    of_channel, of_arm = min(abs(seen - size), abs(seen - size - before)), min(abs(seen), abs(seen - before))
    what = f"with the drives off the torque of {name} is {seen:.3g} {unit}, where {size:.3g} {unit} were found"
    if slack > _NEAR * abs(size):
        return finding, f"{what}, give or take {slack:.3g}: too restless to tell an offset from friction"
    near, far = _NEAR * abs(size) + slack, _FAR * abs(size)
    if of_channel <= near and of_arm >= far:
        return _only(dataset, finding, number, offset, ()), f"{what}: an offset of its channel, and nothing of the arm"
    if of_arm <= near and of_channel >= far:
        left = without_places(dataset, replace(finding, ruled_out=(*finding.ruled_out, place)), without)
        travel = max(float(np.ptp(signals.q[:, joint])) for signals in dataset.fit.signals)
        also = f"; a spring or hose that pulls alike over the {travel:.2g} {travelled} travelled would look the same"
        more = also if len(left.causes) == len(finding.causes) else ", and nothing else in the catalogue does as well"
        return left, f"{what}: its channel has no such offset{more}"
    if abs(seen + size) <= near:
        return (
            finding,
            f"{what}: as much with the other sign; was it the same channel, recorded alike? It settles nothing",
        )
    return finding, f"{what}: that does not tell an offset from friction, and both may be there"


def without_places(dataset: Dataset, finding: Finding, without: Collection[str] = ()) -> Finding:
    """The finding where the places that another test ruled out are no causes and equal none.

    What else may be the constant that an offset is stands in their place: also a law of position on a joint that
    travels too little for it to be tried, of effects that are not in `without`, and one that was no more than the
    offset. A cause that nothing equals is gone.
    """
    for place in finding.ruled_out:
        number = next((k for k, c in enumerate(finding.causes) if place in (c.place, *finding.rivals[k])), None)
        if number is not None:
            finding = _without(dataset, finding, number, place, without)
    return finding


def _known_offsets(model: IdentifiedModel) -> np.ndarray:
    """(n,) what the model has of them already [N·m], of the channel or not."""
    offsets = np.zeros(model.robot.dof)
    for term, value in zip(model.terms, model.values[len(model.independent) :], strict=True):
        if term.form == "offset":
            offsets[term.axle] += value
    return offsets


def _without(dataset: Dataset, finding: Finding, number: int, place: Where, without: Collection[str]) -> Finding:
    """The finding without a place in a class: where it was the cause, its first equal is."""
    step = finding.steps[min(number, len(finding.steps) - 1)]
    untried = _untried(dataset, place, without) | _freed(dataset, step.scores, place, without)
    cause = finding.causes[number].place
    rivals = tuple(dict.fromkeys(r for r in (*finding.rivals[number], *untried) if r not in (place, cause)))
    if cause != place:
        return _only(dataset, finding, number, finding.causes[number], rivals)
    others = [cause for k, cause in enumerate(finding.causes) if k != number]
    made = dataset.fit.with_chosen(others).score(list(untried.values()))
    forms = best_by_place([score for score in (*made, *step.scores) if plausible(score)])
    for k, rival in enumerate(rivals):
        if rival in forms:
            return _only(dataset, finding, number, forms[rival].candidate, rivals[:k] + rivals[k + 1 :])
    kept = [k for k in range(len(finding.causes)) if k != number]
    return finding.only(kept, dataset.fit) if kept else finding.without_causes(abstained(True), dataset.fit)


def _untried(dataset: Dataset, place: Where, without: Collection[str]) -> dict[Where, Candidate]:
    """Laws of position that may be a constant, on a joint that travels too little for them to be tried."""
    excursions, ((joint,), fit) = Excursions.of(dataset.fit.signals, dataset.limits), (place[1], dataset.fit)
    laws = [
        effect
        for effect in CATALOGUE.values()
        if "position" in effect.shapes and place[0] in effect.special_cases and effect.name not in without
        if excursions.moved[joint] and excursions.travel[joint] < effect.needs_travel
    ]
    made = fit.candidates(
        [(effect, place[1], settings) for effect in laws for settings in effect.settings(fit, place[1])]
    )
    return {form.place: form for form in reversed(made)}


def _freed(
    dataset: Dataset, scores: Sequence[HeldOutScore], place: Where, without: Collection[str]
) -> dict[Where, Candidate]:
    """Laws of position that explain about as much as the offset of a place, of which each was no more than that: where
    there is none they are as likely as friction.

    Not one that hardly changes: what is bent or stretched is slack somewhere, and on the straight line through a hose's
    or a spring's torque that is within half a turn.
    """
    (joint,) = place[1]
    q = np.concatenate([signals.q[signals.kept, joint] for signals in dataset.fit.signals])
    best = max((score.gain for score in scores if score.candidate.place == place), default=np.inf)
    found = {}
    for score in scores:
        form = score.candidate
        law = form.joints == (joint,) and "position" in form.effect.shapes and place[0] in form.effect.special_cases
        if not law or form.effect.name in without or not plausible(score):
            continue
        torque = form.blocks[joint] @ score.values * dataset.fit.sigma[:, joint]
        slope, middle = np.polyfit(q - q.mean(), torque, 1)
        slack = dataset.robot.joints[joint].prismatic or abs(middle) <= np.pi * abs(slope)
        if slack and score.gain >= (1 - dataset.limits.equal_gain) * best:
            found[form.place] = form
    return found


def _only(dataset: Dataset, finding: Finding, number: int, cause: Candidate, rivals: tuple[Where, ...]) -> Finding:
    """The finding with another cause in place of one, by number, and what equals it."""
    causes = tuple(cause if k == number else other for k, other in enumerate(finding.causes))
    equals = tuple(rivals if k == number else other for k, other in enumerate(finding.rivals))
    fit = dataset.fit.with_chosen(causes)
    return replace(finding, fit=fit, causes=causes, rivals=equals, verdict=named(bool(equals[0])))
