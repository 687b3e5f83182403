"""The physical signature of the effects of gears, loads, bodies and sensors, measured on the plant."""

import numpy as np
import pytest
from scipy.signal import lfilter

from agent.core.errors import InputError
from agent.robot.dynamics import Dynamics
from fake_controller.actuation import EFFECTS, load_effect
from fake_controller.plant import Plant

HOME = np.array([0.2, 0.1, -1.4, 0.3, 0.5, -0.2])
AWAY = np.array([0.7, 0.5, -0.9, 1.1, -0.7, 1.0])
STILL = np.zeros((1, 6))


def effect(name, joints=(), **parameters):
    return {"effect": name, "joints": list(joints), "parameters": parameters}


@pytest.fixture(scope="module")
def motion(stop_and_go):
    return stop_and_go(np.array([HOME, AWAY, HOME]), 1.0, pause=0.2)


@pytest.fixture(scope="module")
def measured(ns16, motion):
    """(plant, position, torque) of one and the same machine and noise, with effects."""

    def run(*effects):
        plant = Plant(ns16, 7, effects)
        plant.rest(motion[0][0])
        parts = list(plant.run(*motion))
        return plant, np.concatenate([p.position for p in parts]), np.concatenate([p.torque for p in parts])

    return run


@pytest.fixture(scope="module")
def plain(measured):
    return measured()


def resting_torque(robot, q, *effects):
    """Mean (n,) of the measurement with the arm stationary at q."""
    plant = Plant(robot, 7, effects)
    plant.rest(q)
    return np.concatenate([part.torque for part in plant.hold(q, 0.4)]).mean(axis=0)


def test_a_payload_weighs_on_the_arm(ns16):
    extra = resting_torque(ns16, HOME, effect("payload", mass=8.0, centre=[0.05, 0.0, 0.1])) - resting_torque(
        ns16, HOME
    )
    jacobian = Dynamics(ns16).tcp_jacobian(HOME[None])[0]
    pose = Dynamics(ns16).tip_pose(HOME[None])[0]
    lever = pose[:3, :3] @ np.array([0.05, 0.0, 0.1])
    weight = np.array([0.0, 0.0, -8.0 * 9.80665])
    expected = -(jacobian[:3].T @ weight + jacobian[3:].T @ np.cross(lever, weight))
    assert np.allclose(extra, expected, atol=0.6)
    assert np.abs(expected).max() > 50.0


def test_a_link_mismatch_changes_torque_as_the_regressor_predicts(measured, plain, motion):
    plant, _, torque = measured(effect("inertial_mismatch", link=3, scale=1.1, points=[[4.0, 0.1, 0.2, 0.0]]))
    base = plain[0].machine
    change = plant.machine.parameters - base.parameters
    assert change[20] == pytest.approx(0.1 * base.parameters[20] + 4.0)
    assert np.all(change[:20] == 0)
    assert np.all(change[30:] == 0)
    q, qd = motion
    expected = Dynamics(plant.robot).regressor(q, qd, np.gradient(qd, 0.002, axis=0)) @ change
    difference = torque - plain[2]
    assert np.corrcoef(difference[:, 1], expected[:, 1])[0, 1] > 0.99


def test_a_tilted_base_loads_the_vertical_axis(ns16):
    upright, tilted = (resting_torque(ns16, HOME, *e) for e in ((), (effect("base_tilt", roll=0.03, pitch=-0.02),)))
    plant = Plant(ns16, 7)
    assert abs(upright[0]) < 1.0
    assert abs(tilted[0]) > 10.0
    gravity = 9.80665 * np.array([-0.02, -0.03, -1.0])
    expected = plant.machine.dynamics().with_gravity(gravity).inverse_dynamics(HOME[None], STILL, STILL)[0]
    assert np.allclose(tilted, expected, atol=2.0)


