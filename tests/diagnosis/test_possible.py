"""Parameters that no machine can have are no causes, and what stiction leaves open is no gap."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from agent.diagnosis.gap.torque_gap import held_out_gap, rms
from agent.diagnosis.rows.fit import Fit
from agent.model.effect_inputs import NominalModel
from agent.model.effects import CATALOGUE


@pytest.fixture(scope="module")
def reference(baseline) -> NominalModel:
    return NominalModel(baseline)


def level(reference: NominalModel, form: str) -> float:
    model = reference.model
    at = next(k for k, term in enumerate(model.terms) if (term.form, term.axle) == (form, 1))
    return float(model.values[len(model.independent) + at])


def possible(reference, name, settings, values) -> bool:
    effect = CATALOGUE[name]
    joints = effect.possible_joints(reference.robot)[1 if effect.scope == "joint" else 0]
    return effect.plausible(settings, values) and effect.possible(reference, joints, settings, values)


def test_friction_does_not_fall_below_zero(reference):
    coulomb, viscous = level(reference, "coulomb"), level(reference, "viscous")
    assert coulomb > 0
    for factor, fine in ((0.5, True), (-0.5, True), (-1.5, False)):
        change = {"coulomb_change": factor * coulomb}
        assert possible(reference, "friction_change", {"coulomb": 1.0}, change) == fine
        assert possible(reference, "stribeck", {"speed": 0.1, "shape": 1.0}, {"rise": factor * coulomb}) == fine
        drift = {"coulomb_change": 0.0, "coulomb_drift": 0.0, "viscous_change": 0.0, "viscous_drift": factor * viscous}
        assert possible(reference, "thermal_friction", {"time_constant": 30.0}, drift) == fine
        asymmetry = {"coulomb_asymmetry": abs(factor) * coulomb}
        assert possible(reference, "asymmetric_friction", {"coulomb": 1.0}, asymmetry) == fine


def test_no_gear_warms_up_in_a_second_and_no_load_has_negative_inertia(reference):
    drift = {"coulomb_change": 0.1, "coulomb_drift": 0.1, "viscous_change": 0.0, "viscous_drift": 0.0}
    for form, fine in (({"way": 20.0}, True), ({"way": 0.3}, False), ({"time_constant": 0.9}, False)):
        assert possible(reference, "thermal_friction", form, drift) == fine
    load = {"mass": 2.0, "moment_x": 0.2, "moment_y": 0.0, "moment_z": 0.0}
    settings = {"m0": 2.0, "hx0": 0.2, "hy0": 0.0, "hz0": 0.0}
    for inertia, fine in ((0.01, True), (-0.02, False)):
        assert possible(reference, "payload", settings, {**load, "inertia": inertia}) == fine


def test_a_load_without_a_clear_inertia_of_its_own_is_compared_as_a_point_too():
    """Noise takes a point's inertia below zero, as which a ball is impossible and the load would not be found."""

    def forms(inertia: float) -> list[bool]:
        fitted = SimpleNamespace(fit=lambda *_: np.array([2.0, 0.12, 0.0, 0.1, inertia]))
        return ["inertia" in CATALOGUE["payload"].names(form) for form in CATALOGUE["payload"].settings(fitted, ())]

    assert [forms(inertia) for inertia in (-0.0007, 0.0005, 0.01)] == [[True, False], [True, False], [True]]


def test_a_spring_torque_stays_within_the_joint_limit(reference):
    nominal = float(reference.scale[1])
    for size, fine in ((0.5 * nominal, True), (-13905.0 * max(nominal / 100, 1.0), False)):
        assert possible(reference, "gravity_spring", {"harmonics": 1.0}, {"cosine_1": size, "sine_1": 0.0}) == fine
        assert possible(reference, "dress_pack", {}, {"constant": 0.0, "stiffness": size}) == fine
        hardening = {"constant": 0.0, "stiffness": 0.0, "quadratic": 0.0, "cubic": size}
        assert possible(reference, "dress_pack", {"middle": 0.0, "reach": 0.5}, hardening) == fine


def test_torque_within_stiction_at_standstill_keeps_no_cause_from_closing_the_gap(diagnosed):
    found = diagnosed(1)
    fit = found.selected.fit
    rest = fit.near_rest & (np.arange(fit.reference.robot.dof) == 1)
    rows = [np.column_stack([part[:, :-1], part[:, -1] + 1.5 * rest[:, j]]) for j, part in enumerate(fit.rows)]
    open_at_rest = Fit(replace(fit.data, rows=rows), fit.chosen)
    residual = found.dataset.residual + 1.5 * rest * fit.sigma
    gap = held_out_gap(replace(found.dataset, residual=residual), open_at_rest)
    assert rms(open_at_rest.held_out())[1] > 2 * rms(fit.held_out())[1], "the error is there"
    assert gap.after.max() < 2 * found.gap.after.max(), "and it is no gap"
    assert gap.closure > 0.9


def test_a_contact_is_reported_with_link_force_and_times(reference):
    pushes = {1: (1.0, 6.0, 2.0, 0.5), 2: (0.0, 4.0, 4.0, 1.0)}
    keys = ("log", "link", "start", "duration")
    settings = {f"{key}_{n}": value for n, push in pushes.items() for key, value in zip(keys, push, strict=True)}
    force = {f"force_{axis}_{n}": 10.0 * n + k for n in pushes for k, axis in enumerate("xyz")}
    found = CATALOGUE["contact"].reported(reference, settings, force)
    first = {"link": 6.0, "force_x": 10.0, "force_y": 11.0, "force_z": 12.0, "log": 1.0, "start": 2.0, "end": 2.5}
    assert {key: value for key, value in found.items() if not key.endswith("_2")} == first
    assert [found[f"{key}_2"] for key in ("link", "force_z", "log", "start", "end")] == [4.0, 22.0, 0.0, 4.0, 5.0]


def test_tries_couplings_of_any_ratio(reference):
    tried = [abs(settings["ratio"]) for settings in CATALOGUE["wrist_coupling"].settings(None, (4, 5))]
    assert min(tried) <= 0.05
    assert max(tried) == 2.0


def test_a_coupled_shaft_has_positive_friction_and_inertia(reference):
    settings = {"ratio": 0.5, "besides": 1.0, "shaft": 1.0}
    fastest = float(reference.robot.max_velocity[4])  # of the pair that is tried
    for coulomb, viscous, inertia, expected in (
        (1.0, 0.5, 0.1, True),
        (1.0, -0.05, 0.1, True),
        (1.0, -0.5, 0.1, False),
        (-0.5, 1.0, 0.1, False),
        (1.0, 0.5, -0.1, False),
    ):
        values = {"coulomb": coulomb, "viscous": viscous / fastest, "inertia": inertia}
        assert possible(reference, "wrist_coupling", settings, values) is expected


@pytest.mark.parametrize("kind", [{}, {"besides": 1.0}])
def test_a_negligible_coupling_ratio_is_rejected(reference, kind):
    """Friction at a speed that is almost the axle's own is the axle's own friction."""
    values = {"coulomb": 1.0, "viscous": 0.1} if kind else {"rotor": 1e-4, "share": 1.0}
    for ratio, expected in ((0.01, False), (-0.03, False), (0.05, True), (-1.0, True)):
        assert possible(reference, "wrist_coupling", {"ratio": ratio, **kind}, values) is expected
