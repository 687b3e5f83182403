"""The base of every effect: its torque as columns, linear in its parameters, and what is known about it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import ChainMap
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.experiments import THREE_LOADS, SeparatingMotion
from agent.model.effects.simulator_numbers import FileNumbers, SimulatorNumbers
from agent.model.passive_forces import PassiveForces

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Joint → (S, k) torque [N·m] on it per unit of each of the k parameters; joints that feel nothing are left out.
Columns = dict[int, np.ndarray]
#: The joints of a hypothesis, counted from 0.
Joints = tuple[int, ...]
#: Numbers by name: the nonlinear parameters (`settings`) or the linear ones (`values`) of an effect.
Numbers = Mapping[str, float]

#: Part of its size by which an estimate of what is never negative may come out below zero.
BELOW_ZERO = 0.1
#: Factor by which a fitted share or scale may be off from 1: more is something else.
MOST_OFF = 3.0
#: Motion that shows an effect: speed of a joint that slides [rad/s], or what it travels in a second [rad]; travel over
#: which torque bends [rad].
SLIDES, BENDS = 0.02, 0.2
#: Nominal torque, and per radian: no joint is built against a stronger spring or hose.
STRONGEST = 10.0


class FitContext(Protocol):
    """The data that an effect may use to choose its grid of nonlinear parameters."""

    @property
    def reference(self) -> NominalModel:
        """The model under diagnosis."""

    @property
    def signals(self) -> Sequence[MotionSignals]:
        """The motions."""

    @property
    def residuals(self) -> Sequence[np.ndarray]:
        """Per motion (S', n) [N·m]: measured torque minus the fitted model's."""

    @property
    def residuals_as_given(self) -> Sequence[np.ndarray]:
        """The same with the model's parameters as given, if the model was fitted to other data."""

    @property
    def sigmas(self) -> Sequence[np.ndarray]:
        """Per motion (S', n) [N·m]: standard deviation of the noise."""

    @property
    def keeps_parameters(self) -> bool:
        """Whether the model was fitted to other data, so that an effect must exceed the noise."""

    def energy_taken(self, joint: int, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) drop of Σ e² / σ² by each of the columns (S', K) [N·m] alone on one joint, and their factors (K,)."""

    def fit(self, effect: Effect, joints: Joints, settings: Numbers) -> np.ndarray:
        """(k,) parameters fitted to all data together with the model, under its prior."""


class Effect(ABC):
    """One effect of the vocabulary: its parameterisation, and what is known about it.

    An effect is data plus `settings` (the grid of nonlinear parameters) and `columns`; all other methods have a
    default.

    | attribute | meaning |
    | --- | --- |
    | `family` | friction, transmission, load, measurement or path |
    | `scope` | joint, pair, arm or base |
    | `signature`, `phrase`, `look_at` | how it shows in the residual; what it is in plain words; what to check |
    | `confused_with`, `experiment` | effects with a similar residual; the motion that distinguishes them |
    | `structurally_equivalent` | effects with an equal form unless the data distinguish them |
    | `linear` | names of the linear parameters; an effect whose grid changes them has its own `names` |
    | `practical` | smallest torque that matters, RMS over nominal |
    | `shows_in` | torque, or path (set-points only) |
    | `moves_arm` | whether it changes the motion, not only the measurement |
    | `shapes` | what its torque is a curve over: speed, position, twist, mass. Two effects of one joint share none |
    | `transient` | happens at one time: other logs carry no information on it |
    | `refined` | nonlinear parameters worth a finer search |
    | `nonlinear` | nonlinear parameters that cost evidence, because the data choose them; None: all |
    | `residual_driven` | its grid follows the residual, so it is chosen anew in every scan |
    | `why_absent` | why its grid may be empty |
    | `needs_travel`, `needs_speed`, `needs_reversals` | motion a joint needs to show it [rad or 0.1 m; rad/s] |
    | `fast_torque` | acts on fast torque, which may be noise of the positions |
    | `usual` | every arm has a little of it |
    | `units` | of parameters on a turning joint, by name or by what stands before its first underscore or digit |
    | `leading` | parameters that say how large it is, in the order of preference |
    | `components` | what the parts of one size are called together, and their names |
    | `not_reported` | settings that no page shows |
    | `sizes` | parameters that must be positive |
    | `numbers` | a kind of `FileNumbers` that changes under its name in a simulator's file; None: none |
    | `scales_report`, `adds_to_report` | parameters by which the reported torque is off: factor − 1, and offset |
    | `stepped` | its form in the file of effects of a corrected simulator (`standalone_effects`); empty: none |
    | `of_servos` | `phrase` and `look_at` where torque is that of position servos |
    """

    name: ClassVar[str]
    family: ClassVar[str]
    scope: ClassVar[str] = "joint"
    formula: ClassVar[str]
    linear: ClassVar[tuple[str, ...]] = ()
    source: ClassVar[str]
    signature: ClassVar[str]
    confused_with: ClassVar[tuple[str, ...]] = ()
    practical: ClassVar[float] = 0.01  # nominal torque: a change that one would look for at the machine; chosen
    phrase: ClassVar[str]
    look_at: ClassVar[str]
    experiment: ClassVar[SeparatingMotion] = THREE_LOADS
    shows_in: ClassVar[str] = "torque"
    moves_arm: ClassVar[bool] = True
    shapes: ClassVar[tuple[str, ...]] = ()
    structurally_equivalent: ClassVar[tuple[str, ...]] = ()
    transient: ClassVar[bool] = False
    refined: ClassVar[tuple[str, ...]] = ()
    nonlinear: ClassVar[tuple[str, ...] | None] = None
    residual_driven: ClassVar[bool] = False
    why_absent: ClassVar[str] = ""
    needs_travel: ClassVar[float] = SLIDES
    needs_speed: ClassVar[float] = 0.0
    needs_reversals: ClassVar[int] = 0
    fast_torque: ClassVar[bool] = False
    usual: ClassVar[bool] = False
    units: ClassVar[Mapping[str, str]] = MappingProxyType({})
    leading: ClassVar[tuple[str, ...]] = ()
    components: ClassVar[tuple[str, tuple[str, ...]] | None] = None
    not_reported: ClassVar[tuple[str, ...]] = ()
    sizes: ClassVar[tuple[str, ...]] = ()
    numbers: ClassVar[FileNumbers | None] = None
    adds_to_report: ClassVar[str | None] = None
    scales_report: ClassVar[str | None] = None
    stepped: ClassVar[str] = ""
    of_servos: ClassVar[tuple[str, str] | None] = None

    def __init_subclass__(cls) -> None:
        """Refuse a kind of numbers that no file has.

        Raises:
            ValueError: `numbers` is none of `FileNumbers`.
        """
        super().__init_subclass__()
        cls.numbers = None if cls.numbers is None else FileNumbers(cls.numbers)

    @property
    def of_the_arm(self) -> bool:
        """Whether a simulator of the arm has it: neither transient nor in the set-points only."""
        return not self.transient and self.shows_in == "torque"

    def is_transient(self, settings: Numbers) -> bool:
        """Whether it is transient with these nonlinear parameters."""
        return self.transient

    def unit(self, parameter: str) -> str:
        """Unit of a parameter on a turning joint; empty where it is a ratio or a count."""
        units = ChainMap(*(dict(vars(kind).get("units", {})) for kind in type(self).__mro__))
        stem = parameter.rstrip("0123456789")
        return next((units[name] for name in (parameter, stem, stem.split("_")[0]) if name in units), "")

    def possible_joints(self, robot: RobotDescription) -> list[Joints]:
        """Joints where it may act."""
        return [(k,) for k in range(robot.dof)] if self.scope == "joint" else [()]

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        """Grid of nonlinear parameters; one empty dictionary where there are none."""
        return [{}]

    def reversing(self, context: FitContext, joints: Joints, settings: Numbers) -> list[dict[str, float]]:
        """The same settings with a friction reversal of their own; none by default."""
        return []

    def nearby(self, settings: Numbers, factor: float) -> list[dict[str, float]]:
        """Settings with one `refined` parameter a `factor` down or up."""
        steps = ((name, scale) for name in self.refined if name in settings for scale in (1 / factor, factor))
        return [{**settings, name: settings[name] * scale} for name, scale in steps]

    def shown(self, context: FitContext, joints: Joints, settings: Numbers) -> bool:
        """Whether the motions can show these settings: those of `settings` they can, and a finer search moves them."""
        return True

    def counted(self, settings: Numbers) -> int:
        """Number of nonlinear parameters that cost evidence."""
        return len(settings) if self.nonlinear is None else sum(name in settings for name in self.nonlinear)

    def names(self, settings: Numbers) -> tuple[str, ...]:
        """(k,) names of the linear parameters."""
        return self.linear

    def prepare(self, motions: Sequence[MotionSignals], wanted: Sequence[tuple[Joints, Numbers]]) -> None:
        """Compute what several (joints, settings) share on all motions, where that saves time."""
        return

    def release(self, motions: Sequence[MotionSignals]) -> None:
        """Forget what several (joints, settings) share on motions, where it is large."""
        return

    @abstractmethod
    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        """Torque per unit of each linear parameter."""

    def filtered(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns | None:
        """`columns` after the torque filter, where many forms share few filtered parts; None: filter each column."""
        return None

    def in_positions(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns | None:
        """(S', k) by joint what positions show of it, where that is no torque's; None: what they show of `columns`."""
        return None

    def prior_precision(self, context: FitContext, joints: Joints, settings: Numbers) -> np.ndarray | None:
        """(k, k) precision of a zero-mean prior on the parameters; None: there is no prior."""
        return None

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        """Whether fitted parameters are possible on any arm."""
        return True

    def possible(self, reference: NominalModel, joints: Joints, settings: Numbers, values: Numbers) -> bool:
        """Whether they are possible on these joints of this arm, given the model's own friction and torque."""
        return True

    def reported(self, reference: NominalModel, settings: Numbers, values: Numbers) -> dict[str, float]:
        """Parameters as a result shows them."""
        return {**settings, **values}

    def simulator_numbers(self, values: Numbers, load_link: int) -> SimulatorNumbers | None:
        """What its reported parameters are in the numbers of a simulator's file of an arm whose load is at link
        `load_link` (from 0); None where numbers do not say it."""
        return None

    def stepped_parameters(self, values: Numbers, inertia: Sequence[float]) -> dict[str, Any] | None:
        """Its reported parameters as the `stepped` form has them; None where that form cannot say them.

        Args:
            values: the parameters, with their settings.
            inertia: mean inertia that each of its joints carries [kg·m² or kg].
        """
        return {name: float(value) for name, value in values.items()}

    def passive_forces(self, values: Numbers, fastest: float) -> PassiveForces | None:
        """What its reported parameters are as passive forces at its joint, exactly or as nearly as these can say it.

        Args:
            values: the parameters, with their settings.
            fastest: the joint's highest speed [rad/s or m/s].
        """
        return None


def geometric(low: float, high: float) -> tuple[float, ...]:
    """Grid of a nonlinear parameter from `low` to `high`, in equal steps of at most a factor 2.

    The search refines the best of it (`Effect.refined`), so the ends say what is physical, and the step nothing.
    """
    return tuple(np.geomspace(low, high, 1 + int(np.ceil(np.log2(high / low) - 1e-9))).tolist())


#: Of a joint's range in the motions: the travel over which friction reverses. Below, it changes sign within a sample;
#: above, it hardly slides.
REVERSAL_TRAVELS = geometric(2.5e-4, 0.032)
#: Of the highest speed: where a friction law bends. Below is how the friction reverses, in which a model and a machine
#: differ without any effect.
BENDING_SPEEDS = geometric(0.02, 0.32)
#: Powers of friction over speed or load that is not proportional to it.
POWERS = (0.5, 2.0)


def near_one(share: float) -> bool:
    """Whether a fitted share or scale is that of the effect itself."""
    return 1 / MOST_OFF < share < MOST_OFF


def on_axle(reference: NominalModel, axle: int, *columns: np.ndarray) -> Columns:
    """Torques (S,) on one axle as the joints feel them, Cᵀ f."""
    block = np.column_stack(columns)
    share = reference.coupling[axle]
    return {int(joint): share[joint] * block for joint in np.flatnonzero(share)}


def rubs(reference: NominalModel, axle: int, **changes: float) -> bool:
    """Whether the model's friction on an axle stays positive when its levels, by form, change by these amounts.

    Tolerates levels down to −10 %, because levels are estimates (`BELOW_ZERO`). Forms that the model lacks are not
    judged.
    """
    levels = friction_levels(reference, axle)
    return all(
        levels[form] + change > -BELOW_ZERO * abs(levels[form]) for form, change in changes.items() if form in levels
    )


def friction_levels(reference: NominalModel, axle: int) -> dict[str, float]:
    """Parameters of the model's friction terms on an axle, by form."""
    model = reference.model
    terms = enumerate(model.terms, len(model.independent))
    return {term.form: float(model.values[k]) for k, term in terms if term.axle == axle}


def highest_speed(context: FitContext, axle: int) -> float:
    """Highest speed of an axle over all motions [rad/s], at least a millionth of the joint's limit."""
    fastest = max(float(np.abs(s.axles.speed[:, axle]).max()) for s in context.signals)
    return max(fastest, 1e-6 * float(context.reference.robot.max_velocity[axle]))


def travelled(context: FitContext, axle: int) -> tuple[float, float]:
    """Lowest and highest position of an axle over all motions [rad]."""
    low = min(float(s.axles.position[:, axle].min()) for s in context.signals)
    high = max(float(s.axles.position[:, axle].max()) for s in context.signals)
    return low, max(high, low + 1e-9)


def harmonic_names(settings: Numbers) -> tuple[str, ...]:
    """Names of a cosine and a sine for each of the `harmonics`."""
    return tuple(f"{part}_{h}" for h in range(1, int(settings["harmonics"]) + 1) for part in ("cosine", "sine"))


def harmonics(angle: np.ndarray, settings: Numbers) -> list[np.ndarray]:
    """(S,) columns of these cosines and sines over an angle (S,) [rad]."""
    return [part(h * angle) for h in range(1, int(settings["harmonics"]) + 1) for part in (np.cos, np.sin)]
