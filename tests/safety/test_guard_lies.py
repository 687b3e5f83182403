"""Controllers, and whoever stands between, that lie about a motion."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import SafetyError
from agent.motion.interpolator import Trajectory
from agent.safety.planned_program import PlannedProgram
from drivers.errors import DriverError
from tests.conftest import drawn, patience
from tests.safety.following import HOME

SECONDS = 4.0
AXES = drawn(1.0, lambda rng: float(rng.uniform(0.7, 1.1))) * np.array([0.5, 0.0, 0.0, 0.4, 0.0, 0.0])
#: When it begins [s]: where both joints turn, so that it makes a difference.
MOMENT = drawn(0.8, lambda rng: float(rng.uniform(0.6, 1.4)))
SINCE = drawn(5, lambda rng: int(rng.integers(1, 12)))  # block
Motion = Callable[[np.ndarray], np.ndarray]


def planned(times: np.ndarray) -> np.ndarray:
    """(K, n): out and back once, then rest."""
    part = np.clip(times, 0.0, SECONDS) / SECONDS
    return HOME + np.outer(1 - np.cos(2 * np.pi * part), AXES)


@pytest.fixture(scope="module")
def wide() -> PlannedProgram:
    t = np.arange(0.0, SECONDS, 0.002)
    rate = np.outer(2 * np.pi / SECONDS * np.sin(2 * np.pi * t / SECONDS), AXES)
    poses, zeros = np.repeat(np.eye(4)[None], len(t), axis=0), np.zeros_like(rate)
    chain = Trajectory(t, planned(t), rate, zeros, poses, np.full(len(t), 0.1), np.zeros(len(t), int))
    return PlannedProgram("swing", "PROGRAM swing", (chain,))


def since(moment: float, lie: Motion) -> Motion:
    """The planned motion, and from a moment [s] on another."""
    return lambda times: np.where((times >= moment)[:, None], lie(times), planned(times))


def swapped(first: int, second: int) -> Motion:
    order = list(range(6))
    order[first], order[second] = second, first
    return lambda times: planned(times)[:, order]


def burst(moment: float, seconds: float, factor: float) -> Motion:
    """The planned motion, `factor` times as fast for some seconds."""
    return lambda times: planned(times + (factor - 1) * np.clip(times - moment, 0.0, seconds))


#: What is lied about from a moment [s] on: the set-points and, where it is another, what is measured.
LIES: dict[str, Callable[[float], tuple[Motion, Motion | None]]] = {
    "measured positions frozen": lambda at: (planned, lambda times: planned(np.minimum(times, at))),
    "all positions frozen": lambda at: (lambda times: planned(np.minimum(times, at)), None),
    "half a second sent once more": lambda at: (since(at, lambda times: planned(times - 0.5)), None),
    "half a second from the future": lambda at: (since(at, lambda times: planned(times + 0.5)), None),
    "measured from the future": lambda at: (planned, since(at, lambda times: planned(times + 0.5))),
    "joints 4 and 6 swapped": lambda at: (since(at, swapped(3, 5)), None),
    "joints 1 and 4 swapped where measured": lambda at: (planned, since(at, swapped(0, 3))),
    "joints 2 and 3 swapped": lambda at: (since(at, swapped(1, 2)), None),
    "faster for 0.15 s, between two looks": lambda at: (burst(at, 0.15, 3.0), None),
}


def lied_to(bench, wide: PlannedProgram, lie: str, moment: float) -> None:
    bench.controller.pushes, bench.controller.blocks = True, 18
    bench.controller.moves, bench.controller.measures = LIES[lie](moment)
    with pytest.raises(SafetyError):
        bench.run(wide)
    bench.guard.close()


@pytest.mark.parametrize("later", [{}, {"position": tuple(HOME + 0.2)}])
def test_an_honest_motion_is_not_stopped(bench, wide, later):
    """Where the state says that the arm stands is asked for only where its samples do not tell."""
    bench.controller = replace(bench.controller, pushes=True, blocks=18, moves=planned, measures=planned, later=later)
    assert bench.run(wide) == 1800


@pytest.mark.parametrize("lie", LIES)
def test_stops_a_controller_that_reports_false_data(bench, wide, lie):
    lied_to(bench, wide, lie, MOMENT)
    assert bench.controller.starts == 1


@pytest.mark.verify
@pytest.mark.parametrize("lie", LIES)
def test_stops_false_data_whenever_they_begin(bench, wide, lie):
    """Where both joints turn, so that it makes a difference."""
    for moment in np.random.default_rng(len(lie)).uniform(0.6, 1.4, 10):
        lied_to(bench, wide, lie, float(moment))


def test_slowing_between_two_polls_stays_on_the_plan(bench, wide):
    """An override that is turned down and up again between two looks costs time, and nothing else."""
    bench.controller = replace(bench.controller, pushes=True, blocks=20, moves=burst(MOMENT, 0.15, 0.5))
    assert bench.run(wide) == 2000


def test_repeated_blocks_count_once(bench, wide):
    bench.controller = replace(bench.controller, pushes=True, blocks=18, moves=planned, repeats=2)
    assert bench.run(wide) == 1800
    assert bench.guard.lost == 0


@pytest.mark.parametrize("jump", [10**10, 10**18])
def test_stamps_from_the_future_end_the_motion(bench, wide, jump):
    bench.controller = replace(bench.controller, pushes=True, blocks=18, moves=planned, clock_jump=(SINCE, jump))
    with pytest.raises((DriverError, SafetyError)):
        bench.run(wide)
    assert bench.controller.starts == 1


def test_closes_a_half_closed_link(bench, wide):
    """The other end reads on, and would take commands: it hears nothing more, and so its watchdog stops the arm."""
    bench.controller = replace(bench.controller, blocks=18, moves=planned, half_closes_after=SINCE)
    with pytest.raises(DriverError, match="make sure that the arm rests"):
        bench.run(wide)
    assert bench.controller.let_go.wait(patience(2.0))
    assert bench.controller.starts == 1
