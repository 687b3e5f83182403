"""Every command of the documentation is run as it stands there; generated pages are up to date; no link is dead."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryFile

import pytest

from tests import warm
from tests.conftest import ROOT, environment, free_port, loaded

DOCS = ROOT / "docs"
README = ROOT / "README.md"
#: Pages that a reader goes through one after the other in one clone, and what they make.
FIRST = ("../README.md", "tutorial.md", "how-to-recalibrate.md")
MADE = ("first/plan.html", "plan/plan.html", "logs/index.html", "history.json", "diagnosis.html", "model.json")
STORIES = {
    FIRST: MADE,
    (*FIRST, "how-to-diagnosis.md"): (*MADE, "repaired.json"),
    ("how-to-robot.md", "import.md", "recipe.md"): ("tx40.yaml", "table.mcap"),
}
#: Ends the emulator of a page, which the pages after it need.
END = re.compile(r"^kill %1; wait\n", re.M)


def _blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.M)


def _commands(page: Path) -> list[str]:
    """Commands of a page, each with its further lines; a remark at its end is left out."""
    lines = "".join(_blocks(page, "sh")).replace("\\\n", "\\\0").splitlines()
    return [re.sub(r" {2,}# .*", "", line).replace("\0", "\n") for line in lines]


def _typed(pages: Sequence[str]) -> str:
    """What a reader types who does not repeat what an earlier page had him do."""
    script, typed = "", set[str]()
    for page in pages:
        commands = [command for command in _commands(DOCS / page) if command not in typed]
        typed.update(commands)
        script += "\n".join([f"echo '== {page}' >&2", *commands, ""])
    return script


def _tell(pages: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Type all commands of these pages into a shell, in a folder that has the recipes."""
    shutil.copytree(ROOT / "recipes", folder / "recipes")
    (folder / "bin").mkdir()
    script = _typed(pages)
    script = END.sub("", script) + "".join(END.findall(script))
    recipe = folder / "recipes" / "first_look.yaml"
    for port in ("9100", "9101"):
        free = str(free_port())
        script = script.replace(port, free)
        recipe.write_text(recipe.read_text(encoding="utf-8").replace(port, free), encoding="utf-8")
    typed = environment() | {"PATH": f"{folder}/bin:{Path(sys.executable).parent}:{os.environ['PATH']}"}
    agent, story = folder / "bin" / "agent", ["bash", "-c", f"set -e\n{script}\n"]
    # files and not pipes: a program that is still in the background would keep those open
    with warm.shell_command(agent, "agent", "emulator"), TemporaryFile("w+") as out, TemporaryFile("w+") as err:
        streams = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": err}
        shell = subprocess.Popen(story, cwd=folder, env=typed, start_new_session=True, **streams)
        try:
            code = shell.wait(timeout=1200)  # less than a minute where nothing else runs
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(shell.pid, signal.SIGKILL)
        out.seek(0), err.seek(0)
        return subprocess.CompletedProcess(shell.args, code, out.read(), err.read())


@pytest.mark.parametrize(
    "pages",
    [pytest.param(pages, marks=pytest.mark.verify if "how-to-diagnosis.md" in pages else ()) for pages in STORIES],
    ids=" ".join,
)
def test_all_commands_of_readme_tutorial_and_how_tos_run(tmp_path: Path, pages: tuple[str, ...]):
    run = _tell(pages, tmp_path)
    assert run.returncode == 0, run.stderr[-3000:]
    if "tutorial.md" in pages:
        assert "skipped: the last accepted run" in run.stdout
        assert "parameters moved by more than" in run.stdout or "none of" in run.stdout
    for made in STORIES[pages]:
        assert (tmp_path / made).is_file(), made


def test_every_page_with_commands_is_run():
    told = {(DOCS / page).resolve() for pages in STORIES for page in pages}
    pages = [README, *DOCS.rglob("*.md")]
    assert {page.resolve() for page in pages if _blocks(page, "sh")} == told


def test_make_targets_on_pages_exist():
    for page in (README, *DOCS.glob("*.md")):
        for target in re.findall(r"^make ([a-z]+)", "\n".join(_blocks(page, "bash")), re.M):
            run = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
            assert run.returncode == 0, run.stderr


@pytest.mark.parametrize("page", [README, *sorted(DOCS.rglob("*.md"))], ids=lambda page: page.stem)
def test_links_are_not_broken(page: Path):
    for link in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if "://" not in link:
            assert (page.parent / link).exists(), link


#: Written by commands of the pages themselves.
MADE_BY_A_READER = {"recipes/often.yaml"}


def test_files_that_pages_name_exist():
    """Paths and modules of the tree, whole; names of Python files alone, wherever they are."""
    tops = "agent|drivers|fake_controller|second_world|tests|benchmarks|docs|recipes"
    files = {path.name for top in tops.split("|") for path in (ROOT / top).rglob("*.py")}
    lost = []
    for page in [*ROOT.glob("*.md"), *DOCS.rglob("*.md")]:
        text = page.read_text(encoding="utf-8")
        paths = set(re.findall(rf"(?<![\w/.~-])((?:{tops})/[\w./-]*\w)", text)) - MADE_BY_A_READER
        lost += [f"{page.name}: {name}" for name in paths if not (ROOT / name).exists()]
        for name in re.findall(r"`((?:agent|drivers|fake_controller|second_world)(?:\.[a-z_]+)+)(?=[`.:])", text):
            place = ROOT / name.replace(".", "/")
            door = [path for path in place.parent.glob("__init__.py*")] + [place.parent.with_suffix(".py")]
            offered = "\n".join(path.read_text(encoding="utf-8") for path in door if path.is_file())
            if not (place.is_dir() or place.with_suffix(".py").is_file() or re.search(rf"\b{place.name}\b", offered)):
                lost.append(f"{page.name}: {name}")
        if page.name == "method.md":
            lost += [f"{page.name}: {name}" for name in re.findall(r"`([a-z_]+\.py)`", text) if name not in files]
    assert lost == []


def test_the_reference_matches_the_code():
    maker = loaded(DOCS / "make_reference.py")
    written = (DOCS / "reference.md").read_text(encoding="utf-8")
    assert written == maker.reference(), "run: python docs/make_reference.py"


def test_commands_that_are_named_exist():
    written = (DOCS / "reference.md").read_text(encoding="utf-8")
    known = set(re.findall(r"^### `agent ([a-z-]+)", written, re.M))
    for page in DOCS.glob("*.md"):
        for name in re.findall(r"`agent ([a-z][a-z-]*)", page.read_text(encoding="utf-8")):
            assert name in known, f"{page.name}: agent {name}"
