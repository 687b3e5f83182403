"""Logs that no motion of the robot can have made are refused, with the likeliest reason."""

import functools
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core import Console, InputError, RejectedError
from agent.data_quality import QualityFinding, check_quality
from agent.data_quality.description_fit import HEAVIEST, excessive_weight
from agent.data_quality.faults import Recordings
from agent.data_quality.rigid_fit import fit_samples
from agent.estimation import estimate
from agent.pipeline.checked_logs import check_plausible
from agent.pipeline.identify import FitQuestion, estimate_files, validate_files
from agent.recording import Log, read_log, write_log
from agent.robot import load_robot
from fake_controller.plant import Plant
from tests.arms import Bar, serial_arm
from tests.small_arms import PERIOD, make_arm, record, set_points

JOINT = 1


@functools.cache
def recorded(folder, robot: str, *names: str):
    """A real arm's description and its logs of these names."""
    description = load_robot(str(folder / robot))
    return description, [read_log((folder / robot).parent / f"{name}.mcap", description) for name in names]


def plausibility_warnings(robot, logs, others=()) -> list[str]:
    """Why these logs are refused."""
    return [finding.text for finding in check_quality(robot, logs, others) if finding.refuses]


def turned(values: np.ndarray, joint: int = JOINT) -> np.ndarray:
    return values * np.where(np.arange(values.shape[1]) == joint, -1.0, 1.0)


MISTAKES = {
    "N·mm": lambda log: {"effort": 1000 * log.effort},
    "look like degrees": lambda log: {"position": np.degrees(log.position), "velocity": None},
    "opposite signs": lambda log: {"effort": -log.effort},
    "the torque of joint_2 looks flipped": lambda log: {"effort": turned(log.effort)},
    "never negative": lambda log: {"effort": np.abs(log.effort)},
    "the torque of joint_2 is never negative": lambda log: {
        "effort": np.where(np.arange(6) == JOINT, np.abs(log.effort), log.effort)
    },
    "joint_2 never changes while it moves": lambda log: {"effort": np.where(np.arange(6) == JOINT, 0.0, log.effort)},
    "joint_2 is stuck": lambda log: {
        "position": np.where(np.arange(6) == JOINT, log.position[0], log.position),
        "velocity": None,
    },
    "joint_2 is stuck, .*while its velocity says it moves": lambda log: {
        "position": np.where(np.arange(6) == JOINT, log.position[0], log.position),
        "velocity": np.gradient(log.position, log.t, axis=0),
        "reference_position": None,
    },
    "joint_2 and joint_3 look swapped": lambda log: {
        "position": log.position[:, [0, 2, 1, 3, 4, 5]],
        "effort": log.effort[:, [0, 2, 1, 3, 4, 5]],
        "velocity": None,
    },
    "joint_3 looks measured from the link before joint_2: add that of joint_2": lambda log: {
        "position": log.position - np.where(np.arange(6) == 2, log.position[:, [1]], 0.0),
        "velocity": None,
    },
    "0.8 times the derivative.*rate": lambda log: {"velocity": 0.8 * np.gradient(log.position, log.t, axis=0)},
    "-1 times the derivative.*flipped": lambda log: {"velocity": -np.gradient(log.position, log.t, axis=0)},
}


@pytest.fixture(scope="module")
def healthy(ns16):
    return ns16, record(Plant(ns16, seed=3), "excite", 21)


@pytest.mark.parametrize("reason", MISTAKES)
def test_reports_each_impossible_log(healthy, reason):
    robot, log = healthy
    found = plausibility_warnings(robot, [replace(log, **MISTAKES[reason](log))])
    assert found
    assert re.search(reason, found[0]), found


def test_logs_that_a_model_predicts_are_not_searched_for_mistakes(healthy):
    robot, log = healthy
    swapped = replace(log, **MISTAKES["joint_2 and joint_3 look swapped"](log))
    texts = {
        known: str(check_quality(robot, [swapped], predicted=lambda known=known: known)) for known in (True, False)
    }
    assert {known: "look swapped" in text for known, text in texts.items()} == {True: False, False: True}


