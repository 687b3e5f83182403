"""What a robot runs is planned and checked by one function: nothing else makes a program that a link would take."""

import ast
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from agent.core import Console, InputError
from agent.link import RobotLink, planning
from agent.link.alignment import Aligner
from agent.motion import JointTarget, MotionSettings, Move, MoveType, Pdl2Settings, with_frames
from agent.motion.pdl2 import write_program
from agent.recipe import load_recipe, template
from agent.robot import Box, Cell, TorqueLimits, kinematics_for
from agent.safety.first_run import slow_text
from fake_controller.state import home
from tests.conftest import ROOT

HOME = np.radians([0.0, 15.0, -90.0, 0.0, 45.0, 0.0])
THERE, BACK, AWAY = (HOME + np.radians([angle, 0, 0, 0, 0, 0]) for angle in (15.0, -15.0, 90.0))


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    path = tmp_path_factory.mktemp("recipe") / "recipe.yaml"
    path.write_text(template(), encoding="utf-8")
    return replace(load_recipe(path), tool=None)


@pytest.fixture
def checked(monkeypatch):
    """The trajectories that were checked against the cell, by identity."""
    found, truth = [], Cell.check_with_stopping
    spy = lambda cell, chain, margin: found.append(id(chain)) or truth(cell, chain, margin)  # noqa: E731
    monkeypatch.setattr(Cell, "check_with_stopping", spy)
    return found


def swing(robot, cycles=1, end=THERE):
    settings = with_frames(Pdl2Settings(), None)
    goals = [THERE, BACK] * cycles + [end]
    return write_program("swing", [Move(MoveType.JOINT, JointTarget(goal), settings) for goal in goals], robot)


class LinkToNewMachine(RobotLink):
    """A link to a machine that every program is new to, with the arm at `here`; what would run is kept."""

    def __init__(self, recipe, here=HOME):
        guard = SimpleNamespace(position=lambda: here, takes_points=False, identity=SimpleNamespace(serial="7"))
        guard.needs_slow_run = lambda program: not program.stands_for
        super().__init__(guard, recipe, Console(-1), {})
        self.ran = []

    def _record(self, program, log, motion, place=None):
        self.ran.append((motion, program))


def test_a_program_to_run_is_made_by_one_function_only():
    """A link runs nothing but a `PlannedProgram`, and that has been checked where it is made."""
    texts = {path.relative_to(ROOT / "agent"): path.read_text("utf-8") for path in (ROOT / "agent").rglob("*.py")}
    calls = {
        str(path): [ast.unparse(node.func) for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
        for path, text in texts.items()
        if re.search(r"PlannedProgram|plan_program|GuardedLink|guard\.", text)
    }

    def calling(name: str) -> list[str]:
        return [path for path, called in calls.items() if any(re.search(rf"\b{name}$", one) for one in called)]

    assert calling("PlannedProgram") == ["link/planning.py"]
    assert sorted(calling("plan_program")) == ["experiment/next_motion.py", "link/record.py"]  # the first has no link
    assert calling("GuardedLink") == calling(r"guard\.send") == calling(r"guard\.motion") == ["link/record.py"]


def test_every_different_way_is_checked_once(recipe, checked):
    program = planning.plan_program(recipe, swing(recipe.robot, cycles=50), "swing.pdl", HOME)
    assert len(program.chains) == 101
    assert len(checked) == 3, "from where the arm stands, there and back"
    assert {id(chain) for chain in program.chains} == set(checked)


def test_a_link_checks_the_way_from_where_the_arm_stands(recipe):
    """The swing itself is clear of the box, which the arm would have to pass to get there."""
    post = kinematics_for(recipe.robot).forward((HOME + AWAY)[None] / 2)[0, :3, 3]
    walled = replace(recipe, cell=replace(recipe.cell, keep_out=(Box("post", post - 0.1, post + 0.1),)))
    assert LinkToNewMachine(walled).plan(swing(recipe.robot), "swing.pdl").chains
    for start, end, place in ((AWAY, THERE, r"33: .* 0\.\d+"), (HOME, AWAY, r"38: .* 4\.1\d+")):
        with pytest.raises(InputError, match=rf"^swing\.pdl:{place} s .* post are .*: change this move, or move"):
            LinkToNewMachine(walled, start).plan(swing(recipe.robot, 2, end), "swing.pdl")


def test_a_first_run_and_what_follows_it_are_checked_too(recipe, checked, tmp_path):
    link = LinkToNewMachine(recipe)
    planned = link.plan(swing(recipe.robot, cycles=3), "swing.pdl")
    link.run(planned, tmp_path / "swing.mcap", "swing")
    (first, slow), (second, full) = link.ran
    assert (first, second) == ("first_run", "swing")
    assert slow.stands_for == full.checksum
    assert slow.speed <= 0.25 < full.speed
    assert {id(chain) for program in (slow, full) for chain in program.chains} <= set(checked)
    weak = replace(recipe.robot, joints=tuple(replace(joint, max_torque=1.0) for joint in recipe.robot.joints))
    link._limits = TorqueLimits(weak, None, None)  # a mass that the drives cannot even hold
    with pytest.raises(InputError, match="with the mass at the flange"):
        link.run(planned, tmp_path / "swing.mcap", "swing")
    assert len(link.ran) == 2


def test_a_way_to_the_first_point_of_several_goals_is_as_many_stretches():
    recipe = load_recipe(ROOT / "recipes/ros2.yaml")
    robot, period = recipe.robot, 1.0 / recipe.record.rate
    there = home(robot)
    moves = [Move(MoveType.JOINT, JointTarget(there + way), MotionSettings()) for way in (0.0, 0.1, 0.0)]
    away = there + np.array([1.0, 0, 0, 0, 0, 0])
    lines = recipe.dialect.write("swing", moves, robot).splitlines()
    far = json.loads(lines[1]) | {"velocity": [0.07] * 6}
    text = "\n".join([lines[0], json.dumps(far), *2 * lines[2:]]) + "\n"
    plan = planning.plan_program(recipe, text, "swing", away)
    assert plan.approaches == 2
    first, second, *cycles = plan.chains
    assert len(cycles) == 4
    assert max(first.duration, second.duration) <= 20.0 < first.duration + second.duration
    assert np.abs(first.qd).max() <= 0.07
    assert np.allclose(first.q[-1], (away + there) / 2)
    assert np.array_equal(second.q[-1], far["to"])
    aligner, wait = Aligner(plan.chains, period, plan.approaches), 50
    given = np.concatenate([np.pad(chain.q, ((0, wait), (0, 0)), "edge") for chain in plan.chains])
    aligner.take(period * np.arange(len(given)), given)
    begun = np.cumsum([0, *(len(chain.q) + wait for chain in plan.chains)])[[2, 4]]
    assert np.allclose(aligner.finish(lambda *rows: None), period * begun, atol=2 * period)
    slow = slow_text(plan, robot, recipe.dialect, planning.interpolator_of(recipe), away)
    assert json.loads(slow.splitlines()[1])["to"] == far["to"]
