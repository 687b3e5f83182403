"""What every dialect has to do, whatever its language: write a program, read it back, and let its own law run it."""

from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.motion import (
    CartesianTarget,
    Delay,
    JointTarget,
    LoopProgram,
    MotionSettings,
    Move,
    MoveType,
    create_dialect,
    create_interpolator,
    dialect_of,
    interpolator_names,
    left_open,
    with_frames,
)
from agent.motion.registry import dialects
from agent.robot import Tool
from drivers import registry as drivers

ALL = pytest.mark.parametrize("dialect", dialects(), ids=lambda one: one.name)
#: Programs of joint trajectories come back as points (`test_joint_trajectory.py`).
MOVES = pytest.mark.parametrize("dialect", [one for one in dialects() if one.frame_names], ids=lambda one: one.name)
#: Written with nine decimals, of millimetres and degrees at the coarsest.
SAME = 1e-8
TOOL = Tool(frame=np.array([[1.0, 0, 0, 0.01], [0, 1, 0, 0], [0, 0, 1, 0.12], [0, 0, 0, 1]]))
#: Slow enough at the corners for a law that slows nothing down by itself.
GENERAL = with_frames(MotionSettings(fly_distance=0.02, linear_speed=0.08), TOOL)


def program(home, kinematics):
    poses = [kinematics.forward(home[None])[0] for _ in range(3)]
    for k, pose in enumerate(poses):
        pose[:3, 3] += np.array([[0.0, 0.1, 0.0], [0.1, 0.1, 0.05], [0.1, 0.0, 0.0]])[k] + TOOL.frame[:3, 3]
    flying = [Move(MoveType.LINEAR, CartesianTarget(pose), GENERAL, fly=True) for pose in poses]
    slow = GENERAL.changed(speed_override=0.1).stopping()
    stop = Move(MoveType.LINEAR, JointTarget(home), GENERAL.stopping())
    return [Move(MoveType.JOINT, JointTarget(home), slow), Delay(0.25), *flying, stop]


def place(target):
    return target.pose if isinstance(target, CartesianTarget) else target.position


def check_same(found, wanted):
    assert [type(one) for one in found] == [type(one) for one in wanted]
    for one, other in zip(found, wanted, strict=True):
        if isinstance(one, Delay):
            assert one.seconds == pytest.approx(other.seconds)
            continue
        assert (one.type, one.fly, type(one.target)) == (other.type, other.fly, type(other.target))
        assert np.allclose(place(one.target), place(other.target), atol=SAME)
        assert np.allclose(one.settings.tool, other.settings.tool, atol=SAME)
        if one.fly:
            assert one.settings.fly_distance == pytest.approx(other.settings.fly_distance)
        if one.type is MoveType.LINEAR:
            assert one.settings.linear_speed * one.settings.speed_override == pytest.approx(
                other.settings.linear_speed * other.settings.speed_override
            )


@MOVES
def test_programs_round_trip(dialect, ns16, home, kinematics):
    statements = program(home, kinematics)
    read = dialect.read(dialect.write("task", statements, ns16), f"task{dialect.suffix}", ns16)
    assert read.name.startswith("task")
    check_same(list(read.run()), statements)


@MOVES
def test_a_loop_approaches_slowly_and_repeats_its_cycle(dialect, ns16, home, kinematics):
    approach, _, *flying, stop = program(home, kinematics)
    points = [stop.target, *(move.target for move in flying)]
    text = dialect.write_loop("loop", LoopProgram.of(points, GENERAL, 3, None, approach.target), ns16)
    read = list(dialect.read(text, "loop", ns16).run())
    rest = [one for one in read[1:2] if isinstance(one, Delay)]  # a dialect may rest wherever the arm stops
    assert all(one.seconds <= 0.1 for one in rest)
    check_same(read, [approach, *rest, *(3 * [*flying, stop, *rest])])


@MOVES
def test_a_written_program_sets_all_frames(dialect, ns16, home, kinematics):
    assert "tool" in dialect.frame_names
    statements = program(home, kinematics)
    text = dialect.write("task", statements, ns16)
    assert not left_open(dialect.read(text, "", ns16).run(), TOOL, dialect.frame_names)
    bare = [Move(one.type, one.target, MotionSettings(), one.fly) for one in statements if isinstance(one, Move)]
    needed = left_open(dialect.read(dialect.write("task", bare, ns16), "", ns16).run(), TOOL, dialect.frame_names)
    assert [*needed] == [*dialect.frame_names.values()]
    assert np.array_equal(needed[dialect.frame_names["tool"]], TOOL.frame)


@MOVES
def test_a_job_reads_like_a_program(dialect, ns16, home, kinematics):
    statements = program(home, kinematics)
    text, passed = dialect.job(dialect.write("task", statements, ns16), f"task{dialect.suffix}", ns16)
    moves = [one for one in dialect.read(text, "", ns16).run() if isinstance(one, Move)]
    check_same(moves, [one for one in statements if isinstance(one, Move)])
    assert not any(word.lower().startswith("move") for word in passed)


@ALL
@pytest.mark.parametrize("text", ["", "no program at all (", "\x00"])
def test_refuses_an_invalid_program_by_name(dialect, ns16, text):
    with pytest.raises(InputError, match="rubbish"):
        list(dialect.read(text, "rubbish", ns16).run())


@ALL
@pytest.mark.parametrize("name", ["", "1st", "a b", "a;b", "a\nb"])
def test_refuses_an_invalid_program_name(dialect, ns16, name):
    with pytest.raises(InputError, match="name"):
        dialect.write(name, [Delay(1.0)], ns16)


@ALL
def test_refuses_to_write_a_non_finite_coordinate(dialect, ns16):
    with pytest.raises(InputError, match="finite"):
        dialect.write("task", [Move(MoveType.JOINT, JointTarget(np.full(6, np.nan)))], ns16)


@ALL
def test_the_dialects_own_interpolator_runs_its_programs(dialect, ns16, home, kinematics):
    assert set(dialect.interpolators) <= set(interpolator_names(dialect)) <= set(interpolator_names())
    law = create_interpolator(dialect.interpolators[0], ns16, None, period=0.002)
    statements = list(dialect.read(dialect.write("task", program(home, kinematics), ns16), "", ns16).run())
    trajectory = law.plan(statements, home)
    assert np.abs(trajectory.q[-1] - home).max() < 1e-6
    assert (np.abs(trajectory.qd) <= 1.001 * ns16.max_velocity).all()


@ALL
def test_a_recipe_gives_the_settings_of_the_dialect(dialect, ns16):
    assert "distance" in dialect.fly_keys
    from agent.recipe.schema import FlySection

    settings = dialect.settings(FlySection(distance=0.015).model_dump(), 0.6, ns16)
    assert (settings.fly_distance, settings.linear_speed) == (0.015, 0.6)
    assert "15 mm" in settings.blend


@ALL
def test_a_dialect_is_found_by_name_and_by_file(dialect):
    assert create_dialect(dialect.name).name == dialect.name
    found = dialect_of(Path(f"job{dialect.suffix.upper()}"))
    assert found is not None
    assert found.name == dialect.name
    assert dialect_of(Path("job.txt")) is None
    assert dialect.companion(Path("nowhere") / f"job{dialect.suffix}") is None


def test_every_driver_has_a_registered_dialect():
    for name in drivers.available():
        assert create_dialect(drivers.dialect(name)).name == drivers.dialect(name)
    with pytest.raises(InputError, match=r"esperanto.*pdl2"):
        create_dialect("esperanto")
