"""Motions that distinguish effects. Each effect names the best one; of two the one that is defined first is run."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count

_NUMBERS = count()


@dataclass(frozen=True, order=True)
class SeparatingMotion:
    """A motion in words; `order` of definition says which comes first where two effects name different ones."""

    order: int = field(default_factory=_NUMBERS.__next__, kw_only=True)
    motion: str
    #: What to record with the drives off first, where that is not known yet.
    brakes: str = ""

    @property
    def with_brakes(self) -> str:
        """Both in words, the recording without motion first."""
        return f"{self.brakes}{self.motion}"


RAMPS_AND_STANDSTILLS = SeparatingMotion(
    "single-joint ramps both ways at several constant speeds, up to the highest",
    "the stationary arm with the drives off, where only an offset remains (--drives-off); then ",
)
SLOW_REVERSALS = SeparatingMotion(
    "slow reversals of growing travel on this joint, then constant speeds from 1 to 20 % of the highest"
)
WHOLE_RANGE = SeparatingMotion(
    "slow motion of this joint over its whole range, with the joints above it in two different postures"
)
FROM_COLD = SeparatingMotion("the same cycle repeated from cold for 20 minutes")
POSTURES = SeparatingMotion(
    "standstills in ten postures with the wrist turned, then fast wrist motions, without and with the tool"
)
SHARP_REVERSALS = SeparatingMotion("short sharp reversals of this joint with the arm stretched and folded")
THREE_LOADS = SeparatingMotion(
    "constant speeds both ways on this joint at three loads (arm stretched, half, folded, or with known masses)"
)  # distinguishes most pairs
