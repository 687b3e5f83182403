"""A known mass is asked for where it tells more than a motion of the bare arm, and only there."""

from dataclasses import replace
from html import unescape
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from agent.core import Console, write_atomically
from agent.diagnosis import diagnose
from agent.diagnosis.hypotheses.search import Search
from agent.experiment import NextMotion, known_mass, load_distinguishes, open_pairs
from agent.experiment.known_mass import plan_with_mass
from agent.experiment.pieces import GridMotion
from agent.experiment.questions import Alternative, OpenPair
from agent.motion.pdl2.dialect import Pdl2
from agent.pages.diagnosis.summary import planned_section
from agent.pages.elements import Page, render
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import load_recipe, template
from agent.robot import Tool, load_robot
from agent.safety import PlannedProgram
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

QUIET = Console(-1)
CAUSE, EQUAL, NEAR = ((name, (2,)) for name in ("load_dependent_friction", "friction_change", "viscous_nonlinearity"))
FOUND = SimpleNamespace(
    dataset=SimpleNamespace(
        fit=SimpleNamespace(reference=SimpleNamespace(scale=np.full(6, 1000.0), reach=2.0)),
        robot=SimpleNamespace(joint_names=()),
    ),
    selected=SimpleNamespace(causes=(SimpleNamespace(key=CAUSE),), rivals=((EQUAL,),), evidence=None),
)


def side(place):
    return SimpleNamespace(text=lambda: f"{place[0]} on joint_3", form="one", key=lambda names: place)


PAIR, BESIDE = (SimpleNamespace(first=side(CAUSE), second=side(other)) for other in (EQUAL, NEAR))


def planned(after: float, pair=PAIR):
    expected = SimpleNamespace(pair=pair, after=after, before_if=(0.0, 0.0), after_if=(after, after))
    return SimpleNamespace(expected=(expected,), pieces=(SimpleNamespace(motion=None),))


@pytest.fixture
def ask(tmp_path: Path, monkeypatch):
    """`ask(bare, loaded, tells)`: what is said, and the masses it was tried with, where the bare arm's motion promises
    `bare` (None: there is none), one with a mass `loaded`, and a mass grows distances or not."""
    recipe = load_recipe(write_atomically(tmp_path / "job.yaml", template()))
    problem = loop_problem(recipe, recipe.motion.speed)

    def run(bare, loaded, tells=True, change=lambda problem: problem, pair=PAIR):
        tried = []

        def plan(found, pairs, problem, *_):
            tried.append(problem.load.mass)
            return planned(loaded, pair)

        monkeypatch.setattr(known_mass, "plan_experiment", plan)
        monkeypatch.setattr(known_mass, "load_distinguishes", lambda *_: tells)
        motion = None if bare is None else planned(bare, pair)
        return plan_with_mass(FOUND, [pair], change(problem), 1, QUIET, motion), tried  # type: ignore[arg-type,list-item]

    return run


def test_asks_for_a_mass_if_it_makes_the_right_answer_likelier(ask):
    said, _ = ask(0.5, 0.9)
    assert " at the flange, the right answer between " in said.text()
    assert (
        "load_dependent_friction on joint_3 and friction_change on joint_3 has probability 0.90 instead of 0.50."
        in said.text()
    )
    assert ask(0.5, 0.6)[0] is None, "nobody mounts one for that"


def test_plans_no_mass_if_the_bare_arm_suffices_or_no_mass_helps(ask):
    assert ask(0.85, 1.0) == (None, [])
    assert ask(0.5, 1.0, tells=False) == (None, [])
    assert ask(0.5, 1.0, pair=BESIDE) == (None, []), "the verdict says of no such pair that it is open"


def test_proposes_a_mass_if_the_bare_arm_has_no_helpful_motion(ask):
    said, _ = ask(None, 0.6)
    assert " at the flange, the right answer between " in said.text()
    assert "instead" not in said.text()


def test_a_mass_is_as_heavy_as_the_gravity_of_the_arm_needs(ask):
    """Mounted on a slope it is the same mass; at a quarter of the gravity, four times as much."""

    def described(gravity):
        return lambda problem: replace(
            problem, robot=replace(problem.robot, gravity=tuple(np.multiply(gravity, 9.80665)), rated_payload=None)
        )

    (level,), (slope,), (light,) = (
        ask(0.5, 0.9, change=described(gravity))[1]
        for gravity in ((0.0, 0.0, -1.0), (0.6, 0.0, -0.8), (0.15, 0.0, -0.2))
    )
    assert slope == level
    assert light == pytest.approx(4 * level, rel=0.2)  # rounded to one digit


def test_mass_and_tool_stay_within_the_rated_payload(ask):
    def rated(mass):
        tool = Tool(np.eye(4), 2.0, np.zeros(3))
        return lambda problem: replace(problem, robot=replace(problem.robot, rated_payload=mass), tool=tool)

    assert ask(0.5, 0.9, change=rated(2.5))[1] == [pytest.approx(0.5)]
    assert ask(0.5, 0.9, change=rated(2.0)) == (None, [])


def test_the_page_shows_the_mass_next_to_the_bare_arm_motion(ask):
    mass, _ = ask(0.5, 0.9)
    robot = load_robot("comau_ns16")
    experiment = SimpleNamespace(expected=(), pieces=[SimpleNamespace(text=lambda robot: "a loop")])
    text = "PROGRAM x\nBEGIN\n  DELAY 4000\nEND x\n"
    said = NextMotion(experiment, PlannedProgram("experiment", text, ()), robot, Pdl2()).to_dict("x.pdl") | {
        "with_a_mass": mass.to_dict()
    }  # type: ignore[arg-type]
    assert mass.text() in unescape(render(Page("Gap", "it is", "plain", [planned_section(said)])))


def test_a_load_separates_load_dependent_friction_from_other_friction():
    arm = make_arm("RRR")
    model, plant, altered = learn(arm), Plant(arm, seed=3), []
    for name, seed in (("a", 21), ("b", 22), ("c", 23)):
        log = record(plant, name, seed, 0.1)
        torque = model.rigid.torque(
            log.position, log.velocity, np.gradient(log.velocity, log.t, axis=0), model.base_values
        )
        effort = log.effort.copy()
        effort[:, 1] += 0.05 * np.abs(torque[:, 1]) * np.tanh(log.velocity[:, 1] / 1e-3)
        altered.append(replace(log, effort=effort))
    found = diagnose(arm, altered, model)
    pairs = open_pairs(found)
    wanted = {"friction_change", "load_dependent_friction"}
    by_load = [pair for pair in pairs if set(pair.names) == wanted]
    assert by_load
    log = altered[0]
    qdd = np.gradient(log.velocity, log.t, axis=0)
    motion = GridMotion(log.t, log.position, log.velocity, qdd)
    load = Tool(np.eye(4), 20.0, np.zeros(3))
    assert load_distinguishes(found.dataset, found.selected.evidence, by_load, [motion], load)
    sides = []
    for name in ("friction_change", "viscous_nonlinearity"):
        form, *_ = next(Search(found.dataset.fit, only={(name, (1,))}).candidates())
        sides.append(Alternative(name, ("joint_2",), form, np.ones(len(form.names))))
    assert not load_distinguishes(found.dataset, found.selected.evidence, [OpenPair(*sides)], [motion], load)
