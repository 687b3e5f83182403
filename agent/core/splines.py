"""Cubic splines of many curves at once. SciPy's own take half a second to import."""

from __future__ import annotations

import numpy as np


def cubic_spline(knots: np.ndarray, values: np.ndarray, places: np.ndarray, natural: bool = False) -> np.ndarray:
    """(P, m) at places (P,) of the cubic splines through values (K, m) at ascending knots (K,), four or more.

    Not-a-knot at the ends (one cubic over the first two intervals, and one over the last two): the outer cubics go on
    beyond them. `natural`: no bending at the ends, and straight on beyond them.
    """
    slope = _slopes(knots, values, natural)
    width = np.diff(knots)[:, None]
    secant = np.diff(values, axis=0) / width
    bend = (slope[:-1] + slope[1:] - 2 * secant) / width
    cubic, square = bend / width, (secant - slope[:-1]) / width - bend
    inside = np.clip(places, knots[0], knots[-1]) if natural else places
    at = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
    x = (inside - knots[at])[:, None]
    found = ((cubic[at] * x + square[at]) * x + slope[at]) * x + values[at]
    if natural:
        found += (places - inside)[:, None] * np.where((places < knots[0])[:, None], slope[0], slope[-1])
    return np.asarray(found)


def _slopes(knots: np.ndarray, values: np.ndarray, natural: bool) -> np.ndarray:
    """(K, m) at the knots, from a tridiagonal system (de Boor, A Practical Guide to Splines, 1978, chapter IV)."""
    from scipy.linalg import solve_banded

    step = np.diff(knots)
    width = step[:, None]
    secant = np.diff(values, axis=0) / width
    bands, right = np.empty((3, len(knots))), np.empty(values.shape)
    bands[0, 2:], bands[1, 1:-1], bands[2, :-2] = step[:-1], 2 * (step[:-1] + step[1:]), step[1:]
    right[1:-1] = 3 * (width[1:] * secant[:-1] + width[:-1] * secant[1:])
    if natural:
        bands[1, 0], bands[0, 1], right[0] = 2, 1, 3 * secant[0]
        bands[1, -1], bands[2, -2], right[-1] = 2, 1, 3 * secant[-1]
    else:
        first, last = knots[2] - knots[0], knots[-1] - knots[-3]
        bands[1, 0], bands[0, 1] = step[1], first
        bands[1, -1], bands[2, -2] = step[-2], last
        right[0] = ((step[0] + 2 * first) * step[1] * secant[0] + step[0] ** 2 * secant[1]) / first
        right[-1] = (step[-1] ** 2 * secant[-2] + (2 * last + step[-1]) * step[-2] * secant[-1]) / last
    bands[0, 0] = bands[2, -1] = 0.0  # outside of the matrix
    return np.asarray(solve_banded((1, 1), bands, right, overwrite_ab=True, overwrite_b=True, check_finite=False))
