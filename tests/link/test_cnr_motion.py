"""The driver for CNR's programs: its samples, its clocks and one motion, by their laws."""

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from drivers.errors import DriverError, MotionStopped
from drivers.transports.cnr.joiner import Joiner
from drivers.transports.cnr.motion import ClockMatch, stop_reason
from drivers.wire import cnr
from tests.link.cnr_script import READY, feedback, motion

# --- joining the topics

CHANNELS = ("a", "b", "c")
PERIOD = 2000.0


def messages(count, jitter=0, late=0):
    """(channel, time, values) of a number of samples; the last channel is stamped `late` µs later."""
    rng = np.random.default_rng(count + jitter)
    made = []
    for k in range(count):
        stamp = 1_000_000 + 2000 * k + int(rng.integers(-jitter, jitter + 1))
        made += [(c, stamp + (late if c == 2 else 0), (float(k),) * 10) for c in range(3)]
    return made


def joined(joiner, given):
    for message in given:
        joiner.add(*message)
    rows = joiner.take()
    return rows.times, rows.values


@settings(deadline=None, max_examples=50)
@given(
    count=st.integers(2, 40),
    jitter=st.integers(0, 200),
    late=st.integers(-600, 600),
    seed=st.integers(0, 1000),
    reach=st.integers(1, 20),
)
def test_joins_every_sample_once_in_any_order(count, jitter, late, seed, reach):
    given = messages(count, jitter, late)
    rng = np.random.default_rng(seed)
    order = np.argsort(np.arange(len(given)) + rng.uniform(0, reach, len(given)), kind="stable")
    joiner = Joiner(CHANNELS, PERIOD)
    first = [m for m in given[:3]]  # nothing is known of the time before the first whole sample
    rest = [given[k] for k in order if k >= 3]
    times, values = joined(joiner, [*first, *rest])
    expected = [stamp for channel, stamp, _ in given if channel == 0]
    assert times.tolist() == expected
    assert (values[:, :, 0] == np.arange(count)[:, None]).all()
    assert (joiner.counts.late, joiner.counts.duplicate, joiner.counts.missing) == (0, 0, {})


