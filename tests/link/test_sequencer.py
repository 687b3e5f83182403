"""Samples in order, each once, whatever the wire did to their blocks; and a counter that was reset is noticed."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from drivers.errors import ProtocolError
from drivers.protocol import Gap, SampleBlock
from drivers.transports.base.samples import Sequencer

PERIOD = 0.002


def block(first: int, count: int, late: float = 0.0) -> SampleBlock:
    """Samples `first` to `first + count`, `late` [s] behind their time."""
    sequence = np.arange(first, first + count)
    values = np.zeros((count, 2))
    return SampleBlock(sequence, PERIOD * sequence + late, *[values] * 5)


@given(st.lists(st.integers(1, 20), min_size=1, max_size=12), st.data())
def test_delivers_every_sample_once_in_order(sizes, data):
    """Blocks in any order, some of them more than once."""
    starts = np.concatenate([[0], np.cumsum(sizes)])
    blocks = [block(int(first), size) for first, size in zip(starts, sizes, strict=False)]
    repeated = data.draw(st.lists(st.sampled_from(range(len(blocks))), max_size=5))
    order = data.draw(st.permutations([*range(len(blocks)), *repeated]))
    sequencer = Sequencer()
    given_out = [part.sequence for k in order for part in sequencer.accept(blocks[k])]
    np.testing.assert_array_equal(np.concatenate(given_out), np.arange(starts[-1]))
    assert sequencer.gaps == ()


@given(st.integers(1, 100), st.integers(1, 5000), st.integers(1, 100))
def test_abandoned_samples_are_a_gap_not_a_reset(before, missing, after):
    sequencer = Sequencer()
    sequencer.accept(block(0, before))
    assert sequencer.accept(block(before + missing, after)) == []
    assert sequencer.missing() == (before, missing)
    (rest,) = sequencer.give_up(before + missing)
    assert rest.sequence[0] == before + missing
    assert sequencer.gaps == (Gap(before, missing),)


@given(st.integers(2, 100), st.integers(26, 5000))
def test_a_counter_that_was_reset_and_has_caught_up_is_noticed(seen, unseen):
    """So many samples went by unseen before it counted from 0 again: the numbers fit, the times do not."""
    sequencer = Sequencer()
    sequencer.accept(block(0, seen))
    with pytest.raises(ProtocolError, match=f"samples {seen - 1} and {seen} .* its counter reset in mid-motion"):
        sequencer.accept(block(seen, 10, late=PERIOD * unseen))


@given(st.integers(0, 60), st.integers(3, 60), st.integers(1, 2), st.floats(0.06, 1e8))
def test_a_clock_that_is_set_forward_is_noticed_within_a_block_too(seen, before, after, by):
    """A wire that is polled hands out what came before and after it at once."""
    sequencer = Sequencer()
    if seen:
        sequencer.accept(block(0, seen))
    parts = block(seen, before), block(seen + before, after, late=by)
    times = np.concatenate([part.time for part in parts])
    at = seen + before
    values = np.zeros((len(times), 2))
    with pytest.raises(ProtocolError, match=f"samples {at - 1} and {at} .* its clock was set forward"):
        sequencer.accept(SampleBlock(seen + np.arange(len(times)), times, *[values] * 5))


def test_coarse_stamps_are_not_a_clock_jump():
    sequencer = Sequencer()
    for first in range(0, 1000, 20):
        part = block(first, 20)
        times = np.floor(part.time / 0.01) * 0.01
        assert sequencer.accept(SampleBlock(part.sequence, times, *[np.zeros((20, 2))] * 5))


def test_old_numbers_with_new_times_are_a_reset():
    sequencer = Sequencer()
    sequencer.accept(block(0, 100))
    with pytest.raises(ProtocolError, match="went back from 100 to 0"):
        sequencer.accept(block(0, 10, late=1.0))


@given(st.lists(st.floats(0.0, 0.04), min_size=2, max_size=30))
def test_jitter_is_not_a_reset(delays):
    sequencer = Sequencer()
    for number, late in enumerate(np.sort(delays)):
        assert len(sequencer.accept(block(10 * number, 10, late))) == 1
