"""The interpolation law learned from set-points, on an interpolator that the learner has never seen."""

from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.motion import FlyInterpolator, FlyParameters, Learner, RecordedMove, create_interpolator, load_law
from agent.motion.pdl2 import parse_program
from agent.pipeline import learn as learning
from agent.pipeline.learn import learn_files
from agent.recording import read_log
from agent.robot import kinematics_for, load_robot
from fake_controller.interpolation import build_interpolator
from tests.motion.recordings import START, loop_program, record

ROBOT = load_robot("comau_ns16")


class Quiet:
    """A console that says nothing."""

    def __getattr__(self, name):
        return lambda *args, **kwargs: None


def learn(log: Path, out: Path, robot: str = "comau_ns16"):
    return learn_files(robot, [log], out, Quiet())


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A law learned from one recorded loop of the emulator's second interpolator, its file and its log."""
    folder = tmp_path_factory.mktemp("learned")
    log = record(folder / "loop.mcap", ROBOT, loop_program(ROBOT, 1), build_interpolator("second", ROBOT, 2, 0.004))
    return learn(log, folder / "law.yaml"), folder / "law.yaml", log


def judge(parameters: FlyParameters, seed: int, via: int, **loop: float):
    """Errors of a law on another loop of the same controller."""
    moves = list(parse_program(loop_program(ROBOT, via, **loop), "", ROBOT).run())[1:5]
    start = kinematics_for(ROBOT).solve(moves[-1].target.pose, START)
    planned = build_interpolator("second", ROBOT, seed, 0.004).plan(moves, start)
    return Learner(ROBOT, [RecordedMove(tuple(moves), planned.t, planned.q)], 0.004).errors(parameters)


def test_a_law_learned_from_one_loop_predicts_others(learned):
    law = learned[0].law
    assert law.figures["before"]["path_mm"] > 1.0
    for via in (2, 3):
        errors = judge(law.parameters, 2, via)
        assert errors.path < 1.0
        assert errors.time < 0.5
        assert judge(FlyParameters(), 2, via).time > 2.0


def test_a_learned_law_predicts_reorientation_moves(learned):
    """Half a radian within a few centimetres: limits bind that did not in the loop it was learned from."""
    for via in (1, 2):
        errors = judge(learned[0].law.parameters, 2, via, spread=0.05, turn=0.6)
        assert errors.path < 0.1
        assert errors.time < 0.5


def test_the_law_file_loads_as_an_interpolator(learned):
    _, path, _ = learned
    interpolator = create_interpolator(str(path), ROBOT, None, period=0.004)
    assert isinstance(interpolator, FlyInterpolator)
    assert interpolator.parameters == load_law(path, ROBOT).parameters != FlyParameters()
    assert list(load_law(path, ROBOT).settling_s) == ["FINE"]
    assert load_law(path, ROBOT).settling_s["FINE"] == pytest.approx(0.08, abs=0.01)


def test_detects_stops_of_a_few_samples(tmp_path):
    """A controller that settles at once goes on after 20 ms."""
    text, interpolator = loop_program(ROBOT, 1, cycles=3), FlyInterpolator(ROBOT, period=0.004)
    log = record(tmp_path / "loop.mcap", ROBOT, text, interpolator, period=0.004, rest=0.02)
    rests = {}
    read = read_log(log, ROBOT)
    found = learning._stretches(read, learning._statements(read, ROBOT), ROBOT, rests)
    assert [len(stretch.moves) for _, stretch in found] == [1, 4, 4, 4]
    assert rests == {"FINE": [pytest.approx(0.02, abs=0.009)] * 3}


def test_a_learned_law_keeps_the_arms_limits(learned):
    interpolator = create_interpolator(str(learned[1]), ROBOT, None, period=0.004)
    moves = list(parse_program(loop_program(ROBOT, 7), "", ROBOT).run())[1:5]
    plan = interpolator.plan(moves, kinematics_for(ROBOT).solve(moves[-1].target.pose, START))
    assert np.all(np.abs(plan.qd) <= ROBOT.max_velocity * 1.002)
    assert np.all(np.abs(plan.qdd) <= ROBOT.max_acceleration * 1.01)
    assert not plan.qd[[0, -1]].any()


def test_a_recipe_uses_the_law_file_and_reports_its_faults(learned, tmp_path):
    from agent.recipe import load_recipe
    from agent.runs.approved import problem
    from tests.app.conftest import RECIPE

    text = RECIPE.format(address="127.0.0.1:1", cycles=2, motions=2, speed="0.2 m/s", gate=0.03)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(text.replace("seed: 1}", "seed: 1, interpolator: law.yaml}"), encoding="utf-8")
    with pytest.raises(InputError, match=r"recipe.yaml:14: search.interpolator: .*law.yaml: no such file"):
        load_recipe(recipe)
    law = learned[1].read_text(encoding="utf-8")
    (tmp_path / "law.yaml").write_text(law, encoding="utf-8")
    first = problem(load_recipe(recipe))["interpolator"]
    (tmp_path / "law.yaml").write_text(law + "# another\n", encoding="utf-8")
    assert problem(load_recipe(recipe))["interpolator"] != first
    for change, match in (
        (("curve_share: ", "curve_share: 7"), "curve_share"),
        (("comau_ns16", "another"), "was learned from another"),
        (("robot_digest: ", "robot_digest: 0"), "other limits"),
        (("interpolator/1", "interpolator/9"), "schema"),
    ):
        (tmp_path / "law.yaml").write_text(law.replace(*change), encoding="utf-8")
        with pytest.raises(InputError, match=match):
            load_recipe(recipe)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ("no references", "no /joint_references"),
        ("no program", "recorded program is missing"),
        ("another program", "do not follow the program"),
        ("standstill", "the set-points do not move"),
        ("another robot", "a log of somebody"),
    ],
)
def test_unusable_logs_give_one_message(change, match, tmp_path):
    text = loop_program(ROBOT, 1)
    program = loop_program(ROBOT, 9) if change == "another program" else text
    log = record(tmp_path / "loop.mcap", ROBOT, text, FlyInterpolator(ROBOT, period=0.008), program, change, 0.008)
    with pytest.raises(InputError, match=match) as error:
        learn(log, tmp_path / "law.yaml")
    assert "loop.mcap" in str(error.value)
    assert not (tmp_path / "law.yaml").exists()
