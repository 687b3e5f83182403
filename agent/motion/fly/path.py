"""The path of the arm between two standstills, on a grid of knots: geometry only, no speed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.motion import rotation
from agent.motion.fly.blend import CartesianCorner, Corner, bump
from agent.motion.fly.fly_parameters import SPACING, FlyParameters
from agent.motion.fly.move_geometry import Arc, CartesianSegment, JointSegment, Segment, label_of
from agent.motion.fly.rules import path_rules
from agent.motion.interpolator import MotionError
from agent.robot import KinematicsError

#: Largest turn of the orientation, of an arc or of a joint between two knots [rad].
_TURN = 0.04
#: No move is cut into more cells, and none into fewer.
_MOST_CELLS, _FEWEST_CELLS = 4000, 8
_LIMITS = {"unreachable": "reach", "singular": "singularity", "branch": "branch"}


@dataclass(frozen=True, eq=False)
class Path:
    """K knots of one run. `s` is the length of the TCP's path [m] wherever the TCP travels.

    s (K,); q (K, n); position (K, 3) [m] and orientation (K, 4) of the TCP; move (K,) statement index;
    rules (K, 7) as in `path_rules`; overlap (K,) the part of the speed that FLY_NORM leaves, 1 elsewhere;
    block (K,): the k-th move of the run (2k), or the corner after it (2k + 1), whose cell ends at a knot.
    deviations: by corner, how many times $FLY_DIST a joint-space blend is away from it (0 for other blends).
    """

    s: np.ndarray
    q: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    move: np.ndarray
    rules: np.ndarray
    overlap: np.ndarray
    block: np.ndarray
    deviations: tuple[float, ...]

    @property
    def borders(self) -> np.ndarray:
        """(B + 1,) knots at which blocks begin, and the last one."""
        return np.concatenate(([0], 1 + np.flatnonzero(np.diff(self.block[1:])), [len(self.s) - 1]))


@dataclass(eq=False)
class _PathPart:
    """Consecutive knots: `steps` (k,) of s, each from the knot before, and what is known of them."""

    block: np.ndarray
    steps: np.ndarray
    move: np.ndarray
    overlap: np.ndarray
    position: np.ndarray | None = None
    orientation: np.ndarray | None = None
    q: np.ndarray | None = None
    near: np.ndarray | None = None


def build_path(
    segments: Sequence[Segment],
    corners: Sequence[Corner],
    start: np.ndarray,
    speeds: np.ndarray,
    parameters: FlyParameters,
    fineness: float = 1.0,
) -> Path:
    """The path over `segments` blended at `corners` (one fewer), from `start` (n,) at standstill to standstill.

    `speeds` (n,) are the joint speed limits; `fineness` multiplies the number of knots.

    Raises:
        MotionError: out of reach, through a singularity, or not on one branch of the arm.
    """
    corners = [corner.refined(fineness) for corner in corners]
    stretches: list[_PathPart] = []
    deviations = [0.0] * len(corners)
    q, first = np.asarray(start, dtype=float), 0
    running_out = q[None]
    while first < len(segments):
        last = first
        while last < len(corners) and isinstance(corners[last], CartesianCorner):
            last += 1
        lead = corners[first - 1] if first > 0 else None
        trail = corners[last] if last < len(corners) else None
        unit = segments[first : last + 1]
        body = _body(unit, corners[first:last], lead, trail, fineness, first)
        head, tail = _solve(unit, body, lead, trail, q)
        if lead is not None:
            stretches.append(_joint_corner(2 * first - 1, lead, running_out, head, speeds))
            deviations[first - 1] = _deviation(lead, running_out, head, stretches[-1])
            body[0].steps[0] = stretches[-1].steps[-1]
            stretches[-1].steps = stretches[-1].steps[:-1]
        stretches += body
        running_out = tail
        q, first = tail[-1], last + 1
    return _assemble(stretches, segments[0], path_rules(segments, parameters), tuple(deviations))


def motion_error(error: KinematicsError, move: int, label: str) -> MotionError:
    """A refusal of the kinematics, as the fault of one move."""
    # The kinematics counts samples of the path, which the reader of the message never sees.
    text = re.sub(r"between poses \d+ and \d+, | \(pose \d+\)", "", str(error))
    text = re.sub(r"\bpose \d+ at", "the point at", text)
    return MotionError(f"{label}: {text}", move, _LIMITS.get(error.reason, error.reason), error.excess)


def solve_cartesian(
    segments: Sequence[Segment],
    move: np.ndarray,
    position: np.ndarray,
    orientation: np.ndarray,
    start: np.ndarray,
    near: np.ndarray | None = None,
) -> np.ndarray:
    """(S, n) joints along TCP positions (S, 3) and orientations (S, 4) from `start` (n,) on.

    `move` (S,) is the statement of each sample. A redundant arm takes the joints nearest to `near` (S, n).

    Raises:
        MotionError: out of reach, singular, or leaving the branch of `start`.
    """
    try:
        return segments[0].kinematics.follow(rotation.to_pose(position, orientation), start, near)
    except KinematicsError as error:
        culprit = int(move[min(error.index, len(move) - 1)])
        raise motion_error(error, culprit, label_of(segments, culprit)) from None


def _body(
    unit: Sequence[Segment],
    inner: Sequence[Corner],
    lead: Corner | None,
    trail: Corner | None,
    fineness: float,
    first: int,
) -> list[_PathPart]:
    """Knots of the moves of one unit outside joint-space corners; the first stretch has the first knot, step 0."""
    corners = (lead, *inner, trail)
    body: list[_PathPart] = []
    for k, segment in enumerate(unit):
        before, after = corners[k], corners[k + 1]
        begin = 0.0 if before is None else before.into
        end = 1.0 if after is None else 1.0 - after.out
        edges = [
            None if corner is None else 2.0 * part * segment.metric / corner.cells
            for corner, part in ((before, begin), (after, 1.0 - end))
        ]
        travel = _cells((end - begin) * segment.metric, edges[0], edges[1], _spacing(segment) / fineness)
        skip = 0 if k == 0 else 1
        sigma, steps = (begin + travel / segment.metric)[skip:], np.diff(travel, prepend=travel[:1] if k == 0 else [])
        body.append(_on_segment(2 * (first + k), segment, sigma, steps))
        body += [
            _on_corner(2 * (first + k) + 1, corner)
            for corner in inner[k : k + 1]
            if isinstance(corner, CartesianCorner)
        ]
    return body


def _on_segment(block: int, segment: Segment, sigma: np.ndarray, steps: np.ndarray) -> _PathPart:
    count = len(sigma)
    stretch = _PathPart(np.full(count, block), steps, np.full(count, segment.move), np.ones(count))
    if isinstance(segment, JointSegment):
        stretch.q = segment.start + sigma[:, None] * (segment.end - segment.start)
    else:
        stretch.position = segment.curve.position(sigma)
        stretch.orientation = segment.turn.orientation(sigma)
        stretch.near = segment.near(sigma)
    return stretch


def _on_corner(block: int, corner: CartesianCorner) -> _PathPart:
    tau = corner.tau()[1:]
    lengths, along = corner.lengths()
    position, orientation, near_joints = corner.poses(tau)
    return _PathPart(
        np.full(corner.cells, block),
        lengths,
        corner.moves(tau),
        along[1:] if corner.overlap else np.ones(corner.cells),
        position,
        orientation,
        near=near_joints,
    )


def _solve(
    unit: Sequence[Segment], body: list[_PathPart], lead: Corner | None, trail: Corner | None, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the joints of a unit from `start` (n,): those on the way in (lead.cells + 1, n) and on the way out."""
    into = np.empty(0) if lead is None else lead.sigma(lead.tau())[1][:-1]
    out = np.empty(0) if trail is None else trail.sigma(trail.tau())[0][1:]
    stretches = list(body)
    if lead is not None:
        stretches.insert(0, _on_segment(-1, unit[0], into, into))
    if trail is not None:
        stretches.append(_on_segment(-1, unit[-1], out, out))
    if isinstance(unit[0], CartesianSegment):
        position, orientation = (
            np.concatenate([getattr(stretch, name) for stretch in stretches]) for name in ("position", "orientation")
        )
        near_joints = None if stretches[0].near is None else np.concatenate([stretch.near for stretch in stretches])
        q = solve_cartesian(
            unit, np.concatenate([stretch.move for stretch in stretches]), position, orientation, start, near_joints
        )
        cuts = np.cumsum([len(stretch.move) for stretch in stretches])[:-1]
        for stretch, part in zip(stretches, np.split(q, cuts), strict=True):
            stretch.q = part
    else:
        q = np.concatenate([stretch.q for stretch in stretches if stretch.q is not None])
    return q[: len(into) + 1], q[len(q) - len(out) - 1 :]


