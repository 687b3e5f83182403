"""The whole job over a real socket, and what is left when it is cut short."""

import json
import re
import signal
from pathlib import Path

import numpy as np
import pytest

from agent.estimation import FilterSettings, motions
from agent.model import IdentifiedModel
from agent.recording import read_log
from agent.robot import load_robot
from drivers.transports.tcp.driver import TcpDriver
from fake_controller.plant import Plant
from tests.small_arms import true_torque

JOINTS = [f"joint_{k + 1}" for k in range(6)]


def score_of_the_truth(folder: Path) -> np.ndarray:
    """(n,) normalised RMSE on moving samples of the plant's own parameters, on the validation logs of a run."""
    robot = load_robot("comau_ns16")
    plant = Plant(robot, seed=7)
    errors = []
    for path in sorted(folder.glob("validation_*.mcap")):
        for motion in motions(read_log(path, robot), FilterSettings(30.0), reduce=False):
            predicted = motion.low_pass(true_torque(plant, motion.q, motion.qd, motion.qdd))
            moving = np.any(np.abs(motion.qd[motion.kept]) > 1e-3 * robot.max_velocity, axis=1)
            errors.append((motion.low_pass(motion.torque) - predicted)[moving])
    return np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)) / robot.nominal_torque


#: What others read of `result.json`, in its order.
DOCUMENT = """
schema robot accepted reason gate normalised_rmse not_judged search method seed fitness evaluations motion
estimation method cutoff_hz parameters base_parameters condition_number notes
validation motions speed joints units rmse normalised_rmse normalised_rmse_all_samples relative_error_all_joints
recordings log samples lost duration provenance serial conditions reference diagnosis current_model
"""


def keys(document: dict) -> list[str]:
    """Keys of a document and of what lies in it, but not of what is named after files or measured by others."""
    found = []
    for key, value in document.items():
        inner = value[0] if key == "recordings" else value
        found += [key, *(keys(inner) if isinstance(inner, dict) and key not in ("provenance", "conditions") else ())]
    return found


def test_calibrates_the_emulated_robot_end_to_end(controller, write_recipe, run_agent, tmp_path: Path):
    recipe = write_recipe(controller.address, speed="0.2 m/s")
    run = run_agent("calibrate", recipe)
    assert run.returncode == 0, run.stderr
    folder = tmp_path / run.stdout.strip()
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    assert keys(result) == DOCUMENT.split()
    assert result["accepted"] is True
    assert "(gate 3 % of nominal torque on every axis)" in run.stderr
    assert result["gate"] == {"normalised_rmse": 0.03, "not_judged": []}
    assert result["estimation"]["cutoff_hz"] == 30.0
    assert result["validation"]["units"] == ["N·m"] * 6
    figures = np.array(result["validation"]["normalised_rmse"])
    assert figures.max() <= 0.02
    assert np.all(figures <= 1.3 * score_of_the_truth(folder))
    assert result["validation"]["motions"] == 2
    assert [entry["lost"] for entry in result["recordings"]] == [0, 0, 0]
    for name in ("fitness", "condition number", "prediction error", "accepted", "report.html"):
        assert name in run.stderr
    assert re.search(r"motion 1 of 3, excitation: .* s left in all", run.stderr)
    assert "current model       this run" in run.stderr
    assert f"agent recalibrate {recipe}" in run.stderr
    page = (folder / "report.html").read_text(encoding="utf-8")
    (condition,) = re.findall(r"condition number +([0-9]+) ", run.stderr)
    assert f"Condition number {condition} " in page, "one number in the summary and on the page"
    assert "current model: this run." in page

    model = IdentifiedModel.load(folder / "model.json")
    assert len(model.base_values) == 40
    assert np.isfinite(model.standard_deviations).all()
    log = read_log(folder / "excitation.mcap", load_robot("comau_ns16"))
    assert log.metadata["motion"] == "excitation"
    assert len(log.cycle_starts) == 2
    planned = np.isfinite(log.planned_position).all(axis=1)
    assert planned.any()
    gap = np.sqrt(np.mean((log.planned_position - log.reference_position)[planned] ** 2))
    assert 1e-6 < gap < 0.2, "the controller's interpolator is near ours, not ours"
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")

    again = run_agent("calibrate", write_recipe(controller.address, motions=1), "-q")
    assert again.returncode == 0, again.stderr
    assert again.stdout.strip() != run.stdout.strip()
    assert f"current model       unchanged (run {folder.name})" in again.stderr
    assert f"to make this model the current one: agent apply {Path(again.stdout.strip()).name}" in again.stderr
    later = (tmp_path / again.stdout.strip() / "report.html").read_text(encoding="utf-8")
    assert f"current model: unchanged (run {folder.name})" in later
    kept = run_agent("trajectories", "--json")
    assert len(json.loads(kept.stdout)["trajectories"]) == 1, "the same search finds the same loop"