IN_MM = {
    r"look like mm: joint_1 comes to .* m and": lambda log: {"position": 1000 * log.position, "velocity": None},
    r"0\.001 times the derivative of its position: is the position in mm": lambda log: {
        "position": 20 * log.position,  # slow
        "velocity": 0.02 * np.gradient(log.position, log.t, axis=0),
    },
    r"1e\+03 times the derivative of its position: is its unit mm/s": lambda log: {
        "velocity": 1000 * np.gradient(log.position, log.t, axis=0)
    },
}


@pytest.mark.parametrize("reason", IN_MM)
def test_reports_a_prismatic_joint_in_mm(reason):
    robot = make_arm("P")
    log = record(Plant(robot, seed=3), "slide", 21)
    assert not plausibility_warnings(robot, [log])
    found = plausibility_warnings(robot, [replace(log, **IN_MM[reason](log), reference_position=None)])
    assert any(re.search(reason, text) for text in found), found


def test_gravity_in_another_direction_is_named(healthy):
    robot, log = healthy
    (found,) = plausibility_warnings(replace(robot, gravity=(9.80665, 0.0, 0.0)), [log])
    assert "gravity in the base frame looks like (0, 0, -9.807)" in found


DOWN = r"gravity in the base frame looks like \(0, 0, -9.807\)"


@pytest.mark.parametrize(
    "gravity",
    [
        (9.80665, 0.0, 0.0),
        pytest.param((0.0, -9.80665, 0.0), marks=pytest.mark.verify),
        pytest.param((0.0, 0.0, 9.80665), marks=pytest.mark.verify),
    ],
)
@pytest.mark.parametrize(
    ("robot", "logs"),
    [
        ("kr300/robot_none.yaml", ("A", "B")),
        pytest.param("tiago/robot.yaml", ("held",), marks=pytest.mark.verify),
        ("bam_xl330/robot.yaml", ("kp400_sin_sin", "kp400_up_and_down")),
    ],
    ids=["kr300", "tiago", "pendulum"],
)
def test_gravity_in_another_direction_is_named_on_real_arms(shared_data, robot, logs, gravity):
    """A pendulum's torques fit gravity in any direction of its plane; there the described mass decides."""
    described, logs = recorded(shared_data / "real-dev", robot, *logs)
    if described.dof == 1 and gravity[1]:
        gravity = (-9.80665, 0.0, 0.0)  # in the plane of the pendulum
    (found,) = plausibility_warnings(replace(described, gravity=gravity), logs)
    assert re.search(DOWN, found), found
    if described.dof == 1:
        unmeasured = re.sub(r"<inertial>.*?</inertial>", "", described.urdf, flags=re.DOTALL)
        assert not plausibility_warnings(replace(described, gravity=gravity, urdf=unmeasured), logs)


def exchanged(values: np.ndarray, a: int, b: int) -> np.ndarray:
    """The values of two joints swapped."""
    order = np.arange(values.shape[1])
    order[[a, b]] = b, a
    return values[:, order]


#: What is said of logs of real arms, and what was done to them. Narrow motion of four good joints hides two swapped
#: torques; a small arm loads its joints so little that N·mm look like N·m.
REAL_MISTAKES = {
    "position and torque of joint_2 look flipped": (
        ("kr300/robot_none.yaml", "A", "B"),
        lambda log: {"position": turned(log.position), "effort": turned(log.effort), "velocity": None},
    ),
    "joint_3 and joint_4 look swapped": (
        ("kr300/robot_none.yaml", "A", "B"),
        lambda log: {
            "position": exchanged(log.position, 2, 3),
            "effort": exchanged(log.effort, 2, 3),
            "velocity": None,
        },
    ),
    "the torques of joint_2 and joint_3 look swapped": (
        ("kr300/robot_real.yaml", "A", "B"),
        lambda log: {"effort": exchanged(log.effort, 1, 2)},
    ),
    "the torque of arm_4_joint looks flipped|torque and motion of arm_4_joint": (
        ("tiago/robot.yaml", "fit"),
        lambda log: {"effort": turned(log.effort, 4)},
    ),
    "the torque of .* is never negative": (("so101/robot.yaml", "custom_motion"), lambda log: {}),
    "torques look like N·mm: .*more than any of its reach": (
        ("tiago/robot.yaml", "fit"),
        lambda log: {"effort": 1000 * log.effort},
    ),
    "torques look like N·mm": (("bam_xl330/robot.yaml", "kp400_sin_sin"), lambda log: {"effort": 1000 * log.effort}),
}


