"""Faults of recorded data are named, with joints and share of samples; healthy data is accepted."""

import re
from dataclasses import replace

import numpy as np
import pytest

from agent.core import Console, InputError, RejectedError
from agent.data_quality import check_quality, fitted_doubts, spoiled
from agent.estimation import estimate
from agent.pipeline.checked_logs import check_plausible
from agent.pipeline.declared_effort import check_torque, with_declared_effort
from agent.pipeline.identify import FitQuestion, estimate_files, validate_files
from agent.recording import read_log, write_log
from agent.robot import Dynamics, load_robot
from agent.simulators import load_simulator
from tests.estimation.conftest import _arm, _log, _multisine

FRICTION = np.array([3.0, 2.0, 1.0, 0.5, 0.3])


def motion(robot, seed=1, rate=200.0, seconds=18.0, gravity=None, name="a.mcap", noise=0.01, carried=True):
    """A log of a healthy arm: bodies as described, Coulomb and viscous friction, rotors; `gravity` (3,) is the real one
    and `carried` says whether the torques have it in them."""
    n = robot.dof
    q, qd, qdd = _multisine(n, np.arange(0, seconds, 1 / rate), seed)
    real = robot if gravity is None else replace(robot, gravity=tuple(gravity))
    dynamics = Dynamics(real)
    bodies = dynamics.standard_parameters()
    torque = dynamics.regressor(q, qd, qdd) @ bodies
    if not carried:
        torque -= dynamics.regressor(q, 0 * q, 0 * q) @ bodies
    torque = torque + FRICTION[:n] * np.tanh(qd / 0.01) + 0.8 * FRICTION[:n] * qd + 0.3 * FRICTION[:n] * qdd / 5
    torque += noise * np.std(torque, axis=0) * np.random.default_rng(seed + 50).normal(size=torque.shape)
    return _log(robot, np.arange(len(q)) / rate, q, torque, name)


def refusals(robot, *logs):
    return [finding for finding in check_quality(robot, list(logs)) if finding.refuses]


@pytest.fixture(scope="module")
def robot():
    return _arm(4, seed=3)


@pytest.mark.parametrize(("seed", "rate", "seconds"), [(1, 200.0, 18.0), (2, 100.0, 30.0), (3, 333.0, 12.0)])
def test_accepts_healthy_logs_without_a_warning(robot, seed, rate, seconds):
    log = motion(robot, seed, rate, seconds)
    assert check_quality(robot, [log]) == []
    assert spoiled(robot, [log]) == []


@pytest.mark.parametrize(("dof", "seed", "seconds"), [(3, 4, 15.0), (4, 5, 10.0), (5, 6, 25.0)])
def test_torque_without_gravity_is_refused_with_what_to_record(dof, seed, seconds):
    arm = _arm(dof, seed=seed)
    (found,) = refusals(arm, motion(arm, seed, seconds=seconds, carried=False))
    assert "carry no gravity" in found.text
    assert "gravity-compensated effort" in found.advice
    assert found.joints


def test_detects_missing_gravity_in_slow_motion_from_the_described_masses(robot):
    """Without inertia in it nothing but friction is left, which any mass moments near zero fit."""
    log = motion(robot, 7)
    t = log.t * 6
    q, qd, _ = _multisine(4, log.t / 6, 7)
    torque = FRICTION[:4] * np.tanh(qd / 6 / 0.01) + 0.02 * np.random.default_rng(0).normal(size=q.shape)
    slow = _log(robot, t, q, torque)
    (found,) = refusals(robot, slow)
    assert "carry no gravity" in found.text


@pytest.mark.parametrize(("angle", "about"), [(12.0, 0.7), (33.0, 2.5), (58.0, 4.0), (77.0, 5.5)])
def test_the_mounting_is_found_at_any_angle(robot, angle, about):
    a = np.radians(angle)
    true = 9.80665 * np.array([np.sin(a) * np.cos(about), np.sin(a) * np.sin(about), -np.cos(a)])
    log = motion(robot, 8, gravity=true)
    (found,) = refusals(robot, log)
    named = np.array([float(x) for x in re.search(r"looks like \((.*?)\)", found.text)[1].split(",")])
    assert np.linalg.norm(named - true) < 0.02 * 9.80665
    assert f"{angle:.0f}°"[:-2] in found.text
    assert "gravity" in found.advice
    assert refusals(replace(robot, gravity=tuple(named)), log) == []


