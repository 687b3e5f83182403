"""One motion: goals in turn, each watched sample by sample against what was sent, and the brake."""

from __future__ import annotations

import functools
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from drivers.errors import DriverError, LinkStopped, MotionStopped, RefusedError
from drivers.joint_trajectory import GoalProgram, Step
from drivers.protocol import SampleBlock
from drivers.transports.base.samples import SampleStream
from drivers.transports.ros2.following import BRAKE, CANCEL_AFTER, Counter, Course, brake_point
from drivers.transports.ros2.link import CANCELLED, RosLink
from drivers.wire.reasons import EndReason
from drivers.wire.ros2 import JOINT_STATES, JointSample, SetPoint, columns

#: Time [s] from the controller's now to the stamp of a trajectory: with the lead to its first point it may be half a
#: second on its way before the controller would jump.
AHEAD = 0.3
#: Share of its path tolerance that a joint may be off before the arm is braked; the controller stops it at the whole.
SHARE = 0.8
#: How old a sample may be beyond the least age [s], in addition to the watchdog.
LATE = 0.2
#: The arm stands so near to the first point of a goal [rad, m].
START = 0.02
#: Samples waiting to be read [s] beyond which no further goal is sent: nobody watches.
UNREAD = 2.0
_STALL = 0.5  # s in which nothing was watched here, and the second process may have braked
_STEP = 1.0  # s between two samples that no clock makes which is left alone
_OLD = 0.1  # s: what a sample says of an arm that moves on
_TWICE = 0.2  # s: requests to stop that are nearer than this have one cause
_ANSWER, _GOAL_TIME, _SETTLES = 2.0, 1.0, 3.0  # s: of a goal's answer, and after its last point, there and here
_SPAN, _STILL = 0.1, 0.003  # s, and rad/s over it: an arm that stands
_LEFT = 0.003  # rad, m between a stationary arm and its trajectory
_BLOCK = 0.01  # s of samples that are handed out at once
_REPLACED = -1  # of a goal; the arm may move on
_CODES = {
    _REPLACED: "another client's goal replaced it, or the controller was deactivated",
    -4: "it left its path by more than the tolerance",
    -5: "it did not reach the end in time",
    CANCELLED: "somebody cancelled it",
}


