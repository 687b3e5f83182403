"""What is held out: whole motions, parts of one that has to stand alone, and every other tenth of a second of these."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from agent.core import InputError
from agent.diagnosis.rows.folds import folds_of, part_borders
from agent.recording import PARTS, Log


def log_of(name: str, seconds: float, path=np.sin, **more) -> Log:
    """Two joints at 128 Hz: the first moves by a path, the second by its half."""
    t = np.arange(round(seconds * 128) + 1) / 128
    position = np.stack([path(t), 0.5 * path(t)], axis=1)
    fields = {"velocity": None, "effort": None, "reference_position": None, "planned_position": None, **more}
    segments = ((0, len(t)),)
    return Log(Path(name), ("a", "b"), t, position, sample_rate=128.0, stamp=0.0, segments=segments, **fields)


def cut(*logs: Log) -> tuple[list[np.ndarray], list[str]]:
    """Per log the fold of each of its rows (-1: guard); and what the folds are called."""
    time, number = np.concatenate([log.t for log in logs]), np.repeat(range(len(logs)), [len(log.t) for log in logs])
    cell, folds, single = folds_of(time, number, logs)
    fold = np.where(cell < 0, -1, cell // 2)
    assert np.array_equal(cell[cell >= 0] % 2, (time / 0.1).astype(int)[cell >= 0] % 2)
    cells = np.arange(2 * len(folds))
    assert np.array_equal([one.test for one in folds], [cells // 2 == k for k in range(len(folds))])
    assert [one.name for one in single] == [one.name for one in folds for _ in range(2)]
    assert np.array_equal([one.test for one in single], [cells == k for k in cells])
    assert all(np.array_equal(one.train, ~one.test) for one in (*folds, *single))
    return [fold[number == k] for k in range(len(logs))], [one.name for one in folds]


def between(time: np.ndarray, borders) -> np.ndarray:
    """The part of each row, -1 within 0.2 s of a border."""
    near = [np.any(np.abs(one - np.array(borders)) < 0.2) for one in time]
    return np.where(near, -1, np.searchsorted(borders, time, side="right"))


@pytest.mark.parametrize(
    ("cycles", "borders"),
    [
        ((), (2, 4, 6, 8)),
        ((0.0, 5.0), (2, 4, 6, 8)),
        ((0.0, 3.0, 6.0, 10.0), (3, 6)),
        (tuple(range(10)), (1, 3, 5, 7, 9)),
    ],
)
def test_one_log_is_cut_at_its_cycles_or_in_five_blocks(cycles, borders):
    log = log_of("a.mcap", 10, cycle_starts=cycles)
    (fold,), names = cut(log)
    assert np.array_equal(fold, between(log.t, borders))
    edges = [0, *borders, 10]
    assert names == [f"a.mcap {a:.1f}-{b:.1f} s" for a, b in pairwise(edges)]
    assert len(cut(log_of("a.mcap", 3))[1]) == 5
    short = log_of("a.mcap", 3.25)
    with pytest.raises(InputError, match=r"a\.mcap: only 2\.9 s remain after filtering; a single log needs 3 s"):
        folds_of(short.t[32:-16], np.zeros(369, dtype=int), [short])


def test_of_several_each_is_held_out_or_its_parts_where_only_it_tells_of_a_joint():
    logs = [log_of("a.mcap", 4), log_of("b.mcap", 6, metadata={PARTS: "3"}), log_of("c.mcap", 4)]
    folds, names = cut(*logs)
    assert names == ["a.mcap", "b.mcap 0.0-2.0 s", "b.mcap 2.0-4.0 s", "b.mcap 4.0-6.0 s", "c.mcap"]
    assert [np.unique(one).tolist() for one in folds] == [[0], [-1, 1, 2, 3], [4]]
    assert np.array_equal(folds[1], np.where((b := between(logs[1].t, part_borders(logs[1]))) < 0, -1, 1 + b))
    assert cut(logs[0], logs[2])[1] == ["a.mcap", "c.mcap"]
    for share, parts in ((0.04, 2), (0.06, 1)):
        slower = logs[0].position * [1, share]
        moved = [logs[2], *(log_of(f"{k}.mcap", 4) for k in "de")]
        for one in (moved[0], moved[2]):
            one.position[:, 1] = slower[:, 1]
        assert len(cut(*moved)[1]) == 2 + parts


@pytest.mark.parametrize(("said", "parts"), [("1", 1), ("2", 2), ("4", 4), ("9", 5), ("some", 1), ("0", 1)])
def test_parts_have_the_same_time_in_motion(said, parts):
    """Two of eight seconds, in which all stand, are of no part."""
    log = log_of("a.mcap", 8, lambda t: t - np.clip(t - 4, 0, 2), metadata={PARTS: said})
    expected = [at if at <= 4 else at + 2 for at in 6 * np.arange(1, parts) / parts]
    assert part_borders(log) == pytest.approx(expected)
    creep = np.stack([0 * log.t, np.clip(log.t - 4, 0, 2)], axis=1)
    still, creeps = (replace(log, position=log.position * [1, 0] + size * creep) for size in (0.0, 1e-3))
    assert part_borders(still) == pytest.approx(expected)
    assert part_borders(creeps) == pytest.approx(8 * np.arange(1, parts) / parts)
    assert len(part_borders(log, 3)) == max(parts, 3) - 1
    gap = log_of("b.mcap", 2, lambda t: t)
    assert part_borders(gap, 4) == pytest.approx([0.5, 1.0, 1.5])
    assert part_borders(replace(gap, t=gap.t + 3 * (gap.t > 1)), 2) == pytest.approx([2.5])
