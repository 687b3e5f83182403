"""URScript written and read back, people's programs, and the law of motion of UR controllers."""

import re

import numpy as np
import pytest
from hypothesis import given, settings as running, strategies as st

from agent.core import InputError
from agent.motion import (
    CartesianTarget,
    Delay,
    JointTarget,
    LoopProgram,
    MotionError,
    Move,
    MoveType,
    create_dialect,
    create_interpolator,
    stop_to_stop,
    with_frames,
)
from agent.motion.urscript.settings import UrSettings
from agent.robot import Tool, kinematics_for, load_robot

PERIOD = 0.002
HOME = np.array([0.1, -1.5, 1.5, -1.5, -1.5, 0.0])
SCRIPT = create_dialect("urscript")


@pytest.fixture(scope="module")
def robot():
    return load_robot("ur5e")


@pytest.fixture(scope="module")
def law(robot):
    return create_interpolator("ur", robot, None, period=PERIOD)


@pytest.fixture(scope="module")
def pose(robot):
    return kinematics_for(robot, None).forward(HOME[None])[0]


def shifted(pose, *by):
    moved = pose.copy()
    moved[:3, 3] += by
    return moved


def movel(pose, *by, radius=0.0, **values):
    settings = UrSettings(fly_distance=radius, **values)
    return Move(MoveType.LINEAR, CartesianTarget(shifted(pose, *by)), settings, fly=radius > 0)


def as_said(statement):
    """The numbers that the controller receives."""
    if isinstance(statement, Delay):
        return ("sleep", statement.seconds)
    target, of = statement.target, UrSettings.of(statement.settings)
    where = target.pose.ravel() if isinstance(target, CartesianTarget) else target.position
    joint = statement.type is MoveType.JOINT
    speed = (of.joint_speed if joint else of.linear_speed) * of.speed_override
    radius = of.fly_distance if statement.fly else 0.0
    acceleration = of.joint_acceleration if joint else of.linear_acceleration
    return statement.type, statement.fly, np.round(where, 6).tolist(), round(speed, 9), round(acceleration, 9), radius


numbers = st.floats(-1.5, 1.5).map(lambda value: round(value, 6))
speeds = st.floats(0.01, 2.0)
joints = st.lists(numbers, min_size=6, max_size=6).map(np.array)
delays = st.builds(Delay, st.floats(0, 5).map(lambda value: round(value, 6)))


@st.composite
def moves(draw):
    radius, kind = draw(st.sampled_from([0.0, 0.01, 0.05])), draw(st.sampled_from([MoveType.JOINT, MoveType.LINEAR]))
    settings = UrSettings(fly_distance=radius, linear_speed=draw(speeds), joint_acceleration=draw(speeds))
    return Move(kind, JointTarget(draw(joints)), settings, fly=radius > 0)


@running(max_examples=40, deadline=None)
@given(st.lists(delays | moves(), min_size=1, max_size=6))
def test_a_written_program_reads_back_as_the_same_moves(statements):
    program = SCRIPT.read(SCRIPT.write("job", statements))
    assert [as_said(one) for one in program.run()] == [as_said(one) for one in statements]


@running(max_examples=40, deadline=None)
@given(st.lists(numbers, min_size=3, max_size=3), st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3))
def test_a_pose_keeps_its_position_and_rotation(place, turn):
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    (move,) = SCRIPT.read(SCRIPT.write("job", [Move(MoveType.LINEAR, CartesianTarget(pose), UrSettings())])).run()
    np.testing.assert_allclose(move.target.pose, pose, atol=1e-8)


def loop_text(robot, pose, name="excite", cycles=3, tool=None, **values):
    settings = with_frames(SCRIPT.settings({"distance": 0.04}, 0.25, robot), tool).changed(**values)
    points = [CartesianTarget(shifted(pose, *by)) for by in ((0, 0, 0), (0.1, 0.05, 0), (0.05, 0.15, 0.1))]
    loop = LoopProgram.of(points, settings, cycles, settings.changed(speed_override=0.1), JointTarget(HOME))
    return SCRIPT.write_loop(name, loop, robot)