@pytest.mark.parametrize(
    "reason",
    [  # a simulated arm with two joints swapped is above
        pytest.param(reason, marks=pytest.mark.verify if reason == "joint_3 and joint_4 look swapped" else ())
        for reason in REAL_MISTAKES
    ],
)
def test_a_mistake_in_logs_of_a_real_arm_is_named(shared_data, reason):
    (robot, *names), change = REAL_MISTAKES[reason]
    described, logs = recorded(shared_data / "real-dev", robot, *names)
    if described.dof == 1:  # neither the drive's torque nor a reach tells
        described = replace(described, joints=(replace(described.joints[0], nominal_motor_torque=None),))
    found = plausibility_warnings(described, [replace(log, **change(log), reference_position=None) for log in logs])
    assert re.match(reason, found[0]), found


def test_measures_arm_length_along_the_joints(make_log):
    """A remote centre of motion, as surgical arms have: the slide ends where yaw and pitch meet."""
    block = 0.01, 0.01, 0.01
    bars = [
        Bar("R", "0 0 0", "0 0 1", 2.0, "0.1 0 0", block),
        Bar("R", "0 0 0", "0 1 0", 2.0, "0.1 0 0", block),
        Bar("P", "0.43 0 0", "1 0 0", 0.5, "0.1 0 0", block),
        Bar("R", "-0.42 0 0", "1 0 0", 0.1, "0.1 0 0", block),
    ]
    t = np.arange(0, 20, 0.01)
    rate, size = np.array([1.0, 1.7, 2.3, 2.9]), np.array([0.5, 0.5, 0.01, 0.5])
    friction = 3 * np.cos(t[:, None] * rate)
    log = make_log(serial_arm(bars), t, size * np.sin(t[:, None] * rate), friction)
    assert not any("N·mm" in text for text in plausibility_warnings(serial_arm(bars), [log]))


def test_weighs_an_arm_with_the_gravity_that_its_description_has(make_log):
    """A torque that needs too heavy an arm, level or on a slope, needs none where gravity is three times as strong."""
    block = 0.01, 0.01, 0.01
    arm = serial_arm([Bar("R", at, "0 1 0", 2.0, "0.1 0 0", block) for at in ("0 0 0", "0.5 0 0")])
    t = np.arange(0, 10, 0.01)
    log = make_log(arm, t, 0.5 * np.sin(t[:, None] * [1.0, 1.7]), np.zeros((len(t), 2)))
    reach = 0.5  # m
    heavy = replace(log, effort=np.full_like(log.position, 0.75 * HEAVIEST * reach**3 * 9.80665))

    def doubts(*gravity: float) -> int:
        return len(
            list(excessive_weight(Recordings(replace(arm, gravity=tuple(9.80665 * np.array(gravity))), [heavy])))
        )

    assert doubts(0.0, 0.0, -1.0) == doubts(0.6, 0.0, -0.8) == 1
    assert doubts(1.8, 0.0, -2.4) == 0


def test_other_motions_clear_a_false_suspicion_from_a_short_log(shared_data):
    robot, (log, *others) = recorded(shared_data / "real-dev", "kr300/robot_real.yaml", "A_se", "B_se", "C_se")
    short = log.between(log.t[0] + 5.0, log.t[0] + 10.0)
    (doubt,) = plausibility_warnings(robot, [short])
    assert "much more of the torque would be explained" in doubt
    assert plausibility_warnings(robot, [short], others) == []
    wrong, *with_it = (replace(one, effort=turned(one.effort)) for one in (log, *others))
    assert plausibility_warnings(robot, [wrong], with_it)


@pytest.mark.parametrize(
    ("robot", "name", "start", "stop"),
    [("kr300/robot_real.yaml", "B_se", 0.0, 5.0), ("tiago/robot.yaml", "fit", 16.0, 24.0)],
)
def test_joints_of_a_real_arm_that_move_alike_for_some_seconds_are_not_swapped(shared_data, robot, name, start, stop):
    description, (log,) = recorded(shared_data / "real-dev", robot, name)
    assert plausibility_warnings(description, [log.between(start, stop)]) == []


