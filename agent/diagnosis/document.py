"""The document of a diagnosis, typed: docs/diagnosis.md, key by key. `to_dict` is the only way to JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from typing import Any

SCHEMA = "diagnosis/1"


@dataclass(frozen=True)
class NamedEffect:
    """An effect somewhere; `joints` is empty for one of the whole arm or base."""

    effect: str
    joints: tuple[str, ...]


@dataclass(frozen=True)
class Cause:
    """A named effect: what it closes by itself (None: nothing to close), of its class the probability, parameters (SI),
    what these data cannot tell from it, what it closes of what all else leaves on its own joints (None: not judged
    by that), and whether these slide: N and m stand for N·m and rad then."""

    effect: str
    joints: tuple[str, ...]
    closure: float | None
    probability: float
    parameters: Mapping[str, float]
    equivalent_to: tuple[NamedEffect, ...] = ()
    closure_of_joints: float | None = None
    slides: bool = False


@dataclass(frozen=True)
class RegimeShare:
    """A regime's share of a joint's gap, with its 90 % interval, and the share of time spent there."""

    name: str
    share: float
    interval: tuple[float, float] | None
    of_samples: float


@dataclass(frozen=True)
class JointShare:
    """A joint's share of the gap with its 90 % interval, and where in the motion it lies."""

    joint: str
    share: float
    interval: tuple[float, float]
    regimes: tuple[RegimeShare, ...]


@dataclass(frozen=True)
class Remainder:
    """What the causes leave on a joint: its `size` over what a healthy arm may leave, where in the motion it lies, and
    the share of it that a smooth function of the joint's position, speed, acceleration or of time explains."""

    joint: str
    size: float
    regimes: tuple[RegimeShare, ...]
    follows: Mapping[str, float]


@dataclass(frozen=True)
class Rejected:
    """An effect that was likely and is not named, and why it does not explain the gap."""

    effect: str
    joints: tuple[str, ...]
    why: str


@dataclass(frozen=True)
class TorqueGap:
    """Held-out error per joint, in `units`: without the causes, with them, and what does not repeat.

    `of`: torque, or the position of the simulator's free motion under the recorded command.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]
    floor: tuple[float, ...] | None
    of: str = "torque"


@dataclass(frozen=True)
class PathGap:
    """RMSE per joint between planned and executed set-points [rad or m]; None where a log lacks either."""

    before: tuple[float, ...] | None = None
    after: tuple[float, ...] | None = None
    floor: tuple[float, ...] | None = None


@dataclass(frozen=True)
class NotTestable:
    """An effect that would not have been found at its practical size, and why; `joint` is None for the whole arm."""

    effect: str
    joint: str | None
    why: str


@dataclass(frozen=True)
class EffectPower:
    """The smallest size of an effect that these logs would have shown with 80 % power (None: no size), and the size
    that matters: torque over nominal, or N·m where that is unknown. `joint` is None for the whole arm."""

    effect: str
    joint: str | None
    smallest: float | None
    practical: float


class NextKind(StrEnum):
    """A next motion that does not separate effects: the same as these, once the torque can be judged, or one whose
    joints move together, as the model's fit needs."""

    REPEAT = "repeat"
    TOGETHER = "together"


@dataclass(frozen=True)
class NextExperiment:
    """A motion that separates effects, or is of another `kind`; `drives_off`: after a log with the drives off."""

    separates: tuple[str, ...]
    motion: str
    kind: NextKind | None = None
    drives_off: bool = False


@dataclass(frozen=True)
class FoldNames:
    """What was held out of one fit, and what it was fitted on."""

    held_out: str
    fitted_on: tuple[str, ...]


@dataclass(frozen=True)
class WaterfallStep:
    """What a step closes of the held-out gap in the order found, with its 90 % interval, and alone (None: the rest)."""

    step: str
    closes: float
    alone: float | None
    interval: tuple[float, float]


@dataclass(frozen=True)
class DiagnosisResult:
    """The whole document."""

    verdict: str
    gap: TorqueGap
    motion_gap: PathGap
    closure: float | None
    where: tuple[JointShare, ...]
    causes: tuple[Cause, ...]
    not_testable: tuple[NotTestable, ...]
    next_experiment: NextExperiment | None
    folds: tuple[FoldNames, ...]
    warnings: tuple[str, ...]
    #: Place there is a gap in torque, and steps that close it.
    waterfall: tuple[WaterfallStep, ...] = ()
    #: Likely effects that do not explain the gap, and what they would leave.
    rejected: tuple[Rejected, ...] = ()
    remainder: tuple[Remainder, ...] = ()
    #: Of the effects in torque that do not happen only once, on the joints that moved.
    power: tuple[EffectPower, ...] = ()
    #: Whether a joint errs by more than a healthy arm's usual error, which no effect explains.
    large_error: bool = False
    #: The model's held-out error over the torque of these logs; None of a simulator's file, which states no error.
    model_error: float | None = None
    #: Per kind of number and joint value, low and high (95 %), where positions are judged; None: only a class is known.
    servo: Mapping[str, tuple[tuple[float, float, float] | None, ...]] | None = None
    #: What sets the scale of these numbers: gravity of known masses, a known kp, or nothing.
    scale_from: str | None = None
    #: The same of damping, armature and friction over kp, where the kp of a joint is not told.
    servo_over_kp: Mapping[str, tuple[tuple[float, float, float], ...]] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON."""
        data = {"schema": SCHEMA, **_plain(self)}
        data["causes"] = [_unless(cause, {"closure_of_joints": None, "slides": False}) for cause in data["causes"]]
        data["gap"] = _unless(data["gap"], {"of": "torque"})
        if self.next_experiment is not None:
            data["next_experiment"] = _unless(data["next_experiment"], {"kind": None, "drives_off": False})
        usual: dict[str, Any] = {"waterfall": [], "rejected": [], "remainder": [], "large_error": False}
        usual |= dict.fromkeys(("model_error", "servo", "scale_from", "servo_over_kp"))
        return _unless(data, usual)


def _unless(data: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """Drop keys that have their usual value."""
    return {key: value for key, value in data.items() if key not in usual or value != usual[key]}


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value
