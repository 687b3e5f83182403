"""The ROS 2 driver's motion without ROS: the emulated controller at the other end, in simulated time."""

import json
from collections import deque

import numpy as np
import pytest

from drivers.errors import DriverError, MotionStopped, RefusedError
from drivers.joint_trajectory import LONGEST, GoalProgram, JointSpline
from drivers.transports.ros2.brake import SILENCE, Orders
from drivers.transports.ros2.following import BRAKE, Believed, Counter, Course, Speed, brake_point
from drivers.transports.ros2.link import CANCELLED
from drivers.transports.ros2.motion import AHEAD, LATE, Ros2Motion
from drivers.wire.ros2 import JointSample, RosAddress, SetPoint
from fake_controller.ros2.controller import Goal, TrajectoryController
from fake_controller.ros2.trajectory import SampledTrajectory, TrajectoryMessage, TrajectoryPoint

JOINTS = ("a", "b")
PERIOD = 0.002
BEGIN = 1_795_900_000.0


def goal(way=0.5, seconds=2.0, cycles=1, begin=0.0, lead=0.2, tolerance=0.1, joints=JOINTS):
    """A line of a program: from `begin` out by `way` [rad] and back, rest to rest."""
    t = np.arange(0.0, seconds + 1e-6, 0.05)
    phase = 2 * np.pi * t / seconds
    rows = np.array(
        [
            begin + way * (1 - np.cos(phase)) / 2,
            way * np.pi / seconds * np.sin(phase),
            way * 2 * (np.pi / seconds) ** 2 * np.cos(phase),
        ]
    )
    rows[1:, [0, -1]] = 0.0
    points = []
    for k, time in enumerate(t + lead):
        sec, nanosec = divmod(round(time * 1e9), 10**9)
        values = {name: [row[k]] * len(joints) for name, row in zip(FIELDS, rows, strict=True)}
        points.append({**values, "time_from_start": {"sec": sec, "nanosec": nanosec}})
    trajectory = {"joint_names": list(joints), "points": points}
    limits = [{"name": name, "position": tolerance} for name in joints if tolerance]
    return json.dumps({"cycles": cycles, "goal": {"trajectory": trajectory, "path_tolerance": limits}}) + "\n"


FIELDS = ("positions", "velocities", "accelerations")
HEADER = json.dumps({"program": "p", "joint_names": list(JOINTS)}) + "\n"
TO = '{"to": [0, 0], "velocity": [1, 1], "acceleration": [2, 2]}\n'