def _joint_corner(
    block: int, corner: Corner, running_out: np.ndarray, running_in: np.ndarray, speeds: np.ndarray
) -> _PathPart:
    """The knots between two units: joints superposed. One step more than knots: the last leads to the next unit."""
    tau = corner.tau()
    at_corner = running_in[0]
    q = running_out + running_in - at_corner
    if corner.through:
        middle = corner.cells // 2
        q = q + bump(tau)[:, None] * (at_corner - q[middle])
    sigma_one, sigma_two = corner.sigma(tau)
    moves = [np.linalg.norm(np.diff(joints, axis=0) / speeds, axis=1) for joints in (q, running_out, running_in)]
    along = np.minimum(moves[0] / np.maximum(moves[1] + moves[2], 1e-300), 1.0)
    count = corner.cells - 1
    return _PathPart(
        np.full(count, block),
        corner.before.metric * np.diff(sigma_one) + corner.after.metric * np.diff(sigma_two),
        corner.moves(tau[1:-1]),
        0.5 * (along[:-1] + along[1:]) if corner.overlap else np.ones(count),
        q=q[1:-1],
    )


def _deviation(corner: Corner, running_out: np.ndarray, running_in: np.ndarray, blend: _PathPart) -> float:
    if not np.isfinite(corner.allowed) or blend.q is None:
        return 0.0
    forward = corner.after.kinematics.forward
    moves, points = forward(np.concatenate((running_out, running_in)))[:, :3, 3], forward(blend.q)[:, :3, 3]
    if corner.through:
        distance = float(np.max(np.min(np.linalg.norm(points[:, None] - moves[None], axis=2), axis=1)))
    else:
        distance = float(np.min(np.linalg.norm(points - moves[len(running_out)], axis=1)))
    return distance / max(corner.allowed, 1e-9)


