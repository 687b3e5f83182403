"""The programs that are shipped for the controller: read, checked, and run by the fake's own meaning of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.motion import parse_program
from agent.motion.pdl2.tree import Pos
from agent.robot import load_robot
from fake_controller.interpolation import build_interpolator
from fake_controller.interpreter import Interpreter, left_over

FOLDER = Path(__file__).resolve().parents[2] / "drivers" / "controller"
ROBOT = load_robot("comau_ns16")
HOME = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])
NOTHING = (0.0,) * 6


@pytest.fixture
def run():
    """Runs a shipped program on what the one before has left: its statements, and the variables as it leaves them."""

    def go(name: str, seed: int = 3):
        program = parse_program((FOLDER / name).read_text(encoding="utf-8"), name, ROBOT)
        assert program.name == Path(name).stem, "the translator takes the program's name from the file"
        system = left_over(seed)
        return list(Interpreter(program, ROBOT, system).run()), system

    return go


def test_every_file_is_of_the_subset_and_named_on_the_page():
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    files = sorted(FOLDER.glob("*.pdl"))
    assert len(files) == 2
    for file in files:
        assert f"`{file.name}`" in page
        assert max(map(len, file.read_text(encoding="ascii").splitlines())) <= 132


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
