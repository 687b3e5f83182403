"""Interface of every simulated effect, and its reading from plain data."""

from __future__ import annotations

import copy
import dataclasses
import difflib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self, TypeVar, dataclass_transform, get_type_hints

import numpy as np

from agent.core import InputError
from agent.robot import Dynamics, RobotDescription
from fake_controller.actuation.friction import FrictionModifier
from fake_controller.actuation.machine import Machine


class Drawn:
    """What an effect on joint `k` is drawn from: at a `size` of 1 it costs a few percent of `nominal` torque.

    nominal [N·m] is 100 where the description has none, fastest [rad/s] the joint's limit; `sign` is 1 or -1, `seed`
    for what the effect draws itself.
    """

    def __init__(self, robot: RobotDescription, k: int, size: float, rng: np.random.Generator) -> None:
        self.robot, self.size, self.rng, self.uniform = robot, size, rng, rng.uniform
        self.nominal = float(np.nan_to_num(robot.nominal_torque, nan=100.0)[k])
        self.fastest = float(robot.max_velocity[k])
        self.sign, self.seed = float(rng.choice([-1.0, 1.0])), float(rng.integers(1_000_000))
        self._joint = k

    @property
    def inertia(self) -> float:
        """[kg·m²] that the joint sees in the middle of its range."""
        k, (lower, upper) = self._joint, (np.clip(limit, -np.pi, np.pi) for limit in self.robot.position_limits)
        return float(Dynamics(self.robot).mass_matrix(0.5 * (lower + upper))[k, k])


Form = TypeVar("Form", bound="type[SimulatedEffect]")

#: Simulated forms by the name of the effect.
EFFECTS: dict[str, type[SimulatedEffect]] = {}
#: Those that the vocabulary has no name for: what a diagnosis must call unknown.
OUTSIDE: dict[str, type[SimulatedEffect]] = {}


@dataclass_transform(kw_only_default=True)
def effect(name: str, forms: dict[str, type[SimulatedEffect]] = EFFECTS) -> Callable[[Form], Form]:
    """Class decorator: a dataclass whose fields are the effect's parameters, under this name among `forms`."""

    def decorate(form: Form) -> Form:
        dataclasses.dataclass(kw_only=True)(form)  # changes the class it is given
        form.name = name
        forms[name] = form
        return form

    return decorate


@dataclasses.dataclass(kw_only=True)
class SimulatedEffect(ABC):
    """One effect with its parameters: the further fields of the subclass, with units as in `Annotated[float, "rad"]`.

    Those in `POSITIVE` are above 0.

    `joints` are the names it sits on; an effect of the whole arm or base has none.
    """

    name: ClassVar[str]
    POSITIVE: ClassVar[tuple[str, ...]] = ()
    joints: tuple[str, ...] = ()

    @abstractmethod
    def install(self, machine: Machine) -> None:
        """Build the effect into a machine; several may be built into one.

        Raises:
            InputError: joints that the machine does not have, or that the effect cannot sit on, or a parameter that
                makes no sense.
        """

    @staticmethod
    def usual(d: Drawn) -> dict[str, Any]:
        """Parameters of an individual, as the blind check draws it."""
        raise NotImplementedError

    def indices(self, robot: RobotDescription) -> list[int]:
        """Indices of `joints` in the arm.

        Raises:
            InputError: no joint given, or one that the robot does not have.
        """
        if not self.joints:
            raise InputError(f"effect {self.name}: joints: name at least one of {', '.join(robot.joint_names)}")
        for joint in self.joints:
            if joint not in robot.joint_names:
                raise InputError(
                    f"effect {self.name}: joints: {robot.name} has no {joint!r}; it has {', '.join(robot.joint_names)}"
                )
        return [robot.joint_names.index(joint) for joint in self.joints]

    @classmethod
    def units(cls) -> dict[str, str]:
        """Unit of each parameter, as its annotation says; empty for ratios and counts."""
        hints = get_type_hints(cls, include_extras=True)
        names = [field.name for field in dataclasses.fields(cls) if field.name != "joints"]
        return {name: "".join(getattr(hints[name], "__metadata__", ())) for name in names}

    @classmethod
    def from_parameters(cls, joints: tuple[str, ...], parameters: Mapping[str, Any]) -> Self:
        """Build from numbers and lists of numbers.

        Raises:
            InputError: an unknown parameter, or a value that is no number.
        """
        fields = {field.name: field for field in dataclasses.fields(cls) if field.name != "joints"}
        values = {}
        for key, value in parameters.items():
            if key not in fields:
                close = difflib.get_close_matches(str(key), fields, 1)
                hint = f" (did you mean {close[0]}?)" if close else ""
                raise InputError(
                    f"effect {cls.name}: parameters: unknown key {key!r}{hint}; allowed are {', '.join(fields)}"
                )
            values[key] = _plain(cls.name, key, value)
            listed = "tuple[" in str(fields[key].type)
            if listed != isinstance(values[key], tuple):
                kind = "a list of numbers" if listed else "one number"
                raise InputError(f"effect {cls.name}: parameters: {key}: {kind} is expected")
        missing = [
            name for name, field in fields.items() if name not in values and field.default is dataclasses.MISSING
        ]
        if missing:
            raise InputError(f"effect {cls.name}: parameters: {', '.join(missing)} must be given")
        return cls(joints=joints, **values)

    def need(self, holds: bool, key: str, what: str) -> None:
        """Raises:
        InputError: it does not hold; `what` says what the value of `key` must be.
        """
        if not holds:
            raise InputError(f"effect {self.name}: {key}: must be {what}, not {getattr(self, key)}")

    def check(self) -> None:
        """Raises:
        InputError: a parameter is not above zero that must be.
        """
        for key in self.POSITIVE:
            self.need(getattr(self, key) > 0, key, "above 0")


class JointEffect(SimulatedEffect):
    """An effect that sits on every one of its joints in the same way."""

    def install(self, machine: Machine) -> None:
        joints = self.indices(machine.robot)
        self.check()
        for k in joints:
            copy.copy(self).install_on(machine, k)

    @abstractmethod
    def install_on(self, machine: Machine, k: int) -> None:
        """Build it into axle or joint `k`, whose states this copy may hold."""


class FrictionEffect(JointEffect, FrictionModifier):
    """An effect that alters the friction of its axles."""

    def install_on(self, machine: Machine, k: int) -> None:
        machine.terms[k].append(self)


class ArmEffect(SimulatedEffect):
    """An effect of the whole arm or its base."""

    def install(self, machine: Machine) -> None:
        self.check()
        if self.joints:
            raise InputError(f"effect {self.name}: joints: it acts on the whole arm; leave them out")
        self.build_into(machine)

    @abstractmethod
    def build_into(self, machine: Machine) -> None:
        """Build it in."""


def _plain(effect: str, key: str, value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return tuple(_plain(effect, key, part) for part in value)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"effect {effect}: parameters: {key}: {value!r} is not a finite number")
    return float(value)