@pytest.mark.parametrize(("kill", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_stops_the_arm_and_says_where(
    only_run,
    start_controller,
    write_recipe,
    start_agent,
    wait_for_motion,
    run_agent,
    tmp_path: Path,
    kill: signal.Signals,
    code: int,
):
    controller = start_controller("--clock", "real")
    recipe = write_recipe(controller.address, motions=1, cycles=1)
    process = start_agent("calibrate", recipe)
    wait_for_motion(process)
    process.send_signal(kill)
    _, errors = process.communicate()
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    assert "the arm was stopped and stands" in errors
    folder = only_run(tmp_path / "logs")
    assert f"finished steps are in logs/{folder.name}" in errors
    assert f"--resume {folder.name}" in errors
    state = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    assert (state["status"], state["stopped"]["step"]) == ("stopped", "record")
    assert len(read_log(folder / "excitation.mcap").t) > 0
    driver = TcpDriver(controller.address)
    driver.connect()
    assert not driver.status().moving
    driver.close()

    recipe.write_text(recipe.read_text(encoding="utf-8").replace("cycles: 1", "cycles: 2"), encoding="utf-8")
    other = run_agent("calibrate", recipe, "--resume", folder)
    assert other.returncode == 2
    assert "another recipe" in other.stderr


def test_check_and_calibrate_refuse_an_unsupported_sample_rate(controller, write_recipe, run_agent):
    recipe = write_recipe(controller.address)
    recipe.write_text(recipe.read_text(encoding="utf-8").replace("rate: 500 Hz", "rate: 1000 Hz"), encoding="utf-8")
    checked = run_agent("check", recipe, "--json", "-q")
    assert checked.returncode == 4
    (problem,) = (entry for entry in json.loads(checked.stdout)["findings"] if not entry["ok"])
    assert problem["subject"] == "controller"
    assert "samples every 2 ms, the recipe asks for 1000 Hz: change record.rate" in problem["message"]
    run = run_agent("calibrate", recipe)
    assert run.returncode == 4
    assert "change record.rate" in run.stderr
    assert "start again with: agent calibrate recipe.yaml" in run.stderr
    assert "--resume" not in run.stderr


def test_resumes_a_stopped_run_and_keeps_one_that_misses_the_gate(
    only_run, start_controller, write_recipe, start_agent, wait_for_motion, run_agent, tmp_path: Path
):
    slow = start_controller("--clock", "real")
    recipe = write_recipe(slow.address, motions=1, cycles=1, gate=1e-5)
    process = start_agent("calibrate", recipe)
    wait_for_motion(process)
    process.kill()
    process.communicate()
    slow.end()
    folder = only_run(tmp_path / "logs")
    port = slow.address.rsplit(":", 1)[1]
    same = start_controller("--clock", "fast", "--port", port)
    run = run_agent("calibrate", recipe, "--resume", folder.name)
    assert run.returncode == 3, run.stderr
    assert "of nominal torque, 1 unseen motion at " in run.stderr
    assert "(gate 0.001 % of nominal torque on every axis)" in run.stderr
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "the gate is 0.001 %" in page
    assert "on 1 unseen motion in the sub-region" in page
    assert "search" not in run.stderr.split("fitness")[0], "the plan was finished and is not searched again"
    assert (folder / "excitation.stopped1.mcap").exists()
    state = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    assert state["status"] == "rejected"

    same.end()
    start_controller("--port", port, "--seed", "8")
    state |= {"status": "stopped", "steps": {name: state["steps"][name] for name in ("plan", "excitation.mcap")}}
    (folder / "state.json").write_text(json.dumps(state), encoding="utf-8")
    other = run_agent("calibrate", recipe, "--resume", folder.name)
    assert other.returncode == 4
    assert "serial FAKE-0008" in other.stderr
    assert "are of FAKE-0007" in other.stderr


def test_impossible_torque_makes_no_model(only_run, start_controller, write_recipe, run_agent, tmp_path: Path):
    effects = tmp_path / "millimetres.json"
    effects.write_text(
        json.dumps([{"effect": "torque_constant", "joints": JOINTS, "parameters": {"scale": 1000}}]), encoding="utf-8"
    )
    recipe = write_recipe(start_controller("--effects", str(effects)).address, motions=1, cycles=1)
    run = run_agent("calibrate", recipe)
    assert run.returncode == 3, run.stderr
    assert "excitation.mcap: torques look like N·mm" in run.stderr
    folder = only_run(tmp_path / "logs")
    assert not (folder / "model.json").exists()
    stopped = json.loads((folder / "state.json").read_text(encoding="utf-8"))["stopped"]
    assert stopped["step"] == "estimate"
    assert "N·mm" in stopped["reason"]


def test_a_controller_killed_in_motion_ends_the_run(
    only_run, start_controller, write_recipe, start_agent, wait_for_motion, tmp_path: Path
):
    controller = start_controller("--clock", "real")
    process = start_agent("calibrate", write_recipe(controller.address, motions=1, cycles=1))
    wait_for_motion(process)
    controller.end()
    _, errors = process.communicate()
    assert process.returncode == 4, errors
    assert "Traceback" not in errors
    folder = only_run(tmp_path / "logs")
    assert len(read_log(folder / "excitation.mcap").t) > 0
    assert json.loads((folder / "state.json").read_text(encoding="utf-8"))["stopped"]["step"] == "record"


def test_a_second_agent_on_the_same_robot_is_told_that_it_is_busy(
    start_controller, write_recipe, start_agent, wait_for_motion, run_agent
):
    controller = start_controller("--clock", "real")
    recipe = write_recipe(controller.address, motions=1, cycles=1)
    first = start_agent("calibrate", recipe)
    wait_for_motion(first)
    second = run_agent("calibrate", recipe)
    first.kill()
    first.communicate()
    assert second.returncode == 75
    assert "another run holds this robot" in second.stderr


@pytest.mark.verify
def test_quickstart_figures(start_controller, run_agent, only_run, measured, tmp_path: Path):
    """The quickstart as it is, all thirty motions."""
    controller = start_controller("--clock", "fast")
    text = (Path(__file__).parents[2] / "recipes" / "ns16_quickstart.yaml").read_text(encoding="utf-8")
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(text.replace("127.0.0.1:9100", controller.address), encoding="utf-8")
    run = run_agent("calibrate", recipe)
    assert run.returncode == 0, run.stderr
    folder = only_run(tmp_path / "logs")
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    figures = np.array(result["validation"]["normalised_rmse"])
    worst, ratio = figures.max(), np.max(figures / score_of_the_truth(folder))
    measured("quickstart, fitness log10 det(HᵀH/M)", result["search"]["fitness"])
    measured("quickstart, worst axis on 30 unseen motions", 100 * worst, "% of nominal", "at most 2 %", worst <= 0.02)
    measured("quickstart, error over that of the plant's own parameters", ratio, "", "at most 1.3", ratio <= 1.3)
    assert result["validation"]["motions"] == 30
    assert worst <= 0.02
    assert ratio <= 1.3
