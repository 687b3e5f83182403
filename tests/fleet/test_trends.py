"""What wears in a fleet is found on its axle, and little else; machines of one batch are a family."""

import csv
import os
import random
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from agent.core.errors import InputError
from agent.fleet.families import find_families, read_columns
from agent.fleet.simulate import simulate_fleet
from agent.fleet.trends import change_text, fleet_trends
from agent.runs import Background, MachineRuns, RunFigures, Trend


def _planted(table: Path) -> list[dict[str, str]]:
    with open(table, encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _truth(folder: Path) -> dict[tuple[str, str], str]:
    return {(row["robot"], row["joint"]): row["kind"] for row in _planted(folder / "_truth.csv")}


@pytest.fixture(scope="module")
def year(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of 120 machines over 52 weeks."""
    folder = tmp_path_factory.mktemp("fleet") / "year"
    simulate_fleet("comau_ns16", 120, 52, 4, str(folder), rows=True)
    return folder


def test_finds_wear_steps_and_the_affected_family(command, year: Path, tmp_path: Path):
    found = command("fleet", "trends", year, "--columns", year / "_machines.csv", "-o", tmp_path / "t", "--json")
    truth = _truth(year)
    alarms = {(one["robot"], one["joint"]): one for one in found["alarms"]}
    assert alarms.keys() == truth.keys()
    for key, kind in truth.items():
        low, high = alarms[key]["interval"]
        assert alarms[key]["kind"] == ("step" if kind == "step" else "drift")
        assert low - 0.02 < {"wear": 0.10, "step": -0.15, "cause": 0.06}[kind] < high + 0.02
        assert (alarms[key]["since"] is None) == (kind != "step")
    (family,) = found["families"]
    bad = [robot for (robot, _), kind in truth.items() if kind == "cause"]
    assert (family["column"], family["value"], family["robots"]) == ("lubricant_batch", "B07", bad)
    table = pq.read_table(tmp_path / "t")
    assert table.num_rows == found["series"] == 720
    assert sum(table["alarm"].to_pylist()) == len(truth)
    assert set(table["lubricant_batch"].to_pylist()) > {"B07"}
    chances, levels = (np.array(table[name]) for name in ("probability_by_chance", "false_discovery_level"))
    for rate in (0.01, 0.1, 0.5):  # Benjamini and Hochberg 1995
        passed = np.flatnonzero(np.sort(chances) <= rate * np.arange(1, 721) / 720)
        assert np.array_equal(levels <= rate, chances <= np.sort(chances)[passed[-1]])


def test_a_step_is_dated(year: Path):
    from agent.fleet.simulate import _week

    (step,) = (row for row in _planted(year / "_truth.csv") if row["kind"] == "step")
    (found,) = (one for one in fleet_trends(str(year)).alarms if one.runs.machine == step["robot"])
    assert change_text(found).endswith(f" after {_week(int(step['week']) - 1):%Y-%m-%d}")


def test_estimates_of_logs_show_the_wear_that_was_simulated(command, arm: str, tmp_path: Path):
    """From logs to the alarm, through the estimator."""
    simulate_fleet(arm, 1, 10, 11, str(tmp_path / "plant"), rows=False)
    found = command("fleet", "trends", tmp_path / "plant", "-o", tmp_path / "trends", "--json", "-q")
    (worn,) = _planted(tmp_path / "plant" / "truth.csv")
    assert (found["machines"], found["series"]) == (1, 2)
    assert [(one["robot"], one["joint"]) for one in found["alarms"]] == [(worn["robot"], worn["joint"])]
    assert (tmp_path / "trends" / "_estimates" / "rows.parquet").is_file()


def test_few_runs_raise_no_alarm_and_a_missing_result_is_a_usage_error(command, estimated: Path, tmp_path: Path):
    found = command("fleet", "trends", estimated, "--json")
    assert (found["machines"], found["too_few_runs"], found["series"]) == (4, 4, 0)
    with pytest.raises(InputError, match="no result of a fleet"):
        command("fleet", "trends", tmp_path)
    (tmp_path / "t.csv").write_text("name,cell\na,1\n", encoding="utf-8")
    with pytest.raises(InputError, match="no column `robot`"):
        command("fleet", "trends", estimated, "--columns", tmp_path / "t.csv")


def test_finds_a_family_only_if_its_machines_differ(tmp_path: Path):
    (tmp_path / "t.csv").write_text("robot,cell\n" + "".join(f"r{k},{k % 2}\n" for k in range(40)), encoding="utf-8")
    columns = read_columns([tmp_path / "t.csv"])
    noise = 0.005 * np.random.default_rng(2).normal(size=40)
    line, nothing, ripple = np.linspace(0, 1, 12), np.zeros(12), 0.003 * (-1.0) ** np.arange(12)

    def families(changes: np.ndarray) -> list[str]:
        axles = []
        for k, change in enumerate(changes):
            runs, values = MachineRuns(f"r{k}", [RunFigures("", None, ())] * 12), np.exp(change * line + ripple)
            axles.append(Trend(runs, "friction", "joint_1", "N·m", values, nothing, Background(nothing)))
        return sorted(f"{one.column} {one.value}" for one in find_families(columns, axles))

    assert families(noise) == []
    assert families(noise + 0.02 * (np.arange(40) % 2)) == ["cell 0", "cell 1"]


@pytest.mark.verify
def test_a_thousand_machines_over_a_year(tmp_path: Path, measured):
    """A fresh fleet: what is found, and what it costs; the page is made on the way."""
    seed = random.Random(time.time()).randrange(2**31)
    simulate_fleet("comau_ns16", 1000, 52, seed, str(tmp_path / "year"), rows=True)
    truth = _truth(tmp_path / "year")
    found = fleet_trends(str(tmp_path / "year"), [tmp_path / "year" / "_machines.csv"])
    alarms = {(one.runs.machine, one.joint) for one in found.alarms}
    worn = {key for key, kind in truth.items() if kind == "wear"}
    false = 100 * len(alarms - truth.keys()) / len(alarms)
    measured("1 000 machines x 52 weeks: worn axles found", len(worn & alarms), "of 20", "20", worn <= alarms)
    measured("1 000 machines x 52 weeks: false discoveries", false, "%", "at most 5 %", false <= 5)
    assert len(worn) == 20
    assert worn <= alarms
    assert false <= 5
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    command = [sys.executable, "-m", "agent", "fleet", "report", str(tmp_path / "year")]
    script = f"import resource, subprocess; subprocess.run({command!r}, check=True)\n"
    script += "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss >> 10)"
    began = time.monotonic()
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env={**os.environ})
    seconds = time.monotonic() - began
    memory = int(ran.stdout.split()[-1])
    cpu = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    measured("1 000 machines x 52 weeks: report", seconds, f"s ({cpu:.1f} CPU s)", "10 s", seconds <= 10)
    measured("1 000 machines x 52 weeks: report, memory", memory, "MiB", "300 MiB", memory <= 300)
    assert memory <= 300


@pytest.mark.parametrize("text", ["robot,halle\nrobot_0000,S\xfcd\n", "robot,K\xfchlung\nrobot_0000,1\n"])
def test_a_table_that_is_not_utf_8_is_a_usage_error(tmp_path: Path, text: str):
    (tmp_path / "t.csv").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match="save it as CSV in UTF-8"):
        read_columns([tmp_path / "t.csv"])
