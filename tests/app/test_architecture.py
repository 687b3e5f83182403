"""What the documentation says of the code is there: packages, files, names."""

import ast
import importlib
import importlib.util
import re
from pathlib import Path

import pytest

from tests.conftest import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TOPS = ("agent", "drivers", "fake_controller")


def test_the_architecture_page_names_exactly_the_packages():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("## What is added where")[0]
    named = {name.rstrip("/") for name in re.findall(r"`((?:agent|drivers|fake_controller)(?:/[a-z_0-9/]+)?)`", text)}
    there = {path.parent.relative_to(ROOT).as_posix() for top in TOPS for path in (ROOT / top).rglob("__init__.py")}
    assert named == there


def test_answers_to_the_questions_of_a_newcomer_are_in_the_files_that_they_name():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("## Ten questions of a newcomer")[1]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| Wh")]
    assert len(rows) == 10
    for question, files, names in rows:
        paths = re.findall(r"`([^`]+)`", files)
        assert 1 <= len(paths) <= 3, question
        nodes = (node for path in paths for node in ast.parse((ROOT / path).read_text("utf-8")).body)
        tops = {node.name for node in nodes if isinstance(node, ast.ClassDef | ast.FunctionDef)}
        assert set(re.findall(r"`(\w+)`", names)) <= tops, question


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_paths_named_on_the_page_exist(page: Path):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"\b((?:agent|drivers|fake_controller|tests|benchmarks)/[\w/]+(?:\.\w+)?)", text):
        assert (ROOT / name.rstrip("/")).exists(), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_modules_and_functions_named_on_the_page_exist(page: Path):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:agent|drivers|fake_controller)(?:\.\w+)+)`", text):
        assert _resolves(name), name


def _resolves(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.util.find_spec(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        if found is not None:
            value = importlib.import_module(found.name)
            for part in parts[count:]:
                if not hasattr(value, part):
                    return False
                value = getattr(value, part)
            return True
    return False