def test_a_loop_is_recognised_watched_and_marked(robot, pose):
    text = loop_text(robot, pose)
    lines = text.splitlines()
    number = re.fullmatch(r"  write_output_integer_register\(25, (\d+)\)", lines[1])[1]
    assert lines[3] == '  rtde_set_watchdog("input_int_register_24", 2, "stop")'
    assert f"  while read_input_integer_register(25) != {number}:" in lines
    assert re.fullmatch(r"def excite_[0-9a-f]{8}\(\):", lines[0])
    assert text.index("movej") > text.index("  write_output_integer_register(25, 0)")
    assert "    write_output_integer_register(24, i)" in lines
    assert text.count("r=0.04") == 2
    assert text.count("r=0)") == 2
    chains = list(stop_to_stop(SCRIPT.read(text, "", robot).run()))
    assert [len(chain) for chain in chains] == [1, 3, 3, 3]


def test_the_name_is_short_and_follows_from_what_the_program_does(robot, pose):
    long, other = (loop_text(robot, pose, "x" * 40, cycles) for cycles in (3, 4))
    names = [re.match(r"def (\w+)", text)[1] for text in (long, other)]
    assert max(len(name) for name in names) <= 31
    assert names[0] != names[1]


def test_tool_and_load_are_set_before_the_first_move(robot, pose):
    frame = np.eye(4)
    frame[2, 3] = 0.12
    text = loop_text(robot, pose, tool=Tool(frame, 1.2, np.array([0.0, 0.0, -0.07])))
    assert "  set_tcp(p[0, 0, 0.12, 0, 0, 0])\n  set_target_payload(1.2, [0, 0, 0.05])\n" in text
    move = next(SCRIPT.read(text, "", robot).run())
    assert move.settings.load == (1.2, 0.0, 0.0, 0.05)
    np.testing.assert_allclose(np.array(move.settings.tool), frame)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("  servoj([0,0,0,0,0,0])", "t.script:2: .*servoj is not understood"),
        ("  movel(p[0,0,0,0,0])", "a pose has six numbers"),
        ("  movej([0,0,0], a=1)", "ur5e has 6 joints"),
        ("  movej([0,0,0,0,0,0], t=3)", "in a given time"),
        ("  movej(home)", "only the controller knows"),
        ("  while True:\n    movej([0,0,0,0,0,0])\n  end", "without an end"),
        ("  while read_input_integer_register(3) == 0:\n    movej([0,0,0,0,0,0])\n  end", "only the controller knows"),
        ("  if True:\n  sync()", "has no `end`"),
        ("  end\nend\n", "ends no block"),
        ("  movel((((", "no statement that is understood"),
        ("  thread watch():\n  sync()\n  end", "beside the program"),
    ],
)
def test_unknown_statements_are_refused_with_their_line(robot, body, message):
    with pytest.raises(InputError, match=message):
        SCRIPT.read(f"def p():\n{body}\nend\n", "t.script", robot)


def script(*lines):
    return SCRIPT.write("job", [Delay(0.0)]).replace("  sleep(0)\n", "".join(f"  {line}\n" for line in lines))


def turned_to(name):
    return f"movej([{name}, 0, 0, 0, 0, 0], a=1, v=1)"