def test_gravity_upside_down_is_found_in_clean_torques_that_are_mostly_friction(robot):
    log = motion(robot, 8, gravity=(0, 0, 9.80665), noise=0.0005)
    speed = np.gradient(log.position, log.t, axis=0)
    rubbing = replace(log, effort=log.effort + 8 * np.std(log.effort, axis=0) / np.std(speed, axis=0) * speed)
    (found,) = refusals(robot, rubbing)
    assert "looks like (0, 0, 9.807), 180°" in found.text


def interleaved(first, second, every):
    """Samples of a second publisher after each `every`-th one of the first."""
    rows = np.arange(0, len(first.t), every)
    t = np.concatenate([first.t, first.t[rows] + 0.4 / first.sample_rate])
    order = np.argsort(t, kind="stable")
    position, effort = (
        np.concatenate([getattr(first, key), getattr(second, key)[rows]])[order] for key in ("position", "effort")
    )
    return _log(first_robot(first), t[order], position, effort)


def first_robot(log):
    return _arm(log.position.shape[1], seed=3)


@pytest.mark.parametrize(("every", "share"), [(1, 0.5), (4, 0.2), (15, 0.0625)])
@pytest.mark.parametrize("kind", ["zero", "another motion"])
def test_names_two_publishers_on_one_topic(robot, every, share, kind):
    first, second = motion(robot, 9), motion(robot, 10)
    apart = replace(first, position=first.position + 0.9)
    if kind == "zero":
        second = replace(first, position=0 * first.position, effort=0 * first.effort)
    (found,) = refusals(robot, interleaved(apart, second, every))
    assert "two publishers" in found.text
    assert kind in found.text
    assert found.share == pytest.approx(share, abs=0.01)


def test_rows_out_of_order_are_not_reported_as_degrees(robot):
    log = motion(robot, 11)
    order = np.random.default_rng(2).permutation(len(log.t))
    (found,) = refusals(robot, replace(log, position=log.position[order], effort=log.effort[order]))
    assert "rows are out of order" in found.text


def test_fast_motion_below_pi_is_not_reported_as_degrees(robot):
    """The description's speed may be wrong; whoever means degrees has some beyond 3.14."""
    slow = replace(robot, joints=tuple(replace(joint, max_velocity=0.02) for joint in robot.joints))
    assert not any("degrees" in finding.text for finding in check_quality(slow, [motion(robot, 12)]))
    beyond = replace(motion(robot, 12), position=np.degrees(motion(robot, 12).position))
    assert "positions look like degrees" in refusals(robot, beyond)[0].text


def bad(log, change):
    effort = log.effort.copy()
    change(effort)
    return replace(log, effort=effort)


def held(effort, joint=1, start=600, stop=1800, count=9):
    for row in range(start, stop, count):
        effort[row : row + count, joint] = effort[row, joint]


def clipped(effort, joint=2, share=0.15):
    level = np.quantile(np.abs(effort[:, joint]), 1 - share)
    effort[:, joint] = np.clip(effort[:, joint], -level, level)


def zeroed(effort, joint=1):
    for row in range(100, 3400, 300):
        effort[row : row + 25, joint] = 0.0


@pytest.mark.parametrize(
    ("change", "joint", "share", "says"),
    [
        (held, "joint_2", 1200 / 3600, "holds its value"),
        (clipped, "joint_3", 0.15, "looks clipped"),
        (zeroed, "joint_2", 11 * 25 / 3600, "exactly zero"),
    ],
)
def test_counts_spoiled_samples_by_joint(robot, change, joint, share, says):
    (found,) = spoiled(robot, [bad(motion(robot, 13), change)])
    assert found.joints == (joint,)
    assert says in found.text
    assert found.share == pytest.approx(share, rel=0.05)
    assert f"{100 * found.share:.1f} % of the samples" in found.text
    assert not found.refuses


def test_coarse_steps_and_a_stationary_joint_are_not_spoiled(robot):
    log = motion(robot, 14, noise=0.002)
    still = log.position.copy()
    still[:, 3] = still[0, 3]
    coarse = replace(log, position=np.round(still, 4), effort=np.round(log.effort))
    coarse.effort[:, 3] = coarse.effort[0, 3]
    assert spoiled(robot, [coarse]) == []


