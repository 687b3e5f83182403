"""`agent check`: everything that is wrong, in one go, and what to do about it."""

import json
from pathlib import Path

from tests.shop_floor.conftest import LOOP, RECIPE, agent

TEXT = RECIPE.format(address="127.0.0.1:1", every="7 d", **LOOP)


def _check(folder: Path, text: str) -> tuple[int, dict[str, list[str]]]:
    (folder / "recipe.yaml").write_text(text, encoding="utf-8")
    run = agent(folder, "check", "recipe.yaml", "--json", "-q")
    problems: dict[str, list[str]] = {}
    for finding in json.loads(run.stdout)["findings"]:
        if not finding["ok"]:
            problems.setdefault(finding["subject"], []).append(finding["message"])
    return run.returncode, problems


def test_a_recipe_fault_does_not_hide_other_problems(tmp_path: Path):
    text = TEXT.replace("cycles: 3", "cycles: three").replace("3 %", "300 %").replace("[1.0 m, 0 m", "[2.4 m, 0 m")
    code, problems = _check(tmp_path, text)
    assert code == 2
    assert [fault.split(": ")[1] for fault in problems["recipe"]] == ["record.cycles", "gate.normalised_rmse"]
    assert "out of reach" in problems["sub-region"][0]
    assert "no controller answers" in problems["controller"][0]


def test_reports_a_keep_out_box_around_the_base(tmp_path: Path):
    box = "{name: stand, box: {min: [-0.4 m, -0.4 m, 0 m], max: [0.4 m, 0.4 m, 0.4 m]}}"
    code, problems = _check(tmp_path, f"{TEXT}cell: {{keep_out: [{box}]}}\n")
    assert code == 2
    assert "link_1 is in keep-out stand" in problems["loops"][0]
    assert "Make the box smaller" in problems["loops"][0]
