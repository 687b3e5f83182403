"""What a healthy arm has of the effects: how much, in which form, from which logs."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from agent.core import InputError
from agent.diagnosis.hypotheses import healthy
from agent.model import HealthyEffect

ROBOT = SimpleNamespace(joint_names=("base", "elbow"))


@dataclass(frozen=True)
class Model:
    """As much of a model as is asked for."""

    robot: Any = field(default_factory=lambda: ROBOT)
    cutoff: float = 12.0
    healthy: tuple[HealthyEffect, ...] = ()


def fit_of(*told: tuple[str, int, float, float | None], once: str = "") -> SimpleNamespace:
    """Forms as effect, joint, gain and torque over nominal; each has its gain as its parameter."""
    forms = [SimpleNamespace(place=(e, (j,)), once=e == once, settings={"speed": gain}) for e, j, gain, _ in told]
    return SimpleNamespace(forms=forms, gains=np.array([one[2] for one in told]), sizes=[one[3] for one in told])


@pytest.fixture
def learned(monkeypatch):
    """What is learned from fits by what they judge; models of other logs know which these are."""
    fits: dict[Any, Any] = {}

    def estimate(robot, logs, settings):
        if not fits.get(names := tuple(log.name for log in logs), True):
            raise InputError("too little")
        assert (robot, settings.filter.cutoff) == (ROBOT, 12.0)
        return names

    def assemble(robot, model, logs, cutoff):
        assert (robot, cutoff) == (ROBOT, 12.0)
        by = "itself" if isinstance(model, Model) else model
        return SimpleNamespace(fit=fits[by, tuple(log.name for log in logs)])

    def evidence(fit, forms, healthy):
        assert (forms, healthy) == (fit.forms, ())
        sizes = [{} if size is None else {0: 0.0, 1: size} for size in fit.sizes]
        torque = SimpleNamespace(
            torque=lambda number, values: {j: size * values[0] for j, size in sizes[number].items()}
        )
        gains = {"at nothing": (fit.gains, [np.ones(1)] * len(fit.forms))}
        return SimpleNamespace(nothing="at nothing", shortlist_gains=gains.__getitem__, pool=torque)

    for name, stub in (("estimate", estimate), ("assemble", assemble), ("Evidence", evidence)):
        monkeypatch.setattr(healthy, name, stub)
    monkeypatch.setattr(healthy, "Search", lambda fit: SimpleNamespace(forms=lambda: fit.forms))

    def learn(known, *names, held_out=()):
        fits.clear()
        fits.update(known)
        logs = [[SimpleNamespace(name=name, t=np.array([5.0, 65.0])) for name in some] for some in (names, held_out)]
        found = healthy.with_healthy_effects(Model(), *logs).healthy
        return {(one.effect, one.joints): (one.size, one.settings) for one in found}

    return learn


def left_out(**fits: Any) -> dict[Any, Any]:
    """Fits of single logs by models of the others."""
    return {(tuple(other for other in fits if other != name), (name,)): fit for name, fit in fits.items()}


def test_the_mean_square_over_logs_that_were_left_out_or_all_together_is_what_an_arm_has(learned):
    """Over two less than there are; in the form with the largest gain, and of one effect the best form of each log."""
    together = [("spring", 0, 2.0, 0.02), ("offset", 1, 1.0, 0.001), ("tilt", 0, -1.0, 0.5), ("push", 0, 9.0, 0.5)]
    first = fit_of(("offset", 1, 3.0, 0.3), ("offset", 1, 5.0, 0.03), ("spring", 0, 1.0, 0.01))
    fourth = fit_of(("offset", 1, 0.0, 0.1), ("idle", 0, 1.0, None))
    known = left_out(a=first, b=fit_of(("offset", 1, 4.0, 0.04)), c=fit_of(), d=fourth)
    known["itself", ("a", "b", "c", "d")] = fit_of(*together, once="push")
    found = learned(known, *"abcd")
    assert found == {
        ("spring", ("base",)): (pytest.approx(0.02), {"speed": 2.0}),
        ("offset", ("elbow",)): (pytest.approx(0.05 / np.sqrt(2)), {"speed": 5.0}),
        ("idle", ("base",)): (0.0, {"speed": 1.0}),
    }
    known["b", "c", "d"] = False  # too little for a model
    assert learned(known, *"abcd")["offset", ("elbow",)] == (pytest.approx(0.04), {"speed": 4.0})
    known["itself", ("z",)] = fit_of(("tilt", 0, 1.0, 0.1))
    assert ("spring", ("base",)) not in learned(known, *"abcd", held_out=["z"])
    assert learned(known, "a") == {}
    assert learned(known, "a", held_out=["z"]) == {("tilt", ("base",)): (pytest.approx(0.1), {"speed": 1.0})}
    two = {**left_out(a=first, b=fit_of()), ("itself", ("a", "b")): fit_of(("tilt", 0, 1.0, 0.1))}
    assert {name: size for (name, _), (size, _) in learned(two, "a", "b").items()} == pytest.approx(
        {"tilt": 0.1, "offset": 0.03, "spring": 0.01}
    )


def test_only_the_first_minute_of_a_log_is_looked_at(monkeypatch):
    def log(last):
        return SimpleNamespace(t=np.array([5.0, 6.0, last]), between=lambda *times: SimpleNamespace(t=np.array(times)))

    seen = []
    monkeypatch.setattr(
        healthy, "assemble", lambda robot, model, logs, cutoff: seen.extend(logs) or SimpleNamespace(fit=None)
    )
    monkeypatch.setattr(healthy, "_explained", lambda fit: [])
    healthy.with_healthy_effects(Model(), [], [log(65.0), log(65.1)])
    assert [one.t.tolist() for one in seen] == [[5.0, 6.0, 65.0], [5.0, 65.0]]
    assert [hasattr(one, "between") for one in seen] == [True, False]


def test_what_an_arm_has_is_known_in_its_form_and_in_one_of_every_other_kind(monkeypatch):
    grids = {(0,): [{"speed": 1.0}, {"speed": 2.0}, {}], (1,): [{}, {"way": 1.0}, {"way": 2.0}], (0, 1): [{}]}
    spring = SimpleNamespace(settings=lambda seen, joints: grids[joints] if seen is fit else [])
    monkeypatch.setattr(healthy, "CATALOGUE", {"spring": spring, "offset": spring})

    def candidates(wanted):
        return [SimpleNamespace(of=(e, j, s), stable=(j, s) != ((1,), {})) for e, j, s in wanted]

    fit = SimpleNamespace(candidates=candidates)
    known = [("gone", ("base",), {}, 0.3), ("spring", ("base",), {"speed": 7.0}, 0.1)]
    known += [
        ("offset", ("elbow",), {"speed": 7.0}, 0.2),
        ("spring", ("wrist",), {}, 0.4),
        ("spring", ("base", "elbow"), {}, 0.5),
    ]
    model = Model(healthy=tuple(HealthyEffect(*one) for one in known))
    own = [(spring, (0,), {"speed": 7.0}, 0.1), (spring, (0,), {}, 0.1)]
    for without, more in (((), [(spring, (1,), {"way": 2.0}, 0.2)]), (("offset",), [])):
        found = healthy.healthy_on(fit, model, without)
        assert [(*form.of, size) for form, size in found] == [*own, *more, (spring, (0, 1), {}, 0.5)]
    assert healthy.healthy_on(fit, Model()) is None