@pytest.mark.parametrize(
    ("scale", "unit"),
    [
        (lambda nominal: 1 / np.array([11.0, 9.0, 14.0, 12.0]), "motor currents"),
        (lambda nominal: 1000 / nominal, "‰ of nominal torque"),
        (lambda nominal: 100 / nominal, "% of nominal torque"),
    ],
)
def test_detects_a_torque_unit_from_the_described_masses(robot, scale, unit):
    nominal = np.array([700.0, 450.0, 240.0, 30.0])
    joints = tuple(replace(joint, max_torque=value) for joint, value in zip(robot.joints, nominal, strict=True))
    described = replace(robot, joints=joints)
    log = motion(described, 15)
    assert check_quality(described, [log]) == []
    (found,) = check_quality(described, [replace(log, effort=log.effort * scale(nominal))])
    assert found.refuses
    assert unit in found.text
    assert found.joints == robot.joint_names


@pytest.mark.parametrize(("joint", "times"), [(2, 1.4), (2, 0.7)])
def test_reports_a_wrong_length_in_the_description(robot, joint, times):
    old = '<child link="link_3"/><origin xyz="0.05 0.02 0.3"/>'
    new = f'<child link="link_3"/><origin xyz="{0.05 * times} {0.02 * times} {0.3 * times}"/>'
    assert old in robot.urdf
    wrong = replace(robot, urdf=robot.urdf.replace(old, new))
    (found,) = check_quality(wrong, [motion(robot, 16, noise=0.005)])
    assert found.joints == ("joint_2", "joint_3")
    assert not found.refuses
    assert float(re.search(r"about ([\d.]+) times", found.text)[1]) == pytest.approx(1 / times, rel=0.1)


def test_joints_that_move_alike_are_not_reported_as_swapped_or_flipped(robot):
    """As in a routine that moves both together: the joints cannot be distinguished."""
    log = motion(robot, 17)
    q, qd, qdd = (values.copy() for values in _multisine(4, log.t, 17))
    for values in (q, qd, qdd):
        values[:, 2] = 0.8 * values[:, 1]
    q[:, 2] += 0.01 * np.sin(0.3 * log.t)
    torque = Dynamics(robot).regressor(q, qd, qdd) @ Dynamics(robot).standard_parameters()
    friction = FRICTION[:4] * np.tanh(qd / 0.01)
    friction[:, [1, 2]] = friction[:, [2, 1]] * -0.3  # the file's friction is off
    alike = _log(robot, log.t, q, torque + friction)
    texts = [finding.text for finding in check_quality(robot, [alike])]
    assert not [text for text in texts if re.search("joint_[23].*(swapped|flipped)", text)]


def test_logs_that_the_model_predicts_have_no_unit_error(robot):
    """A description with tiny masses in it, as some URDFs have, and somebody who pushes."""
    mass = re.sub(r'mass value="([\d.]+)"', lambda m: f'mass value="{float(m[1]) / 900:.6f}"', robot.urdf)
    centred = replace(robot, urdf=mass)
    model = estimate(robot, [motion(robot, 18)])
    pushed = motion(robot, 19)
    effort = pushed.effort.copy()
    for row in range(200, 3200, 600):
        effort[row : row + 400, 1:] += 5 * np.std(effort[:, 1:], axis=0)
    pushed = replace(pushed, effort=effort)
    drives = replace(centred, joints=tuple(replace(joint, max_torque=0.4) for joint in centred.joints))
    assert any("N·mm" in finding.text for finding in check_quality(drives, [pushed]))
    check_plausible(drives, [pushed], False, Console(-1), model=model)
    with pytest.raises(RejectedError, match="N·mm"):
        check_plausible(drives, [pushed], False, Console(-1))


def test_a_simulators_own_masses_do_not_excuse_missing_gravity(robot, tmp_path):
    """A simulator made of the same URDF predicts torques of the right size on joints that carry little only."""
    path = tmp_path / "arm.urdf"
    path.write_text(robot.urdf, encoding="utf-8")
    model = load_simulator(path, robot, robot.joint_names).model
    weightless = motion(robot, 1, carried=False)
    with pytest.raises(RejectedError, match="carry no gravity"):
        check_plausible(robot, [weightless], False, Console(-1), model=model)


