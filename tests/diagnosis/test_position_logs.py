"""Logs of positions and commands: the simulator's own motion is judged, and the file corrected."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from agent.cli.app import app
from agent.core import InputError
from agent.diagnosis import corrected_numbers, diagnose, ranges
from agent.diagnosis.position_logs.stretch import stretches_of
from agent.model import NominalModel
from agent.recording import HOLD, Log, write_log
from agent.simulators import FreeSimulator, RecordedCommand, ServoNumbers, load_simulator, write_corrected

mujoco = pytest.importorskip("mujoco")
RATE, STEP = 50.0, 0.002
ARM = """<mujoco model="hobby"><option timestep="0.002" integrator="implicitfast"/>
  <default><joint armature="0.03" damping="0.3" frictionloss="0.05"/>
    <position kp="20" kv="0.5" forcerange="-3 3"/></default>
  <worldbody><body name="upper"><joint name="lift" axis="0 1 0"/>
    <inertial pos="0.12 0 0" mass="0.25" diaginertia="1e-3 1e-3 1e-3"/>
    <body name="fore" pos="0.2 0 0"><joint name="elbow" axis="0 1 0"/>
      <inertial pos="0.1 0 0" mass="0.15" diaginertia="5e-4 5e-4 5e-4"/></body></body></worldbody>
  <actuator><position joint="lift"/><position joint="elbow"/></actuator></mujoco>