#: Read as one motion here, and maybe run as another by the controller; or without an end, or never done with.
DOUBTFUL = {
    "expression of many parts": ["x = " + "+".join(["1"] * 900)],
    "many signs": ["x = " + "-" * 900 + "1"],
    "list of a huge length": ["x = [0] * 1000000000"],
    "power": ["x = 9^(9^(9^9))"],
    "numbers beyond 32 bits": ["x = 65536", "x = x * x"],
    "blocks and calls within each other": ["def f():", *["if True:"] * 30, "f()", *["end"] * 31, "f()"],
    "infinite target": [turned_to("1e999")],
    "target that is no number": ["x = 1e999 - 1e999", turned_to("x")],
    "negative acceleration": ["movej([0, 0, 0, 0, 0, 0], a=-1, v=1)"],
    "text as a speed": ['movej([0, 0, 0, 0, 0, 0], a=1, v="nan")'],
    "negative radius": ["movej([0, 0, 0, 0, 0, 0], a=1, v=1, r=-0.1)"],
    "target that is spread": ["movej(**[0, 0, 0, 0, 0, 0])"],
    "no target": ["movej()"],
    "unknown parameter": ["movej([0, 0, 0, 0, 0, 0], a=1, v=1, V=5)"],
    "element of a pose": ["x = p[0.3, 0.2, 0.3, 0, 3.1, 0]", "movel(x[0], a=1, v=0.1)"],
    "element from the end": ["x = [1, 2]", turned_to("x[-1]")],
    "sum of poses": ["x = p[0.3, 0.2, 0.3, 0, 3.1, 0]", "movel(x + x, a=1, v=0.1)"],
    "repeated list": ["movej([0.1, -1.5, 1.5] * 2, a=1, v=0.1)"],
    "posture of a pose": ["movej(get_inverse_kin(p[0.3, 0.2, 0.3, 0, 3.1, 0], [3, 0, 0, 0, 0, 0]), a=1, v=0.1)"],
    "function defined twice": ["def f():", turned_to(1), "end", "def f():", turned_to(2), "end", "f()"],
    "quotient of whole numbers": [turned_to("3 / 2")],
    "else of a loop": ["i = 0", "while i < 0:", "sync()", "else:", turned_to(1), "end"],
    "two elses": ["if False:", "sync()", "else:", "sync()", "else:", turned_to(1), "end"],
    "rest before its time": ["sleep(-1)"],
    "rest without an end": ["sleep(1e9)"],
    "rests of hours": ["i = 0", "while i < 3:", "sleep(1800)", "i = i + 1", "end"],
    "gravity": ["set_gravity([0, 0, -9.82])"],
}


@pytest.mark.parametrize("name", DOUBTFUL)
def test_what_a_controller_may_run_in_another_way_is_refused(name):
    with pytest.raises(InputError, match=r"t\.script:\d+"):
        list(SCRIPT.read(script(*DOUBTFUL[name]), "t.script").run())


def test_variables_of_a_function_are_its_own():
    text = script(
        *("x = 1", "y = 5", "def go(x):", "local y = 0", turned_to("x + y"), "end"),
        *("def two():", "z = 4", "go(3)", turned_to("z"), "x = 6", "end"),
        *("go(2)", turned_to("x"), "two()", turned_to("x"), turned_to("y")),
    )
    targets = [move.target.position[0] for move in SCRIPT.read(text).run()]
    assert targets == [2, 1, 3, 4, 6, 5]


PERSONS = """def task():
  # made by PolyScope
  set_tcp(p[0,0,0.1,0,0,0])
  global height = 0.2
  global Waypoint_1_p=p[.4, -.1, height, d2r(180), 0, 0]
  def up(by):
    movel(pose_trans(Waypoint_1_p, p[0,0,-by,0,0,0]), a=1.2, v=0.25, r=0.01)
  end
  thread watch():
    sync()
  end
  $ 1 "Robot Program"
  while (True):
    set_standard_digital_out(1, True)
    socket_open("10.0.0.1", 50000)
    $ 2 "MoveJ"
    movej(get_inverse_kin(Waypoint_1_p, qnear=[0,0,0,0,0,0]), a=1.4, v=1.05)
    up(0.05)
    movec(p[.4,0,.25,3.14,0,0], p[.4,.1,.2,3.14,0,0], a=1, v=0.1)
  end
end
"""


def test_the_moves_of_a_persons_program_are_read(robot):
    text, passed = SCRIPT.job(PERSONS, "task.script", robot)
    assert passed == {"watch": 1, "socket_open": 1}
    first, second, third = SCRIPT.read(text, "", robot).run()
    assert [one.type for one in (first, second, third)] == [MoveType.JOINT, MoveType.LINEAR, MoveType.CIRCULAR]
    np.testing.assert_allclose(first.target.pose[:3, 3], [0.4, -0.1, 0.2])
    np.testing.assert_allclose(second.target.pose[:3, 3], [0.4, -0.1, 0.25], atol=1e-9)
    assert second.fly
    assert np.array(first.settings.tool)[2, 3] == 0.1


