"""The world of positions and commands: what it draws, records and exports."""

from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.blind_check import exported_runs
from agent.blind_check.key import Key
from agent.blind_check.scoring import results_of, score
from agent.blind_check.worlds import ServoedWorld
from agent.diagnosis.position_logs.fitting import missed
from agent.diagnosis.position_logs.stretch import stretches_of
from agent.model import CATALOGUE
from agent.recording import read_recording
from agent.simulators import FreeSimulator, load_arm, load_simulator
from fake_controller.servoed.__main__ import write
from fake_controller.servoed.cases import EFFECTS, draw_cases
from tests.conftest import ROOT

pytest.importorskip("mujoco")
#: An effect of the small run.
LATE = [{"effect": "time_delay", "joints": [], "parameters": {"delay": 0.06}}]


@cache
def cases() -> list[dict[str, Any]]:
    return draw_cases(90, 4)


def small(form: str, **changes: Any) -> dict[str, Any]:
    """A run of a small arm that a person leads, its logs in this format."""
    case = next(case for case in cases() if case["joints"] == 3)
    plain = {"kind": "none", "motions": "led", "effects": [], "frames": {**case["frames"], "format": form}}
    return {**case, **plain, **changes}


class OneRun(ServoedWorld):
    """The small run alone."""

    def draw(self, count: int, seed: int, laws: str):
        return [small("lerobot", number=0)]


def logs_in(folder: Path):
    arm, logs = load_arm(folder / "arm.xml"), folder / "logs"
    return [log for part in sorted(logs.glob("*.csv")) or [logs] for log in read_recording(part, arm)[0]]


def miss_of_the_file(folder: Path) -> float:
    logs = logs_in(folder)
    free = FreeSimulator(load_simulator(folder / "arm.xml", None, logs[0].joint_names).arm)
    stretches = stretches_of(logs, held=True, settling=0.5)
    errors = [missed(one, one.run(free, free.numbers)) for one in stretches]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def test_kinds_effects_and_arms_are_spread_evenly():
    assert Counter(case["kind"] for case in cases()) == {"none": 30, "one": 36, "two": 12, "outside": 12}
    drawn = Counter(e["effect"] for case in cases() if case["kind"] != "outside" for e in case["effects"])
    assert set(drawn) == set(EFFECTS) <= set(CATALOGUE)
    assert max(drawn.values()) <= min(drawn.values()) + 6
    outside = {e["effect"] for case in cases() if case["kind"] == "outside" for e in case["effects"]}
    assert len(outside) == 5
    assert outside.isdisjoint(CATALOGUE)
    assert {case["joints"] for case in cases()} == {3, 4, 5, 6, 7}
    assert {case["frames"]["rate"] for case in cases()} == {30, 50, 100, 200}


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    """A healthy arm in tables, and the same with a late command in a LeRobot folder."""
    folder = tmp_path_factory.mktemp("runs")
    sizes = [
        write({"truth": small(form, effects=effects), "folder": folder / name, "seconds": 9.0})
        for name, effects, form in (("healthy", [], "csv"), ("late", LATE, "lerobot"))
    ]
    assert sizes[0]["size"] is None
    assert sizes[1]["size"] > 0.005
    assert np.allclose(np.subtract(sizes[1]["numbers"]["delay_s"], sizes[0]["numbers"]["delay_s"]), 0.06)
    return {name: folder / name for name in ("healthy", "late")}


def test_runs_are_read_as_they_stand(runs):
    for folder in runs.values():
        logs = logs_in(folder)
        assert [len(log.t) for log in logs] == [9 * small("csv")["frames"]["rate"]] * 2
        assert all(log.reference_position is not None and log.effort is None for log in logs)
        assert max(np.abs(log.position - log.reference_position).max() for log in logs) < 0.5


def test_a_healthy_arm_moves_as_its_file_says_and_a_delayed_one_does_not(runs):
    healthy, late = miss_of_the_file(runs["healthy"]), miss_of_the_file(runs["late"])
    assert healthy < 2e-3
    assert late > 5 * healthy


def test_a_servo_stands_off_its_set_points_or_is_late_on_its_joint_alone(tmp_path: Path):
    effects = [
        {"effect": "torque_offset", "joints": ["joint_1"], "parameters": {"set_point_offset": 0.05}},
        {"effect": "time_delay", "joints": ["joint_3"], "parameters": {"delay": 0.1}},
    ]
    plain, both = (
        write({"truth": small("csv", effects=some), "folder": tmp_path / name, "seconds": 9.0})
        for name, some in (("plain", []), ("both", effects))
    )
    assert plain["numbers"]["offset"] == [0.0] * 3
    assert both["numbers"]["offset"] == [0.05, 0.0, 0.0]
    assert np.subtract(both["numbers"]["delay_s"], plain["numbers"]["delay_s"]).tolist() == pytest.approx([0, 0, 0.1])
    before, after = logs_in(tmp_path / "plain")[0], logs_in(tmp_path / "both")[0]
    off = np.median(after.position - before.position, axis=0)
    assert off[0] == pytest.approx(0.05, abs=0.01)
    change = np.sqrt(np.mean((after.position - before.position - off) ** 2, axis=0))
    assert change[2] > 5 * change[1]
    assert (tmp_path / "plain" / "arm.xml").read_bytes() == (tmp_path / "both" / "arm.xml").read_bytes()


def test_an_export_holds_no_truth_is_drawn_again_by_its_key_and_its_numbers_are_scored(tmp_path: Path):
    (run,) = exported_runs.export_runs(OneRun(seconds=0.5), tmp_path / "out", tmp_path / "key.json", 1, 5).runs
    first, again = tmp_path / "out" / "runs" / run["run"], tmp_path / "again"
    write({"truth": run, "folder": again, "seconds": 0.5})
    files = [path.relative_to(first) for path in first.rglob("*.*")]
    assert len(files) == 4
    assert all((first / name).read_bytes() == (again / name).read_bytes() for name in files)
    assert sorted(path.name for path in first.iterdir()) == ["arm.xml", "logs"]
    held, wide = ({"kp": [(1.0, low, 1e6)] + [None] * (run["joints"] - 1)} for low in (0.0, 1e5))
    answer = {"run": run["run"], "verdict": "no_gap", "causes": [], "where": [], "without": []}
    results = list(
        results_of(
            Key.load(tmp_path / "key.json"), {"a": [{**answer, "servo": held}], "b": [{**answer, "servo": wide}]}
        )
    )
    assert [one["numbers"] for one in results] == [[1, 1], [0, 1]]
    assert score(results)["a"]["numbers"]["count"] == 1


@pytest.mark.verify
def test_blind_check_on_positions_and_commands(measured):
    """Sixty runs; what is finished is kept in `.verify/`, and so is its page."""
    from agent.blind_check import BlindCheck
    from agent.core import Console, LocalProcesses, available_cores

    with LocalProcesses(available_cores()) as engine:
        check = BlindCheck(ServoedWorld(), 60, ROOT / ".verify" / "blind_check_positions")
        (scores,) = check.run(Console(), engine)["tools"].values()
    for kind, row in scores["outcomes"].items():
        for name, count in row.items():
            measured(f"positions, {kind}: {name}", count, f"of {sum(row.values())}")
    assert scores["outcomes"]["none"]["no gap"] > scores["outcomes"]["none"]["unknown"]