def test_detects_currents_against_a_frictionless_simulator(robot, tmp_path):
    """A simulator without friction predicts next to nothing on some joints, of which currents are no smaller."""
    path = tmp_path / "arm.urdf"
    path.write_text(robot.urdf, encoding="utf-8")
    model = load_simulator(path, robot, robot.joint_names).model
    log = motion(robot, 1)
    dynamics, rest = Dynamics(robot), 0 * log.position
    carried = np.median(np.abs(dynamics.regressor(log.position, rest, rest) @ dynamics.standard_parameters()), axis=0)
    rubbing = np.where(np.arange(4) == np.argmax(carried), 0.0, 8 * carried)
    effort = log.effort + rubbing * np.tanh(np.gradient(log.position, log.t, axis=0) / 0.01)
    with pytest.raises(RejectedError, match="look like another unit"):
        check_plausible(robot, [replace(log, effort=effort / 9)], False, Console(0), model=model)


def test_zero_effort_is_refused_by_estimate_and_validate(robot, tmp_path, shared_robot):
    path, out = tmp_path / "zero.mcap", tmp_path / "model.json"
    arm, description = shared_robot
    good = motion(arm, 20)
    write_log(path, replace(good, effort=0 * good.effort))
    write_log(tmp_path / "good.mcap", good)
    estimate_files(description, [tmp_path / "good.mcap"], out, FitQuestion(10.0, "weighted"), Console(-1))
    for refused in (
        lambda: validate_files(out, [path], None, Console(-1)),
        lambda: estimate_files(description, [path], tmp_path / "new.json", FitQuestion(10.0, "weighted"), Console(-1)),
    ):
        with pytest.raises((InputError, RejectedError), match=r"torque is zero throughout|never changes"):
            refused()


def test_estimate_and_validate_warn_of_spoiled_samples(tmp_path, shared_robot, capsys):
    arm, description = shared_robot
    log = bad(motion(arm, 21), zeroed)
    write_log(path := tmp_path / "log.mcap", log)
    estimate_files(description, [path], tmp_path / "m.json", FitQuestion(10.0, "weighted"), Console(-1))
    assert "the torque of joint_2 is exactly zero for 7.6 % of the samples" in capsys.readouterr().err
    validate_files(tmp_path / "m.json", [path], None, Console(-1))
    assert "the torque of joint_2 is exactly zero for 7.6 % of the samples" in capsys.readouterr().err


def test_warns_of_a_negative_rotor_inertia_and_an_error_far_above_noise(robot):
    log = motion(robot, 22, noise=0.002)
    q, _, qdd = _multisine(4, log.t, 22)
    wrong = log.effort.copy()
    wrong[:, 3] -= 5.0 * qdd[:, 3]
    doubts = list(fitted_doubts(estimate(robot, [log]), [log]))
    assert doubts == []
    (rotor,) = fitted_doubts(estimate(robot, [replace(log, effort=wrong)]), [replace(log, effort=wrong)])
    assert rotor.joints == ("joint_4",)
    assert "negative inertia" in rotor.text
    wrong = log.effort.copy()
    wrong[:, 2] += 0.5 * np.std(wrong[:, 2]) * np.sin(40 * np.sin(q[:, 0]))
    (error,) = fitted_doubts(estimate(robot, [replace(log, effort=wrong)]), [replace(log, effort=wrong)])
    assert error.joints == ("joint_3",)
    assert "more of the torque than its noise" in error.text


@pytest.fixture(scope="module")
def shared_robot(tmp_path_factory):
    """An arm, and the file that describes it."""
    arm = _arm(3, seed=3)
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.urdf").write_text(arm.urdf, encoding="utf-8")
    joints = "".join(
        f"  - {{name: {joint.name}, gear_ratio: {joint.gear_ratio}, max_velocity: 3.0, max_acceleration: 20.0}}\n"
        for joint in arm.joints
    )
    path = folder / "robot.yaml"
    path.write_text(f"name: arm\nurdf: arm.urdf\ntip_frame: {arm.tip_frame}\njoints:\n{joints}", encoding="utf-8")
    return load_robot(str(path)), str(path)


