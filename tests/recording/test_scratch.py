"""Arrays of long logs, on disk."""

import numpy as np
import pytest

from agent.recording import scratch


@pytest.fixture
def on_disk(monkeypatch):
    monkeypatch.setattr(scratch, "_IN_MEMORY", 0)
    monkeypatch.setattr(scratch, "_EXTENT", 2**16)
    monkeypatch.setattr(scratch, "_ROWS", 100)


def test_values_stay_when_their_memory_is_given_back(on_disk):
    rng = np.random.default_rng(0)
    values = [rng.normal(size=(size, 3)) for size in (5, 200, 4000, 1)]
    values[1] = np.asfortranarray(values[1])
    room = scratch.Scratch()
    kept = [room.keep(each) for each in values]
    assert list(room.each("ab")) == ["a", "b"]
    for before, after in zip(values, kept, strict=True):
        assert np.array_equal(before, after)
        assert before.flags.f_contiguous == after.flags.f_contiguous
        assert not np.shares_memory(before, after)


def test_a_full_disk_is_reported_when_space_is_requested(on_disk, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(scratch.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left") as caught:
        scratch.Scratch().empty((10, 10))
    assert caught.value.filename
