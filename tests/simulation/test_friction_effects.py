"""The physical signature of every effect that lives in the friction of a drive, measured on the drive alone."""

import numpy as np
import pytest

from fake_controller.actuation import load_effect
from fake_controller.actuation.drive import Drive
from fake_controller.actuation.machine import draw_machine

DT = 0.0005
JOINT = 1  # joint_2


@pytest.fixture
def drive_with(ns16):
    """A drive of one and the same machine, with one effect on joint_2, and that machine."""

    def build(effect=None, **parameters):
        machine = draw_machine(ns16, 7)
        if effect is not None:
            load_effect({"effect": effect, "joints": ["joint_2"], "parameters": parameters}).install(machine)
        return Drive(machine), machine

    return build


def friction(drive, speeds, torque=0.0):
    """(S,) torque lost by joint_2 while it is driven at `speeds` (S,) and its motor gives `torque`."""
    still, lost = [0.0] * 6, []
    for speed in speeds:
        motion, push = list(still), list(still)
        motion[JOINT], push[JOINT] = speed, torque
        lost.append(torque - drive.step(0.0, still, motion, push, DT)[JOINT])
    return np.array(lost)


def steady(drive, speed, torque=0.0):
    return friction(drive, np.full(4000, speed), torque)[-1]


def test_stribeck_adds_friction_at_low_speed_only(drive_with):
    plain, _ = drive_with()
    drive, _ = drive_with("stribeck", rise=30.0, speed=0.1, shape=1.5)
    extra = {speed: steady(drive, speed) - steady(plain, speed) for speed in (0.001, 0.1, 1.0, -0.001, -1.0)}
    assert extra[0.001] == pytest.approx(30.0, rel=0.01)
    assert extra[0.1] == pytest.approx(15.0, rel=0.01)
    assert extra[-0.001] == pytest.approx(-30.0, rel=0.01)
    assert abs(extra[1.0]) < 1.0 > abs(extra[-1.0])


def test_asymmetric_friction_differs_by_direction(drive_with):
    drive, machine = drive_with("asymmetric_friction", coulomb=0.2, viscous_fraction=-0.1)
    curve = machine.friction[JOINT]
    for speed, coulomb, viscous in ((0.8, 1.2, 0.9), (-0.8, 0.8, 1.1)):
        drag = abs(curve.steady(np.array([speed]))[0]) - curve.coulomb
        assert abs(steady(drive, speed)) == pytest.approx(coulomb * curve.coulomb + viscous * drag, rel=1e-6)


def test_load_dependent_friction_grows_with_the_transmitted_torque(drive_with):
    plain, _ = drive_with()
    drive, drive_machine = drive_with("load_dependent_friction", coefficient=0.05)
    base = steady(plain, 0.5)
    for torque in (400.0, 900.0):
        lost = steady(drive, 0.5, torque)
        load, bearing = torque - lost, 0.1 * drive_machine.nominal[JOINT]
        assert lost - base == pytest.approx(0.05 * load**2 / (load + bearing), rel=1e-3)


def test_viscous_nonlinearity_bends_with_speed(drive_with):
    plain, _ = drive_with()
    thin, _ = drive_with("viscous_nonlinearity", torque=20.0, speed=0.1)
    churn, _ = drive_with("viscous_nonlinearity", cubic=5.0)
    slow, fast = (steady(thin, v) - steady(plain, v) for v in (0.5, 1.0))
    assert fast < 1.5 * slow  # less than in proportion
    slow, fast = (steady(churn, v) - steady(plain, v) for v in (0.5, 1.0))
    assert fast == pytest.approx(8.0 * slow, rel=1e-6)
    assert fast == pytest.approx(5.0, rel=1e-6)


def test_friction_change_scales_the_levels(drive_with):
    _, before = drive_with()
    _, after = drive_with("friction_change", coulomb=1.4, viscous=0.5)
    assert after.friction[JOINT].coulomb == pytest.approx(1.4 * before.friction[JOINT].coulomb)
    assert after.friction[JOINT].viscous == pytest.approx(0.5 * before.friction[JOINT].viscous)
    assert after.friction[0] == before.friction[0]


def test_thermal_friction_drifts_with_its_time_constant(drive_with):
    drive, machine = drive_with(
        "thermal_friction", start=-15.0, time_constant=2.0, viscous_rate=0.03, coulomb_rate=0.005
    )
    curve = machine.friction[JOINT]
    lost = friction(drive, np.full(24000, 0.8))
    warm = curve.steady(np.array([0.8]))[0]
    drag = warm - curve.coulomb
    cold = 1.075 * curve.coulomb + np.exp(0.45) * drag
    assert lost[200] == pytest.approx(cold, rel=0.03)
    assert lost[-1] == pytest.approx(warm, rel=0.003)
    assert 1.5 < DT * np.argmax(lost < warm + (cold - warm) / np.e) < 2.2


def test_thermal_friction_warms_itself_by_what_it_dissipates(drive_with):
    drive, _ = drive_with("thermal_friction", resistance=0.1, time_constant=0.5, coulomb_rate=0.005)
    lost = friction(drive, np.full(8000, 1.5))
    assert lost[-1] < 0.95 * lost[200]


def test_presliding_builds_friction_up_over_the_travel_after_a_reversal(drive_with):
    plain, _ = drive_with()
    drive, machine = drive_with("presliding", share=0.6, travel=0.01)
    there, back = np.full(4000, 0.05), np.full(4000, -0.05)  # 0.1 rad each way
    usual, lost = (friction(d, np.concatenate([there, back])) for d in (plain, drive))
    assert lost[3999] == pytest.approx(usual[3999], rel=1e-6)
    assert lost[-1] == pytest.approx(usual[-1], rel=1e-6)
    after = lost[4000:] - usual[4000:]  # what has not swung over yet
    moved = 0.05 * DT * np.arange(4000)
    assert after[np.searchsorted(moved, 0.002)] > 0.6 * machine.friction[JOINT].coulomb
    assert abs(after[np.searchsorted(moved, 0.021)]) < 0.01 * machine.friction[JOINT].coulomb


def test_presliding_is_hysteresis_in_position_not_in_time(drive_with):
    slow, fast = (drive_with("presliding", share=0.6, travel=0.01)[0] for _ in range(2))
    first = friction(slow, np.concatenate([np.full(4000, 0.04), np.full(400, -0.02)]))[-1]
    second = friction(fast, np.concatenate([np.full(4000, 0.04), np.full(200, -0.04)]))[-1]
    assert first == pytest.approx(second, rel=0.02)


def test_an_effect_leaves_the_other_joints_alone(drive_with):
    plain, _ = drive_with()
    drive, _ = drive_with("stribeck", rise=30.0, speed=0.1)
    still, moving = [0.0] * 6, [0.3] * 6
    for _ in range(1000):
        without, with_it = (d.step(0.0, still, moving, still, DT) for d in (plain, drive))
    same = np.isclose(without, with_it)
    assert same.tolist() == [True, False, True, True, True, True]