class Ros2Motion(SampleStream):
    """Received data of one motion, and the goals that are left of it.

    Args:
        program: what is run.
        link: to the controller.
        by_goal: whether goals are sent, with tolerances and a result; trajectories by topic otherwise.
        torque: (n, n) that makes torque of effort, or None where effort is torque.
        recorded: whether effort is.
        limit: bytes that may wait for the consumer.
        on_over: comes once, when the arm rests or is lost from sight.
        clock: seconds of this computer, for what has to be answered or braked in time.
    """

    def __init__(
        self,
        program: GoalProgram,
        link: RosLink,
        period: float,
        by_goal: bool,
        torque: np.ndarray | None,
        recorded: bool,
        limit: int,
        on_over: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(limit)
        self._clock = clock
        self.strength, self._fastest = program.fastest_change, program.fastest
        self.goals_sent = 0
        self.cycle_starts: list[float] = []  # s, by the controller's clock
        self.oldest = 0.0  # s, of a sample beyond the least
        self.unmatched = 0  # samples without a set-point of their cycle
        self.counter = Counter(period)
        self._program, self._link, self._period = program, link, period
        self._by_goal, self._torque, self._recorded = by_goal, torque, recorded
        self._on_over = on_over
        self._steps = program.run()
        self._lock = threading.RLock()
        self._phase = "idle"
        self.course: Course | None = None
        self._limit_off = np.inf * np.ones(len(program.joints))
        self._since = 0.0  # stamp at which the phase began
        self._sent_at = 0.0  # of this computer's clock
        self._accepted: bool | None = None
        self._result: tuple[int, str] | None = None
        self._braked: float | None = None  # monotonic
        self._brake_due = self._brake_sent = self._doubtful = False
        self._rests_at: np.ndarray | None = None  # once it is braked
        self._polled = np.inf  # when time was looked at last, monotonic
        self._cancel_at = np.inf  # monotonic
        self._cancelled = False
        self._why: DriverError | None = None
        self._recent: deque[tuple[float, np.ndarray]] = deque()
        self._least = np.inf  # age of a sample
        self._batch: list[tuple[int, JointSample, SetPoint | None]] = []
        self._waiting: deque[tuple[int, JointSample]] = deque()  # for their set-points
        self._states = link.states

    def begin(self) -> None:
        """Send the first goal.

        Raises:
            RefusedError: it cannot be run from where the arm stands.
        """
        with self._lock:
            self._go_on(self._link.latest)

    @property
    def begun(self) -> bool:
        """Whether the controller has taken the first goal, as far as it says so."""
        return self._accepted is True or not self._by_goal or self.over

    def brake(self, why: DriverError | None = None) -> None:
        """Bring the arm to rest by one point; once more, and by cancelling, where somebody asks again without a reason.

        The thread of the link sends it at the end of its turn: the newest of the samples that wait says where the arm
        is. One from before a stall would send the arm back there.
        """
        with self._lock:
            self._why, now = self._why or why, self._clock()
            if self.over:
                return
            again = why is None and self._braked is not None and now - self._braked > _TWICE
            if self._braked is None or again:
                self._phase, self._since, self._brake_due = "braking", np.inf, True
            self._braked = self._braked or now
            if again:
                self._cancel_at = now

    def send_brake(self) -> float | None:
        """Send the point that brakes the arm from where it is now; how long that takes [s]. Never raises.

        Where even the newest sample is old, or two sources contradict each other, the arm is where its trajectory has
        it: the controller sees to that by its own tolerance. After a brake nothing says where it is: what runs is
        cancelled, and the point waits for a sample.
        """
        sample = self._link.latest
        # A set-point that jumps makes the arm faster for a moment than it has to be braked from.
        velocity = np.clip(self._link.velocity, -self._fastest, self._fastest)
        age = self._link.clock() - sample.stamp
        if age <= _OLD and not self._doubtful:
            state = sample.position + velocity * max(age, 0.0), velocity
        elif self.course is not None and not self._brake_sent:
            state = self.course.at(self.course.stamp - AHEAD + self._clock() - self._sent_at)
        else:  # it would be thrown back to where it was
            self._cancel()
            return None
        # An arm that obeys and is seen late would be set in motion again by a point from where it seems to be.
        if self._rests_at is not None and np.all(np.abs(self._rests_at - state[0]) <= BRAKE * self._fastest):
            state = self._rests_at, np.zeros_like(velocity)
        self._rests_at, self._brake_sent = brake_point(*state, self.strength)[1], True
        return self._link.brake(self.strength, *state)

    def finish(self, error: DriverError | None) -> None:
        """No more samples; `error` is raised once those that came are read."""
        was = self.over
        self._hand_out(flush=True)
        super().finish(self._why or error)
        if not was:
            self._phase = "over"
            self._on_over()

    # In the thread of the link

    def sample(self, sample: JointSample, now: float) -> None:
        """The next sample, and when it came [s, monotonic]."""
        if self.over or self._phase == "idle":
            return None
        if sample is not self._link.latest:  # another arm's, or none
            self._doubtful = True
            return self.brake(MotionStopped(self._link.doubt))
        step = sample.stamp - self._recent[-1][0] if self._recent else 0.0
        if abs(step) > _STEP:
            self._recent.clear()
            self.brake(LinkStopped(f"the clock of {JOINT_STATES} was set by {step:.3g} s, so the arm was stopped"))
        number = self.counter.number(sample.stamp)
        if self.counter.crowded:
            self._doubtful = True
            self.brake(MotionStopped(f"twice as many samples come as before: {self._link.second_source}"))
        if number is not None:
            self._keep(number, sample)
        elif self._braked is None:
            return None
        with self._lock:
            return self._watch(sample, now)

    def state(self, state: SetPoint) -> None:
        """The next set-point."""
        if self.over or self._phase == "idle":
            return
        if not abs(state.scaling - 1.0) <= 1e-6 and self._phase == "moving":
            self.brake(
                MotionStopped(
                    f"the controller runs the trajectory at {100 * state.scaling:.0f} % of its speed; the arm was "
                    "stopped: set the speed to 100 % there, then run the command again"
                )
            )
        self._match(state.stamp)

    def poll(self) -> None:
        """Look at what depends on time alone."""
        if self.over:
            return
        with self._lock:
            now = self._clock()
            if self._unanswered and now - self._sent_at > _ANSWER:
                self._give_up_goal()
            if now - self._polled > _STALL:
                self._brake_sent = True  # by the second process, for all that is known here
            self._polled = now
            if self._brake_due and (seconds := self.send_brake()) is not None:
                self._brake_due, self._since = False, self._link.latest.stamp + seconds
                self._cancel_at = min(self._cancel_at, now + seconds + CANCEL_AFTER)
            if now >= self._cancel_at:
                self._cancel()
                if self.counter.crowded:  # no samples will show that it rests
                    self._come_to_rest()

    @property
    def _unanswered(self) -> bool:
        return self._by_goal and self._accepted is None and self._phase == "moving"

    def _give_up_goal(self) -> None:
        """Brake and cancel what may run all the same, or come to run."""
        self.brake(
            LinkStopped(
                f"{self._link.target.action} did not answer a goal within {self._clock() - self._sent_at:.1f} s; "
                "whatever runs was braked and cancelled: look at the arm and the controller"
            )
        )
        self._cancel_at = self._clock()

    def _watch(self, sample: JointSample, now: float) -> None:
        self._recent.append((sample.stamp, sample.position))
        while sample.stamp - self._recent[0][0] > _SPAN:
            self._recent.popleft()
        age = now - sample.stamp
        self._least = min(self._least, age)
        self.oldest = max(self.oldest, age - self._least)
        if self._phase in ("moving", "settling") and not age - self._least <= self._link.watchdog + LATE:
            self.brake(
                LinkStopped(
                    f"samples came {age - self._least:.2f} s late, so nobody watched the arm, and it was stopped; has "
                    "this computer or the network too much else to do?"
                )
            )
        if self._phase in ("moving", "settling") and self._result is not None and self._result[0] != 0:
            return self._goal_ended(*self._result)
        match self._phase:
            case "moving":
                self._follow(sample)
            case "settling":
                self._settle(sample)
            case "resting" if sample.stamp >= self._since:
                self._go_on(sample)
            case "braking" if sample.stamp >= self._since and self._stands() and self._has_left(sample):
                self._cancel()
                self._come_to_rest()

    def _follow(self, sample: JointSample) -> None:
        course = self.course
        assert course is not None
        off = np.abs(sample.position - course.position(sample.stamp))
        if not np.all(off <= self._limit_off) and self._unanswered:
            self._give_up_goal()
        elif not np.all(off <= self._limit_off):
            joint = int(np.argmax(np.where(np.isfinite(off), off - self._limit_off, np.inf)))
            self.brake(
                MotionStopped(
                    f"{self._program.joints[joint]} was {off[joint]:.3f} rad off its trajectory, "
                    f"{self._limit_off[joint]:.3f} are allowed; the arm was stopped: was the speed turned down, does "
                    "something hold it, or does something else command it?"
                )
            )
        elif sample.stamp >= course.end:
            self._phase, self._since = "settling", sample.stamp

    def _settle(self, sample: JointSample) -> None:
        """Wait for the result, or without one for an arm that stands at the end."""
        course = self.course
        assert course is not None
        arrived = not self._by_goal and self._stands() and np.all(np.abs(sample.position - course.last) <= START)
        if arrived or self._result is not None:
            return self._go_on(sample)
        if sample.stamp - course.end > _SETTLES:
            self.brake(
                LinkStopped(
                    f"{_SETTLES:g} s after the end of a trajectory "
                    + ("the controller says nothing of it" if self._by_goal else "the arm does not stand where it ends")
                    + "; look at the arm and the controller"
                )
            )

    def _goal_ended(self, code: int, text: str) -> None:
        """The controller has ended the goal by itself, and holds, unless something else moves the arm now."""
        why = _ended_by(code, text)
        if code == _REPLACED:
            return self.brake(why)
        self._why = self._why or why
        self._phase, self._braked = "braking", self._clock()
        self._cancel_at = self._braked + CANCEL_AFTER

    def _go_on(self, sample: JointSample) -> None:
        """Send the next goal, where there is one and somebody watches."""
        if self.stopping:
            return self._come_to_rest()
        if (unread := self.unread * self._period) > UNREAD:
            return self._come_to_rest(
                LinkStopped(
                    f"{unread:.0f} s of samples wait to be read, so the next cycle was not sent: has this computer too "
                    "much else to do?"
                )
            )
        step = next(self._steps, None)
        if step is None:
            return self._come_to_rest()
        if step.points is None and step.to is None:
            self._phase, self._since = "resting", sample.stamp + step.rest
            return None
        self._send(step, sample)

    def _send(self, step: Step, sample: JointSample) -> None:
        points = step.from_(sample.position)
        if step.points is not None and not np.all(np.abs(points.q[0] - sample.position) <= START):
            off = np.abs(points.q[0] - sample.position)
            error = RefusedError(
                f"the arm does not stand where the next trajectory begins: {self._program.joints[int(np.argmax(off))]} "
                f"is off by {off.max():.3f} rad, {START:g} are allowed"
            )
            if self.goals_sent == 0:
                raise error
            return self._come_to_rest(error)
        tolerance = np.full(len(self._program.joints), 0.1) if step.tolerance is None else step.tolerance
        self._limit_off = SHARE * tolerance
        if step.to is not None and not np.array_equal(points.q[-1], step.to[0]):
            self._steps = itertools.chain([step], self._steps)  # a part of the way is left
        rows = list(zip(points.t.tolist(), points.q, points.qd, points.qdd, strict=True))
        self._phase, self._accepted, self._result, self._sent_at = "moving", None, None, self._clock()
        self.goals_sent += 1
        number = self.goals_sent
        if self._by_goal:
            answered, ended = functools.partial(self._answered, number), functools.partial(self._ended, number)
            stamp = self._link.send_goal(AHEAD, rows, tolerance, _GOAL_TIME, answered, ended)
        else:
            stamp = self._link.send(AHEAD, rows)
        self.course = Course(stamp, sample.position, points)
        if step.points is not None:
            self.cycle_starts.append(stamp + float(points.t[0]))

    def _answered(self, number: int, accepted: bool) -> None:
        with self._lock:
            if number != self.goals_sent or self.over:
                return
            self._accepted = accepted
            if not accepted:
                self._come_to_rest(RefusedError("the controller refused a trajectory; its own log says why"))

    def _ended(self, number: int, code: int, text: str) -> None:
        with self._lock:
            if number != self.goals_sent or self._cancelled:
                return
            if self._braked is None:
                self._result = code, text
            elif code:  # by the controller itself, and the guard saw what followed first
                self._why = self._why or _ended_by(code, text)

    def _stands(self) -> bool:
        times = [stamp for stamp, _ in self._recent]
        if len(times) < 3 or times[-1] - times[0] < 0.8 * _SPAN:
            return False
        travelled = np.ptp([position for _, position in self._recent], axis=0)
        return bool(np.all(travelled <= _STILL * _SPAN * 2))

    def _has_left(self, sample: JointSample) -> bool:
        """Whether the arm is where its trajectory would not have it: one that has not set out yet stands as well."""
        course = self.course
        if course is None or sample.stamp >= course.end:
            return True
        return not np.all(np.abs(course.position(sample.stamp) - sample.position) <= _LEFT)

    def _cancel(self) -> None:
        if not self._cancelled:
            self._cancelled = True
            self._link.cancel()

    def _come_to_rest(self, why: DriverError | None = None) -> None:
        self._hand_out(flush=True)
        self._why = why or self._why
        if self._why is not None:
            self.finish(self._why)
        else:
            count = self.sequencer.expected
            self.ended(EndReason.STOPPED if self.stopping else EndReason.DONE, count, "")

    def _keep(self, number: int, sample: JointSample) -> None:
        if self._states:
            self._waiting.append((number, sample))
            self._match(self._states[-1].stamp)
        else:
            self._batch.append((number, sample, None))
        self._hand_out()

    def _match(self, newest: float) -> None:
        """Join samples with the nearest set-points, once those are there; earlier ones are dropped."""
        states = self._states
        while self._waiting:
            number, sample = self._waiting[0]
            if newest < sample.stamp - self._period / 2 and len(self._waiting) < 50:
                return
            self._waiting.popleft()
            while len(states) > 1 and abs(states[1].stamp - sample.stamp) <= abs(states[0].stamp - sample.stamp):
                states.popleft()
            nearest = states[0]
            self.unmatched += abs(nearest.stamp - sample.stamp) > self._period
            self._batch.append((number, sample, nearest))

    def _hand_out(self, flush: bool = False) -> None:
        """Deliver runs of samples without gaps."""
        if flush and self._waiting and self._states:
            self._match(np.inf)
        batch = self._batch
        if not batch or not (flush or len(batch) * self._period >= _BLOCK):
            return
        self._batch = []
        numbers = np.array([number for number, *_ in batch])
        cuts = np.flatnonzero(np.diff(numbers) > 1) + 1
        for first, last in itertools.pairwise([0, *cuts.tolist(), len(batch)]):
            part = batch[first:last]
            self.lost(part[0][0])
            self.take(self._block(part))

    def _block(self, part: list[tuple[int, JointSample, SetPoint | None]]) -> SampleBlock:
        position, velocity, effort = columns([sample for _, sample, _ in part], "position", "velocity", "effort")
        states = [state for *_, state in part if state is not None]
        known = len(states) == len(part)
        reference, rate = columns(states, "position", "velocity") if known else (None, None)
        torque = effort if self._torque is None else effort @ self._torque.T
        return SampleBlock(
            np.array([number for number, *_ in part]),
            np.array([self.counter.time(number) for number, *_ in part]),
            position,
            velocity if np.isfinite(velocity).all() else None,
            torque if self._recorded else np.zeros_like(position),
            reference,
            rate if rate is None or np.isfinite(rate).all() else None,
            time.time(),
            None if self._torque is None else effort,
        )


def _ended_by(code: int, text: str) -> MotionStopped:
    what = _CODES.get(code, f"error {code}") + (f" ({text})" if text else "")
    return MotionStopped(
        f"the controller ended the goal: {what}; the arm was stopped: look for the cause, then run the command again"
    )