"""


def recorded(
    source: Path,
    phase: float,
    late: float = 0.0,
    friction: float = 1.0,
    gain: float = 1.0,
    joints: slice = slice(1, 2),
    rest: float = 0.0,
    impedance: float = 0.9,
    nearest: float = np.inf,
    bend: float = 0.0,
    seconds: float = 4.0,
    offset: float = 0.0,
    later: float = 0.0,
    spring: float = 0.0,
) -> Log:
    """A log of the arm of a file under a held command; its elbow has other friction, and `joints` other servos.

    The command reaches the elbow `later` [s] than the other joint.

    The command moves on after every `rest` [s] and is cut to within `nearest` of the positions; `impedance` is that of
    friction. Damping d is d + `bend` |v|. The servo of the elbow stands `offset` [rad] off its set-points, and a cable
    pulls there with `spring` [N·m/rad].
    """
    model = mujoco.MjModel.from_xml_path(str(source))
    model.dof_solimp[:, 0] = impedance
    model.dof_frictionloss[1] *= friction
    model.dof_dampingpoly[:, 0] = bend
    model.jnt_stiffness[1] = spring
    model.actuator_gainprm[joints, 0] *= gain
    model.actuator_biasprm[joints, 1] *= gain
    model.actuator_biasprm[1, 0] = model.actuator_gainprm[1, 0] * offset
    data, t = mujoco.MjData(model), np.arange(int(seconds * RATE)) / RATE
    parts = ((0.5, 1.1), (0.25, 2.7), (0.08, 6.1))
    asked = np.floor(t / rest) * rest if rest else t
    r = sum(a * np.sin(np.outer(asked, w * np.array([1, 1.2])) + phase * w + [0, 1]) for a, w in parts)
    each, q, sent = round(1 / RATE / STEP), np.empty(r.shape), r.copy()
    for k in range(-int(RATE), len(t)):
        if k >= 0:
            q[k] = data.qpos
            sent[k] = np.clip(r[k], q[k] - nearest, q[k] + nearest)
        for part in range(each):
            now = max(k, 0) / RATE + (part + 0.5) * STEP * (k >= 0) - late
            for j, at in enumerate((now, now - later)):
                data.ctrl[j] = sent[min(max(int(at * RATE), 0), len(r) - 1), j]
            mujoco.mj_step(model, data)
    q = np.round(q / 0.0015) * 0.0015
    metadata = {"robot": "x", HOLD: "held"}
    name = Path(f"{phase}.mcap")
    return Log(name, ("lift", "elbow"), t, q, None, None, r, None, RATE, 100.0, ((0, len(t)),), metadata=metadata)


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("position") / "arm.xml"
    path.write_text(ARM, encoding="utf-8")
    return path


def found_in(source: Path, logs: list[Log]):
    simulator = load_simulator(source, None, logs[0].joint_names, None)
    return simulator, diagnose(simulator.robot, logs, simulator.model, simulator=simulator)


def test_a_wrong_gain_and_a_delay_are_found_and_the_file_follows_the_arm(source, tmp_path):
    logs = [replace(recorded(source, k, late=0.06, gain=0.7), metadata={"robot": "x"}) for k in (1, 2)]
    simulator, found = found_in(source, logs)
    result = found.result
    assert result["gap"]["of"] == "position"
    closes = [cause["closure"] for cause in result["causes"]]
    assert closes == sorted(closes, reverse=True)
    assert all(-0.05 < step["closes"] < 1.05 for step in result["waterfall"]), "each next to those before it"
    gain = next(cause for cause in result["causes"] if cause["joints"])
    assert "torque_constant" in (gain["effect"], *(other["effect"] for other in gain["equivalent_to"]))
    assert gain["joints"] == ["elbow"]
    assert all(
        after < 0.1 * before for before, after in zip(result["gap"]["before"], result["gap"]["after"], strict=True)
    )
    for value, low, high in result["servo"]["delay_s"]:
        assert value == pytest.approx(0.06, abs=3e-3)
        assert low <= value <= high
        assert high > 0.069  # smooth from frame to frame, these commands would be late by half a frame more
    out = tmp_path / "fixed.xml"
    write_corrected(simulator, corrected_numbers(found, simulator), out)
    assert error_of(out, recorded(source, 3, late=0.06, gain=0.7)) < 2e-3
    assert not any("lets a stationary joint creep" in warning for warning in found.warnings)
    assert (mujoco.MjModel.from_xml_path(str(out)).dof_solimp[:, 0] < 0.999).all(), "friction is as soft as the file's"


def test_a_servo_that_is_later_than_the_other_one_is_named_and_written_and_read_again(source, tmp_path):
    logs = [recorded(source, k, late=0.02, later=0.03) for k in (1, 2)]
    simulator, found = found_in(source, logs)
    result = found.result
    delays = {tuple(c["joints"]): c["parameters"]["delay"] for c in result["causes"] if c["effect"] == "time_delay"}
    assert len(delays) == 2, "that of the arm, and of a joint that differs"
    by_joint = [delays.get((name,), delays[()]) for name in ("lift", "elbow")]
    np.testing.assert_allclose(by_joint, (0.02, 0.05), atol=3e-3)
    for (value, low, high), true in zip(result["servo"]["delay_s"], (0.02, 0.05), strict=True):
        assert low <= true <= high < true + 0.02
        assert value == pytest.approx(true, abs=3e-3)
    out, held_out = tmp_path / "fixed.xml", recorded(source, 3, late=0.02, later=0.03)
    write_corrected(simulator, corrected_numbers(found, simulator), out)
    assert error_of(out, held_out) < 2e-3 < 0.1 * error_of(source, held_out)
    again = load_simulator(out, None, logs[0].joint_names, None).arm
    np.testing.assert_allclose(again.servos.delay, (0.02, 0.05), atol=3e-3)
    drawn = ranges(found, corrected_numbers(found, simulator))
    named = {entry.of: entry.value for entry in drawn if entry.parameter == "delay"}
    both = [named.get(f"actuator of {name}", named["actuators"]) for name in ("lift", "elbow")]
    np.testing.assert_allclose(both, (0.02, 0.05), atol=3e-3)


def test_a_servo_that_stands_off_its_set_points_is_found_and_written_as_a_bias(source, tmp_path):
    logs = [recorded(source, k, late=0.02, offset=0.04) for k in (1, 2)]
    simulator, found = found_in(source, logs)
    result = found.result
    cause = next(cause for cause in result["causes"] if cause["joints"])
    assert (cause["effect"], cause["joints"]) == ("torque_offset", ["elbow"])
    assert cause["parameters"]["set_point_offset"] == pytest.approx(0.04, abs=4e-3)
    assert {"effect": "asymmetric_friction", "joints": ["elbow"]} in cause["equivalent_to"]
    lift, elbow = result["servo"]["offset"]
    assert elbow[1] <= 0.04 <= elbow[2]
    assert lift[1] <= 0 <= lift[2]
    out, held_out = tmp_path / "fixed.xml", recorded(source, 3, late=0.02, offset=0.04)
    write_corrected(simulator, corrected_numbers(found, simulator), out)
    assert error_of(out, held_out) < 2e-3 < 0.1 * error_of(source, held_out)
    model = mujoco.MjModel.from_xml_path(str(out))
    assert model.actuator_biasprm[1, 0] / model.actuator_gainprm[1, 0] == pytest.approx(0.04, abs=4e-3)
    for target in ("mjcf", "newton"):
        assert (
            CliRunner().invoke(app, ["export", str(out), "--for", target, "-o", str(tmp_path / target)]).exit_code == 0
        )
    again = mujoco.MjModel.from_xml_path(str(next((tmp_path / "mjcf").glob("*.xml"))))
    assert again.actuator_biasprm[1, :3] == pytest.approx(model.actuator_biasprm[1, :3])
    assert '"of": " of elbow"' in (tmp_path / "newton" / "left_out.json").read_text(encoding="utf-8")
    assert "torque_offset" not in (tmp_path / "mjcf" / "left_out.json").read_text(encoding="utf-8")


def test_a_cable_at_a_joint_is_a_spring_of_the_corrected_file(source, tmp_path):
    logs = [recorded(source, k, late=0.02, spring=1.0) for k in (1, 2)]
    simulator, found = found_in(source, logs)
    cause = next(cause for cause in found.result["causes"] if cause["joints"])
    assert (cause["effect"], cause["joints"]) == ("gravity_spring", ["elbow"])
    assert cause["parameters"]["stiffness"] == pytest.approx(1.0, rel=0.1)
    spring = next(entry for entry in ranges(found, corrected_numbers(found, simulator)) if "spring" in entry.of)
    assert (spring.of, spring.parameter, spring.unit) == ("gravity_spring of elbow", "stiffness", "N·m/rad")
    assert spring.low <= spring.value == pytest.approx(cause["parameters"]["stiffness"])
    out, held_out = tmp_path / "fixed.xml", recorded(source, 3, late=0.02, spring=1.0)
    write_corrected(simulator, corrected_numbers(found, simulator), out)
    assert error_of(out, held_out) < 2e-3 < 0.1 * error_of(source, held_out)
    model = mujoco.MjModel.from_xml_path(str(out))
    np.testing.assert_allclose(model.jnt_stiffness, (0, 1), atol=0.1)
    again = load_simulator(out, None, logs[0].joint_names, None)
    assert diagnose(again.robot, logs, again.model, simulator=again).result["verdict"] == "no_gap", "read as written"


@pytest.mark.parametrize("offset", [-1e-3, pytest.param(1e-3, marks=pytest.mark.verify)])
def test_a_servo_that_hardly_stands_off_its_set_points_is_healthy(source, offset):
    result = found_in(source, [recorded(source, k, offset=offset) for k in (1, 2)])[1].result
    assert result["verdict"] == "no_gap"
    _, elbow = result["servo"]["offset"]
    assert elbow[1] <= offset <= elbow[2]


def error_of(path: Path, log: Log) -> float:
    """RMS error [rad] of the free motion of a file under the commands of a log."""
    arm = FreeSimulator(load_simulator(path, None, log.joint_names, None).arm)
    start = (0.0, log.position[0], np.zeros(2))
    motion = arm.run(arm.numbers, RecordedCommand(log.t, log.reference_position, True), start, float(log.t[-1]))
    assert motion is not None
    return float(np.sqrt(np.mean((motion.at(log.t) - log.position) ** 2)))


# no weight tells the gain of an upright axis
@pytest.mark.parametrize("axis", ["0 1 0", pytest.param("0 0 1", marks=pytest.mark.verify)])
def test_servos_fifty_times_too_stiff_are_corrected(tmp_path, axis):
    true, stiff = tmp_path / "true.xml", tmp_path / "stiff.xml"
    true.write_text(ARM.replace('"lift" axis="0 1 0"', f'"lift" axis="{axis}"'), encoding="utf-8")
    stiff.write_text(true.read_text().replace('kp="20" kv="0.5"', 'kp="1000" kv="3"'), encoding="utf-8")
    simulator, found = found_in(stiff, [recorded(true, k, late=0.02) for k in (1, 2)])
    assert all(step["closes"] > -0.05 for step in found.result["waterfall"]), "steps are joined until they close"
    if over_kp := found.result.get("servo_over_kp"):
        for kind, ratio in (("damping", 0.8 / 20), ("friction", 0.05 / 20)):
            assert all(low <= ratio <= high for _, low, high in over_kp[kind])
    else:
        assert all(low <= 20 <= high for _, low, high in found.result["servo"]["kp"])
    out, other = tmp_path / "fixed.xml", recorded(true, 3, late=0.02)
    write_corrected(simulator, corrected_numbers(found, simulator), out)
    assert error_of(out, other) < 4e-3 < 0.1 * error_of(stiff, other)


def test_a_position_and_a_velocity_actuator_of_a_joint_are_one_servo(source, tmp_path):
    both = ARM.replace(' kv="0.5"', "")
    for joint in ("lift", "elbow"):
        own = f'<position joint="{joint}"/>'
        both = both.replace(own, f'{own}<velocity joint="{joint}" kv="0.5"/>')
    file, out = tmp_path / "both.xml", tmp_path / "fixed.xml"
    file.write_text(both, encoding="utf-8")
    simulator, found = found_in(file, [recorded(source, k, gain=0.7) for k in (1, 2)])
    np.testing.assert_allclose(simulator.arm.servos.damping, 0.5)
    assert [cause["joints"] for cause in found.result["causes"]] == [["elbow"]]
    write_corrected(simulator, corrected_numbers(found, simulator), out)
    again = load_simulator(out, None, ("lift", "elbow"), None).arm.servos
    np.testing.assert_allclose(again.stiffness, (20, 14), rtol=0.02)
    np.testing.assert_allclose(again.damping, 0.5, atol=0.02)
    file.write_text(both.replace("<velocity", "<position"), encoding="utf-8")
    assert "several actuators" in load_simulator(file, None, ("lift", "elbow"), None).arm.servos


def test_contacts_of_a_file_where_the_arm_was_recorded_are_left_out(source, tmp_path):
    blocked = tmp_path / "blocked.xml"
    post = '<worldbody><body name="post" pos="0.3 0 -0.1"><geom type="box" size="0.08 0.1 0.02"/></body>'
    fore = '<body name="fore" pos="0.2 0 0"><geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0"/>'
    text = ARM.replace("<worldbody>", post).replace('<body name="fore" pos="0.2 0 0">', fore)
    blocked.write_text(text, encoding="utf-8")
    simulator, found = found_in(blocked, [recorded(source, k, gain=0.7) for k in (1, 2)])
    assert [cause["joints"] for cause in found.result["causes"]] == [["elbow"]]
    assert any("fore and post" in warning for warning in found.result["warnings"])
    out, other = tmp_path / "fixed.xml", recorded(source, 3, gain=0.7)
    write_corrected(simulator, corrected_numbers(found, simulator), out)
    assert '<exclude body1="fore" body2="post"' in out.read_text(encoding="utf-8")
    assert error_of(out, other) < 2e-3 < 0.1 * error_of(blocked, other)


def test_a_delay_is_named_next_to_numbers_that_are_all_guessed(source, tmp_path):
    guess = tmp_path / "guess.xml"
    guess.write_text(ARM.replace('armature="0.03" damping="0.3" frictionloss="0.05"', 'armature="0.01" damping="0.1"'))
    result = found_in(guess, [recorded(source, k, late=0.04) for k in (1, 2)])[1].result
    delay = next(cause for cause in result["causes"] if cause["effect"] == "time_delay")
    assert delay["parameters"]["delay"] == pytest.approx(0.04, abs=2e-3)
    assert delay["closure"] < 0.1 < delay["closure_of_joints"], "friction that is missing leaves far more"


def carrying(folder: Path, mass: float) -> Path:
    """The file of the arm with a ball at its last link."""
    path = folder / "loaded.xml"
    ball = f'<geom type="sphere" size="0.001" pos="0.15 0 0" mass="{mass}" contype="0" conaffinity="0"/>'
    text = ARM.replace("</body></body></worldbody>", f'<body name="load">{ball}</body></body></body></worldbody>')
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.verify
def test_wrong_gains_of_all_servos_are_no_load(source):
    result = found_in(source, [recorded(source, k, gain=0.7, joints=slice(0, 2)) for k in (1, 2)])[1].result
    assert result["verdict"] == "explained"
    assert {(cause["effect"], *cause["joints"]) for cause in result["causes"]} == {
        ("torque_constant", "lift"),
        ("torque_constant", "elbow"),
    }


def test_the_next_set_points_are_planned_where_a_load_may_be_links(source, tmp_path):
    logs, loaded = [], carrying(tmp_path, 0.06)
    for k in (1, 2):
        log = recorded(loaded, k)
        logs.append(str(tmp_path / log.name))
        write_log(Path(logs[-1]), replace(log, path=Path(logs[-1])))
    page, next_folder = tmp_path / "page.html", tmp_path / "next"
    words = ["diagnose", "--model", str(source), "--next", str(source), "-o", str(next_folder), "--report", str(page)]
    found = CliRunner().invoke(app, [*words, *logs])
    assert found.exit_code == 0, found.exception
    assert "payload or inertial_mismatch" in found.stdout
    assert "probability of the right answer" in found.stdout
    assert (next_folder / "motion_1.csv").is_file()
    assert "probability" in page.read_text(encoding="utf-8").lower()


def test_a_load_is_found_with_its_mass_next_to_friction_and_not_as_gains_of_all_servos(source, tmp_path):
    found = found_in(source, [recorded(carrying(tmp_path, 0.2), k, late=0.12, friction=2.0) for k in (1, 2)])[1]
    result = found.result
    assert not any("commands were cut" in warning for warning in found.warnings)
    load = next(cause for cause in result["causes"] if cause["effect"] == "payload")
    assert {other["effect"] for other in load["equivalent_to"]} == {"inertial_mismatch"}
    assert load["parameters"]["mass"] == pytest.approx(0.2, rel=0.03)
    assert load["closure"] < 0.1, "the delay makes most of the gap"
    named = {(cause["effect"], *cause["joints"]) for cause in result["causes"]}
    assert named == {("time_delay",), ("payload",), ("friction_change", "elbow")}


def test_how_a_log_begins_is_simulated_and_not_judged(source):
    log = recorded(source, 1)
    simulator = load_simulator(source, None, log.joint_names, None)
    free, reference = FreeSimulator(simulator.arm), NominalModel(simulator.model)
    whole, later = (
        stretch.linearised(free, free.numbers, stretch.run(free, free.numbers), reference)
        for stretch in (stretches_of([log], True)[0], stretches_of([log], True, settling=0.5)[0])
    )
    left = round(0.5 * RATE)
    np.testing.assert_allclose(
        later.number_columns(free, free.numbers), whole.number_columns(free, free.numbers)[left:], rtol=1e-9
    )
    assert len(later.signals.time[later.signals.kept]) == len(log.t) - left


def test_a_row_is_the_mean_of_a_tenth_of_a_second_and_hides_less_by_rounding(source):
    log = recorded(source, 1)
    simulator = load_simulator(source, None, log.joint_names, None)
    free, (stretch,) = FreeSimulator(simulator.arm), stretches_of([log], True, settling=0.5)
    line = stretch.linearised(free, free.numbers, stretch.run(free, free.numbers), NominalModel(simulator.model))
    time = stretch.averaged(log.t[stretch.judged])
    np.testing.assert_allclose(np.diff(time), 0.1, rtol=1e-9)
    np.testing.assert_allclose(line.motion.time[line.rows], time, atol=0.5 / RATE)
    simulated = line.motion.at(log.t[stretch.judged])
    rounding = np.round(simulated / 0.0015) * 0.0015 - simulated
    each, mean = (np.sqrt(np.mean(part**2, axis=0)) for part in (rounding, stretch.averaged(rounding)))
    assert np.all(mean < 0.7 * each)


@pytest.mark.parametrize("holds", [False, True])
def test_the_linear_response_is_the_change_of_the_simulated_motion(source, holds):
    log = recorded(source, 1)
    simulator = load_simulator(source, None, log.joint_names, None)
    free, (stretch,) = FreeSimulator(simulator.arm), stretches_of([log], held=True)
    free = free.holding() if holds else free
    motion = stretch.run(free, free.numbers)
    line = stretch.linearised(free, free.numbers, motion, NominalModel(simulator.model))
    columns = line.number_columns(free, free.numbers)
    for place in range(14):
        table = free.numbers.table.ravel()
        step = 0.01 * max(table[place], 0.02)
        table[place] += step
        changed = stretch.run(free, ServoNumbers.of_table(table.reshape(-1, 2)))
        difference = (changed.at(log.t) - motion.at(log.t)) / step
        assert np.corrcoef(difference.ravel(), columns[:, :, place].ravel())[0, 1] > 0.97


def test_a_smooth_command_is_smooth_between_its_frames_and_keeps_to_a_step():
    t, delay = np.arange(60) / 30, 0.02
    wave, edges = 2 * np.pi * 3, np.arange(0.5, 1.5, 1e-3)
    command = RecordedCommand(t, np.stack([np.sin(wave * t), t > 1.0], axis=1), held=False)
    sine, step = command.between(edges, np.full(2, delay)).T
    middle = (edges[1:] + edges[:-1]) / 2 - delay
    assert np.abs(sine - np.sin(wave * middle)).max() < 0.5 * (wave / 30) ** 2 / 8  # half of what straight lines miss
    assert step.min() >= 0
    assert step.max() <= 1


@pytest.mark.parametrize("holds", [pytest.param(False, marks=pytest.mark.verify), True])
def test_friction_holds_a_stationary_joint_where_the_arm_does(source, tmp_path, holds):
    logs = [recorded(source, k, rest=2.0, impedance=0.9999 if holds else 0.9, seconds=6.0) for k in (1, 2)]
    simulator, found = found_in(source, logs)
    assert found.verdict == "no_gap"
    assert any("lets a stationary joint creep" in warning for warning in found.warnings) is holds
    out = tmp_path / "fixed.xml"
    write_corrected(simulator, corrected_numbers(found, simulator), out)
    assert (mujoco.MjModel.from_xml_path(str(out)).dof_solimp[:, 0] > 0.999).all() == holds


def test_a_simulation_in_steps_moves_as_an_arm_that_has_none(source, tmp_path):
    one_joint = ARM[: ARM.index('<body name="fore"')] + "</body></worldbody>"
    one_joint += '<actuator><position joint="lift"/></actuator></mujoco>'
    log = recorded(source, 1, seconds=6.0)
    for number, text in enumerate((ARM, one_joint)):
        moved = []
        for step in ("0.002", "0.0001"):
            path = tmp_path / f"{number}_{step}.xml"
            path.write_text(text.replace('timestep="0.002"', f'timestep="{step}"'), encoding="utf-8")
            names = log.joint_names[: 2 - number]
            free = FreeSimulator(load_simulator(path, None, names, None).arm).holding()
            n = len(names)
            command = RecordedCommand(log.t, log.reference_position[:, :n], True)
            heavy = replace(free.numbers, armature=free.numbers.armature * 2, damping=free.numbers.damping * 3)
            start = (0.0, log.position[0, :n], np.zeros(n))
            moved += [
                free.run(numbers, command, start, float(log.t[-1])).at(log.t) for numbers in (free.numbers, heavy)
            ]
        plain, heavy, plain_exact, heavy_exact = moved
        assert np.sqrt(np.mean((plain - plain_exact) ** 2)) < 3e-5
        assert np.sqrt(np.mean((heavy - heavy_exact) ** 2)) < 1.2e-4
        assert np.abs(heavy - plain).max() > 0.02


@pytest.mark.verify
def test_commands_that_a_recorder_cut_are_said_and_are_no_fault(source):
    logs = [recorded(source, k, late=0.02, rest=2.0, nearest=0.1, seconds=6.0) for k in (1, 2)]
    found = found_in(source, logs)[1]
    (nearest,) = [re.search(r"cut to within ([\d.]+) ", warning) for warning in found.warnings if "cut to" in warning]
    assert nearest is not None
    assert float(nearest[1]) == pytest.approx(0.1, rel=0.02)
    assert {cause["effect"] for cause in found.result["causes"]} <= {"time_delay"}
    assert max(found.result["gap"]["after"]) < 5e-4, "how near they are cut is a number of the fit"
    _, low, high = found.result["servo"]["delay_s"][0]
    assert low <= 0.02 <= high


@pytest.mark.verify
def test_friction_of_joints_whose_damping_bends_is_not_known_better_than_it_is(source):
    logs = [recorded(source, k, bend=-0.05) for k in (1, 2)]
    simulator = load_simulator(source, None, logs[0].joint_names, None)
    result = diagnose(simulator.robot, logs, simulator.model, simulator=simulator, known_kp=True).result
    assert all(low <= 0.05 <= high for _, low, high in result["servo"]["friction"])
    assert not any(cause["effect"] == "friction_change" for cause in result["causes"])


def test_a_simulation_that_blows_up_is_told_by_its_answer_alone(source, tmp_path, monkeypatch, capfd):
    """MuJoCo would print a warning, and write it to a file where the command runs."""
    monkeypatch.chdir(tmp_path)
    simulator = load_simulator(source, None, ("lift", "elbow"), None)
    log = recorded(source, 1)
    free, stretch = FreeSimulator(simulator.arm), stretches_of([log], True, 0.0)[0]
    assert stretch.run(free, replace(free.numbers, armature=np.full(2, -9.0))) is None
    assert capfd.readouterr().err == ""
    assert not list(tmp_path.iterdir())
    assert mujoco.get_mju_user_warning() is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda log: replace(log, reference_position=log.position), "measured positions themselves"),
        (lambda log: replace(log, reference_position=None), "neither torque"),
        (lambda log: replace(log, reference_position=log.reference_position + 3.0), "another unit, zero or arm"),
    ],
)
def test_commands_that_say_nothing_are_refused(source, change, said):
    with pytest.raises(InputError, match=said):
        found_in(source, [change(recorded(source, 1))])
