"""A stop that is followed until the arm is seen to stand: sent, sent again, and at last by closing the link.

A controller's word that it stopped the arm is no proof. Where the arm does not brake, a second stop is sent and then
the link is closed: the controller's own watchdog stops the arm. A second stop does no harm; no start is repeated.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING

import numpy as np

from agent.safety.freshness import EXCUSED, Freshness
from drivers.errors import DriverError
from drivers.protocol import Driver, SampleBlock

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Duration over which a speed is measured [s].
SPEED_WINDOW = 0.1
#: No joint of an arm that stands is faster than this part of its limit.
STATIONARY_SHARE = 0.01
#: An arm that brakes has less than this part of its speed left when that is asked, and has not regained that part of
#: it: one that disobeys slows down too, where its path has a corner.
BRAKING, REGAINED = 0.8, 0.25
#: Time after a stop [s] at which an arm that does not brake gets a second one, and at which the link is closed. An arm
#: that takes 0.1 s to react and 1.2 s to stop has lost a fifth of its speed by then, seen 0.2 s late.
RESEND_AFTER, CLOSE_LINK_AFTER = 0.3, 0.6
#: Samples and states that are older [s] do not show what the arm does now.
MAX_SAMPLE_AGE = 0.3
#: Longest wait [s] for the answer to a stop.
STOP_ANSWER_TIMEOUT = 1.0
#: Time after a stop [s] by which the arm has to stand, or the link is closed.
STANDSTILL_DEADLINE = 4.0
#: Duration of standstill [s] after which a motion is over even if the controller never reports its end.
MISSING_END_AFTER = 2.0
_LOOKS = 20  # at the state, once the samples have ended


class Braking:
    """Follows the speed of an arm; positions come from its samples or, where none come, from its state.

    Args:
        max_velocity: (n,) of its joints [rad/s].
        regained: as `REGAINED`; positions that are renewed now and then only need more.
    """

    def __init__(self, max_velocity: np.ndarray, regained: float = REGAINED) -> None:
        self._limit = max_velocity
        self._regained = regained
        self._times = np.empty(0)
        self._positions = np.empty((0, len(max_velocity)))
        self._still_since: float | None = None
        #: Speed of the fastest joint, as a part of its limit; None if unknown.
        self.speed: float | None = None
        #: The same when the stop was asked for, the least since then, the most, and the least since that.
        self.before: float | None = None
        self._least, self._most, self._least_since_most = np.inf, 0.0, np.inf

    def take(self, times: np.ndarray, positions: np.ndarray) -> None:
        """Measured positions (K, n) at times (K,) [s] of one clock."""
        if len(self._times) and not 0.0 <= times[0] - self._times[-1] <= 10 * SPEED_WINDOW:
            self.forget()
        self._times = np.concatenate([self._times, times])
        self._positions = np.concatenate([self._positions, positions])
        first = max(0, int(np.searchsorted(self._times, self._times[-1] - SPEED_WINDOW, side="right")) - 1)
        self._times, self._positions = self._times[first:], self._positions[first:]
        passed = float(self._times[-1] - self._times[0])
        if passed >= SPEED_WINDOW / 2:
            travelled = np.ptp(self._positions, axis=0)
            self.speed = float(np.max(travelled / self._limit)) / passed
            if self.before is not None:
                self._least, self._most = min(self._least, self.speed), max(self._most, self.speed)
                self._least_since_most = min(self._least_since_most, self.speed) if self.speed < self._most else np.inf
            if not self.speed <= STATIONARY_SHARE:
                self._still_since = None
            elif self._still_since is None:
                self._still_since = float(self._times[0])

    def forget(self) -> None:
        """Positions of another source, or another clock, follow."""
        self._times, self._positions = self._times[:0], self._positions[:0]
        self._still_since = self.speed = None

    @property
    def is_stationary(self) -> bool:
        """Whether the arm stood when it was seen last."""
        return self._still_since is not None

    @property
    def stationary_time(self) -> float:
        """Time [s] for which the arm has rested."""
        return 0.0 if self._still_since is None else float(self._times[-1]) - self._still_since

    @property
    def is_braking(self) -> bool:
        """Whether the arm is clearly slower than when the stop was asked for, and does not speed up again."""
        if self.speed is None or self.before is None:
            return False
        return self.speed < min(BRAKING * self.before, self._least + self._regained * self.before)

    @property
    def seems_braking(self) -> bool:
        """Whether it is clearly slower than it was seen after that: one that is seen late slows down later."""
        if self.speed is None:
            return False
        return self.speed < min(BRAKING * self._most, self._least_since_most + self._regained * self._most)


class Stopping:
    """The stop of one motion.

    Args:
        driver: the motion's.
        robot: who moves.
        address: for messages.
        freshness: of the samples.
        clock: our time [s].
        warn: tells what a person should know at once.
    """

    def __init__(
        self,
        driver: Driver,
        robot: RobotDescription,
        address: str,
        freshness: Freshness,
        clock: Callable[[], float],
        warn: Callable[[str], None],
    ) -> None:
        self._driver = driver
        self._dof = robot.dof
        self._address = address
        self._freshness = freshness
        self._clock = clock
        self._warn = warn
        self._from_samples, self._from_status = Braking(robot.max_velocity), Braking(robot.max_velocity, np.inf)
        self._lock = threading.RLock()
        self._sent: list[threading.Thread] = []
        self._look: Future[None] = Future()
        self._look.set_result(None)
        self._state_at = -np.inf  # when the state that was read last was asked for
        self._excused = 0.0  # s without observation
        self._ended = False
        #: Whether there is nothing left to follow.
        self.over = False
        #: When the stop was asked for, by our clock [s]; None before.
        self.since: float | None = None
        #: What was seen of the arm where it is not known to stand; the link is closed then.
        self.failure = ""
        #: Whether the arm was seen to move on.
        self.disobeyed = False

    def request(self) -> None:
        """Ask for a stop, once; returns at once."""
        with self._lock:
            if self.since is None:
                self._from_samples.before = self._from_status.before = self._from_samples.speed
                self.since = self._clock()
                self._send()

    def take(self, block: SampleBlock) -> None:
        """Samples of the motion, before the stop and after it."""
        with self._lock:
            self._from_samples.take(block.time, block.position)

    def poll(self, stalled: float = 0.0) -> None:
        """Look at the arm, some times a second from the request on; this process stood still for `stalled` [s]."""
        with self._lock:  # or the stop may end between the look and what follows it
            if self.since is None or self.over or self.failure:
                return
            self._excused = min(self._excused + stalled, EXCUSED)
            passed = self._clock() - self.since - self._excused
            if not self._samples_are_current:
                self._look_at_state()
            if self._braking.is_stationary:
                self._end_unreported()
            elif len(self._sent) == 1 and not (passed < RESEND_AFTER or self._braking.is_braking):
                self._send()
            elif not passed < (STANDSTILL_DEADLINE if self._braking.is_braking else CLOSE_LINK_AFTER):
                self._declare_failure(f"{passed:.1f} s after the stop")

    def finish(self, failed: bool) -> None:
        """The samples have ended; `failed`: with the link. The state tells whether the arm stands where they do not."""
        self.over = bool(self.failure) or (self._samples_are_current and self._from_samples.is_stationary)
        self._ended = True
        for _ in range(0 if self.over or failed else _LOOKS):
            with self._lock:
                self._look_at_state()
            if self._braking.is_stationary:
                break
            threading.Event().wait(SPEED_WINDOW / 2)
        with self._lock:
            if not (self.over or failed or self._braking.is_stationary or self.failure):
                self._declare_failure("after the controller reported the end of the motion")
            self.over = True
        self.wait(STOP_ANSWER_TIMEOUT)

    def wait(self, limit: float) -> None:
        """Wait until the stop was carried out, `limit` seconds at most."""
        for sent in self._sent:
            sent.join(limit)

    @property
    def _braking(self) -> Braking:
        return self._from_samples if self._samples_are_current else self._from_status

    @property
    def _samples_are_current(self) -> bool:
        """Whether samples tell what the arm does now, and not what it did before the stop could act."""
        return not self._ended and self._freshness.age <= MAX_SAMPLE_AGE

    def _end_unreported(self) -> None:
        if not self._braking.stationary_time < MISSING_END_AFTER and (
            self._samples_are_current or not self._freshness.silent < CLOSE_LINK_AFTER
        ):
            self.failure = (
                "the arm stands, but the controller does not report the end of the motion; the link was closed"
            )
            self._close()

    def _send(self) -> None:
        number = len(self._sent) + 1
        self._sent.append(threading.Thread(target=self._carry_out, args=(number,), name="stop", daemon=True))
        self._sent[-1].start()

    def _carry_out(self, number: int) -> None:
        try:
            self._driver.stop()
        except Exception as error:  # any error: the other way to stop remains
            with self._lock:
                if number == len(self._sent) and not (self.failure or self.over):
                    self._give_up(
                        f"the stop was not confirmed ({error}); the link was closed, which stops an arm whose "
                        "controller has a watchdog. Go and look at it"
                    )

    def _declare_failure(self, when: str) -> None:
        speed, age = self._braking.speed, self._freshness.age
        # Where samples come late, the state may be as old: it shows rest, but accuses nobody.
        late = not (self._samples_are_current or self._ended or self._freshness.silent > MAX_SAMPLE_AGE)
        known = self._samples_are_current or (self._clock() - self._state_at <= MAX_SAMPLE_AGE and not late)
        if speed is None or not known:
            newest = f"the newest sample is {age:.1f} s old" if np.isfinite(age) else "no sample came"
            self._give_up(
                f"{when} nothing shows what the arm does: {newest}. The link was closed, which stops an arm whose "
                "controller has a watchdog. Go and look"
            )
            return
        self.disobeyed = True
        lag = " It slows down, so what is seen of it may be late." if self._braking.seems_braking else ""
        self._give_up(
            f"the arm does not obey: {when} it still moves, at {100 * speed:.0f} % of a joint's limit.{lag} The "
            "stop was sent again and the link closed, which stops an arm whose controller has a watchdog. PRESS THE "
            "EMERGENCY STOP NOW"
        )

    def _give_up(self, failure: str) -> None:
        self.failure = failure
        self._warn(f"{self._address}: {failure}")
        self._close()

    def _close(self) -> None:
        threading.Thread(target=self._driver.close, name="close link", daemon=True).start()

    def _look_at_state(self) -> None:
        """Ask for the state, one question at a time."""
        if self._look.done():
            self._look = run_in_thread("state", self._take_state, self._clock())

    def _take_state(self, asked: float) -> None:
        """What the state says, which was asked for at a time [s] of our clock: it may be as old as that."""
        try:
            position = np.asarray(self._driver.status().position, dtype=float).reshape(self._dof)
        except (DriverError, ValueError):  # no answer, or one of another arm
            return
        with self._lock:
            if np.isfinite(position).all():
                self._state_at = asked
                self._from_status.take(np.array([self._state_at]), position[None])


def run_in_thread(name: str, task: Callable[[float], None], time: float) -> Future[None]:
    """Run a task in a daemon thread of that name. Where a signal interrupts the start of an executor's thread, Python
    waits for that thread at its end, for ever."""
    done: Future[None] = Future()

    def run() -> None:
        try:
            task(time)
        except BaseException as error:
            done.set_exception(error)
        else:
            done.set_result(None)

    threading.Thread(target=run, name=name, daemon=True).start()
    return done