class Arm:
    """A link whose far end is the emulated controller; time passes when a test says so."""

    target = RosAddress.of("ros2://0/arm")
    watchdog = 0.5

    def __init__(self, by_goal, position=(0.0, 0.0), lag=0.0):
        self.by_goal, self.lag = by_goal, lag
        self.now, self.delay = BEGIN, 0.001
        self.controller = TrajectoryController(JOINTS, PERIOD, np.array(position, dtype=float))
        self.position, self.speed = np.array(position, dtype=float), np.zeros(2)
        self.set_by = 0.0  # s, of its clock
        self.offset = self._off = np.zeros(2)  # where it is asked to be, and where a joint of 5 rad/s is by now
        self.noise = lambda: 0.0
        self.believed, self.doubt = Believed(), "a joint jumps"
        self.second_source = "does a second node publish joint_states?"
        self.states = deque()
        self.sent, self.brakes, self.cancels = [], [], 0
        self.deaf = self.answers_nothing = False
        self.motion = None
        self.sample()

    def run_program(self, text, **options):
        program = GoalProgram.of(text)
        self.over, self.kept = [], []
        self.motion = Ros2Motion(
            program, self, PERIOD, self.by_goal, None, True, 1 << 28, lambda: self.over.append(1), lambda: self.now,
            **options,
        )  # fmt: skip
        self.motion.begin()
        self._reader = self.motion.blocks()
        return self.motion

    @property
    def latest(self):
        return self.believed.sample

    @property
    def velocity(self):
        return self.believed.velocity

    def sample(self):
        self._off = self._off + np.clip(self.offset - self._off, -5 * PERIOD, 5 * PERIOD)
        found = JointSample(self.now, self.position + self._off + self.noise(), self.speed.copy(), np.ones(2))
        self.believed.take(found, self.now + self.delay)
        return found

    def run(self, seconds, states=False, until_over=False, reading=True):
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            command, rate = self.controller.update(self.now, self.position, self.speed)
            before = self.position
            self.position = command - self.lag * rate
            self.speed = (self.position - before) / PERIOD
            sample = self.sample()
            self.motion.sample(sample, self.now + self.delay)
            if states:
                self.set_point(command, rate)
                self.motion.state(self.states[-1])
            self.motion.poll()
            while reading and self.motion.size > 4000:
                self.kept.append(next(self._reader))
            if until_over and self.motion.over:
                return

    def set_point(self, command, rate):
        self.states.append(SetPoint(self.now, command, rate, self.controller.scaling))

    # As the driver sees it

    def clock(self):
        return self.now + self.set_by

    def send(self, ahead, points):
        stamp = self.now + ahead
        self.sent.append((stamp, points))
        if not self.deaf:
            assert self.controller.take(self._message(stamp, points), self.now) == ""
        return stamp

    def send_goal(self, ahead, points, tolerance, goal_time, answered, ended):
        stamp = self.now + ahead
        self.sent.append((stamp, points))
        if self.answers_nothing:
            return stamp
        limits = dict(zip(JOINTS, tolerance.tolist(), strict=True))

        def on_end(status, code, text):
            ended(int(code) or CANCELLED * (status != "succeeded"), text)

        given = Goal(self._message(stamp, points), on_end, limits, {}, goal_time)
        answered(self.controller.take_goal(given, self.now) == "")
        return stamp

    def brake(self, strength, position, velocity):
        self.brakes.append(self.now)
        self.stopped_from, self.braked_at = position, velocity
        seconds, place = brake_point(position, velocity, strength)
        if not self.deaf:
            self.controller.take(self._message(0.0, [(seconds, place, 0.0 * place)]), self.now)
        return seconds

    def cancel(self):
        self.cancels += 1
        self.controller.cancel()

    def _message(self, stamp, points):
        return TrajectoryMessage(JOINTS, stamp, tuple(TrajectoryPoint.of(t, *rows) for t, *rows in points))


BOTH = pytest.mark.parametrize("by_goal", [True, False], ids=["goal", "topic"])


def blocks_of(arm):
    """All that was handed out; raises what ended the motion."""
    return [*arm.kept, *arm._reader]


def test_samples_and_set_points_that_waited_are_joined_by_their_stamps():
    arm = Arm(True)
    arm.set_point(arm.position, arm.speed)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(0.8, states=True)
    take, waiting = arm.motion.sample, []
    arm.motion.sample = lambda *sample: waiting.append(sample)
    arm.run(0.3, states=True)
    for sample, _ in waiting:  # all at once, after their set-points
        arm.believed.sample = sample
        take(sample, arm.now + arm.delay)
    arm.motion.sample = take
    arm.run(6.0, states=True, until_over=True)
    blocks = blocks_of(arm)
    rows = [np.concatenate([getattr(one, name) for one in blocks]) for name in ("reference_position", "position")]
    assert len(rows[0]) > 2000
    assert np.array_equal(*rows)


