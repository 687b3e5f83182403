"""Units that call by the calendar alone, and never because a computer was switched on."""

import configparser
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest


def _units(folder: Path) -> tuple[configparser.ConfigParser, configparser.ConfigParser, list[Path]]:
    paths = sorted((folder / "systemd" / "user").iterdir())
    parsed = []
    for path in paths:
        unit = configparser.ConfigParser(interpolation=None)
        unit.optionxform = str
        unit.read(path)
        parsed.append(unit)
    return parsed[0], parsed[1], paths


def _weekly(shop: Path, every: str = "7 d") -> None:
    recipe = shop / "recipe.yaml"
    recipe.write_text(recipe.read_text(encoding="utf-8").replace("every: 1 s", f"every: {every}"), encoding="utf-8")


def test_installs_the_systemd_units(shop, run_agent, tmp_path: Path):
    _weekly(shop)
    run = run_agent("schedule", "recipe.yaml", "--at", "03:30", "--install", XDG_CONFIG_HOME=str(tmp_path))
    assert run.returncode == 0, run.stderr
    service, timer, paths = _units(tmp_path)
    assert run.stdout.split() == [str(path) for path in paths]
    assert timer["Timer"]["Persistent"] == "false"
    assert timer["Timer"]["OnCalendar"] == "*-*-* 03:30:00"
    assert not [key for key in timer["Timer"] if key.startswith("OnBoot") or key.startswith("OnStartup")]
    assert "Install" not in service, "the service itself is never started by a boot"
    assert service["Service"]["Restart"] == "no"
    assert service["Service"]["WorkingDirectory"] == str(shop)
    assert "enable --now" in run.stderr
    if shutil.which("systemd-analyze"):
        verified = subprocess.run(["systemd-analyze", "verify", *paths], capture_output=True, text=True, check=False)
        assert "Failed to parse" not in verified.stderr
        assert "Unknown" not in verified.stderr


def test_the_crontab_line_runs_recalibrate(shop, run_agent):
    _weekly(shop)
    text = run_agent("schedule", "recipe.yaml").stdout
    command = text.splitlines()[-1].split(" ", 5)[5]
    run = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False, cwd="/")
    # the package is found from the checkout in these tests, where it is not installed
    assert run.returncode == 0 or "No module named agent" in run.stderr
    if run.returncode == 0:
        assert run.stdout.startswith("skipped")


@pytest.mark.parametrize(("every", "line"), [("6 h", "0 * * * *"), ("1 d", "0 2 * * *"), ("30 d", "0 2 * * *")])
def test_the_clock_is_as_fine_as_the_interval_needs(shop, run_agent, every: str, line: str):
    _weekly(shop, every)
    assert f"\n{line} cd " in run_agent("schedule", "recipe.yaml").stdout


def test_quotes_paths_with_blanks_and_percent_signs(shop, run_agent, tmp_path: Path):
    _weekly(shop)
    odd = shop / "50 % wear"
    odd.mkdir()
    (shop / "recipe.yaml").rename(odd / "my recipe.yaml")
    run = run_agent("schedule", "50 % wear/my recipe.yaml", "--install", XDG_CONFIG_HOME=str(tmp_path))
    assert run.returncode == 0, run.stderr
    service, _, paths = _units(tmp_path)
    assert f'"{shop}/50 %% wear/my recipe.yaml"' in service["Service"]["ExecStart"]
    assert paths[0].name == "calibration-agent-my-recipe.service"
    assert r"50 \% wear" in run_agent("schedule", "50 % wear/my recipe.yaml").stdout


@pytest.mark.parametrize(("option", "why"), [("25:00", "a time of day"), ("noon", "a time of day")])
def test_refuses_an_invalid_time_of_day(shop, run_agent, option: str, why: str):
    _weekly(shop)
    run = run_agent("schedule", "recipe.yaml", "--at", option)
    assert run.returncode == 2
    assert why in run.stderr


def test_refuses_to_schedule_an_interval_of_seconds(shop, run_agent):
    run = run_agent("schedule", "recipe.yaml")
    assert run.returncode == 2
    assert "an hour or more" in run.stderr


def test_schedule_checks_the_authorisation(shop, run_agent):
    _weekly(shop)
    run = run_agent("schedule", "recipe.yaml", "--authorisation", "nothing.yaml")
    assert run.returncode == 2
    assert "no such file" in run.stderr


@pytest.mark.parametrize(
    "name", ["x\nExecStartPre=/bin/false", "x\r[Service]", "x\\", "x\n* * * * * touch owned", "x\x85y"], ids=range(5)
)
@pytest.mark.parametrize("what", ["folder", "logs", "authorisation", "recipe"])
def test_a_recipe_name_cannot_inject_a_unit_directive(shop, tmp_path: Path, name: str, what: str):
    from agent.core import InputError
    from agent.pipeline.setup.schedule import make_schedule
    from agent.recipe import load_recipe

    _weekly(shop)
    recipe = load_recipe(shop / "recipe.yaml")
    places = {"logs": tmp_path, "folder": tmp_path, "authorisation": tmp_path}
    if what == "recipe":
        recipe = replace(recipe, path=tmp_path / name)
    else:
        places[what] = tmp_path / name
    with pytest.raises(InputError, match="control characters, or a backslash"):
        make_schedule(recipe, at="02:30", **places)


def test_a_robot_name_cannot_inject_a_unit_directive(shop, tmp_path: Path):
    from agent.core import InputError
    from agent.pipeline.setup.schedule import make_schedule
    from agent.recipe import load_recipe

    _weekly(shop)
    recipe = load_recipe(shop / "recipe.yaml")
    recipe = replace(recipe, robot=replace(recipe.robot, name="arm\n[Service]\nExecStartPre=/bin/false"))
    with pytest.raises(InputError, match="control characters"):
        make_schedule(recipe, tmp_path, tmp_path, "02:30", None)


def test_units_of_another_recipe_are_not_replaced(shop, run_agent, tmp_path: Path):
    _weekly(shop)
    text = (shop / "recipe.yaml").read_text(encoding="utf-8")
    (shop / "left arm.yaml").write_text(text, encoding="utf-8")
    (shop / "left-arm.yaml").write_text(text, encoding="utf-8")

    def install(name: str, at: str) -> int:
        return run_agent("schedule", name, "--at", at, "--install", XDG_CONFIG_HOME=str(tmp_path)).returncode

    assert [install("left arm.yaml", "02:30"), install("left arm.yaml", "03:30")] == [0, 0]
    assert install("left-arm.yaml", "02:30") == 2
    service, timer, _ = _units(tmp_path)
    assert "left arm.yaml" in service["Service"]["ExecStart"]
    assert timer["Timer"]["OnCalendar"] == "*-*-* 03:30:00"
