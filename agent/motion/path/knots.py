"""How finely a move is cut into cells."""

from __future__ import annotations

import numpy as np

from agent.motion.fly_parameters import FlyParameters
from agent.motion.path.segments import Arc, CartesianSegment, JointSegment, Segment, WristSegment

#: Largest turn of the orientation, of an arc or of a joint between two knots [rad].
_TURN = 0.04
#: No move is cut into more cells, and none into fewer.
_MOST_CELLS, _FEWEST_CELLS = 4000, 8


def spacing(segment: Segment, parameters: FlyParameters) -> float:
    """Largest step of s between knots of one move."""
    if isinstance(segment, JointSegment):
        turns = float(np.max(np.abs(segment.end - segment.start))) / _TURN
    else:
        turns = segment.extent / parameters.spacing
        if isinstance(segment.curve, Arc):
            turns = max(turns, segment.curve.angle / _TURN)
        if isinstance(segment, CartesianSegment):
            turns = max(turns, segment.angle / _TURN)
        elif isinstance(segment, WristSegment):
            turns = max(turns, float(np.max(np.abs(segment.end - segment.start))) / _TURN)
    return segment.metric / min(max(turns, _FEWEST_CELLS), _MOST_CELLS)


def cells(length: float, first: float | None, last: float | None, largest: float) -> np.ndarray:
    """Points from 0 to `length`, at most `largest` apart, growing from the cells that blends end with.

    Neighbouring cells of very different size would make the spline through the knots ring.
    """
    if length < 1e-12:
        return np.zeros(1)
    left, right = [], []
    a, b = first or largest, last or largest
    rest = length
    while rest > 0 and min(a, b) < largest:
        if a <= b:
            left.append(a)
            rest -= a
            a = min(1.5 * a, largest)
        else:
            right.append(b)
            rest -= b
            b = min(1.5 * b, largest)
    middle = max(int(np.ceil(rest / largest)), 0)
    sizes = np.array([*left, *([rest / max(middle, 1)] * middle), *right[::-1]])
    points = np.concatenate(([0.0], np.cumsum(sizes)))
    return points * (length / points[-1])