@BOTH
def test_goals_are_sent_in_turn_each_when_the_arm_rests(by_goal):
    arm = Arm(by_goal, (0.1, -0.1))
    arm.set_point(arm.position, arm.speed)  # they come all the time
    motion = arm.run_program(HEADER + TO + goal(cycles=3))
    arm.run(20.0, states=True, until_over=True)
    assert motion.over
    assert len(arm.sent) == 4
    assert not arm.brakes
    assert len(motion.cycle_starts) == 3
    blocks = blocks_of(arm)
    sequence = np.concatenate([block.sequence for block in blocks])
    assert np.array_equal(sequence, np.arange(len(sequence)))
    assert np.allclose(np.diff(np.concatenate([block.time for block in blocks])), PERIOD, rtol=1e-3)
    assert not motion.sequencer.gaps
    assert np.array_equal(np.concatenate([block.reference_position for block in blocks])[-1], (0.0, 0.0))
    for (_, points), (_, before) in zip(arm.sent[1:], arm.sent[:-1], strict=True):
        assert points[0][0] >= 0.2
        assert np.array_equal(points[0][1], before[-1][1])
        assert not np.any(points[-1][2])
    assert arm.over == [1]


@BOTH
def test_each_goal_begins_in_the_future_by_the_controllers_clock(by_goal):
    arm = Arm(by_goal)
    arm.run_program(HEADER + goal())
    (stamp, points), *_ = arm.sent
    assert stamp == arm.latest.stamp + AHEAD
    assert stamp + points[0][0] >= arm.now + 0.5


@BOTH
def test_a_joint_off_its_trajectory_is_braked_before_the_controller_holds_it(by_goal):
    arm = Arm(by_goal)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.5)
    arm.offset = np.array([0.0, 0.085])
    arm.run(2.0, until_over=True)
    assert len(arm.brakes) == 1
    with pytest.raises(MotionStopped, match=r"b was 0.0.. rad off its trajectory, 0.080 are allowed"):
        blocks_of(arm)
    assert not arm.speed.any()
    assert arm.brakes[0] - (BEGIN + 1.5) <= 0.02


@BOTH
@pytest.mark.parametrize("position", [(np.nan, 0.0), (0.0, np.inf), (0.0, 0.0), (-1.5, 1.5)])
def test_a_sample_that_this_arm_cannot_have_made_brakes_it_where_it_really_is(by_goal, position):
    """As from a second node that publishes the same joints."""
    arm = Arm(by_goal)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.5)
    for _ in range(10):
        foreign = JointSample(arm.now + PERIOD / 2, np.array(position), np.zeros(2), np.ones(2))
        arm.believed.take(foreign, arm.now)
        arm.motion.sample(foreign, arm.now)
        arm.run(PERIOD)
    assert len(arm.brakes) == 1
    arm.run(2.0, until_over=True)
    with pytest.raises(MotionStopped, match="a joint jumps"):
        blocks_of(arm)
    assert np.abs(arm.controller.command - arm.stopped_from).max() < 0.3
    assert not arm.speed.any()


@BOTH
@pytest.mark.parametrize("seed", range(3))
def test_samples_that_contradict_each_other_throw_no_arm(by_goal, seed):
    """It is braked from its trajectory, once: no sample says where it is."""
    rng = np.random.default_rng(seed)
    arm = Arm(by_goal)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.5)
    there, fast = arm.position, arm.speed
    arm.noise, speeds = lambda: rng.uniform(-0.2, 0.2, 2), []
    for turn in range(60):
        arm.run(0.02)
        speeds.append(np.abs(arm.speed).max())
        if turn == 15:
            arm.motion.brake()
    assert len(arm.brakes) == 1
    assert np.abs(arm.stopped_from - there).max() < 0.02
    assert max(speeds) <= 1.1 * fast.max()
    assert not arm.speed.any()


def test_after_a_stall_the_newest_sample_says_where_the_arm_is_braked():
    """A process that was stopped finds seconds of old samples, and an arm that a second process has braked."""
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.0)
    waiting = []
    for k in range(1000):
        arm.now += PERIOD
        arm.position = np.minimum(0.5 + 0.5 * PERIOD * k, 0.7) * np.ones(2)
        waiting.append(JointSample(arm.now, arm.position, np.zeros(2), np.ones(2)))
    for sample in waiting:
        arm.believed.take(sample, arm.now)
        arm.motion.sample(sample, arm.now)
    assert not arm.brakes
    arm.motion.poll()
    assert len(arm.brakes) == 1
    assert arm.stopped_from.tolist() == [0.7, 0.7]


