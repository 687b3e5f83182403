"""Figures on measured data, all with default settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.estimation import EstimationSettings, estimate
from agent.recording import import_log, read_log
from agent.robot import load_robot
from agent.validation import predict_log, summary, validate

EXAMPLES = Path(__file__).resolve().parents[2] / "recipes/examples"


def _bootstrap(prediction, block: float, draws: int = 2000) -> tuple[float, float]:
    """95 % interval of ‖e‖/‖τ‖ by resampling blocks of `block` seconds."""
    size = int(block / np.median(np.diff(prediction.time)))
    count = len(prediction.time) // size
    energy = [
        np.add.reduceat(np.sum(signal[: count * size] ** 2, axis=1), np.arange(0, count * size, size))
        for signal in (prediction.error, prediction.measured)
    ]
    rows = np.random.default_rng(0).integers(0, count, (draws, count))
    low, high = np.percentile(np.sqrt(energy[0][rows].sum(axis=1) / energy[1][rows].sum(axis=1)), [2.5, 97.5])
    return float(low), float(high)


def test_tx40_held_out(shared_data, tmp_path, measured):
    robot = load_robot(EXAMPLES / "tx40/robot.yaml")
    tables = [shared_data / "tx40/pos_read_data.csv", shared_data / "tx40/curr_data.csv"]
    logs = {}
    for part in ("fit", "held_out"):
        import_log(robot, EXAMPLES / f"tx40/map_{part}.yaml", tables, tmp_path / f"{part}.mcap")
        logs[part] = read_log(tmp_path / f"{part}.mcap", robot)
    model = estimate(robot, [logs["fit"]], EstimationSettings.create(cutoff=20.0))
    prediction = predict_log(model, logs["held_out"])
    error = summary([prediction]).overall.relative_error_all_joints
    low, high = _bootstrap(prediction, 0.2)
    text = f"{100 * error:.2f} % [{100 * low:.2f}, {100 * high:.2f}]"
    measured("TX40 held out, all joints, every sample, block bootstrap", text, "", "at most 6.0 %", error <= 0.06)
    assert error <= 0.06
    assert low < error < high
    inside = np.mean(np.abs(prediction.error) < prediction.half_width)
    measured("TX40 held out, samples within the 95 % bounds", 100 * inside, "%", "90 to 98 %", 0.9 <= inside <= 0.98)
    assert inside > 0.88


def test_a_term_that_one_fold_speaks_against_is_taken_on_very_strong_evidence(shared_data, tmp_path):
    robot = load_robot(EXAMPLES / "tx40/robot.yaml")
    tables = [shared_data / "tx40/pos_read_data.csv", shared_data / "tx40/curr_data.csv"]
    logs = []
    for part in ("held_out", "fit"):  # the shorter stretch is fitted here
        import_log(robot, EXAMPLES / f"tx40/map_{part}.yaml", tables, tmp_path / f"{part}.mcap")
        logs.append(read_log(tmp_path / f"{part}.mcap", robot))
    model = estimate(robot, logs[:1], EstimationSettings.create(cutoff=20.0))
    assert validate(model, logs[1:]).overall.relative_error_all_joints < 0.07


def test_emps_to_the_pulse_file(shared_data, tmp_path, measured):
    robot = load_robot(EXAMPLES / "emps/robot.yaml")
    logs = []
    for name in ("DATA_EMPS", "DATA_EMPS_PULSES"):
        import_log(robot, EXAMPLES / "emps/map.yaml", [shared_data / f"emps/{name}.mat"], tmp_path / f"{name}.mcap")
        logs.append(read_log(tmp_path / f"{name}.mcap", robot))
    model = estimate(robot, logs[:1])
    error = validate(model, logs[1:], 30.0).overall.relative_error_all_joints
    measured("EMPS estimation file to pulse file, 30 Hz", 100 * error, "%", "at most 4.5 %", error <= 0.045)
    assert error <= 0.045
    mass = model.base_values[0]
    assert mass == pytest.approx(95.1, rel=0.01)


def test_a_baseline_predicts_a_second_machine_without_effects(shared_data, measured):
    robot = load_robot(shared_data / "gap-dev")
    fit = [read_log(shared_data / f"gap-dev/baseline/{name}.mcap", robot) for name in ("excite", "moves")]
    unseen = [read_log(shared_data / f"gap-dev/case_00/logs/{name}.mcap", robot) for name in ("moves", "slow")]
    result = validate(estimate(robot, fit), unseen)
    worst = max(max(entry.normalised_rmse) for entry in result.logs)
    measured(
        "gap-dev, baseline to case_00, worst joint and log",
        100 * worst,
        "% of nominal",
        "at most 0.6 %",
        worst <= 0.006,
    )
    assert worst <= 0.006
