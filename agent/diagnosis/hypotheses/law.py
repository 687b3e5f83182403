"""The numbers of the evidence and of what is named; what a verdict promises stands in `agent.diagnosis.limits`."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.special import ndtri

from agent.diagnosis.limits import number


@dataclass(frozen=True)
class EvidenceLaw:
    """The numbers. Shares of torque are root mean square over nominal joint torque."""

    error_correlation_time: float = number(0.5, "s", "between independent errors", "chosen")
    systematic: float = number(0.4, "held-out error", "the model's own error per background column", "tuned")
    drift: float = number(0.001, "nominal torque", "what an arm changes by itself per background column", "tuned")
    daily: float = number(
        0.05,
        "its value",
        "change of a friction level from day to day: some kelvin at 1 to 3 % each",
        "Bittencourt and Gunnarsson, J. Dyn. Syst. Meas. Control 134, 2012",
    )
    form_error: float = number(0.05, "its torque", "error of any effect's form", "tuned")
    sizes: tuple[float, ...] = number(
        (0.007, 0.02, 0.06, 0.2), "nominal torque", "usual sizes of effects, equally likely", "chosen"
    )
    nu: float = number(6.0, "degrees of freedom", "of the held-out error and of healthy effects", "chosen")
    unlikely: float = number(
        0.1,
        "probability",
        "of an effect outside the catalogue, and of every further effect, before the data; and of a rival, over the "
        "leader's, below which it does not belong to the class; of a healthy joint, that it errs by more than what "
        "causes may leave",
        "chosen",
    )
    least_named_torque: float = number(
        0.003, "nominal torque", "smallest effect worth a name, in the log with most of it", "chosen"
    )
    sure: float = number(0.6, "probability", "of a class that is named: a wrong name costs 1.5 abstentions", "chosen")
    detected: float = number(
        0.8, "probability", "with which an effect of the smallest detectable size is named", "chosen"
    )
    max_effects: int = number(3, "effects", "in one hypothesis", "chosen")
    confidence: float = number(
        0.95, "probability", "of something, below which an arm is healthy, and the highest of any class", "chosen: 5 %"
    )

    @property
    def interval(self) -> tuple[float, float]:
        """Ends of a 90 % interval, as probabilities: `confidence` on each side."""
        return 1 - self.confidence, self.confidence

    @property
    def within(self) -> float:
        """Standard deviations either way that hold 90 % of normal errors: `confidence` on each side."""
        return float(ndtri(self.confidence))

    @property
    def margin(self) -> float:
        """Standard deviations that the smallest detectable size exceeds the threshold by."""
        return float(ndtri(self.detected))


LAW = EvidenceLaw()
