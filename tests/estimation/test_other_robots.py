"""Defaults on arms and logs that nobody tuned them for: what is predicted on a motion that took no part in the fit.

The data come from formulas of their own: Pinocchio on the URDF with altered bodies, friction of another form than any
that is fitted, coarse encoders, noisy torque.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from agent.core.errors import InputError
from agent.data_quality.rigid_fit import FOLDS, FitSamples, RigidFit
from agent.estimation import EstimationSettings, are_placeholders, estimate
from agent.model import IdentifiedModel
from agent.recording import Log, import_log, read_log, scratch, write_log
from agent.robot import Dynamics, RobotDescription
from agent.robot.bodies import rigid_bodies
from agent.simulators.export import export_model
from agent.validation import predict_log, validate


@dataclass(frozen=True, eq=False)
class Truth:
    """One machine of a type: bodies within 15 % of the URDF's, rotors, friction of the axles."""

    robot: RobotDescription
    seed: int = 0

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n) at the joints."""
        rng = np.random.default_rng([self.seed, 1])
        model = pin.buildModelFromXML(self.robot.urdf)
        model.gravity.linear = np.array(self.robot.gravity)
        for k in range(1, model.njoints):
            body, factor = model.inertias[k], rng.uniform(0.85, 1.15)
            lever = body.lever + rng.uniform(-0.03, 0.03, 3)
            model.inertias[k] = pin.Inertia(factor * body.mass, lever, factor * body.inertia)
        data = model.createData()
        links = np.array([pin.rnea(model, data, *state) for state in zip(q, qd, qdd, strict=True)])
        reflected = 1e-4 * rng.uniform(0.8, 1.2, self.robot.dof) * self.robot.gear_ratios**2
        speed = qd @ self.robot.coupling.T
        size = np.array([20.0, 18.0, 12.0, 6.0, 5.0, 4.0, 3.0])[: self.robot.dof]
        friction = size * speed / np.sqrt(speed**2 + 0.01**2) * (1 + 0.15 / (1 + (speed / 0.1) ** 2))
        friction += 0.4 * size * speed / (1 + 0.1 * np.abs(speed))
        return links + (reflected * (qdd @ self.robot.coupling.T) + friction) @ self.robot.coupling

    def measured(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Position counted by 2¹⁴ a motor turn, torque with noise of half a percent of its largest."""
        counts = 2 * np.pi / 2**14 / np.abs(self.robot.gear_ratios)
        torque = self.torque(q, qd, qdd)
        noise = np.random.default_rng([seed, 2]).normal(size=torque.shape)
        return np.round(q / counts) * counts, torque + 0.005 * np.abs(torque).max(axis=0) * noise


@pytest.fixture
def recorded(multisine, make_log) -> Callable[..., Log]:
    """`recorded(robot, rate, seconds, seed, shape=None)`: a motion of the machine of seed 0; `shape` alters q, q̇, q̈."""

    def record(robot: RobotDescription, rate: float, seconds: float, seed: int, shape: Callable | None = None) -> Log:
        t = np.arange(round(rate * seconds)) / rate
        motion = multisine(robot.dof, t, seed, speed=2.0)
        motion = motion if shape is None else shape(t, *motion)
        q, torque = Truth(robot).measured(*motion, seed)
        return make_log(robot, t, q, torque, f"motion{seed}.mcap")

    return record


def held_out(model: IdentifiedModel, log: Log) -> float:
    return validate(model, [log]).overall.relative_error_all_joints


def through_file(log: Log, folder: Path) -> Log:
    path = folder / log.name
    write_log(path, log)
    return read_log(path)


@pytest.mark.parametrize(
    ("dof", "prismatic", "rate", "seconds", "most"),
    [
        pytest.param(1, (0,), 1000, 20, 0.03, id="slide"),
        pytest.param(2, (), 100, 40, 0.03, id="2R at 100 Hz"),
        pytest.param(3, (0, 2), 250, 20, 0.03, id="PRP"),
        pytest.param(6, (), 500, 20, 0.03, id="6R", marks=pytest.mark.verify),
        pytest.param(7, (), 400, 15, 0.03, id="7R", marks=pytest.mark.verify),
        pytest.param(6, (), 5000, 6, 0.03, id="5 kHz"),
    ],
)
def test_held_out_error_is_small_on_any_arm(arm, recorded, tmp_path, dof, prismatic, rate, seconds, most):
    robot = arm(dof, prismatic, seed=dof)
    fit, other = (through_file(recorded(robot, rate, seconds, seed), tmp_path) for seed in (1, 2))
    model = estimate(robot, [fit])
    assert held_out(model, other) < most
    # and the model knows how small: elsewhere than where it was fitted its 95 % intervals still hold
    prediction = predict_log(model, other)
    inside = np.abs(prediction.error) < prediction.half_width
    assert np.all(inside.mean(axis=0) > 0.8)


