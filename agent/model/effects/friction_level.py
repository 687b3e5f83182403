"""Effects that change a friction level, which also changes how friction reverses."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import (
    REVERSAL_TRAVELS,
    SLIDES,
    Columns,
    Effect,
    FitContext,
    Joints,
    Numbers,
    on_axle,
    travelled,
)
from agent.model.friction_terms import Reversal


class FrictionLevel(Effect):
    """A change of a friction level. It reverses as the model's friction does, or over a travel of its own.

    Bristles of one stiffness bend further before they slide when they carry more (LuGre: Canudas de Wit, Olsson,
    Åström, Lischinsky, IEEE TAC 40, 1995). So a form with `reversal_travel` [rad] has r (z − s) in addition to its own
    torque: z is Dahl's state over that travel, and r the `reversal_level`, the friction at which the joint turns back.
    """

    units: ClassVar[Mapping[str, str]] = MappingProxyType({"reversal_travel": "rad", "reversal_level": "N·m"})
    refined: ClassVar[tuple[str, ...]] = ("reversal_travel",)
    nonlinear: ClassVar[tuple[str, ...] | None] = ("reversal_travel",)
    needs_speed: ClassVar[float] = SLIDES

    def level_names(self, settings: Numbers) -> tuple[str, ...]:
        """Names of the linear parameters without the reversal."""
        return self.linear

    @abstractmethod
    def level_columns(self, signals: MotionSignals, axle: int, settings: Numbers) -> tuple[np.ndarray, ...]:
        """Torque (S,) on the axle per unit of each of them."""

    def level_possible(self, reference: NominalModel, axle: int, settings: Numbers, values: Numbers) -> bool:
        """Whether the level is possible, given the model's friction on this axle."""
        return True

    def reversal(self, values: Numbers) -> dict[str, dict[str, float]]:
        """The effect that a reversal over a travel of its own is beyond the levels; none where there is no such one."""
        if "reversal_travel" not in values:
            return {}
        return {"presliding": {key: values[f"reversal_{key}"] for key in ("travel", "level")}}

    def reversing(self, context: FitContext, joints: Joints, settings: Numbers) -> list[dict[str, float]]:
        if "reversal_travel" in settings:
            return []
        low, high = travelled(context, joints[0])
        return [{**settings, "reversal_travel": fraction * (high - low)} for fraction in REVERSAL_TRAVELS]

    def names(self, settings: Numbers) -> tuple[str, ...]:
        level_names = self.level_names(settings)
        return (*level_names, "reversal_level") if "reversal_travel" in settings else level_names

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        (axle,) = joints
        columns = self.level_columns(signals, axle, settings)
        if "reversal_travel" in settings:
            state = signals.axles.direction(axle, Reversal("travel", settings["reversal_travel"]))
            columns = (*columns, state - signals.direction(axle))
        return on_axle(signals.reference, axle, *columns)

    def possible(self, reference: NominalModel, joints: Joints, settings: Numbers, values: Numbers) -> bool:
        approached = "reversal_travel" not in settings or values["reversal_level"] > 0
        return approached and self.level_possible(reference, joints[0], settings, values)
