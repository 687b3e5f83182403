"""What a diagnosis leaves open: pairs of effects that its logs do not distinguish."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, islice

import numpy as np

from agent.diagnosis import Candidate, Diagnosis, EffectKey
from agent.model import CATALOGUE

_MOST_ASKED = 8  # pairs where no effect explains the gap, and effects that are not tested where nothing else is open


@dataclass(frozen=True, eq=False)
class Alternative:
    """One of two that are open: an effect with its form and parameters (k,); no form: nothing beyond the model."""

    effect: str
    joints: tuple[str, ...]
    form: Candidate | None
    values: np.ndarray

    def key(self, joint_names: Sequence[str]) -> EffectKey:
        """Effect and joints from 0."""
        return self.effect, tuple(joint_names.index(name) for name in self.joints)

    def text(self) -> str:
        """For people."""
        if self.form is None:
            return "no effect"
        return f"{self.effect} on {', '.join(self.joints)}" if self.joints else self.effect


@dataclass(frozen=True, eq=False)
class OpenPair:
    """Two that the logs do not distinguish, and the effects that are there whichever of them is true."""

    first: Alternative
    second: Alternative
    shared: tuple[Candidate, ...] = ()

    @property
    def names(self) -> tuple[str, str]:
        """Effects of the two."""
        return self.first.effect, self.second.effect


def open_pairs(diagnosis: Diagnosis) -> list[OpenPair]:
    """Return what is open after a diagnosis, most urgent first; nothing where everything is settled.

    `ambiguous`: every cause against what equals it. `unknown`: the leading effect against those that follow it. Where
    nothing else is open: effects that these logs would not have shown at their practical size, against none.
    """
    if diagnosis.verdict == "ambiguous":
        return list(_rivals(diagnosis))
    if diagnosis.verdict == "unknown":
        return list(islice(_leading(diagnosis), _MOST_ASKED))
    return list(islice(_untested(diagnosis), _MOST_ASKED))


def _rivals(diagnosis: Diagnosis) -> Iterator[OpenPair]:
    selected = diagnosis.selected
    for number, (cause, rivals) in enumerate(zip(selected.causes, selected.rivals, strict=True)):
        shared = tuple(c for k, c in enumerate(selected.causes) if k != number)
        forms = [cause, *(form for key in rivals if (form := _leading_form(diagnosis, key)) is not None)]
        for first, second in combinations([_alternative(diagnosis, form, shared) for form in forms], 2):
            yield OpenPair(first, second, shared)


def _leading_form(diagnosis: Diagnosis, key: EffectKey) -> Candidate | None:
    """The form of an effect in the likeliest hypothesis that has it."""
    forms = (c for hypothesis in diagnosis.selected.hypotheses for c in hypothesis.effects if c.key == key)
    return next(forms, None)


def _alternative(diagnosis: Diagnosis, form: Candidate, shared: Sequence[Candidate]) -> Alternative:
    values = diagnosis.dataset.fit.with_chosen((*shared, form)).values[-1]
    names = diagnosis.dataset.robot.joint_names
    return Alternative(form.effect.name, tuple(names[k] for k in form.joints), form, values)


def _leading(diagnosis: Diagnosis) -> Iterator[OpenPair]:
    ordered = sorted(diagnosis.selected.hypotheses, key=lambda h: -h.log_bayes_factor)
    singles = [h.effects[0] for h in ordered if len(h.effects) == 1]
    if singles:
        leader = _alternative(diagnosis, singles[0], ())
        yield from (OpenPair(leader, _alternative(diagnosis, form, ())) for form in singles[1:])


def _untested(diagnosis: Diagnosis) -> Iterator[OpenPair]:
    fit, robot = diagnosis.dataset.fit, diagnosis.dataset.robot
    names = robot.joint_names
    nothing = Alternative("none", (), None, np.empty(0))
    for entry in diagnosis.document.not_testable:
        effect = CATALOGUE[entry.effect]
        joints = () if entry.joint is None else tuple(names.index(name) for name in entry.joint.split(", "))
        if effect.transient or effect.shows_in != "torque" or joints not in effect.possible_joints(robot):
            continue
        if not (settings := effect.settings(fit, joints)):
            continue
        (form,) = fit.candidates([(effect, joints, settings[0])])
        yield OpenPair(Alternative(effect.name, tuple(names[k] for k in joints), form, np.empty(0)), nothing)