@pytest.mark.parametrize("late", [False, True], ids=["uneven sampling", "late stamps"])
@pytest.mark.parametrize("true_rate", [pytest.param(400.0, marks=pytest.mark.verify), 400.15])
def test_jittered_stamps_cost_little(arm, multisine, make_log, tmp_path, late, true_rate):
    """Every stamp is off by up to three tenths of a period, and the log says 400 Hz."""
    robot = arm(4)
    rng = np.random.default_rng(5)
    logs = []
    for seed in (1, 2):
        even = 1 + np.arange(8000) / true_rate
        stamps = even + rng.uniform(-0.3, 0.3, len(even)) / true_rate
        q, torque = Truth(robot).measured(*multisine(4, even if late else stamps, seed, speed=2.0), seed)
        log = make_log(robot, stamps - stamps[0], q, torque, f"{seed}.mcap", rate=400.0)
        logs.append(through_file(log, tmp_path))
    assert held_out(estimate(robot, logs[:1]), logs[1]) < 0.02


def test_motor_currents_of_a_coupled_wrist_with_broken_last_rows(arm, multisine, tmp_path):
    coupling = np.eye(6)
    coupling[5, 4] = 0.8
    plain = arm(6, coupling=coupling)
    robot = replace(plain, joints=tuple(replace(joint, torque_constant=0.4) for joint in plain.joints))
    (tmp_path / "map.yaml").write_text(
        "side: motor\ntime: {column: t, unit: ms}\nposition: {columns: [m1, m2, m3, m4, m5, m6], unit: deg}\n"
        "effort: {columns: [i1, i2, i3, i4, i5, i6], unit: A}\n"
    )
    logs = []
    for seed in (1, 2):
        t = np.arange(10_000) / 500
        q, torque = Truth(robot).measured(*multisine(6, t, seed, speed=2.0), seed)
        motor = q @ coupling.T * robot.gear_ratios
        current = torque @ np.linalg.inv(coupling) / robot.gear_ratios / 0.4
        header = ",".join(["t", *(f"m{k}" for k in range(1, 7)), *(f"i{k}" for k in range(1, 7))])
        table = tmp_path / f"{seed}.csv"
        columns = np.column_stack([1000 * t, np.degrees(motor), current])
        np.savetxt(table, columns, delimiter=",", header=header, comments="")
        with open(table, "a", encoding="utf-8") as file:
            file.write("20000.0,1.0,2.0\n20002.0,nan,,")
        notes = import_log(robot, tmp_path / "map.yaml", [table], tmp_path / f"{seed}.mcap")
        assert any("rows" in str(note) for note in notes)
        logs.append(read_log(tmp_path / f"{seed}.mcap", robot))
    model = estimate(robot, logs[:1])
    assert held_out(model, logs[1]) < 0.03
    sizes = dict(zip(model.names, model.values, strict=True))
    assert sizes["f0_6"] == pytest.approx(4, rel=0.3)
    assert sizes["f0_5"] == pytest.approx(5, rel=0.3)


def test_a_joint_that_never_moves_is_named_and_spoils_nothing(arm, recorded):
    robot = arm(6)

    def hold(t, q, qd, qdd):
        still = np.array([1, 1, 0, 1, 1, 1])
        return q * still + 0.3 * (1 - still), qd * still, qdd * still

    fit, other = (recorded(robot, 500, 20, seed, hold) for seed in (1, 2))
    model = estimate(robot, [fit])
    assert held_out(model, other) < 0.04
    assert np.all(np.isfinite(model.values))
    assert np.all(np.isfinite(model.covariance))
    assert any("J3" in note or "f0_3" in note or "joint_3" in note for note in model.notes)


def test_a_urdf_without_any_inertia_is_enough(arm, recorded, tmp_path):
    robot = arm(6, seed=1)
    bare = replace(robot, urdf=re.sub("<inertial>.*?</inertial>", "", robot.urdf))
    fit, other = (recorded(robot, 500, 20, seed) for seed in (1, 2))
    model = estimate(bare, [fit], EstimationSettings.create(method="consistent"))
    assert held_out(model, other) < 0.03
    assert all(path.is_file() for path in export_model(model, tmp_path))


def test_a_log_of_mostly_standstill_does_not_spoil_the_fit(arm, recorded):
    robot = arm(3)

    def mostly_still(t, q, qd, qdd):
        # the same motion run by a clock that stands four fifths of the time
        phase = (t % 5) - 4
        s = np.clip(phase, 0, 1)
        warp = t // 5 + s**3 * (10 - 15 * s + 6 * s**2)
        rate = np.where(phase > 0, 30 * s**2 * (1 - s) ** 2, 0.0)
        change = np.where(phase > 0, 60 * s * (1 - s) * (1 - 2 * s), 0.0)
        position, velocity, acceleration = (
            np.stack([np.interp(warp, t, column) for column in array.T], axis=1) for array in (q, qd, qdd)
        )
        rate, change = rate[:, None], change[:, None]
        return position, velocity * rate, acceleration * rate**2 + velocity * change

    fit = recorded(robot, 500, 50, 1, mostly_still)
    moving = recorded(robot, 500, 20, 2)
    model = estimate(robot, [fit])
    assert held_out(model, moving) < 0.06
    assert any("tandstill" in note for note in model.notes)