@pytest.mark.parametrize("stamp", [0.0, BEGIN - 3600.0, BEGIN + 3600.0])
def test_a_clock_that_is_set_brakes_the_arm_where_it_is(stamp):
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.5)
    for _ in range(5):
        sample = JointSample(stamp, arm.position, arm.speed, np.ones(2))
        arm.believed.take(sample, arm.now)
        arm.set_by = stamp - arm.now
        arm.motion.sample(sample, arm.now)
        arm.motion.poll()
    assert len(arm.brakes) == 1
    assert np.allclose(arm.stopped_from, arm.position, atol=0.01)


def test_after_a_brake_an_arm_out_of_sight_is_cancelled_and_not_thrown_to_its_trajectory():
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.5)
    arm.motion.send_brake()
    arm.now += 0.5
    arm.motion.send_brake()
    assert (len(arm.brakes), arm.cancels) == (1, 1)


def test_after_a_stall_a_brake_waits_for_a_sample_of_now():
    """What was kept for a process that was stopped comes little by little."""
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=1.0, seconds=8.0))
    arm.run(1.5)
    old, there = arm.now + PERIOD, arm.position
    arm.now += 2.0
    for stamp, brakes in ((old, 0), (old + PERIOD, 0), (arm.now, 1)):
        sample = JointSample(stamp, there, np.zeros(2), np.ones(2))
        arm.believed.take(sample, arm.now)
        arm.motion.sample(sample, arm.now)
        arm.motion.poll()
        assert len(arm.brakes) == brakes
    assert np.allclose(arm.stopped_from, there, atol=0.01)


def test_two_causes_of_one_stop_brake_once_and_cancel_nothing():
    """Driver and guard see the same."""
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=1.0, seconds=8.0))
    arm.run(1.5)
    arm.motion.brake(MotionStopped("off"))
    arm.run(0.02)
    arm.motion.brake()
    arm.run(0.1)
    assert (len(arm.brakes), arm.cancels) == (1, 0)


def test_a_velocity_in_degrees_does_not_enlarge_a_brake():
    believed = Believed()
    for k in range(100):
        position = np.array([0.5 * k * PERIOD])
        believed.take(JointSample(BEGIN + k * PERIOD, position, np.degrees([0.5]), position), k * PERIOD)
    assert np.allclose(believed.velocity, 0.5, rtol=1e-3)


def test_an_arm_may_be_anywhere_after_a_pause_and_its_clock_may_be_set():
    believed = Believed()
    nothing = np.zeros(1)
    for stamp, position, now, believable in (
        (10.0, 0.0, 0.0, True),
        (10.002, 0.5, 0.002, False),
        (10.2, 0.5, 0.2, True),
        (3600.0, 0.51, 0.21, True),
        (10.3, 0.8, 0.3, False),
        (10.3, 0.8, 1.3, True),
    ):
        jump = believed.take(JointSample(stamp, np.array([position]), nothing, nothing), now)
        assert (jump == 0.0) is believable


@BOTH
def test_a_stop_brakes_by_one_point_and_cancels_once_the_arm_rests(by_goal):
    arm = Arm(by_goal)
    motion = arm.run_program(HEADER + goal(way=1.0, seconds=4.0, cycles=5))
    arm.run(1.5)
    fast = arm.speed.copy()
    assert fast[0] > 0.3
    motion.stopping = True
    motion.brake()
    arm.run(2.0, until_over=True)
    assert motion.over
    assert (len(arm.brakes), arm.cancels) == (1, 1)
    assert len(arm.sent) == 1
    blocks_of(arm)
    assert arm.now - arm.brakes[0] < 0.8
    assert not arm.speed.any()