GRAVITY_FREE, TILTED, PUBLISHERS = "carry no gravity", "gravity in the base frame looks like", "two publishers"
#: Logs, and the expected messages: a refusal, and parts of warnings.
FOLDERS = [
    (("lib/base1", "lib/base2"), None, ()),
    (("lib/base1",), None, ()),
    (("01-gravity-free-effort/F_short",), GRAVITY_FREE, ()),
    (("01-gravity-free-effort/F_nograv1", "01-gravity-free-effort/F_nograv2"), GRAVITY_FREE, ()),
    (("02-tilted-mount/tilt20_1", "02-tilted-mount/tilt20_2"), TILTED, ()),
    (("02-tilted-mount/tilt45_1", "02-tilted-mount/tilt45_2"), TILTED, ()),
    (("07-two-publishers-one-topic/A3_zero_full",), PUBLISHERS, ()),
    (("07-two-publishers-one-topic/A3_zero_full10",), PUBLISHERS, ()),
    (("07-two-publishers-one-topic/E4_same_topic_same_names",), PUBLISHERS, ()),
    (("20-currents-and-bad-effort/U_cur1", "20-currents-and-bad-effort/U_cur2"), "another unit", ("100 %",)),
    (("20-currents-and-bad-effort/U_hold1",), None, ("holds its value for 100.0 %",)),
    (("20-currents-and-bad-effort/U_sat1",), None, ("shoulder_lift_joint stays at its largest value for 34.8 %",)),
    (("20-currents-and-bad-effort/Z_drop2_1",), None, ("shoulder_lift_joint is exactly zero for 9.0 %",)),
]


@pytest.mark.parametrize(("logs", "refused", "warned"), FOLDERS, ids=[logs[0] for logs, *_ in FOLDERS])
def test_files_that_peoples_tools_write_get_the_right_reason(shared_data, logs, refused, warned):
    folder = shared_data / "files-dev"
    description = load_robot(str(folder / "lib/arm_with_masses/robot.yaml"))
    read = [read_log(folder / f"{name}.mcap", description) for name in logs]
    found = check_quality(description, read)
    if refused is None:
        assert [finding.text for finding in found if finding.refuses] == []
    else:
        assert refused in next(finding.text for finding in found if finding.refuses)
    texts = " ".join(map(str, [*found, *(spoiled(description, read) if refused is None else [])]))
    assert bool(texts) == bool(refused or warned), texts
    assert all(part in texts for part in warned), texts


def test_uneven_kilohertz_stamps_give_the_accelerations_of_an_even_clock(shared_data):
    from agent.estimation.signals.filtering import FilterSettings, motions

    folder = shared_data / "files-dev/23-uneven-kilohertz"
    (even,), (uneven,) = (
        motions(read_log(folder / f"{name}.mcap"), FilterSettings(10.0), reduce=False)
        for name in ("even_2", "jitter_2")
    )
    a, b = (each.low_pass(each.qdd) for each in (even, uneven))
    times = uneven.time[uneven.kept]
    inside = (times > even.time[even.kept][0]) & (times < even.time[even.kept][-1])
    expected = np.column_stack([np.interp(times[inside], even.time[even.kept], column) for column in a.T])
    assert np.all(np.std(b[inside] - expected, axis=0) < 0.01 * np.std(expected, axis=0))


def test_what_an_effort_is_declared_to_be_is_checked_against_the_numbers(robot):
    log, amperes = motion(robot, 16), np.array([9.0, 11.0, 8.0, 12.0])
    constants = zip(robot.joints, amperes / 7, strict=True)
    driven = replace(robot, joints=tuple(replace(one, torque_constant=k, gear_ratio=7.0) for one, k in constants))
    bare = motion(robot, 17, carried=False)
    given = {
        "torque": log,
        "current": replace(log, effort=log.effort / amperes),
        "torque-without-gravity": bare,
        "load": replace(log, effort=1000 * log.effort / 100),
        "franka": replace(bare, metadata={"effort": "torque"}),
    }

    def judged(name, effort, arm=robot):
        logs = with_declared_effort(arm, [given[name]], effort, False, Console(-1))
        check_torque(logs)
        check_plausible(arm, logs, False, Console(-1))
        return logs[0]

    for name, effort, arm, reason in (
        ("current", None, robot, "look like another unit"),
        ("current", "torque", robot, "look like another unit"),
        ("current", "current", robot, "torque_constant for every joint"),
        ("load", None, robot, "look like another unit"),
        ("load", "load", robot, "share of the stall torque"),
        ("torque-without-gravity", None, robot, "carry no gravity"),
        ("torque-without-gravity", "torque-without-gravity", robot, "took gravity off"),
        ("torque-without-gravity", "current", robot, "contradict that the effort is current"),
        ("torque", "torque-without-gravity", robot, "contradict that the effort is torque-without-gravity: they carry"),
        ("torque", "current", driven, "look like another unit"),
        ("franka", None, robot, "carry no gravity"),
    ):
        with pytest.raises(RejectedError, match=reason):
            judged(name, effort, arm)
    with pytest.raises(InputError, match="as its driver says"):
        judged("franka", "load")
    with pytest.raises(InputError, match="choose torque, current"):
        judged("torque", "volts")
    np.testing.assert_array_equal(judged("torque", "torque").effort, log.effort)
    np.testing.assert_allclose(judged("current", "current", driven).effort, log.effort)