def test_refuses_a_log_without_motion(arm, recorded):
    robot = arm(3)

    def rest(t, q, qd, qdd):
        return 0 * q + 0.4, 0 * qd, 0 * qdd

    with pytest.raises(InputError, match="no joint moves, so there is nothing to estimate from"):
        estimate(robot, [recorded(robot, 500, 10, 1, rest)])


@pytest.mark.parametrize("method", ["weighted", "consistent", "huber"])
def test_methods_agree_on_good_data(arm, recorded, method):
    robot = arm(4, seed=3)
    fit, other = (recorded(robot, 500, 20, seed) for seed in (1, 2))
    assert held_out(estimate(robot, [fit], EstimationSettings.create(method=method)), other) < 0.03


def test_drops_and_reports_a_wrong_link_prior(arm, multisine, make_log):
    robot = arm(3)
    t = np.arange(10_000) / 500
    q, qd, qdd = multisine(3, t)
    rigid = rigid_bodies(robot)
    weights = 40 * rigid.dynamics.inverse_dynamics(q, qd, qdd) + 20 * qd  # forty times as heavy as it is described
    model = estimate(robot, [make_log(robot, t, q, weights)])
    assert model.provenance["link_prior"] != "description"
    assert any("left out of the prior" in note and "Gravity torque" in note for note in model.notes)
    assert model.held_out_rmse.max() < 0.02 * np.abs(weights).max()


@pytest.mark.parametrize(("factor", "believed"), [(1.0, True), (0.05, False)])
def test_a_description_confirmed_by_the_motion_is_used_as_a_prior(arm, multisine, make_log, factor, believed):
    robot = arm(6, seed=3002)
    t = np.arange(1000) / 50
    q, qd, qdd = multisine(6, t, seed=3002)
    sizes = np.array([40.0, 80, 50, 20, 12, 6])
    torque = rigid_bodies(robot).dynamics.inverse_dynamics(q, qd, qdd) + sizes * (0.1 * qd + 0.15 * np.sign(qd))
    torque += 0.02 * sizes * np.random.default_rng(1).normal(size=q.shape)
    said = re.sub(r'(mass value|i[xyz]{2})="([^"]*)"', lambda m: f'{m[1]}="{factor * float(m[2])}"', robot.urdf)
    model = estimate(replace(robot, urdf=said), [make_log(robot, t, q, torque)], EstimationSettings.create(cutoff=10))
    assert (model.provenance["link_prior"] == "description") == believed


def test_links_of_equal_mass_are_placeholders():
    def links(*masses: float) -> np.ndarray:
        return np.concatenate([[mass, *[0.1 * mass] * 9] for mass in masses])

    assert are_placeholders(links(0, 0, 0))
    assert are_placeholders(links(3, 3, 3, 3, 3, 3.2))
    assert not are_placeholders(links(3.7, 8.4, 2.3, 1.2, 1.2, 0.2))
    assert not are_placeholders(links(5.0))


@pytest.mark.parametrize(("count", "expected"), [(16, True), (400, False)])
def test_a_fit_that_cannot_predict_held_out_data_blames_no_joint(arm, multisine, count, expected):
    robot = arm(7, seed=1)
    q, qd, qdd = multisine(7, np.linspace(0, 1 + count / 10, count), seed=1)
    rng = np.random.default_rng(1)
    fold = np.arange(count) * FOLDS // count
    q += 1.5 * rng.normal(size=(FOLDS, 7))[fold]  # every part of the log is elsewhere
    samples = FitSamples(q, qd, qdd, np.zeros_like(q), np.sign(qd), fold, float(count))
    torque = RigidFit(Dynamics(robot), samples).columns @ rng.normal(size=14 * 7)
    torque += 0.1 * np.std(torque, axis=0) * rng.normal(size=q.shape)
    samples = FitSamples(q, qd, qdd, torque, samples.direction, fold, float(count))
    assert RigidFit(Dynamics(robot), samples).says_something() is not expected


def test_a_model_is_the_same_from_memory_and_from_disk(arm, multisine, make_log, tmp_path, monkeypatch):
    robot = arm(2)
    t = np.arange(6000) / 500
    q, qd, _ = multisine(2, t)
    torque = 3 * np.sign(qd) + qd + np.random.default_rng(0).normal(size=q.shape)
    write_log(tmp_path / "long.mcap", make_log(robot, t, q, torque, reference_position=q))
    settings = EstimationSettings.create(method="weighted")
    models = []
    for in_memory in (2**30, 0):
        monkeypatch.setattr(scratch, "_IN_MEMORY", in_memory)
        models.append(estimate(robot, [read_log(tmp_path / "long.mcap", robot)], settings))
    assert np.array_equal(models[0].values, models[1].values)
    assert np.array_equal(models[0].covariance, models[1].covariance)
