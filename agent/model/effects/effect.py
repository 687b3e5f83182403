"""What every effect offers: its form as columns that are linear in its parameters, and what is known about it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from agent.model.signals import MotionSignals, NominalModel

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Joint → (S, k) torque [N·m] on it per unit of each of the k parameters; joints that feel nothing are left out.
Columns = dict[int, np.ndarray]


class FitContext(Protocol):
    """What an effect may look at to choose where its nonlinear parameters are tried."""

    reference: NominalModel
    signals: Sequence[MotionSignals]
    residuals: Sequence[np.ndarray]
    sigmas: Sequence[np.ndarray]

    def gains_alone(self, joint: int, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) Σ e² / σ² that columns (S', K) [N·m] on one joint would take away one by one, and their factors (K,)."""

    def fit(self, effect: Effect, joints: tuple[int, ...], settings: Mapping[str, float]) -> np.ndarray:
        """(k,) parameters fitted to all the data together with the model, under its prior."""


class Effect(ABC):
    """One effect of the vocabulary.

    `scope` is joint, pair, arm or base. `special_cases` are the simpler forms that it turns into at the border of its
    parameters: it has to do better than they do to be named. `structurally_equivalent` are forms that equal it by
    definition unless the data tell them apart: where they do as well it is not named with confidence, in the
    catalogue or not. `practical` is the smallest torque that matters, root mean square over nominal. `once` marks an
    effect that happens once, so that another log tells nothing about it; `refined` are the nonlinear parameters worth
    a finer search.
    """

    name: ClassVar[str]
    scope: ClassVar[str] = "joint"
    formula: ClassVar[str]
    source: ClassVar[str]
    signature: ClassVar[str]
    confused_with: ClassVar[tuple[str, ...]] = ()
    practical: ClassVar[float] = 0.01
    look_at: ClassVar[str]
    special_cases: ClassVar[tuple[str, ...]] = ()
    structurally_equivalent: ClassVar[tuple[str, ...]] = ()
    once: ClassVar[bool] = False
    refined: ClassVar[tuple[str, ...]] = ()

    def places(self, robot: RobotDescription) -> list[tuple[int, ...]]:
        """Joints (from 0) it may sit on."""
        return [(k,) for k in range(robot.dof)] if self.scope == "joint" else [()]

    def settings(self, survey: FitContext, joints: tuple[int, ...]) -> list[dict[str, float]]:
        """Nonlinear parameters to try; one empty dictionary where there are none."""
        return [{}]

    def nearby(self, settings: Mapping[str, float], factor: float) -> list[dict[str, float]]:
        """Settings with one of the nonlinear parameters that are worth a finer search a `factor` up or down."""
        steps = ((name, scale) for name in self.refined if name in settings for scale in (1 / factor, factor))
        return [{**settings, name: settings[name] * scale} for name, scale in steps]

    @abstractmethod
    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        """(k,) names of the linear parameters."""

    def prepare(
        self, motions: Sequence[MotionSignals], wanted: Sequence[tuple[tuple[int, ...], Mapping[str, float]]]
    ) -> None:
        """Work out together what several (joints, settings) need of all motions, where that saves time."""
        return

    @abstractmethod
    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        """Torque per unit of each linear parameter."""

    def prior_std(
        self, survey: FitContext, joints: tuple[int, ...], settings: Mapping[str, float]
    ) -> np.ndarray | None:
        """(k,) what the parameters may be at most, roughly; None: anything."""
        return None

    def plausible(self, settings: Mapping[str, float], values: Mapping[str, float]) -> bool:
        """Whether fitted parameters can be true."""
        return True

    def n_parameters(self, settings: Mapping[str, float]) -> int:
        """Number of parameters, nonlinear ones included."""
        return len(self.names(settings)) + len(settings)


def on_axle(reference: NominalModel, axle: int, *columns: np.ndarray) -> Columns:
    """Torques (S,) on one axle as the joints feel them, Cᵀ f."""
    block = np.column_stack(columns)
    share = reference.coupling[axle]
    return {int(joint): share[joint] * block for joint in np.flatnonzero(share)}


def highest_speed(survey: FitContext, axle: int) -> float:
    """Of an axle over all motions [rad/s], not below a millionth of what the joint could."""
    seen = max(float(np.abs(s.axles.speed[:, axle]).max()) for s in survey.signals)
    return max(seen, 1e-6 * float(survey.reference.robot.max_velocity[axle]))


def travelled(survey: FitContext, axle: int) -> tuple[float, float]:
    """Lowest and highest position of an axle over all motions [rad]."""
    low = min(float(s.axles.position[:, axle].min()) for s in survey.signals)
    high = max(float(s.axles.position[:, axle].max()) for s in survey.signals)
    return low, max(high, low + 1e-9)
