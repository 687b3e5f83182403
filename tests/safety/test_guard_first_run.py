"""A program that is new to a machine runs slowly first, with somebody watching; what counts as that."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import ControllerError, InputError
from agent.motion.pdl2.dialect import Pdl2
from agent.motion.pdl2.settings import Pdl2Settings
from agent.motion.program import Delay, JointTarget, Move, MoveType, stop_to_stop
from agent.safety.first_run import FIRST_SPEED, CheckedPrograms, slow_version
from agent.safety.planned_program import PlannedProgram
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
    assert bench.controller.stops == 1
    assert not bench.checked.has("NS16-7", program().checksum)


def test_a_slow_program_counts_as_its_own_first_run(bench, program):
    assert bench.run(program(0.2)) == 1000
    assert bench.checked.has("NS16-7", program().checksum)
    assert len(json.loads(bench.checked.path.read_text(encoding="utf-8"))["programs"]) == 1


def test_stores_the_list_of_checked_programs(tmp_path: Path):
    checked = CheckedPrograms(tmp_path / "deep" / "checked_programs.json")
    assert not checked.has("a", "p")
    checked.add("a", "p")
    checked.add("a", "p")
    checked.add("b", "q")
    again = CheckedPrograms(checked.path)
    assert again.has("a", "p")
    assert again.has("b", "q")
    assert not again.has("a", "q")
    assert len(json.loads(checked.path.read_text(encoding="utf-8"))["programs"]) == 2
    for damage in ("", "[]", '{"schema": "other", "programs": []}', '{"schema": "checked_programs/1"}'):
        checked.path.write_text(damage, encoding="utf-8")
        with pytest.raises(InputError, match="damaged"):
            again.has("a", "p")


def test_the_slow_version_is_one_cycle_below_the_first_run_speed(bench):
    from agent.motion import FlyInterpolator, parse_program, write_program

    settings = Pdl2Settings().changed(linear_speed=1.0)
    targets = [JointTarget(HOME + np.radians([angle, 0, 0, 0, 0, 0])) for angle in (20.0, -20.0)]
    swing = [Move(MoveType.JOINT, target, settings) for target in targets]
    text = write_program("swing", swing * 5, bench.robot)
    interpolator = FlyInterpolator(bench.robot, period=0.002)
    slow = slow_version(PlannedProgram("swing", text, ()), bench.robot, Pdl2(), interpolator, HOME)
    assert slow.stands_for == hashlib.sha256(text.encode()).hexdigest()
    assert 0.5 * FIRST_SPEED < slow.speed <= FIRST_SPEED
    assert len(slow.chains) == 3, "from home, there, and back: the fourth stretch would be the second again"
    planned = interpolator.plan(tuple(list(parse_program(slow.text, "slow").run())[:1]), HOME)
    np.testing.assert_allclose(planned.q[-1], targets[0].position, atol=1e-9)
    assert planned.path_speed.max() <= FIRST_SPEED


def test_every_new_path_runs_slowly_first(bench):
    from agent.motion import FlyInterpolator, write_program

    goals = [HOME + np.radians([angle, 0, 0, 0, 0, 0]) for angle in (5.0, 0.0, -5.0, 0.0)]
    moves = [Move(MoveType.JOINT, JointTarget(goal), Pdl2Settings()) for goal in goals]
    text = write_program("ways", moves * 2, bench.robot)
    interpolator = FlyInterpolator(bench.robot, period=0.002)
    slow = slow_version(PlannedProgram("ways", text, ()), bench.robot, Pdl2(), interpolator, HOME)
    assert len(slow.chains) == 4


def test_a_nan_speed_is_not_slow(bench, program):
    from agent.motion import write_program

    class Blind:
        def plan(self, moves, start):
            return replace(program().chains[0], path_speed=np.full(500, np.nan))

    text = write_program("swing", [Move(MoveType.JOINT, JointTarget(HOME + 0.1), Pdl2Settings())], bench.robot)
    with pytest.raises(InputError, match="it still reaches nan m/s"):
        slow_version(PlannedProgram("swing", text, ()), bench.robot, Pdl2(), Blind(), HOME)


def test_a_slow_run_ends_where_the_arm_stops():
    stop, fly = (Move(MoveType.JOINT, JointTarget(HOME), Pdl2Settings(), fly=fly) for fly in (False, True))
    assert list(stop_to_stop([fly, Delay(1.0), stop, stop, fly])) == [[fly, stop], [stop], [fly]]
    assert list(stop_to_stop([stop])) == [[stop]]