def test_zero_that_is_a_level_like_its_neighbours_is_no_dropout(robot):
    """A joint that rests: its torque is noise in steps of a converter, around zero."""
    log = motion(robot, 23)
    effort, step = log.effort.copy(), 0.02 * np.std(log.effort[:, 3])
    effort[:, 3] = step * np.round(np.random.default_rng(1).normal(0, 20, len(effort)))
    assert not [finding for finding in spoiled(robot, [replace(log, effort=effort)]) if "zero" in finding.text]


@pytest.mark.parametrize("velocity", [0.0, 1e-4, None])
def test_postures_are_no_motion(robot, velocity):
    q = np.random.default_rng(2).uniform(-1, 1, (300, 4))
    rate = 1.0 if velocity is None else 3.0
    log = replace(motion(robot, 24), velocity=None)
    log = _log(robot, np.arange(300) / rate, q, np.cos(q))
    log = replace(log, velocity=None if velocity is None else velocity + 0 * q)
    (found,) = refusals(robot, log)
    assert found.text.startswith("these are 300 postures at standstill, ")
    assert "record a motion through them" in found.advice


@pytest.mark.parametrize("velocity", [0.0, None])
@pytest.mark.parametrize("rows", [5, 50])
def test_postures_of_several_rows_are_no_motion(robot, velocity, rows):
    rng = np.random.default_rng(2)
    q = rng.uniform(-1, 1, (60, 4)).repeat(rows, axis=0) + rng.normal(0, 1e-4, (60 * rows, 4))
    log = _log(robot, np.arange(60 * rows) / (2.5 * rows), q, np.cos(q))
    log = replace(log, velocity=None if velocity is None else velocity + 0 * q)
    assert "these are 60 postures at standstill, 0.4" in " ".join(found.text for found in refusals(robot, log))


@pytest.mark.parametrize(("joint", "angle"), [(1, 90.0), (1, -90.0), (1, 180.0), (2, 180.0)])
def test_a_zero_of_another_table_is_named(robot, joint, angle):
    log = motion(robot, 25)
    away = np.where(np.arange(4) == joint, np.radians(angle), 0.0)
    (found,) = refusals(robot, replace(log, position=log.position + away))
    assert f"the zero of joint_{joint + 1} looks {abs(angle):g}° off" in found.text
    assert f"{180 if angle == 180 else -angle:g} deg" in found.text


def test_a_parked_joint_without_torque_leaves_the_others(robot):
    log = motion(robot, 26)
    still = np.arange(4) == 0
    n = robot.dof
    q, qd, qdd = _multisine(n, log.t, 26)
    q, qd, qdd = (np.where(still, 0.0, values) for values in (q, qd, qdd))
    dynamics = Dynamics(robot)
    torque = dynamics.regressor(q, qd, qdd) @ dynamics.standard_parameters()
    torque = torque + FRICTION[:n] * np.tanh(qd / 0.01) + 0.8 * FRICTION[:n] * qd
    torque += 0.01 * np.std(torque, axis=0) * np.random.default_rng(3).normal(size=torque.shape)
    parked = _log(robot, log.t, q, np.where(still, 0.0, torque))
    assert not refusals(robot, parked)
    model = estimate(robot, [parked])
    coulomb = dict(zip(model.names, model.values, strict=True))
    np.testing.assert_allclose([coulomb[f"f0_{k}"] for k in (2, 3, 4)], FRICTION[1:4], rtol=0.1)
    assert any("never move: joint_1" in note for note in model.notes)
