"""Orientations on a path and splines through its knots, for `agent.motion.fly`."""

from __future__ import annotations

import numpy as np

from agent.compiled.compiling import compiled


@compiled("void(f8[::1], f8[::1], f8[::1])")
def _multiply(left: np.ndarray, right: np.ndarray, product: np.ndarray) -> None:
    """Hamilton product of quaternions (4,), scalar first."""
    w1, x1, y1, z1 = left
    w2, x2, y2, z2 = right
    product[0] = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2
    product[1] = w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
    product[2] = w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2
    product[3] = w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2


@compiled("void(f8[::1], f8[::1])")
def _conjugate(quaternion: np.ndarray, conjugate: np.ndarray) -> None:
    conjugate[0], conjugate[1], conjugate[2], conjugate[3] = (
        quaternion[0],
        -quaternion[1],
        -quaternion[2],
        -quaternion[3],
    )


@compiled("f8[:,::1](f8[:,::1], f8[:,::1])")
def quaternion_products(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(S, 4) Hamilton products of quaternions; a single one (1, 4) on either side goes with all of the other."""
    product = np.empty((len(left) if len(right) == 1 else len(right), 4))
    for k in range(len(product)):
        _multiply(left[min(k, len(left) - 1)], right[min(k, len(right) - 1)], product[k])
    return product


@compiled("f8[:,::1](f8[::1], f8[:,:])")
def _slopes(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(K, m) slopes of the not-a-knot splines through rows (m, K), by the tridiagonal
    elimination of LAPACK's dgtsv, which takes the larger of two pivots."""
    count, last = len(rows), len(x) - 1
    h = x[1:] - x[:-1]
    diagonal, above, below, b = np.empty(last + 1), np.empty(last), np.empty(last), np.empty((last + 1, count))
    diagonal[0], diagonal[last] = h[1], h[last - 2]
    above[0], below[last - 1] = x[2] - x[0], x[last] - x[last - 2]
    for k in range(last - 1):
        diagonal[k + 1], above[k + 1], below[k] = 2.0 * (h[k] + h[k + 1]), h[k], h[k + 1]
    first, final = above[0], below[last - 1]
    for row in range(count):
        chord = (rows[row, 1:] - rows[row, :-1]) / h
        for k in range(1, last):
            b[k, row] = 3.0 * (h[k] * chord[k - 1] + h[k - 1] * chord[k])
        b[0, row] = ((h[0] + 2.0 * first) * h[1] * chord[0] + h[0] * h[0] * chord[1]) / first
        outer = (h[last - 1] + 2.0 * final) * h[last - 2] * chord[last - 1]
        b[last, row] = (outer + h[last - 1] * h[last - 1] * chord[last - 2]) / final
    for k in range(last):
        if np.abs(diagonal[k]) >= np.abs(below[k]):
            factor = below[k] / diagonal[k]
            diagonal[k + 1] -= factor * above[k]
            for row in range(count):
                b[k + 1, row] -= factor * b[k, row]
            below[k] = 0.0
            continue
        factor, diagonal[k] = diagonal[k] / below[k], below[k]
        above[k], diagonal[k + 1] = diagonal[k + 1], above[k] - factor * diagonal[k + 1]
        if k < last - 1:  # what the exchange of rows puts two above the diagonal
            below[k] = above[k + 1]
            above[k + 1] *= -factor
        for row in range(count):
            b[k, row], b[k + 1, row] = b[k + 1, row], b[k, row] - factor * b[k + 1, row]
    for row in range(count):
        b[last, row] /= diagonal[last]
        b[last - 1, row] = (b[last - 1, row] - above[last - 1] * b[last, row]) / diagonal[last - 1]
    for k in range(last - 2, -1, -1):
        for row in range(count):
            b[k, row] = (b[k, row] - above[k] * b[k + 1, row] - below[k] * b[k + 2, row]) / diagonal[k]
    return b


@compiled("f8[:,:,::1](f8[::1], f8[:,:])")
def not_a_knot(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(4, m, K - 1) coefficients, highest power first, of the cubic splines through rows (m, K) at K > 3 knots x (K,).

    Their third derivatives do not jump at the second knot nor at the last but one.
    """
    count, cells = len(rows), len(x) - 1
    coefficients, slope = np.empty((4, count, cells)), _slopes(x, rows)
    for row in range(count):
        for k in range(cells):
            h = x[k + 1] - x[k]
            chord = (rows[row, k + 1] - rows[row, k]) / h
            bent = (slope[k, row] + slope[k + 1, row] - 2.0 * chord) / h
            coefficients[0, row, k] = bent / h
            coefficients[1, row, k] = (chord - slope[k, row]) / h - bent
            coefficients[2, row, k], coefficients[3, row, k] = slope[k, row], rows[row, k]
    return coefficients


@compiled("Tuple((f8[:,:,::1], f8[:,:,:,::1]))(f8[:,:,::1], f8, f8[:,:])")
def derivatives(coefficients: np.ndarray, last: float, orientation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3, m, K) first to third derivatives at the knots, and (2, 2, K, 3) velocity and acceleration by the path
    parameter, of the position, then of the rotation.

    The last seven of the m rows are position and quaternion. The third derivative is that of the neighbouring cell
    where it is larger. The angular velocity over s is 2 Q' Q*, its derivative 2 Q'' Q* but for a scalar part;
    Q' is across Q.

    Args:
        coefficients: (4, m, K - 1) of the cubics between the knots, highest power first.
        last: length of the last cell.
        orientation: (K, 4) quaternions at the knots.
    """
    _, rows, cells = coefficients.shape
    changes, tool = np.empty((3, rows, cells + 1)), np.empty((2, 2, cells + 1, 3))
    for row in range(rows):
        cubic, square, linear = coefficients[0, row], coefficients[1, row], coefficients[2, row]
        first, second, third = changes[0, row], changes[1, row], changes[2, row]
        for k in range(cells):
            first[k], second[k], third[k] = linear[k], 2.0 * square[k], 6.0 * cubic[k]
        first[cells] = linear[cells - 1] + last * (2.0 * square[cells - 1] + 3.0 * last * cubic[cells - 1])
        second[cells] = 2.0 * square[cells - 1] + 6.0 * last * cubic[cells - 1]
        third[cells] = 6.0 * cubic[cells - 1]
        for k in range(cells - 1, 0, -1):
            other = 6.0 * cubic[k - 1]
            third[k] = third[k] if np.abs(third[k]) > np.abs(other) else other
    inverse, rate, product = np.empty(4), np.empty(4), np.empty(4)
    for k in range(cells + 1):
        _conjugate(np.ascontiguousarray(orientation[k]), inverse)
        for order in range(2):
            for row in range(3):
                tool[0, order, k, row] = changes[order, rows - 7 + row, k]
            for row in range(4):
                rate[row] = changes[order, rows - 4 + row, k]
            _multiply(rate, inverse, product)
            for row in range(3):
                tool[1, order, k, row] = 2.0 * product[row + 1]
    return changes, tool
