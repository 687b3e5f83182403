"""A program that is new to a machine runs slowly first, with somebody watching; what counts as that."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core import LARGEST_JSON
from agent.core.errors import ControllerError, InputError
from agent.motion import Delay, FlyInterpolator, JointTarget, Move, MoveType, Pdl2Settings, Trajectory, stop_to_stop
from agent.motion.pdl2 import write_program
from agent.motion.pdl2.dialect import Pdl2
from agent.safety import FIRST_SPEED, CheckedPrograms, PlannedProgram, slow_text
from drivers.errors import DriverError
from tests.safety.following import HOME


def test_refuses_an_unattended_first_run(bench, program, authorisation):
    chosen = program(0.1)
    guard = bench.open(yes=False, authorisation=authorisation(chosen))
    with pytest.raises(InputError, match="has never run on serial NS16-7"):
        bench.run(chosen, guard)
    assert bench.controller.starts == 0


def test_an_authorised_new_motion_runs_slowly_and_does_not_count_as_a_first_run(bench, program, authorisation):
    slow, fast = program(FIRST_SPEED), program(0.4)
    word = replace(authorisation(slow), unseen=True)
    assert bench.run(slow, bench.open(yes=False, authorisation=word)) == 1000
    assert not bench.checked.has("NS16-7", slow.checksum), "nobody watched it"
    with pytest.raises(InputError, match=r"with nobody there a new motion runs at no more than 0\.25 m/s"):
        bench.run(fast, bench.open(yes=False, authorisation=replace(authorisation(fast), unseen=True)))
    assert bench.controller.starts == 1


def test_a_program_new_to_a_machine_runs_slowly_first(bench, program):
    fast = program(0.8)
    guard = bench.open()
    assert guard.needs_slow_run(fast)
    with pytest.raises(ControllerError, match="has never run on serial NS16-7"):
        bench.run(fast, guard)
    assert bench.controller.starts == 0
    slow = replace(program(FIRST_SPEED), text="PROGRAM slow", stands_for=fast.checksum)
    assert bench.run(slow, guard) == 1000
    guard.close()
    guard = bench.open()
    assert not guard.needs_slow_run(fast)
    assert bench.run(fast, guard) == 1000
    bench.controller = replace(bench.controller, serial="NS16-8")
    assert bench.open().needs_slow_run(fast), "another machine"
    assert not bench.open().needs_slow_run(slow), "no slower than slow"
    bench.controller = replace(bench.controller, serial="")
    bench.run(slow)
    assert not bench.guard.needs_slow_run(fast)
    assert bench.open().needs_slow_run(fast), "another machine that tells no serial"


def test_an_emulator_needs_no_slow_run(bench, program):
    bench.controller.status = {"emulator": True}
    assert bench.run(program(0.8)) == 1000
    assert bench.run(program(0.1)) == 1000
    assert not bench.checked.path.exists()


def test_a_slow_run_that_was_cut_short_does_not_count(bench, program):
    bench.controller.vanish_after = 4
    with pytest.raises(DriverError):
        bench.run(program(0.2))
    assert not bench.checked.has("NS16-7", program(0.2).checksum)


def test_an_abandoned_slow_run_does_not_count(bench, program):
    guard = bench.open()
    guard.send(program())
    with guard.motion(program()) as samples:
        next(samples)
    assert (bench.controller.stops, bench.warned) == (1, [])
    assert not bench.checked.has("NS16-7", program().checksum)


def test_a_slow_program_counts_as_its_own_first_run(bench, program):
    assert bench.run(program(0.2)) == 1000
    assert bench.checked.has("NS16-7", program().checksum)
    assert len(json.loads(bench.checked.path.read_text(encoding="utf-8"))["programs"]) == 1


def test_stores_the_list_of_checked_programs(tmp_path: Path):
    checked = CheckedPrograms(tmp_path / "deep" / "checked_programs.json")
    assert not checked.has("a", "p")
    checked.add("a", "p")
    written = checked.path.stat().st_ino
    checked.add("a", "p")
    assert checked.path.stat().st_ino == written, "nothing was new"
    checked.add("b", "q")
    again = CheckedPrograms(checked.path)
    assert [again.has(*one) for one in (("a", "p"), ("b", "q"), ("a", "q"))] == [True, True, False]
    assert len(json.loads(checked.path.read_text(encoding="utf-8"))["programs"]) == 2
    for damage in ("", "[]", '{"schema": "other", "programs": []}', '{"schema": "checked_programs/1"}', "[" * 20000):
        checked.path.write_text(damage, encoding="utf-8")
        with pytest.raises(InputError, match="damaged"):
            again.has("a", "p")
    os.truncate(checked.path, LARGEST_JSON + 1)
    with pytest.raises(InputError, match="longer than 64 MiB"):
        again.has("a", "p")


def read(text: str) -> PlannedProgram:
    return PlannedProgram("swing", text, (), statements=tuple(Pdl2().read(text).run()))


def turns(*angles: float) -> list[Move]:
    """Moves of the first joint to angles [deg] from HOME."""
    goals = [JointTarget(HOME + np.radians([angle, 0, 0, 0, 0, 0])) for angle in angles]
    return [Move(MoveType.JOINT, goal, Pdl2Settings()) for goal in goals]


def slow_ways(bench, moves: list[Move]) -> list[Trajectory]:
    """What the slow version of a program with these moves makes, from stop to stop."""
    interpolator = FlyInterpolator(bench.robot, period=0.002)
    text = slow_text(read(write_program("swing", moves, bench.robot)), bench.robot, Pdl2(), interpolator, HOME)
    ways: list[Trajectory] = []
    for way in stop_to_stop(read(text).statements):
        ways.append(interpolator.plan(way, ways[-1].q[-1] if ways else HOME))
    return ways


@pytest.mark.parametrize(
    ("angles", "ends"),
    [
        ([20.0, -20.0] * 5, [20.0, -20.0, 20.0]),  # one cycle: the fourth stretch would be the second again
        ([5.0, 0.0, -5.0, 0.0] * 2, [5.0, 0.0, -5.0, 0.0]),
        ([5.0, 9.0], [5.0, 9.0, 5.0]),  # too short to reach its speed
        ([0.0, 20.0], [0.0, 20.0, 0.0]),  # the arm stands at its first point
        ([20.0, -20.0, 20.0, -20.0, 40.0], [20.0, -20.0, 20.0, -20.0, 40.0, 20.0]),
        # cycles that end where they begin are left out, what is new after them is not
        ([20.0, -20.0, 20.0, -20.0, 20.0, -20.0, 20.0, 40.0, 20.0], [20.0, -20.0, 20.0, 40.0, 20.0]),
        ([20.0, 40.0, 20.0, 40.0, 20.0, -20.0], [20.0, 40.0, 20.0, -20.0, 20.0]),
        # known stretches at the end lead back to where the program begins
        ([20.0, 9.0, -20.0, 20.0, 40.0, 9.0, -20.0, 20.0], [20.0, 9.0, -20.0, 20.0, 40.0, 9.0, -20.0, 20.0]),
        # the way back to the first point begins at the end, which comes before
        ([20.0, -20.0, 40.0, -20.0, 40.0], [20.0, -20.0, 40.0, -20.0, 40.0, 20.0]),
    ],
)
def test_the_slow_version_makes_every_way_once_below_the_first_run_speed(bench, angles, ends):
    slow = slow_ways(bench, turns(*angles))
    assert 0.5 * FIRST_SPEED < max(way.path_speed.max() for way in slow) <= FIRST_SPEED
    np.testing.assert_allclose([np.degrees(way.q[-1] - HOME)[0] for way in slow], ends, atol=1e-6)


def test_a_way_that_begins_with_a_blend_leads_back_to_its_first_point(bench):
    moves = [replace(move, fly=fly) for move, fly in zip(turns(20, 10, -20), (True, True, False), strict=True)]
    ways = slow_ways(bench, moves)
    np.testing.assert_allclose([np.degrees(way.q[-1] - HOME)[0] for way in ways], [-20.0, 20.0], atol=1e-6)


def test_a_program_that_moves_nothing_from_where_the_arm_stands_was_not_seen(bench, program):
    """From elsewhere it moves, and has to run slowly then."""
    bench.controller.moves = lambda times: np.tile(HOME, (len(times), 1))
    assert bench.run(replace(program(), chains=())) == 1000
    assert not bench.checked.path.exists()


def test_a_nan_speed_is_not_slow(bench, program):
    class Blind:
        def plan(self, moves, start):
            return replace(program().chains[0], path_speed=np.full(500, np.nan))

    text = write_program("swing", turns(5.0), bench.robot)
    with pytest.raises(InputError, match="it still reaches nan m/s"):
        slow_text(read(text), bench.robot, Pdl2(), Blind(), HOME)


def test_a_slow_run_ends_where_the_arm_stops():
    stop, fly = (Move(MoveType.JOINT, JointTarget(HOME), Pdl2Settings(), fly=fly) for fly in (False, True))
    assert list(stop_to_stop([fly, Delay(1.0), stop, stop, fly])) == [[fly, stop], [stop], [fly]]
    assert list(stop_to_stop([stop])) == [[stop]]