def test_a_spring_carries_part_of_the_gravity(ns16):
    spring = effect("gravity_spring", ["joint_2"], preload=1500.0, rate=2000.0, anchor=0.5, lever=0.2, angle=-0.3)
    for angle in (-0.3, 0.2, 0.6):
        q = HOME + np.array([0.0, angle - HOME[1], 0.0, 0.0, 0.0, 0.0])
        extra = resting_torque(ns16, q, spring) - resting_torque(ns16, q)
        length = np.sqrt(0.29 - 0.2 * np.cos(angle + 0.3))
        pull = 1500.0 + 2000.0 * (length - 0.3)
        assert extra[1] == pytest.approx(pull * 0.1 * np.sin(angle + 0.3) / length, abs=0.6)
        assert np.abs(np.delete(extra, 1)).max() < 0.5


def test_a_hose_pulls_back_and_lags_behind(ns16, stop_and_go):
    hose = effect("dress_pack", ["joint_4"], stiffness=6.0, centre=0.1, hysteresis=4.0, travel=0.05)
    ends = []
    for side in (-1.0, 1.0):
        q, qd = stop_and_go(np.array([HOME + side * 0.4 * np.eye(6)[3], HOME]), 0.8, pause=0.4)
        torque = []
        for effects in ((), (hose,)):
            plant = Plant(ns16, 7, effects)
            plant.rest(q[0])
            torque.append(np.concatenate([part.torque for part in plant.run(q, qd)])[:, 3])
        difference = torque[1] - torque[0]
        assert difference[50:190].mean() == pytest.approx(12.0 * np.sin(0.5 * (q[0, 3] - 0.1)), abs=0.1)
        # Just before the arm stops: on the move the hose's lag is complete.
        late = np.flatnonzero(np.abs(qd[:, 3]) > 0.2)[-1]
        ends.append(difference[late] - 12.0 * np.sin(0.5 * (q[late, 3] - 0.1)))
    assert ends[0] == pytest.approx(4.0, abs=0.5)
    assert ends[1] == pytest.approx(-4.0, abs=0.5)


def test_a_contact_acts_only_in_its_time_window(measured, plain):
    _, position, torque = measured(effect("contact", force=[60.0, 0.0, -80.0], start=0.5, duration=0.4))
    difference = torque - plain[2]
    assert np.array_equal(torque[:250], plain[2][:250])
    middle = slice(345, 355)  # 0.7 s
    jacobian = Dynamics(plain[0].robot).tcp_jacobian(position[350][None])[0]
    expected = -jacobian[:3].T @ np.array([60.0, 0.0, -80.0])
    assert np.allclose(difference[middle].mean(axis=0)[:3], expected[:3], rtol=0.1, atol=3.0)
    assert np.abs(difference[700:]).mean() < 0.05 * np.abs(expected).max()


def test_ripple_is_a_line_at_its_order_of_the_motor_angle(ns16):
    speed, samples = 0.4, 3000
    q = HOME + np.eye(6)[4] * (speed * 0.002 * np.arange(samples))[:, None] - np.eye(6)[4]
    qd = np.tile(np.eye(6)[4] * speed, (samples, 1))
    plant = Plant(ns16, 7, [effect("torque_ripple", ["joint_5"], amplitude=3.0, order=6.0)])
    plant.rest(q[0])
    parts = list(plant.run(q, qd))
    torque = np.concatenate([p.torque for p in parts])[500:, 4]
    angle = np.concatenate([p.position for p in parts])[500:, 4] * ns16.gear_ratios[4]
    lines = {order: 2 * abs(np.mean((torque - torque.mean()) * np.exp(-1j * order * angle))) for order in range(1, 13)}
    assert max(lines, key=lines.get) == 6
    assert lines[6] > 1.0
    assert 0.1 * lines[6] < lines[12] < 0.4 * lines[6]  # no pure sine
    assert all(lines[order] < 0.2 * lines[6] for order in lines if order not in (6, 12))


@pytest.fixture
def heavy_bar(make_arm):
    """One horizontal bar on joint_2 of two; its gravity torque changes sign at ±90 degrees."""
    return make_arm(2)