@BOTH
def test_an_arm_that_has_not_set_out_yet_does_not_rest(by_goal):
    """The brake may be on its way while the arm still stands, and not arrive."""
    arm = Arm(by_goal)
    motion = arm.run_program(HEADER + goal(way=1.0, seconds=8.0))
    arm.deaf = True
    motion.stopping = True
    motion.brake()
    arm.run(0.45)
    assert not motion.over
    arm = Arm(by_goal)
    motion = arm.run_program(HEADER + goal(way=1.0, seconds=8.0))
    motion.stopping = True
    motion.brake()
    arm.run(1.5, until_over=True)
    assert motion.over
    assert not arm.position.any()
    blocks_of(arm)


def test_a_controller_that_does_not_brake_is_cancelled():
    arm = Arm(True)
    motion = arm.run_program(HEADER + goal(way=1.0, seconds=8.0))
    arm.run(1.5)
    arm.deaf = True
    motion.stopping = True
    motion.brake()
    arm.run(0.55)
    assert arm.cancels == 0
    arm.run(0.8)
    assert arm.cancels == 1
    arm.run(1.0, until_over=True)
    assert motion.over


def test_a_second_stop_brakes_again_and_cancels():
    arm = Arm(True)
    motion = arm.run_program(HEADER + goal(way=1.0, seconds=8.0))
    arm.run(1.5)
    arm.deaf = True
    motion.brake()
    arm.run(0.3)
    motion.brake()
    arm.run(PERIOD)
    assert (len(arm.brakes), arm.cancels) == (2, 1)


@BOTH
def test_an_arm_that_obeys_and_is_seen_late_is_not_set_in_motion_again(by_goal):
    """Positions stand still for 0.3 s, and are as late from then on; two stops follow, as the guard sends them."""
    arm = Arm(by_goal)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.5)
    was = deque([arm.position] * 150)
    arm.noise = lambda: was.append(arm.position) or was.popleft() - arm.position
    arm.run(0.15)
    arm.motion.stopping = True
    for wait in (0.3, 0.3, 1.0):
        arm.motion.brake()
        speeds = []
        for _ in range(round(wait / 0.01)):
            arm.run(0.01, until_over=True)
            speeds.append(np.abs(arm.speed).max())
        if len(arm.brakes) > 1:
            assert max(speeds) < 0.05, "the second stop moved it"
    assert len(arm.brakes) > 1


def test_a_second_stop_of_an_arm_that_went_far_brakes_it_where_it_is():
    arm = Arm(False)
    arm.run_program(HEADER + goal(way=1.0, seconds=8.0))
    arm.run(1.5)
    arm.deaf = True
    arm.motion.stopping = True
    arm.motion.brake()
    arm.run(2.0)
    arm.deaf = False
    there = arm.position
    arm.motion.brake()
    arm.run(0.05)
    assert np.allclose(arm.stopped_from, there, atol=0.03)


def test_an_arm_that_follows_a_set_point_that_jumped_is_braked_from_no_more_than_its_planned_speed():
    """As where the controller's clock is set forward: the arm is four times as fast for a moment."""
    arm = Arm(False)
    motion = arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.5)
    arm.offset = np.array([0.07, 0.07])  # at 5 rad/s
    arm.run(0.02)
    assert np.abs(arm.velocity).max() > 2.0
    motion.brake()
    arm.run(PERIOD)
    assert np.abs(arm.braked_at).max() < 1.0


def test_late_samples_are_judged_by_their_stamp():
    arm = Arm(True)
    arm.run_program(HEADER + goal(seconds=8.0))
    arm.run(2.0)
    arm.delay = arm.watchdog + LATE - 0.05
    arm.run(0.1)
    assert not arm.brakes
    arm.delay = arm.watchdog + LATE + 0.05
    arm.run(0.1)
    assert len(arm.brakes) == 1
    arm.run(1.0, until_over=True)
    with pytest.raises(DriverError, match="s late, so nobody watched the arm"):
        blocks_of(arm)


