"""A fake controller on a real socket, one calibration against it that the tests share, and runs written by hand."""

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.core import sha256_text
from agent.runs import stored_loops
from tests import warm
from tests.browser import Browser
from tests.conftest import DRAW, drawn

JOINTS = [f"joint_{k + 1}" for k in range(6)]
RECIPE = """
robot: comau_ns16
controller: {{driver: tcp, address: "{address}"}}
motion:
  speed: 1 m/s
  via_points:
    count: 6
    box:
      centre: [1.0 m, {aside}, 0.8 m]
      size: [500 mm, 600 mm, 400 mm]
      orientation: [0 deg, 180 deg, 0 deg]
      cone: 30 deg
search: {{population: 4, generations: 1, seed: {seed}}}
record: {{rate: 500 Hz, cycles: 3}}
validate: {{motions: 1, speed: 0.5 m/s, seed: 2}}
gate: {{normalised_rmse: 3 %}}
recalibrate: {{every: {every}, parameters: friction}}
"""
#: Which loop is searched for, and where.
LOOP = drawn({"seed": 1, "aside": "0 m"}, lambda rng: {"seed": DRAW, "aside": f"{rng.integers(-90, 91)} mm"})


def agent(folder: Path, *arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line off a terminal."""
    return warm.run("agent", *arguments, cwd=folder, **environment)


def edit(file: Path, **changes: object) -> None:
    """Change keys of a JSON file; None takes a key away."""
    data = json.loads(file.read_text(encoding="utf-8")) | changes
    file.write_text(json.dumps({key: value for key, value in data.items() if value is not None}), encoding="utf-8")


def authorisation(shop: Path, **changes: object) -> Path:
    """A file that permits unattended motion of the stored loop, with some of its keys changed."""
    (loop,) = stored_loops(shop / "logs" / "trajectories")
    said = {
        "robot": "comau_ns16",
        "serial": "FAKE-0007",
        "program": loop.checksum,
        "problem": loop.key,
        "limits": {"speed": "1.1 m/s", "duration": "5 min"},
        "expires": (datetime.now(UTC) + timedelta(days=30)).date().isoformat(),
        "written_by": "M. Rossi",
        **changes,
    }
    path = shop / "authorisation.yaml"
    path.write_text(json.dumps(said), encoding="utf-8")
    path.chmod(0o644)
    return path


@pytest.fixture(scope="session")
def controller(start_lasting_controller: Callable[..., Any]) -> Any:
    """One machine for the whole session, serial FAKE-0007."""
    return start_lasting_controller()


@pytest.fixture(scope="session")
def calibrated(controller: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recipe, its stored loop, and one accepted calibration in `logs`. Not to be changed."""
    folder = tmp_path_factory.mktemp("calibrated")
    (folder / "recipe.yaml").write_text(
        RECIPE.format(address=controller.address, every="1 s", **LOOP), encoding="utf-8"
    )
    run = agent(folder, "calibrate", "recipe.yaml")
    assert run.returncode == 0, run.stderr
    return folder


@pytest.fixture(scope="session")
def recalibrated(calibrated: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """That folder after a recalibration of friction, the run's folder, and what was said. Not to be changed.

    A second accepted calibration of the loop, a second later, was not made current.
    """
    folder = tmp_path_factory.mktemp("recalibrated") / "shop"
    shutil.copytree(calibrated, folder, symlinks=True)
    (first,) = runs_with_state(folder)
    later = first.with_name(f"{first.name}_2")
    shutil.copytree(first, later)
    started = datetime.fromisoformat(json.loads((first / "state.json").read_text(encoding="utf-8"))["started"])
    edit(later / "state.json", started=(started + timedelta(seconds=1)).isoformat())
    run = agent(folder, "recalibrate", "recipe.yaml")
    assert run.returncode == 0, run.stderr
    return folder, folder / run.stdout.strip(), run.stderr


def runs_with_state(shop: Path) -> list[Path]:
    """The folders of runs in a shop, by name."""
    return sorted(path for path in (shop / "logs").iterdir() if (path / "state.json").exists())


@pytest.fixture
def shop(calibrated: Path, tmp_path: Path) -> Path:
    """A copy of that folder for one test."""
    folder = tmp_path / "shop"
    shutil.copytree(calibrated, folder, symlinks=True)
    return folder


@pytest.fixture
def run_agent(shop: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the command line in that copy."""
    return lambda *arguments, **environment: agent(shop, *arguments, **environment)


@pytest.fixture
def browse(browser: Browser) -> Callable[[Path], tuple[list[str], list[str], str]]:
    """Opens a page and draws its plots; returns console messages, addresses it asked for, and the document after."""

    def open_page(page: Path) -> tuple[list[str], list[str], str]:
        with browser.page(page) as opened:
            opened.draw()
            return opened.console, opened.asked, opened.tab.content()

    return open_page


@pytest.fixture
def write_runs(tmp_path: Path) -> Callable[..., Path]:
    """Writes run folders with the scatter of real ones into a folder of runs; returns it.

    `write(count, seed, change, **planted)`: `change(number, result)` may alter a result before it is written.
    """

    def write(
        count: int, seed: int = 0, change: Callable[[int, dict[str, Any]], None] | None = None, **planted: Any
    ) -> Path:
        logs = tmp_path / f"logs_{seed}"
        for number, (result, parameters) in enumerate(friction_runs(count, seed, **planted)):
            if change is not None:
                change(number, result)
            write_run(logs, number, result, parameters)
        return logs

    return write


def runs_of(logs: Path) -> list[Path]:
    """The run folders, oldest first."""
    return sorted(path for path in logs.iterdir() if path.is_dir())


def friction_runs(
    count: int,
    seed: int,
    wear: int | None = None,
    wear_by: float = 0.10,
    warm_up: float = 0.05,
    cooling: bool = False,
    scatter: float = 0.003,
) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """Results of `count` recalibrations of six axles.

    Each run starts somewhere in a warm-up that raises friction by up to `warm_up` and decays within 600 s; axles answer
    to it differently. The rate within a run has a part of its own on each axle that is the same in all runs, as the
    first cycles of a real loop give it. `cooling`: later runs start warmer, so that warm-up goes along with time. Axle
    `wear` gains `wear_by` over all runs.
    """
    rng = np.random.default_rng(seed)
    base, answer = rng.uniform(5.0, 100.0, 6), rng.uniform(0.5, 1.5, 6)
    settling = 1e-4 * rng.normal(size=6)
    for number in range(count):
        part = number / max(1, count - 1)
        cold = warm_up * ((1.0 - part) if cooling else rng.uniform())
        worn = 1.0 + wear_by * part * (np.arange(6) == (-1 if wear is None else wear))
        friction = base * (1.0 + answer * cold) * worn * (1.0 + scatter * rng.normal(size=6))
        levels = [
            {
                "joint": joint,
                "speed": speed,
                "value": friction[k] * speed**0.1 * (1.0 + scatter * rng.normal()),
                "standard_deviation": 0.01 * friction[k],
                "from_run_to_run": scatter * friction[k],
            }
            for k, joint in enumerate(JOINTS)
            for speed in (0.2, 0.8)
        ]
        doubt = 1.2e-5
        rate = settling - answer * cold / 600.0 + doubt * rng.normal(size=6)
        conditions = {
            "cycles": 4,
            "motion_s": 30.0,
            "nominal_torque": [500.0] * 6,
            "warm_up": {"rate_per_s": rate.tolist(), "standard_deviation": [doubt] * 6},
            "friction": levels,
        }
        error = (0.003 + 2e-4 * rng.normal(size=6)).tolist()
        result = {
            "gate": {"normalised_rmse": 0.03},
            "validation": {"joints": JOINTS, "normalised_rmse": error},
            "conditions": conditions,
        }
        names = [(f"f0_{k + 1}", "N·m", friction[k]) for k in range(6)]
        names += [(f"p{k}", "kg·m²", 1.0 + k) for k in range(60)]
        parameters = [
            {"name": name, "unit": unit, "value": float(value), "standard_deviation": 0.01 * abs(float(value))}
            for name, unit, value in names
        ]
        yield result, parameters


def write_run(logs: Path, number: int, result: dict[str, Any], parameters: list[dict[str, Any]]) -> Path:
    """One accepted run, as `agent recalibrate` leaves it; a day after the other."""
    day = np.datetime64("2026-01-01T02:00:00") + np.timedelta64(number, "D")
    run = logs / f"{str(day).replace('-', '').replace(':', '')}Z_comau_ns16"
    run.mkdir(parents=True)
    state = {
        "schema": "run/1",
        "robot": "comau_ns16",
        "serial": "NS16-1",
        "kind": "recalibrate",
        "started": f"{day}+00:00",
        "status": "finished",
        "loop": "l",
        "program": "p",
        "controller": "tcp x",
        "steps": {},
    }
    model = json.dumps({"number": number, "base_parameters": parameters[6:], "friction": parameters[:6]})
    state["model_sha256"] = sha256_text(model)
    (run / "state.json").write_text(json.dumps(state), encoding="utf-8")
    (run / "result.json").write_text(json.dumps(result), encoding="utf-8")
    (run / "model.json").write_text(model, encoding="utf-8")
    return run
