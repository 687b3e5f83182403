"""What rubs more also gives way over a longer travel: the reversal of effects that change a friction level."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import numpy as np

from agent.model.effects.effect import Columns, Effect, FitContext, on_axle, travelled
from agent.model.friction_terms import Reversal
from agent.model.signals import MotionSignals, NominalModel

_TRAVELS = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3, 8e-3)  # of the joint's range in the motions


class FrictionLevel(Effect):
    """An effect on the level of a friction that reverses with s, or at its own travel where its settings have one.

    Bristles of one stiffness that carry another level bend further before they slide (LuGre: Canudas de Wit, Olsson,
    Åström, Lischinsky, IEEE TAC 40, 1995), so where the level is another one the reversal is too: beside its own torque
    such a form has r (z − s), z Dahl's state over a travel `reversal_travel` [rad] and r the `reversal_level`, the
    friction that is there while the joint turns back.
    """

    @abstractmethod
    def level_names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        """Names of the linear parameters without the reversal."""

    @abstractmethod
    def level_columns(self, signals: MotionSignals, axle: int, settings: Mapping[str, float]) -> tuple[np.ndarray, ...]:
        """Torque (S,) on the axle per unit of each of them."""

    def level_parameters(self, settings: Mapping[str, float]) -> int:
        """Number of parameters without the reversal, nonlinear ones included."""
        return len(self.level_names(settings)) + len(settings)

    def level_possible(
        self, reference: NominalModel, axle: int, settings: Mapping[str, float], values: Mapping[str, float]
    ) -> bool:
        """Whether the level can be true, beside what the model has on this axle."""
        return True

    def level_changes(self, settings: Mapping[str, float]) -> bool:
        """Whether these settings change the level at which the joint turns back."""
        return True

    def reversing(
        self, context: FitContext, joints: tuple[int, ...], settings: Mapping[str, float]
    ) -> list[dict[str, float]]:
        if "reversal_travel" in settings or not self.level_changes(settings):
            return []
        low, high = travelled(context, joints[0])
        return [{**settings, "reversal_travel": fraction * (high - low)} for fraction in _TRAVELS]

    def nearby(self, settings: Mapping[str, float], factor: float) -> list[dict[str, float]]:
        own = super().nearby(settings, factor)
        travels = (
            settings["reversal_travel"] * scale for scale in (1 / factor, factor) if "reversal_travel" in settings
        )
        return [*own, *({**settings, "reversal_travel": travel} for travel in travels)]

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        own = self.level_names(_level(settings))
        return (*own, "reversal_level") if "reversal_travel" in settings else own

    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        (axle,) = joints
        columns = self.level_columns(signals, axle, _level(settings))
        if "reversal_travel" in settings:
            state = signals.axles.direction(axle, Reversal("travel", settings["reversal_travel"]))
            columns = (*columns, state - signals.direction(axle))
        return on_axle(signals.reference, axle, *columns)

    def possible(
        self,
        reference: NominalModel,
        joints: tuple[int, ...],
        settings: Mapping[str, float],
        values: Mapping[str, float],
    ) -> bool:
        late = "reversal_travel" not in settings or values["reversal_level"] > 0
        return late and self.level_possible(reference, joints[0], _level(settings), values)

    def n_parameters(self, settings: Mapping[str, float]) -> int:
        return self.level_parameters(_level(settings)) + 2 * ("reversal_travel" in settings)


def _level(settings: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in settings.items() if name != "reversal_travel"}
