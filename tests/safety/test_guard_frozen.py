"""Samples that freeze while their stamps run on: stopped within 0.7 s by the stamps; healthy motions are not."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from agent.motion import JointTarget, Move, MoveType, Pdl2Settings, Trajectory, create_interpolator
from agent.robot import RobotDescription, load_robot
from agent.safety.adherence import Adherence
from drivers.protocol import SampleBlock
from tests.motion.test_other_arms import ARMS, arm
from tests.safety.test_off_plan import Arm, drawn

PERIOD = 0.002
#: Time from the freeze to the stop, of which the link takes 0.2 s.
LIMIT = 0.5


@dataclass
class Lie:
    """What goes on being reported as it was at the freeze, and the noise that is added to it [of a speed limit]."""

    positions: bool = True
    set_points: bool = True
    speeds: str = "true"  # or "zero", or "frozen"
    noise: float = 0.0


LIES = {
    "all but the speeds": Lie(),
    "positions alone": Lie(set_points=False),
    "set-points alone": Lie(positions=False),
    "speeds too": Lie(speeds="frozen"),
    "a standstill": Lie(speeds="zero"),
    "a standstill with noise": Lie(speeds="zero", noise=1e-5),
}


def frozen(block: SampleBlock, at: SampleBlock, lie: Lie, limits: np.ndarray, rng: np.random.Generator) -> SampleBlock:
    """A block as it is reported after the freeze `at` the last sample of another."""

    def held(name: str) -> np.ndarray:
        last = np.repeat(getattr(at, name)[-1:], len(block), axis=0)
        return last + rng.normal(0.0, 1.0, last.shape) * lie.noise * limits

    changes = {"position": held("position")} if lie.positions else {}
    if lie.set_points and block.reference_position is not None:
        changes["reference_position"] = held("reference_position")
    if lie.speeds != "true" and block.velocity is not None:
        changes["velocity"] = held("velocity") * (lie.speeds == "frozen")
    return replace(block, **changes)


def blocks_of(chains, pauses: float, seen: bool, size: int = 8, slower: float = 1.0) -> Iterator[SampleBlock]:
    """A motion as planned, with a rest before and after every stretch; `slower`: all times are longer."""
    rests = [np.repeat(chain.q[:1], round(pauses / PERIOD), axis=0) for chain in chains]
    ways = [
        np.stack(
            [np.interp(np.arange(0, chain.t[-1], PERIOD / slower), chain.t, column) for column in chain.q.T], axis=1
        )
        for chain in chains
    ]
    q = np.concatenate([part for pair in zip(rests, ways, strict=True) for part in pair])
    speed = np.gradient(q, PERIOD, axis=0)
    for first in range(0, len(q), size):
        rows = slice(first, min(first + size, len(q)))
        number = np.arange(rows.start, rows.stop)
        nothing = np.zeros_like(q[rows])
        yield SampleBlock(number, PERIOD * number, q[rows], speed[rows], nothing, q[rows] if seen else None, None)


def lied_to(watch: Adherence, blocks, moment: float, lie: Lie, robot: RobotDescription) -> float | None:
    """Time [s] from a freeze to the stop; None without a stop."""
    rng, at = np.random.default_rng(3), None
    for block in blocks:
        if at is not None:
            block = frozen(block, at, lie, robot.max_velocity, rng)
        elif block.time[-1] >= moment:
            at = block
        if watch.take(block) is not None:
            return None if at is None else float(block.time[-1] - at.time[-1])
    return None


def there_and_back(robot: RobotDescription, start: np.ndarray, end: np.ndarray, share: float = 0.5) -> list[Trajectory]:
    law = create_interpolator("fly", robot, None, period=PERIOD)
    chains, stand = [], start
    for goal in (end, start, end):
        move = Move(MoveType.JOINT, JointTarget(goal), Pdl2Settings(speed_override=share))
        chains.append(law.plan((move,), stand))
        stand = goal
    return chains


FOREIGN = {name: arm(name) for name in ARMS}
UR = load_robot("ur5e")
FOREIGN["ur5e"] = UR, np.array([0.0, -1.2, 1.2, -1.5, -1.5, 0.0]), np.array([0.6, -1.0, 0.9, -1.2, -1.5, 0.4])


@pytest.mark.parametrize("seen", [True, False], ids=["with set-points", "without"])
@pytest.mark.parametrize("lie", LIES)
def test_a_freeze_in_mid_path_is_stopped_in_time(lie, seen):
    """On every arm."""
    if not seen and not LIES[lie].positions:
        return
    for robot, start, end in FOREIGN.values():
        chains = there_and_back(robot, start, end)
        for moment in chains[0].duration * np.array([0.35, 0.6]):
            watch = Adherence(chains, robot, None, 0.02, PERIOD)
            took = lied_to(watch, blocks_of(chains, 0.1, seen), 0.1 + moment, LIES[lie], robot)
            assert took is not None, (robot.name, moment)
            assert took <= LIMIT, (robot.name, moment, took)


@pytest.mark.parametrize("share", [0.3, 0.05])
def test_a_freeze_of_a_slow_program_is_stopped_in_time(share):
    robot, start, end = FOREIGN["7 axes"]
    chains = there_and_back(robot, start, end, share)
    for lie in ("a standstill", "all but the speeds"):
        watch = Adherence(chains, robot, None, 0.02, PERIOD)
        took = lied_to(watch, blocks_of(chains, 0.1, True), 0.5 * chains[0].duration, LIES[lie], robot)
        assert took is not None
        assert took <= LIMIT


@pytest.mark.parametrize("lie", LIES)
def test_an_emulated_arm_that_freezes_is_stopped_in_time(lie):
    one = Arm(drawn(1000), 3)
    take, rng, moment = one._watch.take, np.random.default_rng(3), 0.4 * one.loop.planned.duration
    at: list[SampleBlock] = []

    def lying(block: SampleBlock) -> str | None:
        if at:
            block = frozen(block, at[0], LIES[lie], one._watch._robot.max_velocity, rng)
        elif block.time[-1] >= moment:
            at.append(block)
        return take(block)

    one._watch.take = lying
    one.run()
    assert one.reason is not None
    assert PERIOD * one.stopped - float(at[0].time[-1]) <= LIMIT


def test_a_motion_that_freezes_at_a_stop_ends_with_its_longest_rest():
    robot, start, end = FOREIGN["ur5e"]
    chains = there_and_back(robot, start, end)
    watch = Adherence(chains, robot, None, 0.02, PERIOD, longest_rest=1.5)
    moment = 0.5 + chains[0].duration + 0.3  # in the rest between two stretches
    took = lied_to(watch, blocks_of(chains, 0.5, seen=True), moment, Lie(speeds="zero"), robot)
    assert took is not None
    assert took <= 1.5 + LIMIT


def test_speeds_that_run_on_at_a_stop_are_a_contradiction():
    robot, start, end = FOREIGN["ur5e"]
    chains = there_and_back(robot, start, end, 1.0)
    watch = Adherence(chains, robot, None, 0.02, PERIOD)
    took = lied_to(watch, blocks_of(chains, 0.5, seen=True), 0.5 + chains[0].duration + 0.3, Lie(), robot)
    assert took is not None
    assert took <= 0.2 + 0.5 + LIMIT  # the rest that is left, the ramp, and the limit


@pytest.mark.parametrize(("pauses", "seen"), [(0.0, True), (0.1, False), (2.5, True)])
def test_rests_of_the_plan_are_no_freeze(pauses, seen):
    """Nor are slow programs, and motions that are a little slower than planned."""
    for name, share, slower in (("ur5e", 1.0, 0.93), ("7 axes", 0.05, 1.0), ("gantry", 0.3, 1.0)):
        robot, start, end = FOREIGN[name]
        chains = there_and_back(robot, start, end, share)
        watch = Adherence(chains, robot, None, 0.02, PERIOD, longest_rest=3.0)
        assert not any(watch.take(block) for block in blocks_of(chains, pauses, seen, 50, slower))


def test_an_arm_that_rests_off_its_stop_by_a_servo_error_is_not_frozen():
    """A slow plan moves on from there, whereas the arm stands: by 2 mm or so, as measured."""
    robot, start, end = FOREIGN["7 axes"]
    chains = there_and_back(robot, start, end, 0.05)
    watch = Adherence(chains, robot, None, 0.02, PERIOD, longest_rest=3.0)
    way = end - start
    for block in blocks_of(chains[:2], 1.5, False, 50):
        part = np.minimum((block.position - start) / np.where(way, way, np.inf), 1.0 - 0.003 / np.abs(way).max())
        assert watch.take(replace(block, position=start + part * way)) is None


def stationary(q: np.ndarray, first: int, count: int) -> Iterator[SampleBlock]:
    nothing = np.zeros((50, len(q)))
    for number in np.arange(first, first + count).reshape(-1, 50):
        there = np.repeat(q[None], 50, axis=0)
        yield SampleBlock(number, PERIOD * number, there, nothing, nothing, there, nothing)


def test_an_arm_may_wait_at_its_start_and_at_its_end():
    """For a permit, for a person who presses START, or for the controller to say that the motion is over."""
    robot, start, end = FOREIGN["ur5e"]
    chains = there_and_back(robot, start, end)[:1]
    watch = Adherence(chains, robot, None, 0.02, PERIOD, longest_rest=3.0)
    assert not any(watch.take(block) for block in stationary(start, 0, 15_000))
    moving = list(blocks_of(chains, 0.0, True, 50))
    later = [replace(block, sequence=block.sequence + 15_000, time=block.time + 30.0) for block in moving]
    assert not any(watch.take(block) for block in later)
    assert not any(watch.take(block) for block in stationary(end, int(later[-1].sequence[-1]) + 1, 5000))


def test_speeds_of_set_points_that_run_on_are_a_contradiction():
    robot, start, end = FOREIGN["ur5e"]
    chains = there_and_back(robot, start, end)[:1]
    watch = Adherence(chains, robot, None, 0.02, PERIOD)
    fast = np.full((50, 6), 0.3) * robot.max_velocity
    took = [watch.take(replace(block, reference_velocity=fast)) for block in stationary(start, 0, 300)]
    assert took[2] is None, "less than 0.4 s is too short to tell"
    assert "says that it moves" in took[-1]


def test_the_first_samples_are_too_few_to_tell():
    """Those before them were lost, so that the motion is seen from mid-path on."""
    robot, start, end = FOREIGN["ur5e"]
    chains = there_and_back(robot, start, end, 0.3)
    for seen in (True, False):
        watch = Adherence(chains, robot, None, 0.02, PERIOD)
        assert not any(watch.take(block) for block in list(blocks_of(chains, 0.0, seen, 10))[60:])


def test_positions_that_are_no_longer_known_for_long_enough_are_not_frozen():
    """Samples were lost for a while: two of them that are alike say nothing about the time between."""
    robot, start, end = FOREIGN["ur5e"]
    chains = there_and_back(robot, start, end, 0.3)
    watch, blocks = Adherence(chains, robot, None, 0.02, PERIOD), list(blocks_of(chains, 0.0, True, 10))
    seen = [block for block in blocks if not 0.5 < block.time[0] < 0.8]
    assert not any(watch.take(block) for block in seen)