def test_an_elastic_joint_twists_under_gravity_and_rings(heavy_bar, stop_and_go):
    stiffness = 8000.0
    plant = Plant(heavy_bar, 3, [effect("joint_elasticity", ["joint_2"], stiffness=stiffness)])
    rest = np.zeros(2)
    plant.rest(rest)
    simulation = plant._simulation
    gravity = plant.machine.dynamics().inverse_dynamics(simulation.position[None], STILL[:, :2], STILL[:, :2])[0]
    twist = simulation.motor_position - simulation.position
    assert twist[1] == pytest.approx(gravity[1] / stiffness, rel=0.01)
    assert twist[0] == 0.0
    q, qd = stop_and_go(np.array([[0.0, 0.0], [0.0, 0.3]]), 0.12, pause=0.0)
    list(plant.run(q, qd))
    swing = []
    for _ in range(400):
        list(plant.hold(q[-1], 0.002))
        swing.append(simulation.position[1])
    swing = np.array(swing[100:]) - np.mean(swing[100:])
    crossings = np.flatnonzero(np.diff(np.sign(swing)))
    frequency = (len(crossings) - 1) / (2 * 0.002 * (crossings[-1] - crossings[0]))
    link = plant.machine.dynamics().mass_matrix(q[-1])[1, 1]
    # Between the link swinging on a held rotor and on a free one.
    low, high = (
        np.sqrt(stiffness * m) / (2 * np.pi) for m in (1 / link, 1 / link + 1 / plant.machine.reflected_rotors[1])
    )
    assert 0.9 * low < frequency < 1.1 * high


def test_backlash_is_a_jump_of_the_motor_when_the_load_changes_sides(heavy_bar, stop_and_go):
    gap = 2e-3
    plant = Plant(heavy_bar, 3, [effect("backlash", ["joint_2"], gap=gap)])
    simulation = plant._simulation
    twists = []
    q, qd = stop_and_go(np.array([[0.0, 1.2], [0.0, 1.9]]), 1.5, pause=0.3)  # over the top
    plant.rest(q[0])
    twists.append((simulation.motor_position - simulation.position)[1])
    list(plant.run(q, qd))
    twists.append((simulation.motor_position - simulation.position)[1])
    assert twists[0] < -0.5 * gap  # gravity pulls at either side, beyond the play
    assert twists[1] > 0.5 * gap
    assert twists[1] - twists[0] == pytest.approx(gap, rel=0.25)


def test_a_gear_too_stiff_to_simulate_is_refused(ns16):
    with pytest.raises(InputError, match=r"joint_6.*N·m/rad.*softer"):
        Plant(ns16, 1, [effect("joint_elasticity", ["joint_6"], stiffness=1e8)])


def test_with_wrist_coupling_the_second_motor_works_while_only_the_first_joint_moves(ns16, stop_and_go):
    q, qd = stop_and_go(np.array([HOME, HOME + 0.8 * np.eye(6)[4], HOME]), 1.0)
    torques = []
    for effects in ((), (effect("wrist_coupling", ["joint_5", "joint_6"], factor=0.5),)):
        plant = Plant(ns16, 7, effects)
        plant.rest(q[0])
        parts = list(plant.run(q, qd))
        assert np.abs(np.concatenate([part.position for part in parts]) - q).max() < 1e-2
        torques.append(np.concatenate([part.torque for part in parts]))
    difference = torques[1] - torques[0]
    friction = plant.machine.friction[5]
    for direction in (1.0, -1.0):
        fast = direction * qd[:, 4] > 0.8
        expected = direction * friction.steady(np.array([0.5]))[0]
        assert difference[fast, 5].mean() == pytest.approx(expected, rel=0.25)
    assert np.abs(difference[:, :4]).max() < 0.01 * ns16.nominal_torque.max()


