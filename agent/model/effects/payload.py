"""Mass at the flange that the model does not have, or has and the arm has not."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import BELOW_ZERO, Columns, Effect, FitContext, Joints, Numbers
from agent.model.effects.experiments import POSTURES
from agent.model.effects.simulator_numbers import FileNumbers, SimulatorNumbers
from agent.robot import ParameterLayout

_ROUNDS = 6  # numerical: of Gauss and Newton
_START = ("m0", "hx0", "hy0", "hz0")
_POINT = "point_mass"  # in settings without an inertia of its own
_USUAL = (20.0, 5.0, 0.5, 2.0)  # kg, kg·m, kg·m² of a ball's own and of a link's inertia: standard deviations of a load
_LEAST_RADIUS = 0.05  # m of an inertia m r²
_LEAST_MASS = 0.01  # numerical: kg, as forms divide by it
_BALL = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0])


class Payload(Effect):
    """A ball of mass m at c: columns of the last link for m, h = m c, and I = (hᵀh E − h hᵀ) / m + i E.

    I is homogeneous of degree one in (m, h), so with its derivatives at (m₀, h₀) the torque is exactly linear there;
    (m₀, h₀) start from a fit of all ten parameters of the last link and settle in a few rounds (Gauss-Newton). A point
    with i = 0 is compared too where i is not clearly above zero: noise, and torque that is scaled wrongly, take it
    below. A load that was taken off is the same with every sign changed.
    """

    name = "payload"
    family = "load"
    scope = "arm"
    formula = "Y_n · (m, m c, I(m, c)), a ball on the last link"
    source = "Atkeson, An, Hollerbach, Int. J. Robotics Research 5 (1986): loads"
    signature = "residual of weight and inertia on all joints, as of a mass at the flange"
    confused_with = ("inertial_mismatch", "base_tilt")
    phrase = "the flange carries another mass than in the model"
    look_at = "what hangs on the flange or was taken off it: tool, part, mass entered in the controller"
    units = MappingProxyType({"mass": "kg", "moment": "kg·m", "inertia": "kg·m²"})
    leading = ("mass",)
    shapes = ("mass",)
    experiment = POSTURES
    residual_driven = True
    not_reported = (*_START, _POINT)
    numbers = FileNumbers.LOAD
    nonlinear = ()

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        start: dict[str, float] = {}
        for _ in range(_ROUNDS):
            values = context.fit(self, joints, start)
            if not abs(values[0]) > _LEAST_MASS:
                return []
            start = dict(zip(_START, map(float, values[:4]), strict=True))
        physical = self._own(dict(zip(self.names(start), values, strict=True))) > BELOW_ZERO
        return [start] if physical else [start, {**start, _POINT: 1.0}]

    def names(self, settings: Numbers) -> tuple[str, ...]:
        first = ("mass", "moment_x", "moment_y", "moment_z")
        if _POINT in settings:
            return first
        more = ("inertia",) if "m0" in settings else tuple(f"inertia_{k}" for k in ("xx", "xy", "yy", "xz", "yz", "zz"))
        return (*first, *more)

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        return _of_ball(_last_link(signals, signals.standard), settings)

    def filtered(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        link = signals.remembered(self.name, lambda: signals.low_pass(_last_link(signals, signals.regressor())))
        return _of_ball(link, settings)

    def prior_precision(self, context: FitContext, joints: Joints, settings: Numbers) -> np.ndarray | None:
        mass, moment, own_inertia, link_inertia = _USUAL
        usual = {"mass": mass, "moment": moment, "inertia": own_inertia if settings else link_inertia}
        return np.diag([usual[name.split("_")[0]] ** -2.0 for name in self.names(settings)])

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        moment = np.array([values["moment_x"], values["moment_y"], values["moment_z"]])
        mass = abs(values["mass"])
        return mass > _LEAST_MASS and float(np.linalg.norm(moment)) < mass and self._own(values) > -BELOW_ZERO

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers:
        added = np.array([values[name] for name in self.names(values)])
        return SimulatorNumbers(body=(load_link, np.asarray(ball(values) @ added if "m0" in values else added)))

    @staticmethod
    def _own(values: Numbers) -> float:
        """A ball's own inertia, counted as its mass is, over that of its mass at the distance of its centre."""
        mass, *moment = (values[name] for name in ("mass", "moment_x", "moment_y", "moment_z"))
        radius = max(float(np.linalg.norm(moment)) / abs(mass), _LEAST_RADIUS)
        return values.get("inertia", 0.0) / mass / radius**2


def _last_link(signals: MotionSignals, regressor: np.ndarray) -> np.ndarray:
    """(S, 10 n) torque of each joint per unit of each parameter of the link that carries it."""
    robot = signals.reference.robot
    return regressor[:, :, ParameterLayout.of(robot).link(robot.load_link)].reshape(len(signals.time), -1)


def _of_ball(link: np.ndarray, settings: Numbers) -> Columns:
    change = ball(settings) if settings else np.eye(10)
    return {j: part @ change for j, part in enumerate(np.split(link, link.shape[1] // len(change), axis=1))}


def _voigt(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(6,) aᵀb E − a bᵀ as Ixx, Ixy, Iyy, Ixz, Iyz, Izz, symmetric part."""
    tensor = a @ b * np.eye(3) - 0.5 * (np.outer(a, b) + np.outer(b, a))
    return tensor[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]


def ball(settings: Numbers) -> np.ndarray:
    """(10, 5) parameters of a link per unit of a ball's mass, first moments and own inertia, about (m0, h0); (10, 4) of
    a point's."""
    m, h = settings["m0"], np.array([settings["hx0"], settings["hy0"], settings["hz0"]])
    change = np.zeros((10, 5))
    change[:4, :4] = np.eye(4)
    change[4:, 0] = -_voigt(h, h) / m**2
    for axis, unit in enumerate(np.eye(3)):
        change[4:, 1 + axis] = (_voigt(unit, h) + _voigt(h, unit)) / m
    change[4:, 4] = _BALL
    return change[:, :4] if _POINT in settings else change
