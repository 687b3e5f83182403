"""What a verdict promises and how its rows are made, as data: value, unit, meaning and source of each number.

The numbers of the evidence are in `agent.diagnosis.hypotheses.law`; docs/measured/numbers.md lists all.

A source is `derived` (a formula gives the number), the definition of the verdict, `chosen` (what somebody at the
machine would call small, or what a motion lasts), `tuned` (on simulated runs), or a publication.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Limit:
    """What is known about one number."""

    name: str
    value: Any
    unit: str
    meaning: str
    source: str


def number(value: Any, unit: str, meaning: str, source: str) -> Any:
    """A field with its unit, meaning and source."""
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "source": source})


_CONTRACT = "the definition of the verdict (docs/diagnosis.md)"


@dataclass(frozen=True)
class DecisionLimits:
    """What a verdict promises, and how rows are made, grouped and weighed."""

    # What of a file is released
    least_gain: float = number(
        0.02,
        "background energy of all rows",
        "numbers of a simulator have to gain as much to be released",
        "tuned by hand on simulated runs",
    )

    # What a verdict promises
    explained: float = number(0.75, "gap", "that all causes close together, or it is not explained", _CONTRACT)
    least_share: float = number(0.1, "gap", "a cause that closes less by itself has no size", "chosen")
    negligible: float = number(
        0.05,
        "part",
        "that counts as nothing: of a gap, of an error, of the energy or the change of a torque, of a travel",
        "chosen: 5 %",
    )
    significant_deviations: float = number(
        3.0, "standard deviations", "more is no chance", "chosen: 0.3 % of normal errors"
    )
    min_samples: int = number(10, "samples", "fewer say nothing", "chosen")

    # In plain held-out error
    equal_ratio: float = number(
        1.1,
        "another error",
        "up to which two errors are alike: a gap and its repeatability, what two corrections leave, how far two "
        "simulators drift, gains of a servo that positions tell",
        _CONTRACT,
    )
    usual_error: float = number(
        2.0,
        "held-out error of the model",
        "from where on a joint's error is more than the model's own",
        "tuned: of 62 healthy development runs one exceeds it",
    )
    majority: float = number(
        0.5,
        "part",
        "that counts as most: of the energy where a torque channel stands still, of the closure that causes close "
        "themselves, of the effects that logs have to show before nothing changed, of the largest gap of a joint",
        "chosen: half",
    )
    path_gap: float = number(1e-4, "rad or m, RMS", "between planned and executed path that is notable", "chosen")
    path_rate: float = number(
        0.005,
        "of the speed",
        "executed faster or slower than planned by more matters",
        "chosen: as a learned law is held to",
    )
    path_time: float = number(0.01, "s", "executed later or rounded over longer than planned matters", "chosen")

    # Background
    stiction: float = number(
        1 / 3**0.5, "Coulomb level", "RMS of torque at rest", "derived: uniform within ± Coulomb, 1 / √3"
    )
    least_background: float = number(0.002, "nominal torque", "error that every model has", "chosen")
    unknown_error: float = number(
        0.04, "RMS torque", "what a model usually leaves, where no other logs tell", "tuned on simulated arms"
    )
    least_error: float = number(
        0.01, "RMS torque", "expected of a simulator's file, however little its numbers moved leave", "chosen"
    )
    over_median_joint: float = number(
        1.5, "relative error of the joint in the middle", "expected of every joint of a simulator's file", "chosen"
    )
    least_travel: float = number(3e-3, "rad or m", "that a joint travels in one log, or it never moves", "chosen")

    # Segments of time
    segment_duration: float = number(1.0, "s", "of motion that are drawn as one: errors last as long", "chosen")
    row_correlation_time: float = number(
        0.1,
        "s",
        "between independent rows: filters carry an error half as far either way, a shorter standstill is a reversal, "
        "and twice as much is left out between folds of one log",
        "chosen: the filter's reach",
    )
    log_parts: int = number(5, "parts", "of a log that is compared with itself", "chosen")

    def expected_share(self, relative: np.ndarray) -> float:
        """Share of torque that a right simulator's file leaves on every joint, where its numbers leave these (n,)."""
        return float(np.clip(self.over_median_joint * np.median(relative), self.least_error, self.unknown_error))

    @property
    def shortest(self) -> float:
        """Shortest only log [s]: all its blocks have guards on both sides, and as much between them."""
        guards = 2 * self.row_correlation_time * self.log_parts
        return 2 * guards + guards

    @property
    def weak_model(self) -> float:
        """Share of torque that a model gets wrong by itself, from where on it is said: far more than usual."""
        return self.significant_deviations * self.unknown_error


LIMITS = DecisionLimits()


def described(limits: Any) -> tuple[Limit, ...]:
    """What is known about each of a set of numbers, whose fields are `number`."""
    return tuple(Limit(e.name, getattr(limits, e.name), **e.metadata) for e in fields(limits))
