"""A recording takes the same memory after an hour as after a minute."""

import gc
import itertools
import time
import tracemalloc

import numpy as np
from hypothesis import given, strategies as st

from agent.link.alignment import Aligner, MovingSegments, moving_segments
from agent.recording import LogWriter
from agent.safety.freshness import Freshness
from agent.safety.stopping import Braking
from drivers.protocol import SampleBlock
from tests.safety.following import HOME, PERIOD, ROBOT

#: Of a sample that was recorded [bytes]; a sample has 250 on the wire.
LEAST = 20


def block(first: int, count: int = 10) -> SampleBlock:
    """As a driver makes it: views of one message."""
    values = np.tile(HOME, (5, count, 1)) + 0.1 * np.sin(np.arange(first, first + count) / 300)[:, None]
    sequence = np.arange(first, first + count)
    return SampleBlock(sequence, 5.0 + PERIOD * sequence, *values, received=1.0)


def test_memory_does_not_grow_with_the_recording(tmp_path):
    aligner, braking = Aligner((), PERIOD), Braking(ROBOT.max_velocity)
    freshness = Freshness(PERIOD, 0.5, lambda: 0.0)
    held: dict[int, list[int]] = {0: [], 2: []}
    with LogWriter(tmp_path / "long.mcap", ROBOT.joint_names, robot="r", motion="m") as writer:
        tracemalloc.start()
        for k in range(3000):
            samples = block(10 * k)
            writer.write(samples)
            aligner.take(samples.time, samples.reference_position)
            braking.take(samples.time, samples.position)
            freshness.judged(float(samples.time[-1]))
            if k // 1000 in held and k % 1000 >= 950:  # two flushes: what fills the open chunk is not growth
                while writer.backlog:
                    time.sleep(0.001)
                if k % 1000 == 950:
                    gc.collect()
                held[k // 1000].append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert (min(held[2]) - min(held[0])) / 20_000 < LEAST


@given(st.lists(st.integers(0, 30), max_size=60), st.integers(0, 12), st.integers(1, 9))
def test_segments_do_not_depend_on_block_size(stays, rest, chunk):
    reference = np.array([value for value, stay in enumerate(stays) for _ in range(stay)], dtype=float)[:, None]
    segments = MovingSegments(rest)
    for first in range(0, len(reference), chunk):
        segments.add(reference[first : first + chunk])
    assert segments.ranges == moving_segments(reference, rest)
    moves = np.flatnonzero(np.diff(reference[:, 0], axis=0)) if len(reference) else []
    inside = [any(start <= move < stop - 1 for start, stop in segments.ranges) for move in moves]
    assert all(inside)
    assert all(after[0] - (before[1] - 2) > rest for before, after in itertools.pairwise(segments.ranges))
