"""Hose or cable that bends with the joint."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial import Polynomial

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import (
    BENDS,
    REVERSAL_TRAVELS,
    STRONGEST,
    Columns,
    Effect,
    FitContext,
    Joints,
    Numbers,
)
from agent.model.effects.experiments import WHOLE_RANGE
from agent.model.effects.simulator_numbers import SimulatorNumbers, linear_spring
from agent.model.friction_terms import dahl
from agent.model.passive_forces import Bristles, PassiveForces, spring_near, spring_of

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from scipy.interpolate import CubicSpline

N_NODES = 6  # knots of its torque over position; chosen: a hose bends a few times over the range of a joint
_BEND = 0.1  # nominal torque: usual deviation from a straight line at a node


class DressPack(Effect):
    """τ = a + b x (+ c x² + e x³), or a curve through torques at N_NODES positions; with hysteresis d z(q) (Dahl's z).

    The curve is a natural cubic spline over the travelled range `low` to `high`, straight beyond it, because a hose may
    be slack up to some angle, harden, or give way. A prior on its bends keeps it straight where no motion shows it. The
    cubic extrapolates a hose that hardens; its x is q from the `middle` of the range, which is `reach` to both sides.
    """

    name = "dress_pack"
    family = "load"
    stepped = "joint_dress_pack"
    formula = "a + b · x (+ c · x² + e · x³) + d · z(q), or curve(q) + d · z(q)"
    source = "hose as a spring with inner friction (Dahl, AIAA J. 14, 1976); natural splines (de Boor, 1978)"
    signature = "residual that depends on the joint's own position, without the shape of gravity"
    confused_with = ("gravity_spring", "torque_offset", "friction_change")
    structurally_equivalent = ("gravity_spring", "torque_offset")
    phrase = "a hose or cable pulls at the joint"
    look_at = "hoses and cables at this joint: stiff, caught or too short"
    units = MappingProxyType(
        {
            **dict.fromkeys(("constant", "torque", "hysteresis"), "N·m"),
            **{"stiffness": "N·m/rad", "quadratic": "N·m/rad²", "cubic": "N·m/rad³"},
            **dict.fromkeys(("travel", "low", "high", "middle", "reach"), "rad"),
        }
    )
    leading = ("stiffness", "constant", "hysteresis")
    needs_travel = BENDS
    shapes = ("position",)
    experiment = WHOLE_RANGE
    refined = ("travel",)
    nonlinear = ()

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        low = float(min(s.q[:, joints[0]].min() for s in context.signals))
        high = max(float(max(s.q[:, joints[0]].max() for s in context.signals)), low + 1e-9)
        curve, rubbing = (
            {"low": low, "high": high},
            [{"travel": share * (high - low)} for share in REVERSAL_TRAVELS[3::4]],
        )
        shapes: list[dict[str, float]] = [{}, {"middle": (low + high) / 2, "reach": (high - low) / 2}, curve]
        return [{**shape, **kind} for shape in shapes for kind in ({}, *rubbing)]

    def names(self, settings: Numbers) -> tuple[str, ...]:
        nodes = tuple(f"torque_{k}" for k in range(N_NODES)) if "low" in settings else self._straight(settings)
        return (*nodes, "hysteresis") if "travel" in settings else nodes

    def _straight(self, settings: Numbers) -> tuple[str, ...]:
        """Coefficients by ascending power."""
        return ("constant", "stiffness", *(("quadratic", "cubic") if "middle" in settings else ()))

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return values.get("hysteresis", 0.0) >= 0

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        q = signals.q[:, joints[0]]
        if "low" in settings:
            low, high = settings["low"], settings["high"]
            parts = signals.remembered(("curve", joints[0], low, high), lambda: _curve(q, low, high))
        else:
            x = q - settings.get("middle", 0.0)
            parts = [x**power for power, _ in enumerate(self._straight(settings))]
        if "travel" in settings:
            parts = [*parts, dahl(q, np.array([settings["travel"]]))[:, 0]]
        return {joints[0]: np.column_stack(parts)}

    def prior_precision(self, context: FitContext, joints: Joints, settings: Numbers) -> np.ndarray | None:
        """A curve bends by about a tenth of the joint's nominal torque at each node."""
        if "low" not in settings:
            return None
        bends = np.diff(np.eye(N_NODES), 2, axis=0) / (_BEND * float(context.reference.scale[joints[0]]))
        precision = np.zeros((len(self.names(settings)),) * 2)
        precision[:N_NODES, :N_NODES] = bends.T @ bends
        return precision

    def possible(self, reference: NominalModel, joints: Joints, settings: Numbers, values: Numbers) -> bool:
        falling = [abs(values.get(name, 0.0)) for name in ("cubic", "quadratic", "stiffness", "constant")]
        steepest = float(np.polyval(np.polyder(falling), settings.get("reach", 0.0)))
        return steepest < STRONGEST * float(reference.scale[joints[0]])

    def stepped_parameters(self, values: Numbers, inertia: Sequence[float]) -> dict[str, Any] | None:
        """A curve as the powers of its pieces."""
        if "low" not in values:
            return super().stepped_parameters(values, inertia)
        curve = _spline([values[f"torque_{k}"] for k in range(N_NODES)], values["low"], values["high"])
        rubbing = {key: values[key] for key in ("travel", "hysteresis") if key in values}
        return {**rubbing, "nodes": curve.x.tolist(), "curve": curve.c[::-1].tolist()}

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers | None:
        return linear_spring(values)

    def passive_forces(self, values: Numbers, fastest: float) -> PassiveForces:
        """Of a curve, the cubic next to it over the travelled range."""
        if "low" in values:
            low, high = values["low"], values["high"]
            nodes = [values[f"torque_{k}"] for k in range(N_NODES)]
            spring = spring_near(lambda q: np.column_stack(_curve(q, low, high)) @ nodes, low, high)
        else:
            powers = [values.get(key, 0.0) for key in ("constant", "stiffness", "quadratic", "cubic")]
            spring = spring_of(Polynomial(powers)(Polynomial([-values.get("middle", 0.0), 1.0])))
        rubbing = (
            Bristles(level=values["hysteresis"], travel=values["travel"], additional=True)
            if "travel" in values
            else None
        )
        return PassiveForces(spring=spring, bristles=rubbing)


def _spline(torque: ArrayLike, low: float, high: float) -> CubicSpline:
    from scipy.interpolate import CubicSpline  # slow to load

    return CubicSpline(np.linspace(low, high, N_NODES), torque, bc_type="natural")


def _curve(q: np.ndarray, low: float, high: float) -> list[np.ndarray]:
    """(S,) per node: the natural spline that is 1 at this node and 0 at the others, and goes on straight."""
    spline = _spline(np.eye(N_NODES), low, high)
    inside = np.clip(q, low, high)
    return list((spline(inside) + (q - inside)[:, None] * spline(inside, 1)).T)
