"""What every effect offers: its form as columns that are linear in its parameters, and what is known about it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from agent.model.effects.experiments import THREE_LOADS, SeparatingMotion
from agent.model.signals import MotionSignals, NominalModel

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Joint → (S, k) torque [N·m] on it per unit of each of the k parameters; joints that feel nothing are left out.
Columns = dict[int, np.ndarray]


class FitContext(Protocol):
    """What an effect may look at to choose where its nonlinear parameters are tried."""

    @property
    def reference(self) -> NominalModel:
        """The model that is diagnosed against."""

    @property
    def signals(self) -> Sequence[MotionSignals]:
        """The motions."""

    @property
    def residuals(self) -> Sequence[np.ndarray]:
        """Per motion (S', n) [N·m]: what is left of the torque."""

    @property
    def residuals_as_given(self) -> Sequence[np.ndarray]:
        """The same where the model's parameters stay as they are, if it is of other data."""

    @property
    def sigmas(self) -> Sequence[np.ndarray]:
        """Per motion (S', n) [N·m]: the background."""

    @property
    def given(self) -> bool:
        """Whether the model is of other data, so that an effect shows as an error over the background only."""

    def gains_alone(self, joint: int, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) Σ e² / σ² that columns (S', K) [N·m] on one joint would take away one by one, and their factors (K,)."""

    def fit(self, effect: Effect, joints: tuple[int, ...], settings: Mapping[str, float]) -> np.ndarray:
        """(k,) parameters fitted to all the data together with the model, under its prior."""


class Effect(ABC):
    """One effect of the vocabulary: its fitted form, and all that is known about it.

    `family` is the part of the arm it belongs to: friction, transmission, load, measurement or path. `signature` is how
    it shows in the residual, `phrase` what it is for somebody who has never read the vocabulary, and `look_at` what to
    check on the arm. `confused_with` are its usual confusions, and `experiment` the motion that tells it from them.

    `scope` is joint, pair, arm or base. `shows_in` is torque, or path: the set-points alone. One that `moves_arm` is
    not of the measurement alone. `practical` is the smallest torque that matters, root mean square over nominal.

    `structurally_equivalent` are forms that equal it by definition unless the data distinguish them. `shapes` are what
    its torque is a curve over (speed, position, twist, mass): a second effect with such a shape on the same joint would
    only imitate a third.

    `once` marks an effect that happens once, so that another log has no information on it; `refined` are the nonlinear
    parameters worth a finer search; `residual_driven` ones are chosen from what is left, so anew in every scan.
    `why_absent` says why `settings` may be empty.

    A joint shows an effect only if it travels `needs_travel` [rad, or 0.1 m], reaches `needs_speed` [rad/s, or 0.1 m/s]
    and turns back `needs_reversals` times. One of `fast_torque` is named only where the torque that was measured
    goes with the prediction that has it: fast torque may be noise of the positions. Every arm has a little of one that
    is `usual`.

    `units` are those of parameters whose name alone does not say them, `not_reported` settings that no page shows.
    `sizes` are parameters that are above zero, or the opposite of the effect was found: of a simulator's file, whose
    friction changes sign as its engine lets it, that is no effect.
    `numbers` are those of a simulator's file that move under its name: `friction` of its joint, `links`, or the `load`
    that the last link gained. The torque that a drive reports is that of its
    motor times one plus the parameter `scales_report`, plus the parameter `adds_to_report`; most effects have neither.
    `of_servos` are `phrase` and `look_at` where torque is that of position servos at recorded set-points.
    """

    name: ClassVar[str]
    family: ClassVar[str]
    scope: ClassVar[str] = "joint"
    formula: ClassVar[str]
    source: ClassVar[str]
    signature: ClassVar[str]
    confused_with: ClassVar[tuple[str, ...]] = ()
    practical: ClassVar[float] = 0.01
    phrase: ClassVar[str]
    look_at: ClassVar[str]
    experiment: ClassVar[SeparatingMotion] = THREE_LOADS
    shows_in: ClassVar[str] = "torque"
    moves_arm: ClassVar[bool] = True
    shapes: ClassVar[tuple[str, ...]] = ()
    structurally_equivalent: ClassVar[tuple[str, ...]] = ()
    once: ClassVar[bool] = False
    refined: ClassVar[tuple[str, ...]] = ()
    residual_driven: ClassVar[bool] = False
    why_absent: ClassVar[str] = ""
    needs_travel: ClassVar[float] = 0.02
    needs_speed: ClassVar[float] = 0.0
    needs_reversals: ClassVar[int] = 0
    fast_torque: ClassVar[bool] = False
    usual: ClassVar[bool] = False
    units: ClassVar[Mapping[str, str]] = MappingProxyType({})
    not_reported: ClassVar[tuple[str, ...]] = ()
    sizes: ClassVar[tuple[str, ...]] = ()
    numbers: ClassVar[str] = ""
    adds_to_report: ClassVar[str | None] = None
    scales_report: ClassVar[str | None] = None
    of_servos: ClassVar[tuple[str, str] | None] = None

    @property
    def of_the_arm(self) -> bool:
        """Whether it is part of the arm that a simulator has: not once only, nor in the set-points alone."""
        return not self.once and self.shows_in == "torque"

    def happens_once(self, settings: Mapping[str, float]) -> bool:
        """Whether it does with these nonlinear parameters."""
        return self.once

    def places(self, robot: RobotDescription) -> list[tuple[int, ...]]:
        """Joints (from 0) it may sit on."""
        return [(k,) for k in range(robot.dof)] if self.scope == "joint" else [()]

    def settings(self, context: FitContext, joints: tuple[int, ...]) -> list[dict[str, float]]:
        """Nonlinear parameters to try; one empty dictionary where there are none."""
        return [{}]

    def reversing(
        self, context: FitContext, joints: tuple[int, ...], settings: Mapping[str, float]
    ) -> list[dict[str, float]]:
        """The same settings with reversals of their own, to try beside them; none where it has no such."""
        return []

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

    def filtered(
        self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]
    ) -> Columns | None:
        """`columns` after the filter of the torque, where many forms are made of few parts; None: they are to be
        filtered one by one."""
        return None

    def prior_precision(
        self, context: FitContext, joints: tuple[int, ...], settings: Mapping[str, float]
    ) -> np.ndarray | None:
        """(k, k) how far the parameters are known before, none of them being likelier than its opposite; None: not."""
        return None

    def plausible(self, settings: Mapping[str, float], values: Mapping[str, float]) -> bool:
        """Whether fitted parameters can be true."""
        return True

    def possible(
        self,
        reference: NominalModel,
        joints: tuple[int, ...],
        settings: Mapping[str, float],
        values: Mapping[str, float],
    ) -> bool:
        """Whether they can be true of an effect on these joints of this arm, beside what its model has there."""
        return True

    def reported(
        self, reference: NominalModel, settings: Mapping[str, float], values: Mapping[str, float]
    ) -> dict[str, float]:
        """Parameters as a result gives them."""
        return {**settings, **values}

    def n_parameters(self, settings: Mapping[str, float]) -> int:
        """Number of parameters, nonlinear ones included."""
        return len(self.names(settings)) + len(settings)


def on_axle(reference: NominalModel, axle: int, *columns: np.ndarray) -> Columns:
    """Torques (S,) on one axle as the joints feel them, Cᵀ f."""
    block = np.column_stack(columns)
    share = reference.coupling[axle]
    return {int(joint): share[joint] * block for joint in np.flatnonzero(share)}


def rubs(reference: NominalModel, axle: int, **changes: float) -> bool:
    """Whether the model's friction on an axle stays a friction when its levels, by form, change by as much.

    A tenth of a level below nought is let be: levels are estimates. A level that the model does not have is not judged.
    """
    levels = friction_levels(reference, axle)
    return all(levels[form] + change > -0.1 * abs(levels[form]) for form, change in changes.items() if form in levels)


def friction_levels(reference: NominalModel, axle: int) -> dict[str, float]:
    """Parameters of the model's friction on an axle by their form."""
    model = reference.model
    terms = enumerate(model.terms, len(model.independent))
    return {term.form: float(model.values[k]) for k, term in terms if term.axle == axle}


def highest_speed(context: FitContext, axle: int) -> float:
    """Of an axle over all motions [rad/s], not below a millionth of what the joint could."""
    seen = max(float(np.abs(s.axles.speed[:, axle]).max()) for s in context.signals)
    return max(seen, 1e-6 * float(context.reference.robot.max_velocity[axle]))


def travelled(context: FitContext, axle: int) -> tuple[float, float]:
    """Lowest and highest position of an axle over all motions [rad]."""
    low = min(float(s.axles.position[:, axle].min()) for s in context.signals)
    high = max(float(s.axles.position[:, axle].max()) for s in context.signals)
    return low, max(high, low + 1e-9)
