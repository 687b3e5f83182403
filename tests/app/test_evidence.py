"""The benchmark behind docs/measured/evidence.md: a small piece of it, what is resumed, and the page."""

import json
from pathlib import Path

import numpy as np
import pytest

from agent.pipeline.planning.plan import loop_problem
from agent.recipe import load_recipe
from agent.robot import Dynamics, load_robot
from benchmarks.evidence import __main__ as evidence, criteria, page
from benchmarks.evidence.few_data import wrong_urdf
from benchmarks.evidence.loops import GlobalLoops, LocalLoops, StoppingLoops, WeightedCriterion
from benchmarks.evidence.results import FOLDER, ROOT, Results
from benchmarks.evidence.tables import ratio_of, text, verdict

DEFAULT = "torque-weighted D"


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    text = evidence.RECIPE.read_text("utf-8")
    for usual, small in (
        ("population: 20, generations: 20", "population: 4, generations: 1"),
        ("motions: 2, speed: 0.1 m/s", "motions: 1, speed: 0.5 m/s"),
        ("count: 6", "count: 5"),
    ):
        assert usual in text
        text = text.replace(usual, small)
    path = tmp_path / "recipe.yaml"
    path.write_text(text, "utf-8")
    return path


def test_stores_one_line_per_result_and_writes_the_page(tmp_path: Path, recipe: Path, monkeypatch, capsys):
    given = ["--folder", str(tmp_path / "results"), "--recipe", str(recipe)]
    with pytest.raises(SystemExit):
        evidence.main([*given, "page", "--docs", str(tmp_path)])
    assert "has no results" in capsys.readouterr().err
    monkeypatch.setitem(page.PIECES, "criteria", ([DEFAULT], criteria.measure))
    evidence.main([*given, "run", "criteria", "--machines", "1"])
    assert "complete" in capsys.readouterr().err
    (line,) = (tmp_path / "results/criteria.jsonl").read_text("utf-8").splitlines()
    entry = json.loads(line)
    assert (entry["machine"], entry["setting"]) == (501, DEFAULT)
    for seconds in ("10", "30"):
        assert 0.1 < np.mean(entry["values"][seconds]["error"]) < 5.0
    evidence.main([*given, "page", "--docs", str(tmp_path)])
    written = (tmp_path / "evidence.md").read_text("utf-8")
    assert f"| {DEFAULT} | 1 |" in written
    assert written.index("## What a loop is searched for") < written.index("local against global: not run")


def test_stored_results_are_not_computed_again(tmp_path: Path, recipe: Path, monkeypatch, capsys):
    asked: list[tuple[int, str]] = []
    given = ["--folder", str(tmp_path), "--recipe", str(recipe), "run", "local", "--machines"]

    def measure(recipe, machine, setting, loops, memory):
        asked.append((machine, setting))
        return {"error": 1.0}

    monkeypatch.setitem(page.PIECES, "local", (["a", "b"], measure))
    evidence.main([*given, "1", "--minutes", "-1"])
    assert (asked, capsys.readouterr().err) == ([], "2 left; run the same command again to do them\n")
    evidence.main([*given, "1"])
    file = tmp_path / "local.jsonl"
    file.write_text(file.read_text("utf-8")[:-9], "utf-8")  # killed while it wrote
    evidence.main([*given, "2"])
    assert asked == [(501, "a"), (501, "b"), (501, "b"), (502, "a"), (502, "b")]
    assert len(Results(tmp_path, "local")) == 4


def test_the_published_page_matches_the_stored_results(tmp_path: Path):
    evidence.main(["page", "--docs", str(tmp_path)])
    assert (tmp_path / "evidence.md").read_text("utf-8") == (ROOT / "docs/measured/evidence.md").read_text("utf-8")
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 300_000


def test_compares_searches_in_pairs_and_reports_a_better_one(tmp_path: Path):
    for budget, gain in ((500, 0.0), (2000, 3.0)):
        results = Results(tmp_path, f"search-{budget}")
        for machine in range(501, 507):
            for method, fitness, error in (("genetic", -20.0, 0.4), ("CMA-ES", -19.0, 0.4), ("random", -30.0, 0.5)):
                values = {"fitness": fitness + gain + machine, "10": {"error": [error, machine]}}
                results.keep(machine, f"{method} at {budget}", values, 1.0)
    evidence.main(["--folder", str(tmp_path), "page", "--docs", str(tmp_path)])
    written = (tmp_path / "evidence.md").read_text("utf-8")
    row = next(line for line in written.splitlines() if line.startswith("| random | 2000 | 6 |"))
    assert "| -10.0 [-10.0, -10.0] |" in row
    weak = written.split("## Limits")[1]
    assert "- CMA-ES of 500 candidates found fitter loops than the genetic search: by 1.0 [1.0, 1.0] decades" in weak
    assert "- genetic searches of 2000 candidates led to models that are not shown to be better" in weak
    assert "random of" not in weak
    assert "searches of 20000 candidates: not run" in weak


def test_scores_a_loop_in_the_mode_it_runs_in():
    recipe = load_recipe(evidence.RECIPE)
    problem = loop_problem(recipe, recipe.motion.speed)
    (genome,) = np.random.default_rng(1).random((1, problem.genes))
    flown, stopping, anywhere = LocalLoops(problem), StoppingLoops(problem), GlobalLoops(problem, 0.4)
    assert stopping.loop(genome).trajectory.duration > 1.05 * flown.loop(genome).trajectory.duration
    nominal = recipe.robot.nominal_torque
    weighted, unweighted = (
        LocalLoops(problem, WeightedCriterion(recipe.robot, weights)) for weights in (nominal, np.ones_like(nominal))
    )
    kinds = (flown, stopping, anywhere, unweighted)
    assert len({round(kind.score(genome).fitness, 6) for kind in kinds}) == len(kinds)
    assert weighted.score(genome).fitness == pytest.approx(flown.score(genome).fitness, abs=1e-6)
    assert anywhere.loop(genome).trajectory.q.std(axis=0).min() > 3 * flown.loop(genome).trajectory.q.std(axis=0).min()


def test_a_perturbed_urdf_differs_by_the_stated_amount():
    robot = load_robot("comau_ns16")
    own = Dynamics(robot).standard_parameters() * 1.1
    assert Dynamics(wrong_urdf(robot, own, 0.0, 1)).standard_parameters() == pytest.approx(own, abs=1e-9)
    wrong = Dynamics(wrong_urdf(robot, own, 0.25, 1)).standard_parameters()
    masses = wrong[::10] / own[::10]
    assert np.all(np.abs(masses - 1) <= 0.25)
    assert np.abs(masses - 1).max() > 0.1


def test_error_ratios_are_computed_in_pairs():
    wide = {machine: float(machine) for machine in range(1, 11)}
    ratio, low, high = ratio_of({machine: 0.5 * error for machine, error in wide.items()}, wide)
    assert (ratio, low, high) == pytest.approx((0.5, 0.5, 0.5))
    assert [verdict((ratio, low, high), machines) for machines in (10, 5)] == ["better", "open"]
    alone = ratio_of({1: 0.5}, wide)
    assert (text(alone), verdict(alone, 1)) == ("0.50", "open")