def test_a_delay_that_is_always_the_same_is_the_clocks():
    arm = Arm(True)
    arm.delay = 3600.0
    arm.run_program(HEADER + goal())
    arm.run(10.0, until_over=True)
    blocks_of(arm)
    assert not arm.brakes


def test_the_controllers_own_end_of_a_goal_is_told():
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.5)
    arm.controller.deactivate()
    arm.run(2.0, until_over=True)
    with pytest.raises(MotionStopped, match="another client's goal replaced it, or the controller was deactivated"):
        blocks_of(arm)
    assert not arm.brakes or arm.cancels


@pytest.mark.parametrize("at", [1.5, 4.1, 4.45])
def test_a_goal_that_somebody_cancels_is_told(at):
    """Near its end the arm stands where it would have stood."""
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=0.3, seconds=4.0, cycles=2))
    arm.run(at)
    arm.controller.cancel()
    arm.run(2.0, until_over=True)
    with pytest.raises(MotionStopped, match="somebody cancelled it"):
        blocks_of(arm)
    assert len(arm.sent) == 1
    assert not arm.speed.any()


def test_a_goal_that_somebody_cancels_is_told_where_the_guard_sees_it_first():
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=0.3, seconds=4.0))
    arm.run(1.5)
    arm.motion.brake()
    arm.controller.cancel()
    arm.run(2.0, until_over=True)
    with pytest.raises(MotionStopped, match="somebody cancelled it"):
        blocks_of(arm)


def test_an_arm_whose_goal_another_client_replaced_is_braked():
    """The controller does not hold it: it moves on, to where the other one wants it."""
    arm = Arm(True)
    arm.run_program(HEADER + goal(way=0.3, seconds=4.0, cycles=2))
    arm.run(1.5)
    there = arm._message(0.0, [(3.0, np.full(2, -1.0), np.zeros(2))])
    assert arm.controller.take_goal(Goal(there, lambda *end: None), arm.now) == ""
    arm.run(2.0, until_over=True)
    with pytest.raises(MotionStopped, match="another client's goal replaced it"):
        blocks_of(arm)
    assert (len(arm.sent), len(arm.brakes)) == (1, 1)
    assert arm.now - arm.brakes[0] < 0.8
    assert not arm.speed.any()


def test_an_arm_that_is_off_its_trajectory_while_its_goal_is_not_answered_may_come_to_run_it():
    arm = Arm(True)
    arm.answers_nothing = True
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(2.0, until_over=True)
    with pytest.raises(DriverError, match=r"did not answer a goal within 0\.\d s"):
        blocks_of(arm)
    assert (len(arm.sent), len(arm.brakes), arm.cancels) == (1, 1, 1)


def test_a_goal_that_nobody_answers_is_braked_and_cancelled_and_not_sent_again():
    arm = Arm(True)
    arm.answers_nothing = True
    arm.run_program(HEADER + goal(way=0.02, seconds=15.0))
    arm.run(2.5)
    assert (len(arm.sent), len(arm.brakes), arm.cancels) == (1, 1, 1)
    arm.run(1.0, until_over=True)
    with pytest.raises(DriverError, match=r"did not answer a goal within 2\.0 s"):
        blocks_of(arm)


def test_a_scaled_trajectory_is_noticed():
    arm = Arm(True)
    arm.run_program(HEADER + goal(seconds=8.0))
    arm.run(1.5, states=True)
    arm.controller.scaling = 0.97
    arm.run(1.0, states=True, until_over=True)
    with pytest.raises(MotionStopped, match="at 97 % of its speed"):
        blocks_of(arm)


def test_a_scaled_trajectory_without_set_points_is_found_off_its_plan():
    arm = Arm(False)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.0)
    arm.controller.scaling = 0.5
    arm.run(3.0, until_over=True)
    with pytest.raises(MotionStopped, match="was the speed turned down"):
        blocks_of(arm)


