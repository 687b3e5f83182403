"""`import agent as ca`: lazy, complete, and its page and notebook run as they stand there."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import agent as ca
from agent.core.errors import InputError
from tests.conftest import ROOT, loaded

DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def maker():
    return loaded(DOCS / "make_notebook.py")


@pytest.fixture(scope="module")
def executed(maker):
    """The notebook's cells, executed anew."""
    return maker.notebook()


@pytest.fixture(scope="module")
def folder(maker, tmp_path_factory):
    """A folder with the notebook's logs."""
    path = tmp_path_factory.mktemp("front_door")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        maker.execute(next(cell for cell in maker.CELLS if not maker.is_text(cell)), {})
    return path


def test_importing_the_agent_loads_no_heavy_package():
    script = (
        "import sys, agent as ca\n"
        "assert [name for name in dir(ca) if name[0] != '_'] == ca.__all__\n"
        "loaded = {'numpy', 'pydantic', 'rich', 'agent.notebook'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
        "assert len(ca.effects()) >= 22 and 'tcp' in ca.drivers()\n"
        "import agent.pages; assert callable(ca.report) and ca.pages is agent.pages\n"
    )
    run = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_exports_exactly_the_documented_names():
    assert all(callable(getattr(ca, name)) for name in ca.__all__)
    with pytest.raises(AttributeError, match="no attribute 'calibrte'"):
        ca.calibrte  # noqa: B018
    typed = next(
        node for node in ast.parse(Path(ca.__file__).read_text(encoding="utf-8")).body if isinstance(node, ast.If)
    )
    assert [name.name for name in typed.body[0].names] == ca.__all__
    assert not {path.stem for path in Path(ca.__file__).parent.iterdir()} & set(ca.__all__), "no package is named alike"
    page = (DOCS / "python.md").read_text(encoding="utf-8")
    assert {name for name in re.findall(r"`(\w+)\(", page)} == set(ca.__all__)


def test_no_module_of_the_agent_imports_the_python_api():
    for path in (ROOT / "agent").rglob("*.py"):
        if path.name == "__init__.py" and path.parent == ROOT / "agent":
            continue
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if re.search(r"from agent import|import .*\bagent\b", text) else ():
            if isinstance(node, ast.ImportFrom) and node.module == "agent":
                assert not {alias.name for alias in node.names} & set(ca.__all__), path
            assert not (isinstance(node, ast.Import) and "agent" in {alias.name for alias in node.names}), path


def test_examples_on_the_python_page_run(folder, monkeypatch, capsys):
    (code,) = re.findall(r"^```python\n(.*?)^```", (DOCS / "python.md").read_text(encoding="utf-8"), re.DOTALL | re.M)
    assert len([line for line in code.splitlines() if line]) == 10
    monkeypatch.chdir(folder)
    exec(compile(code, "docs/python.md", "exec"), {})
    shown = capsys.readouterr().out
    assert "torque predicted to" in shown
    assert "joint_3: the friction level differs from the model's (friction_change), or " in shown
    assert "<svg" in (folder / "diagnosis.html").read_text(encoding="utf-8")
    assert {path.name for path in (folder / "robot").iterdir()} >= {"friction.json", "comau_ns16.urdf"}


def test_the_notebook_matches_its_generator(maker, executed):
    written = json.loads(maker.NOTEBOOK.read_text(encoding="utf-8"))
    assert maker.NOTEBOOK.stat().st_size < 300_000
    assert [cell["source"] for cell in written["cells"]] == [cell["source"] for cell in executed["cells"]], (
        "run: python docs/make_notebook.py"
    )
    for there, here in zip(written["cells"], executed["cells"], strict=True):
        for before, now in zip(there.get("outputs", []), here.get("outputs", []), strict=True):
            assert before["data"].keys() == now["data"].keys()
            assert re.sub(r"[0-9.]+ %", "", before["data"]["text/plain"][0]) == re.sub(
                r"[0-9.]+ %", "", now["data"]["text/plain"][0]
            )


def test_results_show_a_key_figure_and_a_plot(executed):
    shown = ["".join(o["data"].get("text/html", [])) for c in executed["cells"] for o in c.get("outputs", [])]
    cards = [html for html in shown if html]
    assert len(cards) == 4
    for html in cards:
        assert re.search(r"<b>[^<]*[0-9][^<]*</b>", html)
        assert html.count('class="panel"') + html.count("<table") == 1, "one plot, or one table of bars"
        assert "<svg" in html
        assert not re.search(r"\b(nan|inf)\b", html)
        assert len(html) < 40_000


def test_paths_and_objects_give_the_same_results(folder, monkeypatch):
    monkeypatch.chdir(folder)
    robot = ca.load_robot("comau_ns16")
    by_path = ca.read_logs(["logs/monday_1.mcap", "logs/monday_2.mcap"], "comau_ns16")
    assert [log.name for log in ca.read_logs("logs/monday_[12].mcap", robot)] == [log.name for log in by_path]
    assert ca.read_logs(by_path[0], robot)[0] is by_path[0]
    assert ca.load_robot(robot) is robot
    assert len(repr(robot)) < 5000
    model = ca.estimate(robot, by_path[0], method="paper", cutoff=20)
    model.save("paper.json")
    first, second = ca.validate(model, by_path[1]), ca.validate("paper.json", "logs/monday_2.mcap")
    assert first.to_dict() == second.to_dict()
    assert ca.report(first, "page.html").read_text(encoding="utf-8").count("<svg") >= 1
    with pytest.raises(InputError, match="no file is named like that"):
        ca.read_logs("logs/tuesday_*.mcap", robot)
    with pytest.raises(InputError, match="name the page"):
        ca.report(first)
    with pytest.raises(InputError, match="nothing to validate on"):
        ca.validate(model, [])


def test_plans_a_recipe_from_python(write_recipe, tmp_path):
    recipe = ca.load_recipe(write_recipe("127.0.0.1:1"))
    assert ca.load_recipe(recipe) is recipe
    loop = ca.plan(recipe, tmp_path / "plan")
    assert repr(loop).startswith("fitness ")
    assert "<svg" in loop._repr_html_()
    assert (tmp_path / "plan" / "program.pdl").is_file()


def test_results_have_the_attributes_that_the_page_lists(folder, monkeypatch):
    """`dir` lists each of them, and tables are arrays and CSV."""
    import re

    import numpy as np

    import agent as ca

    monkeypatch.chdir(folder)
    logs = sorted(folder.glob("**/*.mcap"))
    robot = ca.load_robot("comau_ns16")
    given = ca.read_logs(logs[0], robot)
    model = ca.estimate(robot, given, force=True)
    checked = ca.validate(model, given)
    rows = re.findall(r"^\| `(Logs|Model|TorqueValidation)` \| (.*) \|$", (DOCS / "python.md").read_text(), re.M)
    assert len(rows) == 3
    for (_, listed), result in zip(rows, (given[0], model, checked), strict=True):
        names = set(re.findall(r"`(\w+)`", listed)) - {"Log", "time", "measured", "predicted"}
        assert names <= set(dir(result)) | {"t"}
    prediction = model.predict(given[0])
    np.testing.assert_array_equal(prediction.predicted, checked.predictions[0].predicted)
    assert checked.rmse.shape == (1, robot.dof)
    lines = checked.to_csv().splitlines()
    assert lines[0] == "log,joint,rmse,normalised_rmse,relative_error"
    assert len(lines) == 1 + robot.dof
    assert float(lines[1].split(",")[2]) == checked.rmse[0, 0]