def test_torque_constant_and_offset_change_what_is_measured(measured, plain):
    plant, position, torque = measured(
        effect("torque_constant", ["joint_2"], scale=1.1), effect("torque_offset", ["joint_3"], offset=12.0)
    )
    share = (plain[2][:, 1] / plant.machine.nominal[1]) ** 2
    assert np.allclose(torque[:, 1], plain[2][:, 1] * (1.0 + 0.1 * (1 + share / (3 + 3 * share))))
    shift = torque[:, 2] - plain[2][:, 2]
    assert np.abs(shift - 12.0).max() < 0.6 + 1e-9
    assert np.ptp(shift) > 0.01
    assert np.array_equal(position, plain[1])
    assert np.array_equal(plant.machine.torque_scale, [1.0, 1.1, 1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize("delay", [0.0075, 0.004, -0.003])
def test_a_delay_shifts_torque_against_position(measured, plain, delay):
    _, position, torque = measured(effect("time_delay", delay=delay))
    t = 0.002 * np.arange(len(torque))
    late, original = (torque[:, 1], plain[2][:, 1]) if delay > 0 else (position[:, 1], plain[1][:, 1])
    noise = 9.0 if delay > 0 else 1e-5
    shifted = np.interp(t - 0.5 * abs(delay), t, original)
    for _ in range(2):  # and two filters, whose lags are the rest
        kept = 0.25 * abs(delay) / (0.002 + 0.25 * abs(delay))
        shifted = lfilter([1.0 - kept], [1.0, -kept], shifted, zi=[kept * shifted[0]])[0]
    assert np.sqrt(np.mean((late - shifted)[10:] ** 2)) < noise
    assert np.abs(late - original).max() > 4 * noise


def test_an_encoder_offset_moves_the_arm_not_the_reading(measured, plain):
    plant, position, torque = measured(effect("encoder_offset", ["joint_2"], offset=0.02))
    assert np.abs(position - plain[1]).max() < 1e-3
    true = HOME - 0.02 * np.eye(6)[1]
    gravity = plant.machine.dynamics().inverse_dynamics(np.stack([HOME, true]), np.zeros((2, 6)), np.zeros((2, 6)))
    assert np.allclose((torque - plain[2])[20:90].mean(axis=0), gravity[1] - gravity[0], atol=0.5)
    assert abs(gravity[1] - gravity[0]).max() > 5.0


def test_another_interpolator_runs_another_path_from_start_to_end(ns16, motion):
    plant = Plant(ns16, 7, [effect("interpolator_mismatch", rate=0.95, blend=0.04)])
    q, qd = plant.executed_path(*motion)
    planned = motion[0]
    assert len(q) == pytest.approx(len(planned) / 0.95, abs=25)
    assert np.allclose(q[[0, -1]], planned[[0, -1]])
    assert np.allclose(np.cumsum(qd, axis=0) * 0.002 + q[0], q, atol=4e-3)
    assert np.abs(qd[[0, -1]]).max() == 0.0
    # It still passes the far corner, where both rest.
    assert np.abs(q - AWAY).max(axis=1).min() < 1e-9
    same = Plant(ns16, 7).executed_path(*motion)
    assert same[0] is motion[0]


def test_a_blend_cuts_corners(ns16):
    corner = np.zeros((400, 6))
    corner[:200, 0], corner[200:, 0] = np.linspace(0, 0.1, 200), 0.1
    corner[200:, 1] = np.linspace(0, 0.1, 200)
    plant = Plant(ns16, 7, [effect("interpolator_mismatch", blend=0.05)])
    path, _ = plant.executed_path(corner, np.gradient(corner, 0.002, axis=0))
    assert 1e-3 < np.linalg.norm(path - corner[200], axis=1).min() < 1e-2


def test_the_vocabulary_is_complete_and_all_effects_can_act_at_once(ns16, motion):
    everything = {
        "stribeck": (["joint_1"], {"rise": 15.0, "speed": 0.1}),
        "asymmetric_friction": (["joint_2"], {"coulomb": 0.2}),
        "load_dependent_friction": (["joint_3"], {"coefficient": 0.03}),
        "viscous_nonlinearity": (["joint_4"], {"torque": 2.0}),
        "thermal_friction": (["joint_5"], {"start": -10.0, "viscous_rate": 0.03}),
        "presliding": (["joint_6"], {"share": 0.5, "travel": 0.01}),
        "friction_change": (["joint_1", "joint_4"], {"coulomb": 1.3}),
        "joint_elasticity": (["joint_2"], {"stiffness": 2.5e5}),
        "backlash": (["joint_3"], {"gap": 3e-4}),
        "torque_ripple": (["joint_4"], {"amplitude": 1.0, "order": 2}),
        "wrist_coupling": (["joint_4", "joint_5"], {"factor": 0.02}),
        "payload": ([], {"mass": 5.0}),
        "gravity_spring": (["joint_2"], {"preload": 1000.0}),
        "dress_pack": (["joint_4"], {"stiffness": 2.0}),
        "base_tilt": ([], {"roll": 0.02}),
        "inertial_mismatch": ([], {"link": 2, "scale": 1.1}),
        "contact": ([], {"force": [30, 0, 0], "start": 0.5, "duration": 0.3}),
        "torque_constant": (["joint_1"], {"scale": 1.05}),
        "torque_offset": (["joint_6"], {"offset": 1.0}),
        "time_delay": ([], {"delay": 0.002}),
        "encoder_offset": (["joint_3"], {"offset": 0.01}),
        "interpolator_mismatch": ([], {"rate": 0.98}),
    }
    assert set(EFFECTS) == set(everything)
    effects = [effect(name, joints, **parameters) for name, (joints, parameters) in everything.items()]
    plant = Plant(ns16, 7, effects)
    q, qd = plant.executed_path(*motion)
    plant.rest(q[0])
    parts = list(plant.run(q, qd))
    position = np.concatenate([part.position for part in parts])
    assert np.abs(position - q).max() < 2e-2
    assert np.all(np.isfinite(np.concatenate([part.torque for part in parts])))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"effect": "stribek"}, "stribek.*known are.*stribeck"),
        ({"effect": "stribeck", "joint": ["joint_2"]}, "unknown key 'joint'"),
        (effect("stribeck", ["joint_2"], rise=1.0), "speed must be given"),
        (effect("stribeck", ["joint_2"], rize=1.0, speed=0.1), "rize.*did you mean rise"),
        (effect("stribeck", ["joint_9"], rise=1.0, speed=0.1), "no 'joint_9'"),
        (effect("stribeck", [], rise=1.0, speed=0.1), "name at least one"),
        (effect("stribeck", ["joint_2"], rise="big", speed=0.1), "'big' is not a finite number"),
        (effect("stribeck", ["joint_2"], rise=[1.0], speed=0.1), "one number"),
        (effect("stribeck", ["joint_2"], rise=1.0, speed=0.0), "speed: must be above 0"),
        (effect("payload", ["joint_2"], mass=1.0), "whole arm"),
        (effect("payload", mass=1.0, centre=[0.0]), "three numbers"),
        (effect("payload", mass=1.0, centre=0.0), "a list of numbers"),
        (effect("presliding", ["joint_2"], share=1.5, travel=0.01), "between 0 and 0.9"),
        (effect("inertial_mismatch", link=7), "whole number from 1 to 6"),
        (effect("inertial_mismatch", link=2, points=[[1.0, 0.0]]), r"\[mass, x, y, z\]"),
        (effect("wrist_coupling", ["joint_5"], factor=0.1), "joints: must be two"),
    ],
)
def test_an_invalid_effect_is_reported_with_entry_and_reason(ns16, data, message):
    with pytest.raises(InputError, match=message):
        Plant(ns16, 1, [data])


def test_refuses_two_gear_effects_on_one_joint(ns16):
    both = [effect("joint_elasticity", ["joint_2"], stiffness=3e5), effect("backlash", ["joint_2"], gap=1e-3)]
    with pytest.raises(InputError, match="joint_2 has another gear effect"):
        Plant(ns16, 1, both)


def test_effects_can_be_given_by_name(ns16):
    for name, form in EFFECTS.items():
        assert form.name == name
        assert form.__doc__
    assert isinstance(load_effect(effect("time_delay", delay=0.001)), EFFECTS["time_delay"])