@BOTH
def test_no_goal_is_sent_while_samples_wait_to_be_read(by_goal):
    arm = Arm(by_goal)
    arm.run_program(HEADER + goal(cycles=50))
    arm.run(30.0, until_over=True, reading=False)
    assert len(arm.sent) < 4
    with pytest.raises(DriverError, match="wait to be read, so the next cycle was not sent"):
        blocks_of(arm)
    assert not arm.speed.any()


@BOTH
def test_an_arm_elsewhere_is_sent_nothing(by_goal):
    arm = Arm(by_goal, (0.1, 0.0))
    with pytest.raises(RefusedError, match=r"a is off by 0\.100 rad"):
        arm.run_program(HEADER + goal())
    assert not arm.sent


def test_a_rest_between_goals_is_kept():
    arm = Arm(True)
    motion = arm.run_program(HEADER + goal() + '{"rest": 1.5}\n' + goal())
    arm.run(20.0, until_over=True)
    assert motion.over
    (first, points), (second, _) = arm.sent
    assert second - (first + points[-1][0]) > 1.5


def test_a_servo_that_lags_is_no_fault():
    arm = Arm(False, lag=0.04)
    arm.run_program(HEADER + goal(way=1.0, seconds=3.0))
    arm.run(20.0, until_over=True)
    blocks_of(arm)
    assert not arm.brakes


@pytest.mark.parametrize("seed", range(5))
def test_the_course_is_what_the_controller_commands(seed):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.2, 1.0, 6))
    rows = rng.normal(size=(6, 3, 2))
    rows[-1, 1:] = 0.0
    start = rng.normal(size=2)
    course = Course(50.0, start, JointSpline(times, *rows.transpose(1, 0, 2)))
    points = tuple(TrajectoryPoint.of(t, *row) for t, row in zip(times, rows, strict=True))
    sampled = SampledTrajectory(TrajectoryMessage(JOINTS, 50.0, points), JOINTS, 50.0, (start, np.zeros(2)))
    for t in 50.0 + np.linspace(0.0, times[-1] + 0.5, 200):
        for one, other in zip(course.at(t), sampled.at(t), strict=True):
            assert np.allclose(one, other, atol=1e-9)
    assert np.array_equal(course.at(49.0)[0], start)


def test_a_brake_takes_longer_where_the_joints_are_weak_but_never_for_ever():
    position, velocity = np.zeros(2), np.array([1.0, -2.0])
    for strength, seconds in (((100.0, 100.0), BRAKE), ((100.0, 4.0), 0.5), ((0.1, 4.0), 1.0), ((0.0, 0.0), 1.0)):
        took, end = brake_point(position, velocity, np.array(strength))
        assert took == pytest.approx(seconds)
        assert np.allclose(end, velocity * took / 2)


def test_numbers_follow_the_stamps():
    rng = np.random.default_rng(0)
    counter = Counter(PERIOD)
    stamps = BEGIN + np.arange(60_000) * PERIOD * (1 + 1e-4) + rng.uniform(-0.4, 0.4, 60_000) * PERIOD
    assert [counter.number(stamp) for stamp in stamps] == list(range(60_000))
    assert counter.number(stamps[-1]) is None
    assert counter.number(stamps[-1] + 5 * PERIOD) in (60_003, 60_004, 60_005)
    assert counter.time(10) - counter.time(9) == pytest.approx(PERIOD, rel=1e-3)


