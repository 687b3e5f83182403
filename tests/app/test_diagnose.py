"""A diagnosis that records first, over a real socket, and the files it leaves."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from agent.model import IdentifiedModel
from agent.recording import Log, write_log
from agent.robot import load_robot

DELAY = 0.008  # s


def write_zero(path: Path, **facts: str) -> Path:
    """A log of the arm on its brakes, its drives off."""
    robot = load_robot("comau_ns16")
    time, shape = np.arange(1000) / 500, (1000, robot.dof)
    effort = np.random.default_rng(1).normal(size=shape)
    log = Log(
        path,
        robot.joint_names,
        time,
        np.zeros(shape),
        None,
        effort,
        None,
        None,
        500.0,
        0.0,
        ((0, 1000),),
        metadata=facts,
    )
    write_log(path, log)
    return path


def test_a_recipe_is_recorded_then_diagnosed(start_controller, write_recipe, run_agent, only_run, tmp_path: Path):
    effects = tmp_path / "effects.json"
    effects.write_text(json.dumps([{"effect": "time_delay", "parameters": {"delay": DELAY}}]))
    controller = start_controller("--clock", "fast", "--effects", str(effects))
    recipe = write_recipe(controller.address, motions=1, speed="0.6 m/s")
    zero = write_zero(tmp_path / "zero.mcap")
    run = run_agent("diagnose", "--record", recipe, "--json", "-o", "model.json", "--drives-off", zero)
    assert run.returncode == 0, run.stderr
    assert "filtering" in run.stderr, "it says how far it has come"
    result = json.loads(run.stdout)
    named = {cause["effect"]: cause["parameters"] for cause in result["causes"]}
    assert abs(named["time_delay"]["delay"] - DELAY) < 0.2 * DELAY
    assert result["closure"] > 0.75, "over all samples, those around standstill included"
    assert max(result["motion_gap"]["before"]) > 1e-3, "the controller's interpolator is near ours, not ours"
    assert {entry["log"] for entry in result["simulation"]["logs"]} == {"excitation.mcap", "validation_01.mcap"}
    folder = only_run(tmp_path / "logs")
    assert json.loads((folder / "result.json").read_text()) == result
    assert json.loads((folder / "state.json").read_text())["status"] == "finished"
    page = folder / "report.html"
    assert "(time_delay)" in page.read_text(encoding="utf-8")
    assert "with the drives off no torque channel shows an offset" in page.read_text(encoding="utf-8")
    page.unlink()
    zero.unlink()
    assert run_agent("report", folder).returncode == 0
    assert "(time_delay)" in page.read_text(encoding="utf-8"), "made again from the run's own files"
    assert "with the drives off no torque channel shows an offset" in page.read_text(encoding="utf-8")
    assert [entry.effect for entry in IdentifiedModel.load(tmp_path / "model.json").effects] == ["time_delay"]


def test_refuses_a_drives_off_log_of_another_machine(run_agent, tmp_path: Path):
    zero = write_zero(tmp_path / "zero.mcap", serial="NS16-1")
    other = write_zero(tmp_path / "other.mcap", serial="NS16-2")
    run = run_agent("diagnose", "--robot", "comau_ns16", zero, "--drives-off", other)
    assert run.returncode == 2
    assert "not of one machine: serial NS16-1 (zero.mcap) and NS16-2 (other.mcap)" in run.stderr


def test_invalid_options_move_nothing(controller, write_recipe, run_agent, arm, tmp_path: Path):
    recipe = write_recipe(controller.address)
    for arguments, reason in (
        (["--record", recipe, "--robot", "comau_ns16"], "leave out LOG and --robot"),
        (["--record", recipe, "some.mcap"], "leave out LOG and --robot"),
        (["--robot", "comau_ns16"], "or a recipe to record"),
        (["some.mcap"], "name the robot"),
        (["--record", recipe, "--without", "squeak"], "squeak"),
        (["--record", recipe, "--model", "absent.json"], "no such file; name a model.json"),
        (["--record", recipe, "--report", "nowhere/page.html"], "there is no folder"),
        (["--record", recipe, "--report", "/proc/page.html"], "/proc/page.html: cannot be written there"),
        (["--record", recipe, "--budget", "5 min"], "of --until-sure: give that too"),
        (["--record", recipe, "--report", "both.json", "-o", "both.json"], "name two files"),
        (["--record", recipe, "--drives-off", "absent.mcap"], "absent.mcap"),
        (["--robot", "comau_ns16", "some.mcap", "--until-sure"], "name the recipe to record"),
        (["--record", recipe, "--until-sure", "--budget", "10"], "10 min"),
        (["--record", recipe, "--until-sure", "--next", recipe, "-o", "plan"], "leave out --next"),
        (["--record", recipe, "--until-sure", "--budget", "2 s"], "of motion are allowed"),
        (["--robot", "comau_ns16", "some.mcap", "--next", recipe], "with -o DIR"),
        (["--robot", "comau_ns16", "some.mcap", "--next", "absent.yaml", "-o", "next"], "absent.yaml"),
        (["--robot", "comau_ns16", "some.mcap", "--next", recipe, "-o", str(recipe)], "is a file"),
        (["--robot", arm, "some.mcap", "--next", recipe, "-o", "next"], "Name a recipe of that robot"),
    ):
        run = run_agent("diagnose", *arguments)
        assert run.returncode == 2, (arguments, run.stderr)
        assert reason in run.stderr
    assert not (tmp_path / "logs").exists()


def test_a_stopped_diagnosis_names_the_command_to_run_again(write_recipe, run_agent, tmp_path: Path):
    options = ["--cutoff", "20.0", "--without", "stribeck", "--force", "--report", "the page.html"]
    run = run_agent("diagnose", "--record", write_recipe("127.0.0.1:1"), *options, "--until-sure", "-q")
    assert run.returncode == 4
    words = shlex.split(run.stderr.partition("start again with: ")[2].splitlines()[0])
    assert words[:4] == ["agent", "diagnose", "--record", "recipe.yaml"]
    given = {
        "--cutoff 20.0",
        "--without stribeck",
        "--force",
        "--report the page.html",
        "--until-sure",
        "--budget 600 s",
    }
    assert set(re.split(r" (?=--)", " ".join(words[4:]))) == given


@pytest.mark.verify
def test_rounds_of_recording_settle_an_ambiguity(start_controller, write_recipe, run_agent, only_run, tmp_path: Path):
    healthy = start_controller("--clock", "fast")
    assert run_agent("calibrate", write_recipe(healthy.address, speed="0.3 m/s"), "--yes").returncode == 0
    model = only_run(tmp_path / "logs") / "model.json"
    effects = tmp_path / "effects.json"
    one_sided = {"effect": "asymmetric_friction", "joints": ["joint_2"], "parameters": {"coulomb": 0.3}}
    effects.write_text(json.dumps([one_sided]))
    changed = start_controller("--clock", "fast", "--effects", str(effects))
    recipe = write_recipe(changed.address, speed="0.3 m/s")
    runs = ("--logs", tmp_path / "rounds", "--yes", "--json")
    run = run_agent("diagnose", "--record", recipe, "--model", model, "--until-sure", "--budget", "2 min", *runs)
    assert run.returncode == 0, run.stderr
    result, folder = json.loads(run.stdout), only_run(tmp_path / "rounds")
    assert result["verdict"] == "ambiguous", "while it moves, the two are one"
    for number, one in enumerate(result["rounds"], start=1):
        assert {"asymmetric_friction", "torque_offset"} <= set(one["separates"])
        assert (folder / f"experiment_{number:02d}.mcap").exists()
        assert (folder / one["program"]).exists()
    held_out = {fold["held_out"].split()[0] for fold in result["folds"]}
    assert len(held_out) == 3 + len(result["rounds"]), "all logs count, a long one in parts"