def test_other_motions_do_not_clear_an_evident_mistake(healthy):
    robot, log = healthy
    for reason in ("N·mm", "opposite signs", "joint_2 never changes while it moves", "joint_2 is stuck"):
        (found, *_) = plausibility_warnings(robot, [replace(log, **MISTAKES[reason](log))], [log])
        assert re.search(reason, found), found


@pytest.mark.parametrize(
    ("robot", "names", "short"),
    [
        pytest.param("gap-dev/robot.yaml", ("baseline/excite", "baseline/moves"), True, marks=pytest.mark.verify),
        pytest.param(
            "gap-dev/robot.yaml", ("case_03/logs/excite", "case_03/logs/moves"), False, marks=pytest.mark.verify
        ),
        pytest.param(
            "gap-dev/robot.yaml", ("case_04/logs/excite", "case_04/logs/moves"), False, marks=pytest.mark.verify
        ),
        ("real-dev/kr300/robot_real.yaml", ("A", "A_se"), True),
        pytest.param("real-dev/tiago/robot.yaml", ("fit", "held"), True, marks=pytest.mark.verify),
        ("real-dev/bam_xl330/robot.yaml", ("kp100_sin_time_square", "kp100_lift_and_drop", "kp100_sin_sin"), True),
    ],
)
def test_real_logs_are_not_refused(shared_data, robot, names, short):
    """Neither are a few seconds of them, which distinguish no mistake from chance."""
    description, logs = recorded(shared_data, robot, *names)
    for log in logs:
        assert not plausibility_warnings(description, [log]), log.path
    if short:
        for start in np.linspace(0, logs[0].t[-1] - 2, 3):
            assert not plausibility_warnings(description, [logs[0].between(start, start + 2)])
        assert not plausibility_warnings(description, [logs[0].between(0, 1)])


def test_nothing_is_written_unless_forced(healthy, tmp_path, capsys):
    _, log = healthy
    robot, out, quiet = "comau_ns16", tmp_path / "model.json", Console(-1)
    flipped = tmp_path / "flipped.mcap"
    write_log(flipped, replace(log, effort=-log.effort, metadata={**log.metadata, "robot": "panda"}))
    with pytest.raises(RejectedError, match=r"robot panda, not of comau_ns16.*opposite signs.*--force"):
        estimate_files(robot, [flipped], out, FitQuestion(10.0, "weighted"), quiet)
    assert not out.exists()
    estimate_files(robot, [flipped], out, FitQuestion(10.0, "weighted", force=True), quiet)
    assert out.exists()
    assert "the logs say that they are of robot panda, not of comau_ns16" in capsys.readouterr().err


def test_logs_of_two_machines_or_tools_are_not_pooled(healthy, tmp_path, capsys):
    _, log = healthy
    robot, out, quiet = "comau_ns16", tmp_path / "model.json", Console(-1)
    paths: list[Path] = []
    for serial, tool in (("A-1", "none"), ("B-2", "none"), ("A-1", "gripper")):
        paths.append(tmp_path / f"{serial}_{tool}.mcap")
        part = log.between(len(paths), len(paths) + 12)
        write_log(paths[-1], replace(part, metadata={"serial": serial, "tool": tool}))
    first, other, gripped = paths
    with pytest.raises(InputError, match=r"serial A-1 \(A-1_none.mcap\) and B-2 \(B-2_none.mcap\).*--allow-mixed"):
        estimate_files(robot, [first, other], out, FitQuestion(10.0, "weighted"), quiet)
    assert not out.exists()
    estimate_files(robot, [first], out, FitQuestion(10.0, "weighted"), quiet)
    with pytest.raises(InputError, match=r"serial A-1 \(the model\) and B-2"):
        validate_files(out, [other], None, quiet)
    with pytest.raises(InputError, match=r"tool gripper .* and none \(the model\)"):
        validate_files(out, [gripped], None, quiet)
    capsys.readouterr()
    validate_files(out, [first], None, quiet)
    assert "fitted to A-1_none.mcap" in capsys.readouterr().err
    validate_files(out, [other], None, quiet, allow_mixed=True)
    assert "fitted to" not in capsys.readouterr().err


