"""What docs/fleet.md shows is run as it stands there: its commands, and its five questions."""

import re
import shlex
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "fleet.md"


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.M)


def test_commands_and_queries_of_the_page_run(command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    duckdb = pytest.importorskip("duckdb")
    monkeypatch.chdir(tmp_path)
    lines = [line for block in _blocks("bash") for line in block.splitlines()]
    assert len(lines) == 5
    for line in lines:
        agent, *arguments = shlex.split(line)
        assert agent == "agent"
        command(*arguments)
    broken = Path("plant/robot_0000/broken.mcap")
    broken.write_text("nonsense", encoding="utf-8")
    command("fleet", "estimate", "plant", "-o", "models")
    questions = [duckdb.sql(question).fetchall() for question in _blocks("sql")]
    worst, failed, months, cells, far = questions
    assert len(worst) == 10
    assert failed[0][:1] + failed[0][2:] == ("unreadable", 1, "robot_0000")
    assert len(months) > 100
    truth = {tuple(line.split(",")[:2]) for line in Path("year/_truth.csv").read_text("utf-8").splitlines()[1:]}
    assert {tuple(axle.split(" ")) for cell in cells for axle in cell[2]} == truth
    assert far[0][:2] in truth