@settings(deadline=None, max_examples=20)
@given(count=st.integers(300, 400), lost=st.sets(st.integers(3, 500), max_size=20))
def test_a_lost_message_loses_one_sample(count, lost):
    given = messages(count)
    joiner = Joiner(CHANNELS, PERIOD)
    times, _ = joined(joiner, [message for k, message in enumerate(given) if k not in lost])
    broken = {k // 3 for k in lost}
    expected = [1_000_000 + 2000 * k for k in range(count) if k not in broken]
    # The last samples may still wait for what comes in the next quarter of a second.
    assert times.tolist() == expected[: len(times)]
    assert len(times) >= len(expected) - 130
    known = {k for k in lost if 1_000_000 + 2000 * (k // 3) < times[-1]}
    absent = {k // 3 for k in known if {3 * (k // 3) + c for c in range(3)} <= lost}
    missing = sum(joiner.counts.missing.values())
    assert missing == len([k for k in known if k // 3 not in absent])


def test_repeated_and_late_messages_are_counted():
    joiner = Joiner(CHANNELS, PERIOD)
    given = messages(4)
    joined(joiner, [given[0], given[0], *given[1:6], given[1]])
    assert (joiner.counts.duplicate, joiner.counts.late) == (1, 1)
    joiner.forget_counts()
    assert (joiner.counts.duplicate, joiner.counts.late) == (0, 0)


def test_memory_stays_bounded_if_a_topic_is_silent():
    joiner = Joiner(CHANNELS, PERIOD)
    for k in range(30_000):
        joiner.add(0, 2000 * k, (0.0,) * 10)
    assert len(joiner._waiting) <= 20_001
    assert joiner.silent_channels() == ["b", "c"]
    assert Joiner(CHANNELS, PERIOD).silent_channels() == list(CHANNELS)


def test_a_clock_set_back_restarts_the_joiner():
    joiner = Joiner(CHANNELS, PERIOD)
    joined(joiner, messages(1000))
    times, _ = joined(joiner, messages(10))
    assert joiner.restarts == 1
    assert len(times) == 10


# --- the clocks


def moving(time):
    """(K, 2) positions of an arm that begins to move at 1 s."""
    way = np.maximum(0.0, np.asarray(time)[:, None] - 1.0)
    return 0.3 * (1 - np.cos(way * [1.3, 2.1]))


@settings(deadline=None, max_examples=12)
@given(
    offset=st.floats(-1e6, 1e6), drift=st.floats(-50e-6, 50e-6), phase=st.floats(0.0, 0.02), behind=st.integers(0, 150)
)
@example(offset=0.0, drift=0.0, phase=0.02, behind=0)
def test_aligns_the_clocks_by_the_common_motion(offset, drift, phase, behind):
    """Feedbacks every 20 ms in whole milliseconds; samples on their own clock, delayed by a number of feedbacks."""
    match, length = ClockMatch(), 5.0
    feedback, sample = np.arange(phase, length, 0.02), np.arange(0.0, length, 0.002)
    stamps, positions = sample + offset + drift * sample, moving(sample)
    for k in range(len(feedback) + behind):
        if k < len(feedback):
            match.feedback(np.floor(1000 * feedback[k] + 1e-6) / 1000, moving(feedback[k : k + 1])[0])
        part = slice(10 * (k - behind), 10 * (k - behind) + 10)
        if k >= behind and len(stamps[part]):
            match.samples(stamps[part], positions[part])
    # Whole milliseconds leave the middle of one unknown: half a millisecond either way, at the end of the motion.
    assert abs(match.offset() - (offset + drift * 4.3)) < 0.6e-3
    assert match.offset() == pytest.approx(offset + 3.0 * drift, rel=1e-15, abs=1e-3)


def test_a_stationary_arm_gives_no_clock_offset():
    match = ClockMatch()
    for k in range(5000):
        match.feedback(0.02 * k, np.zeros(2))
        match.samples(np.array([0.02 * k]), np.zeros((1, 2)))
    assert match.offset() is None
    assert len(match._pending) <= 500


# --- one motion


def topics(times, joints, currents=(1.0, 2.0)):
    """Values (K, 5, 10) of an arm whose set-points are where it is, in degrees."""
    values = np.zeros((len(times), 5, 10))
    values[:, 0, :2] = values[:, 2, :2] = joints
    values[:, 4, :2] = currents
    return (np.asarray(times) * 1e6).astype(np.int64), values


def ramp(times):
    return np.maximum(0.0, np.asarray(times)[:, None] - 1.0) ** 2 * [10.0, 5.0]


def test_converts_currents_to_torque_and_delivers_every_sample():
    run = motion()
    times = np.arange(0.0, 3.0, 0.002)
    way = ramp(np.minimum(times, 2.0))
    for k in range(0, len(times), 10):
        if run.over:
            break
        now = times[k]
        run.samples(*topics(times[k : k + 10], way[k : k + 10]))
        run.feedbacks([feedback(int(1000 * now), way[k], moves=int(now < 2.0), last=7 if now >= 2.0 else 0)], READY)
        run.poll()
    blocks = list(run.blocks())
    time = np.concatenate([block.time for block in blocks])
    assert time[0] == 0.0
    assert time[-1] == pytest.approx(2.0, abs=0.03)
    np.testing.assert_array_equal(np.concatenate([b.sequence for b in blocks]), np.arange(len(time)))
    np.testing.assert_allclose(blocks[0].torque[0], [2.0 * 1.0, 0.5 * 1.0 - 2.0])
    np.testing.assert_allclose(blocks[0].current[0], [1.0, 2.0])
    np.testing.assert_allclose(np.concatenate([b.position for b in blocks]), np.radians(ramp(np.minimum(time, 2.0))))


def test_watches_the_arm_during_pauses():
    """Nothing is held back until the set-points change again."""
    run = motion()
    times = np.arange(0.0, 3.0, 0.002)
    for k in range(0, len(times), 10):
        run.samples(*topics(times[k : k + 10], ramp(np.minimum(times, 1.5))[k : k + 10]))
    assert sum(len(block) for block in run._ready) == len(times)


def test_trims_the_rest_before_a_motion_started_by_hand():
    run = motion(is_over=None)
    times = np.arange(0.0, 2.0, 0.002)
    for k in range(0, len(times), 10):
        run.samples(*topics(times[k : k + 10], ramp(times[k : k + 10])))
    assert run._ready[0].time[0] == pytest.approx(0.9, abs=0.01)


def test_missing_samples_are_gaps_by_their_times():
    run = motion()
    times = np.concatenate([np.arange(0.9, 1.5, 0.002), np.arange(1.52, 1.8, 0.002)])
    run.samples(*topics(times, ramp(times)))
    gaps = run.sequencer.gaps
    assert [gap.count for gap in gaps] == [10]
    first = next(run.blocks())
    assert run.sequencer.expected == round((times[-1] - first.time[0]) / 0.002) + 1


def test_samples_that_end_before_the_motion_are_an_error():
    """A recording without the end of the motion is refused, whatever the controller reports."""
    for heard in (0.0, 1.6):  # s of samples
        run = motion()
        run._patience = 0.0
        times = np.arange(0.0, 3.0, 0.002)
        way = ramp(np.minimum(times, 2.0))
        for k in range(0, len(times), 10):
            if times[k] < heard:
                run.samples(*topics(times[k : k + 10], way[k : k + 10]))
            moves = times[k] < 2.0
            run.feedbacks([feedback(int(1000 * times[k]), way[k], moves=int(moves), last=0 if moves else 7)], READY)
        run._silence = 60.0
        fault = run.poll()
        assert f"end {0.4 if heard else 1.0:.1f} s before the motion did: nothing on x" in str(fault)
        assert not run.over


def test_a_clock_that_goes_back_in_motion_ends_it():
    run = motion()
    run.feedbacks([feedback(5000), feedback(5020)], READY)
    assert run.poll() is None
    run.feedbacks([feedback(10)], READY)
    assert "clock" in str(run.poll())


def received(run):
    """Times of the samples that are handed out before the motion ends with an error about a clock."""
    times = []
    with pytest.raises(DriverError, match="clock"):
        times.extend(block.time for block in run.blocks())
    return np.concatenate(times) if times else np.empty(0)


def test_samples_that_a_busy_broker_still_has_are_waited_for_when_the_motion_fails():
    """The sockets know of the fault while not one sample of the motion has come through."""
    run = motion()
    times = np.arange(0.0, 2.0, 0.002)
    way = ramp(times)
    for k in range(0, len(times), 10):
        run.feedbacks([feedback(int(1000 * times[k]), way[k])], READY)
    run.feedbacks([feedback(10)], READY)
    run.fail(run.poll())
    for k in range(0, len(times), 10):
        assert not run.over
        run.feedbacks([feedback(30)], READY)
        run.samples(*topics(times[k : k + 10], way[k : k + 10]))
        assert run.poll() is None
    assert run.over
    assert received(run)[-1] == pytest.approx(1.98, abs=0.03)


@settings(deadline=None, max_examples=20)
@given(size=st.integers(20, 2000))
def test_drops_samples_after_a_clock_went_back(size):
    """However many arrive at once, before and after in one go among them."""
    run = motion()
    times = np.concatenate([np.arange(10.0, 12.0, 0.002), np.arange(0.0, 2.0, 0.002)])
    way = ramp(times - np.where(times >= 10.0, 10.0, -1.0))
    for k in range(0, len(times), size):
        run.samples(*topics(times[k : k + size], way[k : k + size]))
        if not run.failing and (fault := run.poll()) is not None:
            run.fail(fault)
    run.poll()
    assert run.over
    handed_out = received(run)
    assert 10.0 <= handed_out[0] <= 10.91
    assert handed_out[-1] == pytest.approx(11.998, abs=0.01)
    np.testing.assert_allclose(np.diff(handed_out), 0.002)


def test_a_motion_that_fails_does_not_wait_for_a_broker_that_is_gone():
    run = motion()
    run.feedbacks([feedback(int(20 * k), ramp([0.02 * k])[0]) for k in range(100)], READY)
    run.fail(DriverError("a clock, or whatever it is"))
    run.poll()
    assert not run.over
    run._silence = 60.0
    run.poll()
    assert run.over
    assert len(received(run)) == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"e_stopped": 1}, "emergency stop"),
        ({"in_error": 1, "error_code": 62513}, "62513"),
        ({"drives_powered": 0}, "drives"),
        ({"mode": 1}, "selector"),
        ({"motion_possible": 0}, "cell"),
        ({}, "by hand"),
    ],
)
def test_reports_the_reason_of_a_controller_stop(change, said):
    state = cnr.StatusMessage(**{**READY.__dict__, **change})
    run = motion(broker=False)
    run.feedbacks([feedback(20), feedback(40)], READY)
    for k in range(20):
        run.feedbacks([feedback(60 + 20 * k, moves=0)], state)
        run.poll()
    with pytest.raises(MotionStopped, match=said):
        list(run.blocks())
    assert (stop_reason(state) is None) == (not change)


def test_a_stop_is_confirmed_by_rest_not_by_the_flag():
    run = motion(broker=False)
    run.stopping = True
    for k in range(30):
        run.feedbacks([feedback(20 * k, (min(k, 15), 0.0), moves=int(k < 5))], READY)
        run.poll()
        assert run.over == (k >= 25), "it is still slowing down, or has only just come to rest"
    list(run.blocks())


def test_a_start_may_take_effect_after_an_ignored_stop():
    run = motion(broker=False)
    run.stopping = True
    for k in range(9):
        run.feedbacks([feedback(20 * k, moves=0)], READY)
    run.feedbacks([feedback(180, moves=1)], READY)
    run.poll()
    assert not run.over


def test_a_short_pause_is_not_a_stop():
    run = motion(broker=False)
    run.feedbacks([feedback(20)], READY)
    for k in range(5):
        run.feedbacks([feedback(40 + 20 * k, moves=0)], READY)
        run.poll()
    assert not run.over
    run.feedbacks([feedback(200), feedback(220, moves=0, last=7)], READY)
    run.poll()
    assert run.over
    assert len(list(run.blocks())) == 8


def test_a_program_started_by_hand_ends_with_a_rest():
    run = motion(is_over=None, broker=False)
    for k in range(150):
        now = 20 * k
        run.feedbacks([feedback(now, (min(now, 400) * 0.01, 0.0), moves=0)], READY)
        run.poll()
    assert run.over
    blocks = list(run.blocks())
    assert blocks[-1].time[-1] == pytest.approx(0.4 + 2.0, abs=0.1)
    assert blocks[0].velocity is None
    assert blocks[0].reference_position is None
