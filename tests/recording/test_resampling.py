"""Uneven logs on an even grid, and logs from memory to a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.recording import Log, read_log, write_log
from agent.recording.mcap.log_file import RecordingError
from agent.recording.resampling import resampled


@pytest.fixture
def uneven() -> Log:
    """Two stretches of a 1 Hz motion with a gap between them, unevenly sampled at about 500 Hz."""
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.001, 0.003, 2000))
    t[1000:] += 0.5
    t -= t[0]
    q = np.sin(2 * np.pi * t)[:, None] * [1.0, 2.0]
    planned = q.copy()
    planned[:300] = np.nan
    return Log(
        path=Path("uneven.mcap"),
        joint_names=("a", "b"),
        t=t,
        position=q,
        velocity=None,
        effort=np.sign(q),
        reference_position=q,
        planned_position=planned,
        sample_rate=500.0,
        stamp=7.0,
        segments=((0, 1000), (1000, 2000)),
        cycle_starts=(0.0, 1.0),
        metadata={"robot": "arm", "motion": "test"},
    )


def test_the_grid_is_even_and_the_motion_the_same(uneven):
    log = resampled(uneven, 400.0)
    assert log.sample_rate == 400.0
    assert len(log.segments) == 2
    for start, stop in log.segments:
        np.testing.assert_allclose(np.diff(log.t[start:stop]), 1 / 400, rtol=1e-9)
    np.testing.assert_allclose(log.position[:, 1], 2 * np.sin(2 * np.pi * log.t), atol=1e-6)
    assert np.abs(log.effort).max() <= 1.0  # monotone between samples: no overshoot at the steps
    assert log.velocity is None
    assert log.cycle_starts == (0.0, 1.0)


def test_times_of_breaks_and_cycles_follow_the_first_sample(uneven):
    """A first segment of one sample is dropped: what is left starts later, and every time in it with it."""
    there = float(uneven.t[1500])
    cut = replace(uneven, segments=((0, 1), (1000, 2000)), breaks=(there,), cycle_starts=(0.0, there))
    log = resampled(cut, 400.0)
    assert log.t[0] == 0.0
    assert log.stamp == pytest.approx(cut.stamp + cut.t[1000])
    assert [log.stamp + time for time in log.breaks] == pytest.approx([cut.stamp + there])
    assert [log.stamp + time for time in log.cycle_starts] == pytest.approx([cut.stamp + there])


def test_unknown_set_points_stay_unknown(uneven):
    log = resampled(uneven)
    known = np.isfinite(log.planned_position[:, 0])
    assert not known[log.t < uneven.t[300]].any()
    assert known[log.t >= uneven.t[300]].all()
    np.testing.assert_allclose(log.planned_position[known], log.position[known], atol=1e-6)


def test_it_says_that_it_interpolated(uneven):
    assert any("interpolated to 500 Hz" in repair.kind for repair in resampled(uneven).repairs)


def test_too_short_for_the_grid(uneven):
    with pytest.raises(InputError, match=r"uneven.mcap.*too short for 0.1 Hz"):
        resampled(uneven, 0.1)


def test_a_folder_that_is_not_there(uneven, tmp_path):
    (tmp_path / "file").touch()
    for folder, reason in (("missing", "No such file or directory"), ("file", "Not a directory")):
        with pytest.raises(RecordingError, match=rf"{folder}/copy.mcap: the log cannot be written: {reason}"):
            write_log(tmp_path / folder / "copy.mcap", uneven)


def test_a_log_in_memory_goes_to_a_file_and_back(uneven, tmp_path):
    path = tmp_path / "copy.mcap"
    write_log(path, uneven)
    write_log(path, uneven)  # replaces it
    log = read_log(path)
    for name in ("position", "effort", "reference_position", "planned_position"):
        np.testing.assert_array_equal(getattr(log, name), getattr(uneven, name))
    np.testing.assert_allclose(log.t, uneven.t, atol=2e-9)
    assert log.velocity is None
    assert log.stamp == 7.0
    assert log.segments == uneven.segments
    np.testing.assert_allclose(log.cycle_starts, uneven.cycle_starts, atol=1e-9)
    assert [p.name for p in tmp_path.iterdir()] == ["copy.mcap"]
