"""Reports as a browser sees them: no error in the console, no request to anywhere, data a click away."""

import base64
import gzip
import html
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from agent.cli.app import app
from agent.core import Console, InputError
from agent.pipeline import compare_runs, write_index
from tests.shop_floor.conftest import agent

FOREIGN = re.compile(r"""(?:src|href|action|data)\s*=\s*["'](?!data:|#)([^"']+)|url\(\s*["']?(?!#|data:)([^"')]+)""")


@pytest.fixture
def worn(shop: Path, start_controller) -> Path:
    """The shop, where the machine has got 30 % more Coulomb friction on joint_2 since."""
    effects = shop / "effects.json"
    wear = {"effect": "friction_change", "joints": ["joint_2"], "parameters": {"coulomb": 1.3}}
    effects.write_text(json.dumps([wear]), encoding="utf-8")
    machine = start_controller("--seed", "7", "--effects", str(effects))
    recipe = shop / "recipe.yaml"
    text = re.sub(r'address: "[^"]*"', f'address: "{machine.address}"', recipe.read_text(encoding="utf-8"))
    recipe.write_text(text, encoding="utf-8")
    return shop


def _page(calibrated: Path) -> Path:
    return next(calibrated.glob("logs/*/state.json")).with_name("report.html")


def _check_file(page: Path, links: tuple[str, ...] = ()) -> str:
    text = page.read_text(encoding="utf-8")
    foreign = [a or b for a, b in FOREIGN.findall(text)]
    assert sorted(set(foreign)) == sorted(links), "a page stands alone"
    return text


def _titles(page: str) -> list[str]:
    return re.findall("<h2 [^>]*>([^<]+) <a", page)


def _check_shown(browse, page: Path) -> str:
    console, asked, document = browse(page)
    assert console == []
    assert asked == []
    assert "<svg" in document
    return document


def test_the_page_of_a_calibration(calibrated: Path, browse):
    page = _page(calibrated)
    text = _check_file(page)
    assert ", ".join(_titles(text)) == (
        "Prediction of unseen motions, Diagnosis, Motion, Search, Residuals, Friction, Observation matrix, "
        "Logs, Conditions, Parameters, Provenance"
    )
    assert "Not needed: there is no earlier model" in text
    assert "value ± 95 %" in text
    assert "jitter [µs RMS]" in text
    document = _check_shown(browse, page)
    assert document.count("<canvas") > 1, "plots are drawn"


def test_figures_have_the_papers_numbers(calibrated: Path):
    """And Fig. 5a is every validation motion, not one."""
    text = _page(calibrated).read_text(encoding="utf-8")
    captions = html.unescape(" ".join(re.findall(r"<(?:fig)?caption>(.*?)</(?:fig)?caption>", text, flags=re.DOTALL)))
    assert re.findall(r"the paper's Fig\. (\d\w?)", captions) == ["5a", "5b", "6", "4b", "4a"]
    scenes = [
        json.loads(found) for found in re.findall(r'<script type="application/json">(\{"lines".*?)</script>', text)
    ]
    (paths,) = [scene["lines"]["validation paths"] for scene in scenes if "validation paths" in scene["lines"]]
    plan = json.loads((_page(calibrated).parent / "plan.json").read_text(encoding="utf-8"))
    assert np.shape(paths) == (len(plan["validation"]), 120, 3)


def test_every_plot_and_table_offers_its_data(calibrated: Path):
    text = _page(calibrated).read_text(encoding="utf-8")
    plain = re.findall(r'download="([^"]+\.csv)" href="data:text/csv;base64,([^"]*)"', text)
    packed = re.findall(r'download="([^"]+\.csv)\.gz" href="data:application/gzip;base64,([^"]*)"', text)
    assert len(plain) == text.count("<table")
    assert len(packed) == text.count("<figure")
    assert len({name for name, _ in plain + packed}) == len(plain + packed)
    tables = [base64.b64decode(data) for _, data in plain]
    tables += [gzip.decompress(base64.b64decode(data)) for _, data in packed]
    for table in tables:
        header, *rows = table.decode("utf-8").splitlines()
        assert "," in header
        assert rows


def test_the_page_of_a_recalibration(recalibrated, browse):
    shop, run, _ = recalibrated
    page = run / "report.html"
    text = _check_file(page)
    assert ", ".join(_titles(text)) == (
        "Prediction, Diagnosis, Motion, Search, Against the last accepted run, Residuals, "
        "Friction, Observation matrix, Logs, Conditions, Parameters, Provenance"
    )
    assert "predicts the fresh data no worse" in text
    assert text.count("<canvas") == 1
    assert "parameters moved by more than their uncertainty" in text
    _check_shown(browse, page)
    before = text
    again = agent(shop, "report", run.name)
    assert again.returncode == 0, again.stderr
    assert page.read_text(encoding="utf-8") == before, "made again from its files, it is the same page"


@pytest.mark.verify
def test_the_page_of_a_changed_machine_opens_with_the_diagnosis(worn: Path, run_agent, browse):
    run = run_agent("calibrate", "recipe.yaml", "-q")
    assert run.returncode == 0, run.stderr
    folder = worn / run.stdout.strip()
    found = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    assert (found["causes"][0]["effect"], found["causes"][0]["joints"]) == ("friction_change", ["joint_2"])
    page = _check_file(folder / "report.html")
    titles = _titles(page)
    assert titles[0].startswith("Diagnosis")
    assert "Against the last accepted run" in titles
    head = page.split("</header>")[0]
    assert "(friction_change)" in head
    assert "joint_2, most likely" in head
    _check_shown(browse, folder / "report.html")


