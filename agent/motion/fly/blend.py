"""FLY corners: the end of one move and the start of the next, superposed.

Over the blend's own parameter τ in [0, 1] the first move runs out, dσ₁/dτ = 2 e₁ (1 − h(τ)), while the second runs in,
dσ₂/dτ = 2 e₂ h(τ), with e the part of the move given to the blend and h a polynomial step. What is blended is the sum

    p = p₁(σ₁) + p₂(σ₂) − p_corner,   R = R₁(σ₁) R_cornerᵀ R₂(σ₂),   q = q₁(σ₁) + q₂(σ₂) − q_corner

so one law serves lines, arcs, orientations and joints. Because h and h' of a polynomial vanish at τ = 0 and h' at
τ = 1, its path is curvature-continuous. With h = τ two lines are joined by a parabola, with h ∝ sin θτ by the circle
that touches both, θ the angle between them: what other controllers do. Nothing here knows about speed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from agent.compiled import quaternion_products
from agent.motion import rotation
from agent.motion.fly.fly_parameters import SPACING, FlyParameters
from agent.motion.fly.move_geometry import CartesianSegment, JointSegment, Line, Segment
from agent.motion.path_settings import FlyTrajectory, FlyType, PathSettings

_CELLS, _MOST_CELLS = 24, 256
#: [m] Blends smaller than this are stops.
_SMALLEST = 1e-4
#: [rad] A circle through less is a parabola.
_STRAIGHT = 1e-3
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True)
class BlendStep:
    """The step h of a blend: polynomial (cubic, quintic or a mixture, `shape` 0..1), `parabola`, or `circle`.

    `angle` [rad] by which the way turns, of a circle. `turn`: the orientation goes by the same step (`path`), or by
    `slerp` from one move's to the other's, each run on beyond the blend.
    """

    shape: float = 0.0
    family: str = "polynomial"
    angle: float = 1.0
    turn: str = "path"

    def value(self, tau: np.ndarray) -> np.ndarray:
        """h(τ)"""
        if self.family == "parabola":
            return tau
        if self.family == "circle":
            return 0.5 * self.angle * np.sin(self.angle * tau) / (1.0 - np.cos(self.angle))
        cubic = tau * tau * (3.0 - 2.0 * tau)
        quintic = tau**3 * (10.0 + tau * (6.0 * tau - 15.0))
        return (1.0 - self.shape) * cubic + self.shape * quintic

    def integral(self, tau: np.ndarray) -> np.ndarray:
        """∫h from 0 to τ; one half at τ = 1."""
        if self.family == "parabola":
            return 0.5 * tau * tau
        if self.family == "circle":
            return 0.5 * (1.0 - np.cos(self.angle * tau)) / (1.0 - np.cos(self.angle))
        cubic = tau**3 * (1.0 - 0.5 * tau)
        quintic = tau**4 * (2.5 + tau * (tau - 3.0))
        return (1.0 - self.shape) * cubic + self.shape * quintic

    def sigma(self, tau: np.ndarray, out: float, into: float) -> tuple[np.ndarray, np.ndarray]:
        """Parameters at τ of the moves before and after, of which the blend takes the parts e₁ and e₂, at most ½."""
        leaving = self.integral(1.0 - tau)
        return 1.0 - 2.0 * out * leaving, 2.0 * into * self.integral(tau)

    def rate(self, tau: np.ndarray, out: float, into: float) -> tuple[np.ndarray, np.ndarray]:
        """Their derivatives by τ."""
        return 2.0 * out * self.value(1.0 - tau), 2.0 * into * self.value(tau)


@dataclass(frozen=True, eq=False)
class Corner:
    """A blend in joint space between two moves, one of which prescribes the joints, and how finely it is sampled.

    `out` and `into` are the parts e₁ and e₂ (at most ½) that it takes of them. `through` passes the point (FLY_PASS),
    `overlap` lets the speed dip as the superposed moves do (FLY_NORM). `allowed` [m] is $FLY_DIST where it bounds.
    """

    before: Segment
    after: Segment
    out: float
    into: float
    through: bool
    overlap: bool
    cells: int
    step: BlendStep
    allowed: float

    def deviation(self) -> float:
        """[m] by which the path is away from the corner point, as far as that is known before it is built."""
        return 0.0

    def tau(self) -> np.ndarray:
        """(cells + 1,) samples of the blend's parameter."""
        return _tau(self.cells)

    def sigma(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Parameters of the move before and the move after."""
        return self.step.sigma(tau, self.out, self.into)

    def moves(self, tau: np.ndarray) -> np.ndarray:
        """(S,) statement that a sample belongs to: in the first half that of the move before."""
        return np.where(tau < 0.5, self.before.move, self.after.move)

    def scaled(self, factor: float) -> Corner:
        """The same blend, smaller."""
        return replace(self, out=factor * self.out, into=factor * self.into)

    def refined(self, fineness: float) -> Corner:
        """The same blend, sampled finer by a factor."""
        return replace(self, cells=2 * round(0.5 * fineness * self.cells))


@dataclass(frozen=True, eq=False)
class CartesianCorner(Corner):
    """A blend between two moves that prescribe the TCP's path and orientation."""

    before: CartesianSegment
    after: CartesianSegment

    def deviation(self) -> float:
        """[m] of the path from the corner point, or for FLY_PASS of the path from the two moves."""
        before, after = self.before.curve, self.after.curve
        if self._legs is not None:
            sides = self.into * self._legs[1] - self.out * self._legs[0]
            return 2.0 * float(self.step.integral(np.array(0.5))) * rotation.length(sides)
        samples = np.linspace(0.0, 1.0, 33)
        points = self._position(samples, *self.sigma(samples))
        if not self.through:
            return float(np.min(np.linalg.norm(points - before.position(np.ones(1)), axis=1)))
        fine = np.linspace(0.0, 1.0, 65)
        sides = np.concatenate((before.position(1.0 - 1.2 * self.out * fine), after.position(1.2 * self.into * fine)))
        return float(np.max(np.min(np.linalg.norm(points[:, None] - sides[None], axis=2), axis=1)))

    def poses(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Position (S, 3) [m] and orientation (S, 4) in the blend, and the straight ways in joint space (S, n); None
        where the pose alone says what the joints are."""
        sigma_one, sigma_two = self.sigma(tau)
        orientation = self._turned(tau, sigma_one, sigma_two)
        if self.through:
            at_corner, half = self.after.turn.orientation(np.zeros(1)), np.array([0.5])
            missing = rotation.multiply(at_corner, rotation.conjugate(self._turned(half, *self.sigma(half))))[0]
            pull = rotation.from_rotation_vector(bump(tau)[:, None] * rotation.rotation_vector(missing))
            orientation = rotation.multiply(pull, orientation)
        leaving, arriving, near_joints = self.before.near(sigma_one), self.after.near(sigma_two), None
        if leaving is not None and arriving is not None and self.after.ends is not None:
            near_joints = leaving + arriving - self.after.ends[0]
        return self._position(tau, sigma_one, sigma_two), orientation, near_joints

    def lengths(self) -> tuple[np.ndarray, np.ndarray]:
        """Lengths of its cells (cells,) [m], and at `tau` how far the two moves add up (cells + 1,), 0..1."""
        tau, (nodes, cells) = self.tau(), _nodes(self.cells)
        if self.step.family == "parabola":
            # It is run through at a constant rate of τ: one acceleration from the one velocity to the other.
            along, apart = self._rates(tau)
            distance = self.out * self.before.extent + self.into * self.after.extent
            return distance * cells, np.minimum(along / apart, 1.0)
        along, apart = self._rates(np.concatenate((nodes, tau)))
        lengths = (along[: len(nodes)].reshape(-1, 3) @ _WEIGHTS) * 0.5 * cells
        return lengths, np.minimum(along[len(nodes) :] / apart[len(nodes) :], 1.0)

    @cached_property
    def _legs(self) -> tuple[np.ndarray, np.ndarray] | None:
        """(3,) [m] of both moves where their sum alone is the blend; else None."""
        before, after = self.before.curve, self.after.curve
        if self.through or not isinstance(before, Line) or not isinstance(after, Line):
            return None
        return before.way, after.way

    def _pull(self) -> np.ndarray:
        sigma_one, sigma_two = self.sigma(np.array([0.5]))
        point = self.after.curve.position(np.zeros(1))
        return 2.0 * point - self.before.curve.position(sigma_one) - self.after.curve.position(sigma_two)

    def _position(self, tau: np.ndarray, sigma_one: np.ndarray, sigma_two: np.ndarray) -> np.ndarray:
        """(S, 3) at parameters of the move before and the move after."""
        point = self.after.curve.position(np.zeros(1))
        positions = self.before.curve.position(sigma_one) + self.after.curve.position(sigma_two) - point
        return positions + bump(tau)[:, None] * self._pull() if self.through else positions

    def _turned(self, tau: np.ndarray, sigma_one: np.ndarray, sigma_two: np.ndarray) -> np.ndarray:
        """(S, 4) the orientation there, not yet pulled through the point."""
        before, after = self.before.turn, self.after.turn
        if self.step.turn == "slerp":
            # At both ends the rate is that of the step h.
            u = tau + (float(self.step.value(np.ones(1))[0]) - 1.0) * tau * (1.0 - tau) * (1.0 - 2.0 * tau)
            leaving = before.orientation(1.0 - self.out * (1.0 - u))
            between = rotation.multiply(rotation.conjugate(leaving), after.orientation(self.into * u))
            vectors = np.stack([rotation.rotation_vector(quaternion) for quaternion in between])
            return rotation.multiply(leaving, rotation.from_rotation_vector(u[:, None] * vectors))
        at_corner = after.orientation(np.zeros(1))
        return quaternion_products(
            before.orientation(sigma_one),
            quaternion_products(rotation.conjugate(at_corner), after.orientation(sigma_two)),
        )

    def _rates(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """ds/dτ (S,) of the blend, and of its two moves one after the other."""
        before, after = self.before, self.after
        rate_one, rate_two = self.step.rate(tau, self.out, self.into)
        if self._legs is not None:
            a, b = self._legs
            squares = rate_one * (rate_one * (a @ a) + rate_two * (2.0 * (a @ b))) + rate_two**2 * (b @ b)
        else:
            sigma_one, sigma_two = self.sigma(tau)
            velocity = rate_one[:, None] * before.curve.derivative(sigma_one)
            velocity = velocity + rate_two[:, None] * after.curve.derivative(sigma_two)
            if self.through:
                velocity = velocity + (192.0 * (tau * (1.0 - tau)) ** 2 * (1.0 - 2.0 * tau))[:, None] * self._pull()
            squares = np.einsum("si,si->s", velocity, velocity)
        turned = before.turning * rate_one + after.turning * rate_two
        return np.sqrt(np.maximum(squares, 0.0) + turned**2), before.extent * rate_one + after.extent * rate_two


@lru_cache(maxsize=1000)
def _tau(cells: int) -> np.ndarray:
    return np.linspace(0.0, 1.0, cells + 1)


def bump(tau: np.ndarray) -> np.ndarray:
    """1 in the middle of a blend, 0 with two derivatives at its ends: what pulls a FLY_PASS blend through the point."""
    return 64.0 * (tau * (1.0 - tau)) ** 3


def corner_between(before: Segment, after: Segment, parameters: FlyParameters) -> Corner | None:
    """The FLY corner at the end of `before`, or None where the arm has to stop.

    It stops where the path turns back on itself, where the tool changes, and where no blend worth the name is left.
    A joint-space blend is measured only once it is built (`path.build_path`), and may then be `scaled` down.
    """
    settings = before.settings
    if before.kinematics is not after.kinematics:
        return None
    half = 0.5 * min(before.extent, after.extent)
    overlap = settings.fly_type is FlyType.FLY_NORM
    through = settings.fly_trajectory is FlyTrajectory.FLY_PASS
    kind: type[Corner] = Corner
    right_angle = 0.5 * np.pi
    if isinstance(before, CartesianSegment) and isinstance(after, CartesianSegment):
        kind, right_angle = CartesianCorner, _deflection(before, after)
    family = "parabola" if parameters.blend == "circle" and right_angle < _STRAIGHT else parameters.blend
    step = BlendStep(parameters.blend_shape, family, right_angle, parameters.blend_turn)
    if right_angle > parameters.stop_angle:
        return None
    size = min(half, _reach(settings, half, before, parameters))
    fineness = max(1.0, 0.5 / np.cos(0.5 * right_angle), 2.0 * size / SPACING / _CELLS)
    cells = 2 * int(min(_MOST_CELLS, _CELLS * fineness) / 2)

    allowed = settings.fly_distance if through or settings.fly_trajectory is FlyTrajectory.FLY_TOL else np.inf

    def sized(size: float) -> Corner:
        out, into = size / before.extent, size / after.extent
        return kind(before, after, out, into, through, overlap, cells, step, allowed)

    if kind is Corner:
        # Where directions are not known before the arm's joints are: the widest the sum of two moves can be.
        size = min(size, allowed / (4.0 * float(step.integral(np.array(0.5)))))
    corner = sized(size)
    for _ in range(12):
        deviation = corner.deviation()
        if deviation <= allowed * (1.0 + 1e-9):
            break
        size *= 0.9999 * allowed / deviation
        corner = sized(size)
    return corner if size >= _SMALLEST else None


def _reach(settings: PathSettings, half: float, before: Segment, parameters: FlyParameters) -> float:
    """[m] how far before the corner the blend may start, by $FLY_TYPE and $FLY_TRAJ."""
    if settings.fly_trajectory is FlyTrajectory.FLY_FROM:
        size = settings.fly_distance
    elif settings.fly_trajectory is FlyTrajectory.FLY_AUTO:
        size = half * (1.0 - parameters.auto_tightness * settings.stress_percent / 100.0)
    else:
        size = half
    if settings.fly_type is FlyType.FLY_NORM:
        speed = settings.linear_speed * settings.speed_override * settings.arm_override
        if isinstance(before, JointSegment):
            speed = 2.0 * half * settings.speed_override * settings.arm_override
        size = min(size, settings.fly_percent / 100.0 * speed**2 / (2.0 * parameters.norm_acceleration))
    return size


def _deflection(before: CartesianSegment, after: CartesianSegment) -> float:
    incoming, outgoing = before.curve.directions()[1], after.curve.directions()[0]
    sizes = rotation.length(incoming) * rotation.length(outgoing)
    if sizes < 1e-12:
        return 0.0
    return float(np.arccos(min(max(incoming.dot(outgoing) / sizes, -1.0), 1.0)))


@lru_cache(maxsize=1000)
def _nodes(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (3 cells,) at which a blend is integrated, and the sizes of its cells (cells,)."""
    tau = np.linspace(0.0, 1.0, cells + 1)
    sizes = np.diff(tau)
    return (tau[:-1, None] + sizes[:, None] * 0.5 * (1.0 + _NODES)).ravel(), sizes