def test_a_job_with_motion_that_has_no_target_is_refused(robot):
    with pytest.raises(InputError, match="speedl"):
        SCRIPT.job("def p():\n  speedl([0,0,0.1,0,0,0], 0.5)\nend\n", "p.script", robot)


def test_a_joint_move_is_a_trapezoid_of_the_joint_that_moves_farthest(law):
    """L = 1 rad at v = 0.5, a = 2: v/a + L/v = 2.25 s."""
    goal = HOME + np.array([1.0, -0.2, 0.3, 0, 0, 0.5])
    move = Move(MoveType.JOINT, JointTarget(goal), UrSettings(joint_speed=0.5, joint_acceleration=2.0))
    plan = law.plan([move], HOME)
    assert plan.duration == pytest.approx(2.25, abs=2 * PERIOD)
    assert np.abs(plan.qd).max() == pytest.approx(0.5)
    np.testing.assert_allclose(plan.q[-1], goal, atol=1e-9)
    shares = (plan.q - HOME)[1:] / (goal - HOME + [0, 0, 0, 1, 1, 0])
    np.testing.assert_allclose(shares[:, [1, 2, 5]], shares[:, [0, 0, 0]], atol=1e-9)


def test_a_straight_move_is_a_trapezoid_of_the_tool(law, pose):
    """L = 0.2 m at v = 0.2, a = 1: 1.2 s; half of the speed after 0.1 s."""
    plan = law.plan([movel(pose, 0.2, 0, 0, linear_speed=0.2, linear_acceleration=1.0)], HOME)
    assert plan.duration == pytest.approx(1.2, abs=2 * PERIOD)
    assert plan.path_speed.max() == pytest.approx(0.2, rel=1e-6)
    assert np.interp(0.1, plan.t, plan.path_speed) == pytest.approx(0.1, abs=0.003)


def test_a_blend_keeps_the_speed_and_begins_at_its_radius(law, pose):
    corner = pose[:3, 3] + [0.2, 0, 0]
    slow = {"linear_speed": 0.1, "linear_acceleration": 1.0}
    plan = law.plan([movel(pose, 0.2, 0, 0, radius=0.03, **slow), movel(pose, 0.2, 0.2, 0, **slow)], HOME)
    place = plan.tcp[:, :3, 3]
    between = (plan.t > 0.15) & (plan.t < plan.duration - 0.15)
    np.testing.assert_allclose(plan.path_speed[between], 0.1, rtol=2e-3)
    bent = (np.abs(place - pose[:3, 3])[:, 1] > 1e-5) & (np.abs(place - corner)[:, 0] > 1e-5)
    away = np.linalg.norm(place[bent] - corner, axis=1)
    assert away.max() == pytest.approx(0.03, abs=0.001)
    assert away.min() == pytest.approx(0.03 * (np.sqrt(2) - 1), abs=0.0005)


def test_blends_that_overlap_are_refused(law, pose):
    blended = [movel(pose, 0.06 * k, 0.06 * (k % 2), 0, radius=0.05, linear_speed=0.05) for k in (1, 2)]
    with pytest.raises(MotionError, match=r"take 100\.0 mm") as refused:
        law.plan([*blended, movel(pose, 0.3, 0, 0, linear_speed=0.05)], HOME)
    assert refused.value.limit == "blend overlap"


def test_a_move_beyond_a_limit_is_refused(law, pose):
    fast = Move(MoveType.JOINT, JointTarget(HOME + 2.0), UrSettings(joint_speed=4.0, joint_acceleration=9.0))
    hard = movel(pose, 0.05, 0.6, -0.1, linear_speed=1.0, linear_acceleration=20.0)
    for move, limit in ((fast, "the tool speed"), (hard, "acceleration")):
        with pytest.raises(MotionError, match="move more slowly") as refused:
            law.plan([move], HOME)
        assert limit in refused.value.limit
        assert refused.value.excess > 0


@pytest.mark.parametrize("name", ["ur3e", "ur5e", "ur10e"])
def test_the_recipe_of_each_arm_uses_urscript(name):
    from agent.recipe import load_recipe

    recipe = load_recipe(f"recipes/{name}.yaml")
    assert (recipe.robot.name, recipe.dialect.name, recipe.interpolator) == (name, "urscript", "ur")