def test_the_page_of_a_repeated_calibration(shop: Path, run_agent):
    (page,) = (shop / "logs").glob("*/report.html")
    before = page.read_text(encoding="utf-8")
    page.unlink()
    run = run_agent("report", page.parent.name)
    assert run.returncode == 0, run.stderr
    assert page.read_text(encoding="utf-8") == before


def test_a_rejected_calibration_names_the_axis(shop: Path, run_agent):
    (file,) = (shop / "logs").glob("*/result.json")
    result = json.loads(file.read_text(encoding="utf-8"))
    figures = dict(zip(result["validation"]["joints"], result["validation"]["normalised_rmse"], strict=True))
    worst, second = sorted(figures, key=figures.get, reverse=True)[:2]
    gate = (figures[worst] + figures[second]) / 2
    result |= {"accepted": False, "gate": result["gate"] | {"normalised_rmse": gate}}
    file.write_text(json.dumps(result), encoding="utf-8")
    run = run_agent("report", file.parent.name)
    assert run.returncode == 0, run.stderr
    page = (file.parent / "report.html").read_text(encoding="utf-8")
    assert f"Rejected: the worst axis, {worst}," in page
    assert page.count("above the gate</td>") == 1
    assert "does not change the current model" in page


def test_the_index_page_of_all_runs(write_runs, browse):
    logs = write_runs(20, 2, wear=1)
    page = write_index(logs)
    links = tuple(f"{path.name}/report.html" for path in logs.iterdir() if path.is_dir())
    text = _check_file(page, links)
    assert "friction of joint_2" in text
    assert text.count("alarm</td>") >= 1
    _check_shown(browse, page)


def test_the_browser_helper_reports_errors_and_requests(tmp_path: Path, browse):
    page = tmp_path / "page.html"
    page.write_text(
        '<img src="http://127.0.0.1:9/a.png"><svg></svg><script>undefined_name()</script>', encoding="utf-8"
    )
    console, asked, _ = browse(page)
    assert any("undefined_name" in line for line in console)
    assert any("127.0.0.1:9/a.png" in entry for entry in asked)


def test_the_index_page_without_trends(write_runs, browse):
    page = write_index(write_runs(2))
    assert "at least eight runs" in page.read_text(encoding="utf-8")
    assert browse(page)[:2] == ([], [])


def test_a_diagnosis_opens_the_report_when_the_last_model_predicts_worse(worn: Path, run_agent, browse):
    run = run_agent("recalibrate", "recipe.yaml")
    assert run.returncode == 0, run.stderr
    folder = worn / run.stdout.strip()
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    assert result["validation"]["worse_before"] == ["joint_2"]
    found = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    assert found["causes"][0]["effect"] == "friction_change"
    assert found["causes"][0]["joints"] == ["joint_2"]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.index("Diagnosis against the last model <a") < page.index("Prediction <a")
    head = page.split("</header>")[0]
    assert "(friction_change)" in head
    assert "joint_2, most likely" in head
    _check_shown(browse, folder / "report.html")
    compared = json.loads(run_agent("compare", result["reference"], folder.name, "--json").stdout)
    assert next(entry["name"] for entry in compared["parameters"] if entry["moved"]) == "f0_2"


def test_compares_runs_side_by_side(shop: Path, browse):
    (first,) = (path.parent for path in shop.glob("logs/*/model.json"))
    second = first.with_name("20300101T000000Z_comau_ns16")
    shutil.copytree(first, second)
    model = json.loads((second / "model.json").read_text(encoding="utf-8"))
    worn = next(entry for entry in model["friction"] if entry["name"] == "f0_2")
    worn["value"] *= 1.5
    (second / "model.json").write_text(json.dumps(model), encoding="utf-8")
    third = first.with_name("20300102T000000Z_comau_ns16")
    shutil.copytree(first, third)
    page = shop / "compare.html"
    with pytest.raises(InputError, match="there is no folder"):
        compare_runs([first, second, third], Console(-1), shop / "none" / "compare.html")
    compare_runs([first, second, third], Console(-1), page)
    assert "None of" in page.read_text("utf-8").split("</header>")[0], "the last against the first"
    found = compare_runs([first, second], Console(-1), page)
    assert [change.name for change in found[0].parameters if change.moved] == ["f0_2"]
    text = _check_file(page)
    assert "1 of" in text.split("</header>")[0]
    assert "f0_2 by" in text.split("</header>")[0]
    assert "Friction curves" in _titles(text)
    assert "agent apply" in text
    _check_shown(browse, page)


def test_runs_of_two_machines_are_not_compared_as_changes(shop: Path):
    first = min(path.parent for path in shop.glob("logs/*/model.json"))
    other = first.with_name("20300103T000000Z_comau_ns16")
    shutil.copytree(first, other)
    model = json.loads((other / "model.json").read_text(encoding="utf-8"))
    model["provenance"]["serial"] = ["ANOTHER-8"]
    (other / "model.json").write_text(json.dumps(model), encoding="utf-8")
    page = shop / "machines.html"
    (found,) = compare_runs([first, other], Console(-1), page)
    shutil.rmtree(other)
    assert "and ANOTHER-8): the figures say how they differ" in found.text()
    assert found.to_dict()["machines"][1] == "ANOTHER-8"
    text = page.read_text(encoding="utf-8")
    assert "These are two machines" in text.split("</header>")[0]
    assert "agent apply" not in text


def test_a_run_refreshes_the_index_page(calibrated: Path, monkeypatch):
    index = calibrated / "logs/index.html"
    (run,) = (path.parent.name for path in calibrated.glob("logs/*/state.json"))
    assert run in index.read_text(encoding="utf-8")
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    shown = CliRunner().invoke(app, ["report", "--index", "--open", "--logs", str(calibrated / "logs")])
    assert shown.exit_code == 0, shown.output
    assert opened == [index.as_uri()]