def _assemble(stretches: list[_PathPart], segment: Segment, rules: np.ndarray, deviations: tuple[float, ...]) -> Path:
    q = np.concatenate([stretch.q for stretch in stretches if stretch.q is not None])
    position, orientation = np.empty((len(q), 3)), np.empty((len(q), 4))
    unknown = np.concatenate([np.full(len(stretch.move), stretch.orientation is None) for stretch in stretches])
    known = [stretch for stretch in stretches if stretch.orientation is not None]
    if known:
        position[~unknown] = np.concatenate([stretch.position for stretch in known])
        orientation[~unknown] = np.concatenate([stretch.orientation for stretch in known])
    if unknown.any():
        poses = segment.kinematics.forward(q[unknown])
        position[unknown] = poses[:, :3, 3]
        orientation[unknown] = rotation.from_matrices(poses[:, :3, :3])
    block = np.concatenate([stretch.block for stretch in stretches])
    return Path(
        np.cumsum(np.concatenate([stretch.steps for stretch in stretches])),
        q,
        position,
        rotation.continuous(orientation),
        np.concatenate([stretch.move for stretch in stretches]),
        rules[block],
        np.concatenate([stretch.overlap for stretch in stretches]),
        block,
        deviations,
    )


def _spacing(segment: Segment) -> float:
    """Largest step of s between knots of one move."""
    if isinstance(segment, JointSegment):
        turns = float(np.max(np.abs(segment.end - segment.start))) / _TURN
    else:
        turns = segment.extent / SPACING
        if isinstance(segment.curve, Arc):
            turns = max(turns, segment.curve.angle / _TURN)
        turns = max(turns, segment.angle / _TURN)
    return segment.metric / min(max(turns, _FEWEST_CELLS), _MOST_CELLS)


def _cells(length: float, first: float | None, last: float | None, largest: float) -> np.ndarray:
    """Points from 0 to `length`, at most `largest` apart, growing from the cells that blends end with.

    Neighbouring cells of very different size would make the spline through the knots ring.
    """
    if length < 1e-12:
        return np.zeros(1)
    left, right = [], []
    a, b = first or largest, last or largest
    remaining = length
    while remaining > 0 and min(a, b) < largest:
        if a <= b:
            left.append(a)
            remaining -= a
            a = min(1.5 * a, largest)
        else:
            right.append(b)
            remaining -= b
            b = min(1.5 * b, largest)
    middle = max(int(np.ceil(remaining / largest)), 0)
    sizes = np.array([*left, *([remaining / max(middle, 1)] * middle), *right[::-1]])
    points = np.concatenate(([0.0], np.cumsum(sizes)))
    return points * (length / points[-1])
