"""The paper's own estimator: its terms, its weights, no prior."""

import re
from dataclasses import replace

import numpy as np
import pytest

from agent.estimation import ESTIMATORS, EstimationSettings, Estimator, estimate
from agent.estimation.problem import Estimate
from agent.model import IdentifiedModel
from agent.robot.bodies import rigid_bodies
from fake_controller.plant import Plant
from tests.estimation.conftest import _links
from tests.small_arms import record

PAPER = EstimationSettings.create(method="paper")


@pytest.fixture
def log(arm, multisine, make_log):
    """Six seconds of a two-joint arm with friction that the paper's terms don't have; the second joint may rest."""

    def make(rest: bool = False, noise: float = 0.5):
        robot = arm(2)
        t = np.arange(3000) / 500
        q, qd, qdd = multisine(2, t)
        if rest:
            q[:, 1], qd[:, 1], qdd[:, 1] = 0.3, 0.0, 0.0
        links = _links(robot, q, qd, qdd)
        friction = 5 * np.tanh(qd / 0.01) + 3 * qd + 4 * np.sign(qd) * np.exp(-np.abs(qd) / 0.1) + 2
        noisy = links + friction + noise * np.random.default_rng(1).normal(size=q.shape)
        return robot, make_log(robot, t, q, noisy)

    return make


def test_always_uses_the_friction_terms_of_the_paper(log):
    robot, recorded = log()
    model = estimate(robot, [recorded], PAPER)
    assert model.method == "paper"
    assert [(term.axle, term.form) for term in model.terms] == [
        (axle, form) for axle in range(2) for form in ("coulomb", "viscous", "quadratic")
    ]
    assert any(note.startswith("The paper's own estimator") for note in model.notes)
    assert np.array_equal(model.weights[0], model.weights[1])  # a joint's rows, moving or not, count alike


def test_it_recovers_friction_of_its_own_form(ns16):
    """An emulated NS16 with stated f0, f1 and f2; gears, servos, counted positions and noise as they are.

    Stiction at reversals, which its form lacks, counts most in the wrist, so f0 trades with f1 and f2 there.
    """
    coulomb = np.array([68.0, 108.8, 50.4, 7.17, 12.8, 8.08])  # N·m
    stated = np.stack([coulomb, 0.6 * coulomb, -0.1 * coulomb], axis=1)  # N·m over powers of rad/s
    healthy = [record(Plant(ns16, 3), "healthy", 11)]
    links = estimate(ns16, healthy, EstimationSettings.create(method="consistent", friction="paper"))
    machine = Plant(ns16, 5, model=replace(links, values=np.append(links.base_values, stated)))
    found = estimate(ns16, [record(machine, name, seed) for name, seed in (("one", 31), ("two", 32))], PAPER)
    levels = found.values[len(found.independent) :].reshape(6, 3)
    for speed in (0.5, 1.0):  # rad/s
        powers = speed ** np.arange(3)
        assert levels @ powers == pytest.approx(stated @ powers, rel=0.05)
    assert levels[:3, 0] == pytest.approx(coulomb[:3], rel=0.05)
    assert levels[3:, 0] == pytest.approx(coulomb[3:], rel=0.25)


def test_does_not_depend_on_the_described_masses(log):
    robot, recorded = log()
    heavier = re.sub(r'(mass value|ixx|iyy|izz)="([^"]*)"', lambda m: f'{m[1]}="{7 * float(m[2])}"', robot.urdf)
    first, second = (estimate(r, [recorded], PAPER) for r in (robot, replace(robot, urdf=heavier)))
    assert np.allclose(first.values, second.values, rtol=1e-6, atol=1e-9 * np.abs(first.values).max())
    assert first.cutoff == second.cutoff


def test_equals_the_weighted_pseudo_inverse(log):
    from agent.estimation.signals.observation import observe

    robot, recorded = log()
    model = estimate(robot, [recorded], PAPER)
    observation = observe(rigid_bodies(robot), [recorded], replace(PAPER.filter, cutoff=model.cutoff))
    rows, torque = [], []
    for segment in observation.segments:
        columns = observation.friction(segment, model.terms, model.base_values)
        for index, block in observation.joint_rows(segment, model.terms, columns):
            full = np.zeros((len(block), len(model.values)))
            full[:, index] = block[:, :-1]
            rows.append(full)
            torque.append(block[:, -1])
    equal = np.linalg.lstsq(np.concatenate(rows), np.concatenate(torque), rcond=None)[0]
    scale = [1 / np.sqrt(np.mean((y - x @ equal) ** 2)) for x, y in zip(rows, torque, strict=True)]
    weighted = np.linalg.lstsq(
        np.concatenate([x * w for x, w in zip(rows, scale, strict=True)]),
        np.concatenate([y * w for y, w in zip(torque, scale, strict=True)]),
        rcond=None,
    )[0]
    assert np.allclose(model.values, weighted, rtol=1e-5, atol=1e-7 * np.abs(weighted).max())


def test_unidentifiable_parameters_have_minimum_norm_and_are_reported(log, tmp_path):
    robot, recorded = log(rest=True)
    model = estimate(robot, [recorded], PAPER)
    silent = [k for k, name in enumerate(model.names) if re.fullmatch(r"f[12]_2", name)]
    assert len(silent) == 2
    assert np.all(model.values[silent] == 0)
    assert np.all(model.standard_deviations[silent] > 0.05), "what the data do not show is not known"
    assert np.all(np.linalg.eigvalsh(model.covariance) > -1e-9 * np.abs(model.covariance).max())
    assert any("minimum norm" in note for note in model.notes)
    assert not any("prior (" in note for note in model.notes)
    model.save(tmp_path / "model.json")
    assert np.array_equal(IdentifiedModel.load(tmp_path / "model.json").values, model.values)


def test_unidentifiable_parameters_do_not_widen_other_intervals(log):
    """The second joint rests: its friction is anything, that of the first is as certain as it was."""
    deviations = []
    for rest in (False, True):
        robot, recorded = log(rest=rest)
        model = estimate(robot, [recorded], PAPER)
        first = [k for k, term in enumerate(model.terms) if term.axle == 0]
        deviations.append(model.standard_deviations[len(model.independent) :][first])
    assert np.all(deviations[1] < 3 * deviations[0])


def test_an_estimator_needs_one_function_and_one_registration(log, monkeypatch):
    def from_description(problem) -> Estimate:
        """No fit at all: what the description says."""
        found = ESTIMATORS["weighted"].fit(problem)
        return replace(found, parameters=problem.prior.mean, note="Nothing was fitted.")

    robot, recorded = log()
    monkeypatch.setitem(ESTIMATORS, "description", Estimator(from_description, friction="paper"))
    model = estimate(robot, [recorded], EstimationSettings.create(method="description"))
    assert model.method == "description"
    assert "Nothing was fitted." in model.notes
    assert np.all(model.values[len(model.base_values) :] == 0)
