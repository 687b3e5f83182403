"""Every command of the documentation is run as it stands there; generated pages are up to date; no link is dead."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
# The how-tos go on where the tutorial ends.
PAGES = ("tutorial.md", "how-to-diagnosis.md", "how-to-recalibrate.md", "how-to-robot.md")


def _commands(page: str) -> str:
    return "\n".join(re.findall(r"^```sh\n(.*?)^```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL | re.M))


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_every_command_of_tutorial_and_how_tos(tmp_path: Path):
    shutil.copytree(ROOT / "recipes", tmp_path / "recipes")
    (tmp_path / "bin").mkdir()
    agent = tmp_path / "bin" / "agent"
    agent.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m agent "$@"\n', encoding="utf-8")
    agent.chmod(0o755)
    script = "\n".join(f"echo '== {page}' >&2\n{_commands(page)}" for page in PAGES)
    for port in ("9100", "9101"):
        free = str(_free_port())
        script = script.replace(port, free)
        recipe = tmp_path / "recipes" / "first_look.yaml"
        recipe.write_text(recipe.read_text(encoding="utf-8").replace(port, free), encoding="utf-8")
    whole = f"set -e\ntrap 'kill $(jobs -p) 2>/dev/null' EXIT\n{script}\n"
    path = os.pathsep.join([str(tmp_path / "bin"), os.environ["PATH"]])
    run = subprocess.run(
        ["bash", "-c", whole],
        cwd=tmp_path,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=540,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert "skipped: the last accepted run" in run.stdout
    assert "parameters moved by more than" in run.stdout or "none of" in run.stdout
    for made in ("plan/plan.html", "logs/index.html", "diagnosis.html", "tx40.yaml", "history.json"):
        assert (tmp_path / made).is_file(), made


@pytest.mark.parametrize("page", sorted(path.name for path in DOCS.glob("*.md")))
def test_links_lead_somewhere(page: str):
    text = (DOCS / page).read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text):
        if "://" not in link:
            assert (DOCS / link).exists(), f"{page}: {link}"


def test_files_that_the_method_names_exist():
    text = (DOCS / "method.md").read_text(encoding="utf-8")
    for row in text.splitlines():
        folder = None
        for name in re.findall(r"`([a-z_/]+\.py)`", row.split("|")[-2] if row.startswith("|") else ""):
            path = ROOT / name if "/" in name else folder / name
            folder = path.parent
            assert path.is_file(), name


def test_the_reference_is_what_the_code_says():
    spec = importlib.util.spec_from_file_location("make_reference", DOCS / "make_reference.py")
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    written = (DOCS / "reference.md").read_text(encoding="utf-8")
    assert written == maker.reference(), "run: python docs/make_reference.py"


def test_commands_that_are_named_exist():
    written = (DOCS / "reference.md").read_text(encoding="utf-8")
    known = set(re.findall(r"^### `agent ([a-z-]+)", written, re.M))
    for page in DOCS.glob("*.md"):
        for name in re.findall(r"`agent ([a-z][a-z-]*)", page.read_text(encoding="utf-8")):
            assert name in known, f"{page.name}: agent {name}"
