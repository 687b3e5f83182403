"""What a robot runs is planned and checked in one place: nothing else makes a program that a link would take."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from agent.core import Console, InputError
from agent.link import planning
from agent.link.record import RobotLink
from agent.motion import Delay, JointTarget, Move, MoveType, Pdl2Settings, with_frames, write_program
from agent.recipe import load_recipe, template
from agent.robot import Box, TorqueLimits, kinematics_for
from tests.conftest import ROOT

HOME = np.radians([0.0, 15.0, -90.0, 0.0, 45.0, 0.0])
WAYS = [HOME + np.radians([angle, 0, 0, 0, 0, 0]) for angle in (15.0, -15.0)]
CALM = with_frames(Pdl2Settings(), None)


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    path = tmp_path_factory.mktemp("recipe") / "recipe.yaml"
    path.write_text(template(), encoding="utf-8")
    return replace(load_recipe(path), tool=None)


@pytest.fixture
def counted(monkeypatch):
    """Trajectories that were checked against the cell."""
    checked = []
    truth = planning.check_cell
    monkeypatch.setattr(planning, "check_cell", lambda recipe, chain: checked.append(chain) or truth(recipe, chain))
    return checked


def swing(robot, cycles=1, last=HOME):
    goals = [*WAYS * cycles, last]
    moves = [Move(MoveType.JOINT, JointTarget(goal), CALM) for goal in goals]
    return write_program("swing", [*moves, Delay(2.5)], robot)


def calls(name: str) -> list[str]:
    """Where the agent calls something of this name."""
    found = []
    for path in sorted((ROOT / "agent").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] == name:
                found.append(path.relative_to(ROOT / "agent").as_posix())
    return found


def test_a_program_to_run_is_made_in_one_place_only():
    """A link runs nothing but a `PlannedProgram`, and that has been checked where it is made."""
    assert calls("PlannedProgram") == ["link/planning.py"]
    assert calls("plan_program") == ["link/record.py", "pipeline/gap/next_experiment.py"], "the second has no link"
    assert set(calls("GuardedLink")) == {"link/record.py"}
    senders = [
        path for path in (ROOT / "agent").rglob("*.py") if re.search(r"guard\.(send|motion)\(", path.read_text())
    ]
    assert [path.name for path in senders] == ["record.py"]


def test_every_different_way_is_checked_once(recipe, counted):
    program = planning.plan_program(recipe, swing(recipe.robot, cycles=50, last=WAYS[0]), "swing.pdl", HOME)
    assert len(program.chains) == 101
    assert len(counted) == 3, "from where the arm stands, there and back"
    assert {id(chain) for chain in program.chains} == {id(chain) for chain in counted}
    assert program.duration == pytest.approx(sum(chain.duration for chain in program.chains) + 2.5)


def test_a_link_checks_the_way_from_where_the_arm_stands(recipe):
    """The loop itself is clear of the box; the arm would have to pass it to get there."""
    away = HOME + np.radians([90.0, 0, 0, 0, 0, 0])
    post = kinematics_for(recipe.robot).forward((HOME + away)[None] / 2)[0, :3, 3]
    box = (Box("post", post - 0.1, post + 0.1),)
    walled = replace(recipe, cell=replace(recipe.cell, keep_out=box))
    near = RobotLink(SimpleNamespace(position=lambda: HOME, takes_points=False), walled, Console(-1), {})
    assert near.plan(swing(recipe.robot), "swing.pdl").chains
    far = RobotLink(SimpleNamespace(position=lambda: away, takes_points=False), walled, Console(-1), {})
    with pytest.raises(InputError, match="post"):
        far.plan(swing(recipe.robot), "swing.pdl")


class SlowLink(RobotLink):
    """A link to a machine that a program is new to; what would run is kept."""

    def __init__(self, recipe, limits=None):
        guard = SimpleNamespace(
            position=lambda: HOME,
            takes_points=False,
            needs_slow_run=lambda program: not program.stands_for,
            identity=SimpleNamespace(serial="7"),
        )
        super().__init__(guard, recipe, Console(-1), {}, limits)
        self.ran = []

    def _record(self, program, log, motion, place=None):
        self.ran.append((motion, program))


def test_a_first_run_and_what_follows_it_are_checked_too(recipe, counted, tmp_path):
    link = SlowLink(recipe)
    text = swing(recipe.robot, cycles=3)
    link.run(link.plan(text, "swing.pdl"), tmp_path / "swing.mcap", "swing")
    (first, slow), (second, full) = link.ran
    assert (first, second) == ("first_run", "swing")
    assert slow.stands_for == full.checksum
    assert slow.speed <= 0.25 < full.speed
    assert {id(chain) for program in (slow, full) for chain in program.chains} <= {id(chain) for chain in counted}


def test_a_first_run_bears_the_mass_at_the_flange(recipe, tmp_path):
    """The slow version alone would need less torque than the drives have; a heavy mass they cannot even hold."""
    weak = replace(recipe.robot, joints=tuple(replace(joint, max_torque=1.0) for joint in recipe.robot.joints))
    link = SlowLink(recipe)
    planned = link.plan(swing(recipe.robot), "swing.pdl")
    link._limits = TorqueLimits(weak, None, None)
    with pytest.raises(InputError, match="with the mass at the flange"):
        link.run(planned, tmp_path / "swing.mcap", "swing")
    assert link.ran == []
