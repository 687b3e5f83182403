"""The page over a fleet: what it holds, and that a browser opens it."""

import base64
import gzip
import json
import re
import shutil
from pathlib import Path

import pytest

from agent.fleet import simulate_fleet, write_page
from tests.browser import Browser


def _data(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    (packed,) = re.findall(r'id="data">([A-Za-z0-9+/=]+)<', text)
    assert not re.search(r'(src|href)="?https?:', text), "nothing from anywhere else"
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def test_machines_are_sorted_by_urgency_with_the_reason(command, tmp_path: Path):
    year = tmp_path / "year"
    simulate_fleet("comau_ns16", 40, 20, 5, str(year), rows=True)
    printed = command("fleet", "report", year, "--columns", year / "_machines.csv")
    assert printed.strip() == f"{year}/_report.html"
    data = _data(year / "_report.html")
    machines = data["machines"]
    assert [one["urgency"] for one in machines] == sorted((one["urgency"] for one in machines), reverse=True)
    truth = {line.split(",")[0] for line in (year / "_truth.csv").read_text("utf-8").splitlines()[1:]}
    assert {one["robot"] for one in machines if one["why"]} == truth
    first = machines[0]
    assert first["joints"] == data["joints"] == [f"joint_{k}" for k in range(1, 7)]
    assert sum(first["alarm"]) == 1
    assert len(first["courses"][0]["days"]) == len(first["runs"]) == 20
    assert first["of"][1].startswith("B")


def test_a_failed_run_is_listed_as_a_reason_and_run_pages_are_linked(command, plant, estimated, tmp_path: Path):
    here, out = tmp_path / "plant", tmp_path / "result"
    shutil.copytree(plant / "robot_0000", here / "robot_0000")
    shutil.copytree(plant / "robot_0003" / "bad", here / "robot_0003" / "bad")
    for description in ("robot.yaml", "robot.urdf"):
        shutil.copy(plant / "robot_0003" / description, here / "robot_0003")
    shutil.copytree(plant / "robot_0003" / "bad", here / "robot_0007" / "bad")  # and no run with figures
    (page_of,) = [path for path in sorted((here / "robot_0000").iterdir()) if path.is_dir()][:1]
    (page_of / "report.html").write_text("<p>the run</p>", encoding="utf-8")
    shutil.copytree(estimated, out)
    (out / "rows.parquet").unlink()
    command("fleet", "estimate", here, "-o", out, "-q")
    write_page(str(out), out=str(tmp_path / "page.html"))
    machines = {one["robot"]: one for one in _data(tmp_path / "page.html")["machines"]}
    for robot, reason in (("robot_0003", "not an MCAP file"), ("robot_0007", "no robot.yaml")):
        assert [reason in why for why in machines[robot]["why"]] == [True]
    assert (machines["robot_0007"]["joints"], machines["robot_0007"]["courses"]) == ([], [])
    links = [run[4] for run in machines["robot_0000"]["runs"]]
    assert [bool(link) for link in links] == [True, False]
    assert (tmp_path / links[0]).read_text(encoding="utf-8") == "<p>the run</p>"


def _opened(browser: Browser, page: Path, machines: int, longest: float) -> dict:
    with browser.page(page, width=1200) as opened:
        view = opened.tab
        view.wait_for_selector("body[data-ready]", timeout=1000 * longest)
        found = {"nodes": view.evaluate("document.querySelectorAll('*').length")}
        assert f"{machines} of {machines} machines" in view.inner_text("#count")
        found["frame_ms"] = view.evaluate(
            """async () => {
              const list = document.getElementById("list");
              let worst = 0, last = performance.now();
              for (let k = 1; k <= 30; k++) {
                list.scrollTop = (k / 30) * list.scrollHeight;
                await new Promise((done) => requestAnimationFrame(done));
                worst = Math.max(worst, performance.now() - last);
                last = performance.now();
              }
              return worst;
            }"""
        )
        view.evaluate("document.getElementById('list').scrollTop = 0")
        view.select_option("#order", "robot")
        view.click("#map", position={"x": 40, "y": 24})
        found["second"] = view.inner_text("#machine h3 >> nth=0")
        view.fill("#search", found["second"])
        found["count"] = view.inner_text("#count")
        view.keyboard.press("Tab")
        assert opened.console == []
    return found


def test_the_page_draws_only_the_visible_machines(browser: Browser, tmp_path: Path):
    simulate_fleet("comau_ns16", 300, 2, 6, str(tmp_path / "f"), rows=True)
    write_page(str(tmp_path / "f"))
    found = _opened(browser, tmp_path / "f" / "_report.html", 300, 30)
    assert found["second"] == "robot_0001"
    assert found["count"] == "1 of 300 machines"
    assert found["nodes"] < 300, "machines are drawn, not elements of the page"


@pytest.mark.verify
def test_ten_thousand_machines_open_without_freezing(browser: Browser, tmp_path: Path, measured):
    simulate_fleet("comau_ns16", 10_000, 8, 7, str(tmp_path / "f"), rows=True)
    write_page(str(tmp_path / "f"))
    found = _opened(browser, tmp_path / "f" / "_report.html", 10_000, 60)
    measured("page of 10 000 machines: longest frame while scrolling", found["frame_ms"], "ms", "at most 100 ms")
    size = (tmp_path / "f" / "_report.html").stat().st_size / 1e6
    measured("page of 10 000 machines x 8 runs: size", size, "MB")
    assert found["count"] == "1 of 10000 machines"