def test_validate_comments_on_an_absurd_error(healthy, tmp_path, capsys):
    _, log = healthy
    robot, out, quiet = "comau_ns16", tmp_path / "model.json", Console(-1)
    for name, factor in (("right", 1.0), ("wrong", 1000.0)):
        write_log(tmp_path / f"{name}.mcap", replace(log, effort=factor * log.effort))
    estimate_files(robot, [tmp_path / "wrong.mcap"], out, FitQuestion(10.0, "weighted", force=True), quiet)
    capsys.readouterr()
    validate_files(out, [tmp_path / "right.mcap"], None, quiet)
    assert "predicting no torque at all would be better" in capsys.readouterr().err


def test_friction_of_a_one_way_sweep_is_reported_as_a_possible_offset():
    """Nor can it be said to drive the joint on."""
    robot = make_arm("R")
    log = record(Plant(robot, seed=3), "sweep", 21)
    time = log.t
    begins = np.clip((time - 3.0) / 0.5, 0, 1)
    speed = begins * (0.4 + 0.1 * np.sin(2 * np.pi * time / 7.0))
    position = np.cumsum(speed) * (time[1] - time[0]) - 2.0
    rng = np.random.default_rng(5)
    torque = 3.0 - 1.5 * begins + 0.5 * speed + 0.02 * rng.normal(size=len(time))  # stiction holds any of it
    sweep = replace(
        log,
        position=position[:, None],
        velocity=speed[:, None],
        effort=torque[:, None],
        reference_position=None,
        cycle_starts=(),
    )
    assert not [text for text in plausibility_warnings(robot, [sweep]) if "opposite signs" in text]
    found = estimate(robot, [sweep])
    assert any("goes one way only" in note for note in found.notes)
    both_ways = estimate(robot, [log])
    assert not any("goes one way only" in note for note in both_ways.notes)


def test_a_stationary_joint_with_velocity_noise_is_not_stuck(healthy):
    robot, log = healthy
    rng = np.random.default_rng(1)
    position, velocity = log.position.copy(), np.gradient(log.position, log.t, axis=0)
    position[:, 5] = position[0, 5]
    velocity[:, 5] = 0.02 * np.round(rng.normal(1.0, 1.5, len(log.t)))  # counts about a bias: 0.4 rad in 20 s
    still = replace(log, position=position, velocity=velocity, reference_position=None)
    assert not [text for text in plausibility_warnings(robot, [still]) if "is stuck, or" in text]


def standing(log):
    """The arm is stationary for three times as long, and stiction holds any torque below its level."""
    count = 3 * len(log.t)
    held = log.effort[-1] + 2 * np.std(log.effort, axis=0)
    return replace(
        log,
        t=np.arange(count) / log.sample_rate,
        position=np.tile(log.position[-1], (count, 1)),
        velocity=np.zeros((count, log.position.shape[1])),
        effort=held + 0.01 * np.std(log.effort) * np.random.default_rng(1).normal(size=(count, log.position.shape[1])),
        reference_position=None,
        planned_position=None,
        segments=((0, count),),
        cycle_starts=(),
    )


def test_logs_that_the_model_predicts_are_not_refused(healthy, monkeypatch):
    """On a few seconds a refit with a mistake in it may do better; logs that the model predicts have none."""
    robot, log = healthy
    model = estimate(robot, [record(Plant(robot, seed=3), name, seed) for name, seed in (("one", 11), ("two", 12))])
    swapped = QualityFinding("joint_1 and joint_5 look swapped", ("joint_1", "joint_5"))
    monkeypatch.setattr("agent.pipeline.checked_logs.check_quality", lambda *_: [swapped])
    quiet = Console(-1)
    with pytest.raises(RejectedError, match="look swapped"):
        check_plausible(robot, [log], False, quiet)
    check_plausible(robot, [log], False, quiet, model=model)
    check_plausible(robot, [log, standing(log)], False, quiet, model=model)
    mistaken = replace(log, effort=turned(log.effort))
    with pytest.raises(RejectedError, match="look swapped"):
        check_plausible(robot, [mistaken], False, quiet, model=model)


def with_friction(log, friction):
    """A log with more torque on the wrist: `friction` of speed over its highest, as a part of the torque."""
    speed = np.gradient(log.position, log.t, axis=0)
    highest, size = np.abs(speed).max(axis=0), np.sqrt(np.mean(log.effort**2, axis=0))
    wrist = np.arange(log.position.shape[1]) >= 3
    return replace(log, effort=log.effort + size * wrist * np.tanh(100 * speed / highest) * friction(speed / highest))


