"""The programs that are shipped for the controller: read, checked, and run by the fake's own meaning of them."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from agent.motion.pdl2 import parse_program
from agent.motion.pdl2.reduced_job import job_text
from agent.motion.pdl2.syntax import Pos
from agent.robot import load_robot
from fake_controller.interpolation import build_interpolator
from fake_controller.program.interpreter import Interpreter, left_over

FOLDER = Path(__file__).resolve().parents[2] / "drivers" / "controller"
DOCS = FOLDER.parents[1] / "docs"
ROBOT = load_robot("comau_ns16")
HOME = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])
NOTHING = (0.0,) * 6


@pytest.fixture
def run():
    """Runs a shipped program on what the one before has left: its statements, and the variables as it leaves them."""

    def go(name: str, seed: int = 3):
        text, _ = job_text((FOLDER / name).read_text(encoding="utf-8"), name, ROBOT)
        program = parse_program(text, name, ROBOT)
        assert program.name == Path(name).stem, "the translator takes the program's name from the file"
        system = left_over(seed)
        return list(Interpreter(program, ROBOT, system).run()), system

    return go


def test_every_program_is_documented_and_fits_the_translator():
    page = (DOCS / "controller-programs.md").read_text(encoding="utf-8")
    files = sorted(FOLDER.glob("*.pdl"))
    assert len(files) == 4
    for file in files:
        assert f"`{file.name}`" in page
        assert max(map(len, file.read_text(encoding="ascii").splitlines())) <= 132


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.pdl")), ids=lambda file: file.stem)
def test_uses_only_words_of_published_programs(file):
    """The page on PDL2 says where; strings, comments and names of their own are no words of the language."""
    seen = set(
        re.findall(r"\$?[A-Z][A-Z_0-9]+", (DOCS / "pdl2.md").read_text(encoding="utf-8").partition("## Where each")[2])
    )
    bare = [re.sub(r"'[^']*'", "", line).partition("--")[0] for line in file.read_text(encoding="ascii").splitlines()]
    own = {found[1] for line in bare if (found := re.match(r"  (\w+) = ", line))}
    words = {word for line in bare for word in re.findall(r"\$?\b[A-Z][A-Z_0-9]+\b", line) if "_COMAU_" not in word}
    assert words - own <= seen


@pytest.mark.parametrize("name", ["agent_watch.pdl", "agent_start.pdl"])
def test_the_watch_and_start_programs_contain_no_move(name, run):
    statements, _ = run(name)
    assert not [one for one in statements if hasattr(one, "target")]


def test_they_are_installed_with_the_package():
    """A wheel has them: they are data of a package that is installed, of a kind that is shipped."""
    project = tomllib.loads((FOLDER.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    tools = project["tool"]["setuptools"]
    assert "*.pdl" in tools["package-data"]["*"]
    assert "drivers*" in tools["packages"]["find"]["include"]
    assert tools["packages"]["find"].get("namespaces", True)


def test_the_frames_that_point_mode_needs_are_set_and_nothing_moves(run):
    statements, system = run("agent_frames.pdl")
    assert statements == []
    for name in ("$BASE", "$TOOL", "$UFRAME"):
        assert system[name] == Pos(NOTHING, "") != left_over(3)[name]


@pytest.mark.parametrize("kind", ["ours", "second"])
def test_the_first_motion_turns_joint_1_slowly_and_nothing_else(run, kind):
    statements, _ = run("agent_first_motion.pdl")
    moves = [one for one in statements if hasattr(one, "target")]
    q = build_interpolator(kind, ROBOT, 0, 0.01).plan(moves, HOME)
    assert np.degrees(q.q[:, 0].max()) == pytest.approx(5.0, abs=1e-6)
    np.testing.assert_allclose(q.q[:, 1:], np.tile(HOME[1:], (len(q.q), 1)), atol=1e-9)
    assert np.abs(q.qd[:, 0]).max() <= 0.05 * ROBOT.max_velocity[0] * 1.001
    np.testing.assert_allclose(q.q[-1], HOME, atol=1e-9)
