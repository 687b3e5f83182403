"""Effects that make the machine another one: what it carries, what its links weigh, how it stands, how it is geared."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from agent.robot import Dynamics, Tool
from fake_controller.actuation.effect import ArmEffect, SimulatedEffect, effect
from fake_controller.actuation.machine import Machine

_SECOND_MOMENTS = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0])


@effect("payload")
class SimulatedPayload(ArmEffect):
    """A ball of `mass` [kg] and `radius` [m] at `centre` (3,) [m] of the tip frame."""

    usual = staticmethod(lambda d: {"mass": 3 * d.size, "centre": [*d.uniform(-0.05, 0.05, 2), d.uniform(0.02, 0.2)]})
    POSITIVE = ("mass",)
    mass: Annotated[float, "kg"]
    centre: Annotated[tuple[float, ...], "m"] = (0.0, 0.0, 0.1)
    radius: Annotated[float, "m"] = 0.08

    def build_into(self, machine: Machine) -> None:
        self.need(len(self.centre) == 3, "centre", "three numbers")
        point = Tool(np.eye(4), self.mass, np.array(self.centre))
        machine.parameters += Dynamics(machine.robot, point).standard_parameters()
        machine.parameters -= Dynamics(machine.robot).standard_parameters()
        machine.parameters[-10:] += 0.4 * self.mass * self.radius**2 * _SECOND_MOMENTS


@effect("inertial_mismatch")
class SimulatedInertialMismatch(ArmEffect):
    """Link number `link` (from 1) is `scale` times as dense and has `points` ((mass, x, y, z), …) bolted to it.

    kg and m in the frame of the link's joint: whatever is drawn is a body.
    """

    usual = staticmethod(
        lambda d: {
            "link": float(d.rng.integers(2, max(d.robot.dof, 3))),  # a changed last link is a payload by another name
            "scale": 1 + d.sign * 0.2 * d.size,
            "points": [[4 * d.size, *d.uniform(-0.3, 0.3, 3)]],
        }
    )
    POSITIVE = ("scale",)
    link: Annotated[float, "from 1"]
    scale: float = 1.0
    points: Annotated[tuple[tuple[float, ...], ...], "kg, m, m, m"] = ()

    def build_into(self, machine: Machine) -> None:
        self.need(self.link in range(1, machine.robot.dof + 1), "link", f"a whole number from 1 to {machine.robot.dof}")
        self.need(
            all(isinstance(p, tuple) and len(p) == 4 and p[0] > 0 for p in self.points),
            "points",
            "a list of [mass, x, y, z] with positive masses",
        )
        block = machine.parameters[10 * (int(self.link) - 1) : 10 * int(self.link)]
        block *= self.scale
        for mass, x, y, z in self.points:
            square = np.array([y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y])
            block += mass * np.array([1.0, x, y, z, *square])


@effect("base_tilt")
class SimulatedBaseTilt(ArmEffect):
    """The base leans by `roll` about its x axis, then `pitch` about its y axis [rad]."""

    usual = staticmethod(lambda d: {"roll": d.sign * 0.02 * d.size, "pitch": d.uniform(-0.02, 0.02) * d.size})
    roll: Annotated[float, "rad"] = 0.0
    pitch: Annotated[float, "rad"] = 0.0

    def build_into(self, machine: Machine) -> None:
        sr, cr, sp, cp = np.sin(self.roll), np.cos(self.roll), np.sin(self.pitch), np.cos(self.pitch)
        roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
        pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        machine.gravity = (pitch @ roll).T @ machine.gravity


@effect("wrist_coupling")
class SimulatedWristCoupling(SimulatedEffect):
    """The motor of the second joint named also turns with the first: C[second, first] grows by `factor`.

    The controller moves the joints as they should; the torque it reports knows nothing of the coupling.
    """

    usual = staticmethod(lambda d: {"factor": d.sign * 0.25 * d.size})
    factor: float

    def install(self, machine: Machine) -> None:
        self.need(len(self.joints) == 2, "joints", "two: the one that turns along, then the one whose motor it is")
        first, second = self.indices(machine.robot)
        self.need(first != second, "joints", "two different ones")
        machine.coupling[second, first] += self.factor
