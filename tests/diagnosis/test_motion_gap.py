"""Planned against executed set-points: what pace, delay and rounding are found, and what is none of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.diagnosis.gap.motion_gap import motion_gap
from agent.recording import Log

PERIOD = 0.002
WAYS = ((0.9, 2.0), (-0.5, 1.4), (0.7, 2.6), (-1.1, 3.0))  # rad, s: from stop to stop


def way(reach: float, lasting: float, share: float = 1.0) -> np.ndarray:
    """(S, 2) of a joint that moves and one that goes along; `share` bends the time law."""
    u = np.arange(round(lasting / PERIOD) + 1) * PERIOD / lasting
    u = u + (share - 1) * np.sin(2 * np.pi * u) / (2 * np.pi)
    s = u**3 * (10 - 15 * u + 6 * u**2)
    return reach * np.stack([s, 0.4 * s], axis=1)


def recorded(name: str, ways, rate: float, share: float = 1.0) -> Log:
    """A log of ways with stops of 0.1 s, each run at a rate of the plan, which is laid on anew at every stop."""
    executed, planned, at = [], [], np.zeros(2)
    for reach, lasting in ways:
        plan, ran = way(reach, lasting), way(reach, lasting / rate, share)
        waits = np.repeat(ran[-1:], round(0.1 / PERIOD), axis=0)
        executed.append(at + np.concatenate([ran, waits]))
        laid = np.full(executed[-1].shape, np.nan)
        count = min(len(plan), len(laid))
        laid[:count] = at + plan[:count]
        planned.append(laid)
        at = executed[-1][-1]
    position = np.concatenate(executed)
    t = np.arange(len(position)) * PERIOD
    return Log(
        path=Path(name), joint_names=("a", "b"), t=t, position=position, velocity=None, effort=None,
        reference_position=position, planned_position=np.concatenate(planned), sample_rate=1 / PERIOD, stamp=0.0,
        segments=((0, len(t)),), cycle_starts=(), metadata={},
    )  # fmt: skip


@pytest.mark.parametrize("rate", [0.987, 1.018])
def test_finds_a_different_pace_in_motions_with_stops(rate):
    """The plan is laid on from stop to stop, so no single rate over the log's time describes it."""
    gap = motion_gap([recorded("one.mcap", WAYS, rate), recorded("two.mcap", WAYS[::-1], rate)])
    assert gap.described
    assert gap.rate == pytest.approx(rate, abs=1e-3)
    assert gap.closure > 0.95


SIZES = {"large.mcap": (6.0, 1.006), "small.mcap": (0.5, 1.012), "least.mcap": (0.1, 1.0)}


@pytest.mark.parametrize(
    "logs",
    [
        [recorded("one.mcap", WAYS, 1.0, 1.15), recorded("two.mcap", WAYS[::-1], 1.0, 0.85)],
        [recorded(name, [(k * reach, lasting) for reach, lasting in WAYS], rate) for name, (k, rate) in SIZES.items()],
    ],
    ids=["other ramps", "corners of a large motion that look like one, by chance that between two others"],
)
def test_what_one_motion_contradicts_is_no_other_pace(logs):
    gap = motion_gap(logs)
    assert gap.notable
    assert not gap.described


def test_the_repeatability_is_what_neighbouring_cycles_differ_by():
    time = np.arange(3000) * PERIOD
    error = 1e-7 * np.repeat([[1.0, 2.0], [3.0, 6.0], [4.0, 8.0]], 1000, axis=0)
    arrays = {"t": time, "planned_position": 0 * error, "reference_position": error, "cycle_starts": (0.0, 2.0, 4.0)}
    gap = motion_gap([replace(recorded("one.mcap", WAYS, 1.0), **arrays)])
    assert gap.floor == pytest.approx(1e-7 * np.sqrt((2**2 + 1**2) / 2 / 2) * np.array([1, 2]), rel=1e-9, abs=0)
    assert not gap.notable