def test_a_second_source_that_is_near_the_first_stops_the_arm():
    """As a relay of the same joints, or a simulation of them: by no jump, but by twice as many samples."""
    arm = Arm(False)
    arm.run_program(HEADER + goal(way=1.0, seconds=4.0))
    arm.run(1.0)
    take = arm.motion.sample

    def both(sample, now):
        take(sample, now)
        near = JointSample(sample.stamp + 0.6 * PERIOD, sample.position + 0.02, sample.velocity, sample.effort)
        arm.believed.take(near, now)
        take(near, now)

    arm.motion.sample = both
    arm.run(0.2)
    assert arm.brakes, "it was not told to brake"
    assert arm.brakes[0] <= BEGIN + 1.2
    arm.motion.sample = take
    arm.run(2.0, until_over=True)
    with pytest.raises(MotionStopped, match="does a second node publish"):
        list(arm.motion.blocks())


@pytest.mark.parametrize("rate", [0.75, 1.0, 1.3])
def test_one_source_is_no_second_one(rate):
    """Whatever its true rate, with jitter, samples that come twice, and pairs that come in the other order."""
    rng, counter = np.random.default_rng(0), Counter(PERIOD)
    stamps = BEGIN + (np.arange(20_000) + rng.uniform(-0.3, 0.3, 20_000)) * PERIOD / rate
    for k in range(0, 20_000, 50):
        stamps[[k, k + 1]] = stamps[[k + 1, k]]
    for stamp in np.repeat(stamps, 2):
        counter.number(stamp)
        assert not counter.crowded


def test_speed_without_a_velocity_comes_from_positions():
    speed, nothing = Speed(), np.full(1, np.nan)
    for k in range(50):
        found = speed.of(JointSample(BEGIN + k * PERIOD, np.array([0.7 * k * PERIOD]), nothing, nothing))
    assert found[0] == pytest.approx(0.7, rel=1e-4)


def test_the_second_process_brakes_where_the_agent_is_gone_or_silent():
    orders = Orders(0.0)
    assert not orders.gone(100.0)
    orders.take(b"arm 1.5 2", 1.0)
    orders.take(b".0\n", 1.0)
    assert orders.strength.tolist() == [1.5, 2.0]
    assert not orders.gone(1.0 + 0.9 * SILENCE)
    orders.take(b"\n\n", 2.0)
    assert not orders.gone(2.9)
    assert orders.gone(2.1 + SILENCE)
    orders.take(b"\n", 4.0)
    assert not orders.gone(4.1)
    orders.take(b"", 4.1)
    assert orders.gone(4.1)
    calm = Orders(0.0)
    calm.take(b"arm 1\ndisarm\n", 0.0)
    calm.take(b"", 0.0)
    assert not calm.gone(100.0)


@pytest.mark.parametrize("text", [goal(seconds=LONGEST + 1), goal(tolerance=0), goal(tolerance=0.5), goal(lead=0.05)])
def test_a_program_that_could_not_be_left_alone_is_refused(text):
    """The dialect reads by the same rules: `tests/motion/test_joint_trajectory.py` has them all."""
    with pytest.raises(RefusedError, match=":2: not a line of a program"):
        GoalProgram.of(HEADER + text)


def test_a_way_from_far_away_is_several_goals_each_from_rest_to_rest():
    arm = Arm(True, (1.5, -0.3))
    motion = arm.run_program(HEADER + TO.replace("[1, 1]", "[0.1, 1]") + goal())
    arm.run(40.0, until_over=True)
    assert motion.over
    assert not arm.brakes
    first, second, cycle = (points for _, points in arm.sent)
    assert first[-1][0] == pytest.approx(second[-1][0])
    assert all(points[-1][0] <= LONGEST + 0.2 and not np.any(points[-1][2]) for points in (first, second))
    assert np.allclose(first[-1][1], (0.75, -0.15))
    assert np.array_equal(second[-1][1], (0.0, 0.0))
    assert len(motion.cycle_starts) == 1
    assert motion.cycle_starts[0] == arm.sent[2][0] + cycle[0][0]


def test_a_move_of_many_goals_is_refused():
    program = GoalProgram.of(HEADER + TO)
    with pytest.raises(RefusedError, match="10 goals of 20 s are allowed"):
        program.steps[0].from_(np.array([300.0, 0.0]))
