"""Samples matched to the points of a plan: by the edges of runs, with the result of point-by-point matching."""

import numpy as np
from hypothesis import given, strategies as st

from agent.safety.reference_path import ReferencePath

GAP, WITHIN = 0.1, 0.3
STEP = 0.02


def path_of(count: int) -> ReferencePath:
    nothing = np.zeros((count, 1))
    plan_time = STEP * np.arange(count)
    return ReferencePath(
        np.arange(count),
        plan_time,
        nothing,
        nothing,
        nothing,
        nothing,
        nothing,
        nothing[:, 0],
        np.arange(1),
        np.ones(1),
        STEP,
    )


def point_by_point(path, fits, reached, first, passed, ahead):
    firsts, lasts = [], []
    for k in range(len(fits)):
        expected = passed[k] + path.plan_time[first + np.flatnonzero(reached)[-1]]
        onward = path.onward(reached, first, ahead[k])
        if not np.any(onward & fits[k]):
            return firsts, lasts, onward
        reached = onward & fits[k]
        if passed[k] > GAP:
            reached = path.runs_near(reached, first, expected, WITHIN)
        matched = np.flatnonzero(reached)
        firsts.append(first + matched[0])
        lasts.append(first + matched[-1])
    return firsts, lasts, reached


@st.composite
def matchings(draw):
    """Some samples; most fit a run of points, some several, some none."""
    width, samples, first = draw(st.integers(1, 40)), draw(st.integers(1, 12)), draw(st.integers(0, 30))
    place = st.integers(0, width)
    fits = np.zeros((samples, width), dtype=bool)
    for row in fits:
        for a, b in draw(st.lists(st.tuples(place, place), min_size=1, max_size=3)):
            row[min(a, b) : max(a, b) + 1] = True
    reached = np.zeros(width, dtype=bool)
    for a, b in draw(st.lists(st.tuples(place, place), min_size=1, max_size=2)):
        reached[min(a, width - 1) : max(a, b) + 1] = True
    passed = np.array(draw(st.lists(st.sampled_from([0.0, 0.004, 0.05, 0.2]), min_size=samples, max_size=samples)))
    return fits, reached, first, passed


@given(matchings())
def test_batch_matching_equals_point_by_point_matching(matching):
    fits, reached, first, passed = matching
    path = path_of(first + fits.shape[1])
    ahead = 4.0 * passed
    matched = path.match_samples(fits, reached, first, passed, ahead, GAP, WITHIN)
    for edge, expected in zip(matched, point_by_point(path, fits, reached, first, passed, ahead), strict=True):
        np.testing.assert_array_equal(edge, expected)
