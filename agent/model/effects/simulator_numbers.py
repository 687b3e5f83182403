"""What an effect is in the numbers of a simulator's file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np


class FileNumbers(StrEnum):
    """Kinds of numbers of a simulator's file that an effect may be under another name."""

    FRICTION = "friction"
    LINKS = "links"
    LOAD = "load"
    GAIN = "servo gain"
    SPRING = "spring"
    OFFSET = "offset of set-points"
    DELAY = "delay of the command"
    ZERO = "zero of the joint"


@dataclass(frozen=True, eq=False)
class SimulatorNumbers:
    """Changes of a simulator's numbers that have the torque of an effect; what is None stays.

    `body`: a link, from 0, and the change (10,) of its inertial parameters. `friction`: changes of levels by form
    (coulomb [N·m], viscous [N·m·s/rad]). `tilt` [rad] of gravity along the directions of `across`. `zero` [rad or m] by
    which the joint's zero is lower. `spring`: constant [N·m] and stiffness [N·m/rad] of the joint. `beyond`: effects,
    with their parameters, for what numbers do not say of it.
    """

    body: tuple[int, np.ndarray] | None = None
    friction: Mapping[str, float] = field(default_factory=dict)
    tilt: tuple[float, float] | None = None
    zero: float | None = None
    spring: tuple[float, float] | None = None
    beyond: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


def linear_spring(values: Mapping[str, float]) -> SimulatorNumbers | None:
    """Of a torque with these parameters: a spring, or None for another form."""
    if set(values) != {"constant", "stiffness"}:
        return None
    return SimulatorNumbers(spring=(values["constant"], values["stiffness"]))