def test_a_sign_is_refused_only_if_the_turned_one_predicts_better(healthy):
    """Friction that falls with speed, as a compensated drive's, drives the joints of a linear fit on."""
    robot, log = healthy
    falling = with_friction(log, lambda speed: 40 * np.maximum(1 - 4 * np.abs(speed), -0.3))
    (found,) = check_quality(robot, [falling])
    assert not found.refuses
    assert re.search("sign of the torque of joint_5 fits better .*would drive joint_5 on", found.text)
    driving = with_friction(log, lambda speed: 40 * np.maximum(1 - 8 * np.abs(speed), -0.3))
    (found,) = check_quality(robot, [driving])
    assert found.refuses
    assert "joint_4, joint_5, joint_6 have opposite signs" in found.text


def test_torque_that_a_rigid_arm_explains_in_part_is_not_refused(healthy):
    robot, log = healthy
    size, rng = np.sqrt(np.mean(log.effort**2, axis=0)), np.random.default_rng(0)
    (found,) = check_quality(robot, [replace(log, effort=log.effort + size * np.sin(8 * log.position))])
    assert not found.refuses
    assert "neither bodies nor friction" in found.text
    (found,) = check_quality(robot, [replace(log, effort=rng.normal(size=log.effort.shape).cumsum(axis=0))])
    assert found.refuses
    assert "do not belong together" in found.text


@pytest.mark.parametrize(
    ("arm", "joint", "stiffness"), [("RRR", 0, 10.0), ("RRR", 2, 10.0), ("PRR", 2, 30.0), ("ur5e", 0, 15.0)]
)
def test_a_stiff_hose_passes_for_no_mistake(arm, joint, stiffness):
    """Were no spring tried, tilted gravity, flipped or swapped joints would explain more of these."""
    robot = load_robot(arm) if arm == "ur5e" else make_arm(arm)
    hose = {"stiffness": stiffness, "centre": 0.3}
    effect = {"effect": "dress_pack", "joints": [robot.joint_names[joint]], "parameters": hose}
    log = record(Plant(robot, seed=3, effects=[effect]), "hose", 21, 0.4)
    assert not plausibility_warnings(robot, [log])


def test_a_model_refuses_logs_of_another_robot_whose_joints_have_the_same_names(capsys):
    ur5e, ur10e = load_robot("ur5e"), load_robot("ur10e")
    model = estimate(ur5e, [record(Plant(ur5e, seed=3), name, seed) for name, seed in (("one", 11), ("two", 12))])
    quiet, other = Console(-1), replace(record(Plant(ur10e, seed=3), "other", 21), metadata={"robot": "ur10e"})
    with pytest.raises(RejectedError, match=r"other\.mcap: the logs say .* ur10e, not of ur5e, .*--force"):
        check_plausible(ur5e, [other], False, quiet, model=model)
    check_plausible(ur5e, [other], True, quiet, model=model)
    renamed = {"robot": "cell_7"}
    check_plausible(
        ur5e, [replace(record(Plant(ur5e, seed=3), "own", 21), metadata=renamed)], False, quiet, model=model
    )
    assert "robot cell_7, not of ur5e" in capsys.readouterr().err
    loaded = Plant(ur5e, seed=3, effects=({"effect": "payload", "parameters": {"mass": 4.0}},))
    check_plausible(
        ur5e, [replace(record(loaded, "loaded", 21), metadata={"robot": "ur5e"})], False, quiet, model=model
    )


def test_pauses_can_be_left_out():
    """Stiction holds an arm with any torque there, which once passed for gravity."""
    moves, _ = set_points(2, 0)
    standstill = np.repeat(moves[:1], round(2.0 / PERIOD), axis=0)
    q = np.concatenate([moves, standstill, moves, standstill])
    t = PERIOD * np.arange(len(q))
    log = Log(Path("pauses"), ("a", "b"), t, q, None, 0 * q, None, None, 1 / PERIOD, 0.0, ((0, len(t)),))
    samples = fit_samples([log])
    moving = samples.in_motion()
    at_rest, left = (np.all(np.abs(some.direction) < 0.5, axis=1) for some in (samples, moving))
    assert at_rest.any()
    assert not left.any()
    assert len(left) == samples.moving.sum()
    assert moving.rows_each == pytest.approx(samples.rows_each)
