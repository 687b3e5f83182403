"""The limits by which a diagnosis decides, as data: value, unit, meaning, where it comes from, and how much it moves.

A source is `derived` (a formula or a definition gives the number), `tuned` (on simulated runs; the script in
`benchmarks/fit_decision_limits.py` does it again on one set of draws and judges on another), or `chosen` (what
somebody at the machine would call small, or what a motion lasts). Background energy is Σ e² / σ² of a model that is
right, so one to a row; a gain is taken from it, held out.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


@dataclass(frozen=True)
class Limit:
    """What is known about one limit. `sensitivity`: how far verdicts move when it moves by a quarter."""

    name: str
    value: Any
    unit: str
    meaning: str
    source: str
    sensitivity: str


def _limit(value: Any, unit: str, meaning: str, source: str) -> Any:
    return field(default=value, metadata={"unit": unit, "meaning": meaning, "source": source})


#: Source of the limits that a script may fit.
TUNED = "tuned by hand on simulated runs with withheld effects"
_CONTRACT = "derived: the definition of the verdict (docs/diagnosis.md)"


@dataclass(frozen=True)
class DecisionLimits:
    """All of them; `described` lists what is known about each."""

    # What may be named
    least_gain: float = _limit(
        0.02, "background energy of all rows", "an effect must gain as much to be named, chance or not", TUNED
    )
    practical_torque: float = _limit(
        0.005, "nominal torque, RMS", "a smaller effect, or gap over the background in motion, is let be", "chosen"
    )
    unexplained_torque: float = _limit(
        0.0075, "nominal torque, RMS", "minimum unexplained gap that is reported, and gap of all rows", TUNED
    )
    clear_of_background: float = _limit(
        2.0, "background", "a joint's error in motion beyond which it is not the model's own", TUNED
    )
    excess_energy: float = _limit(
        0.6, "background energy of a row", "over it on one joint before something counts as unexplained", TUNED
    )
    own_excess: float = _limit(
        0.5, "gain", "energy over the background on the effect's joints, or the model may have absorbed it", TUNED
    )
    false_alarms: float = _limit(
        0.01, "probability", "that the search names anything where there is nothing", "derived: level of the test"
    )
    power: float = _limit(
        0.8, "probability", "of finding an effect that is called testable", "derived: usual power of a test"
    )
    draws: int = _limit(
        199, "", "of the background's signs; p-values are multiples of 1 / 200", "derived: 2 draws beyond 99 %"
    )

    # Which of several
    equal_gain: float = _limit(0.04, "gain of the best", "forms this close are as good; the simplest is taken", TUNED)
    equal_gain_floor: float = _limit(0.02, "background energy of all rows", "the same, at least", TUNED)
    indistinguishable_gain: float = _limit(
        0.003, "gain of the best", "forms this close are indistinguishable, however well the better one fits", TUNED
    )
    equal_shape_gain: float = _limit(
        0.01, "gain of the best", "a law of position and a curve through anything this close are as good", TUNED
    )
    equal_gain_of_pushes: float = _limit(
        0.1,
        "gain of a push",
        "or of several, and what repeats this close, with a third of the parameters, is as good",
        "chosen",
    )
    further_effect: float = _limit(0.35, "energy still unexplained", "that every further effect must explain", TUNED)
    in_band_gain: float = _limit(
        0.4, "gain", "of an effect in fast torque, where measured torque goes with the prediction that has it", "chosen"
    )
    gain_beside: float = _limit(
        0.05, "excess energy of its joints", "that an effect must explain beside another on one of them", "chosen"
    )
    simpler_ratio: float = _limit(
        3.0, "times the parameters", "a form has to have before `equal_gain` counts in full", "chosen"
    )
    redundant_gain: float = _limit(0.002, "energy of all rows", "what an effect must add beside the others", TUNED)
    single_effect_closure: float = _limit(
        0.9, "excess energy", "closed by one effect, so that no other start is tried", TUNED
    )
    runner_up_gain: float = _limit(0.5, "gain of the cause", "by the next best forms where it fits doubtfully", TUNED)
    rival_energy: float = _limit(
        0.5, "energy that a cause leaves", "explained by a shape of its own kind: the two are rivals", TUNED
    )
    good_fit: tuple[float, ...] = _limit(
        (0.975, 0.98, 0.98), "excess energy", "closed by one, two, three effects, or the form is uncertain", TUNED
    )
    most_effects: int = _limit(3, "effects", "sought at most", "chosen: what an answer can be checked for")
    starts: int = _limit(4, "effects", "that the search begins with, best first", "chosen: time")

    # What a verdict promises
    explained: float = _limit(0.75, "gap", "that all causes close together, or it is not explained", _CONTRACT)
    least_closure: float = _limit(0.25, "gap", "causes that close less are not named, whatever equals them", "chosen")
    least_share: float = _limit(0.03, "gap", "a cause that closes less by itself has no size", "chosen")
    cancelling: float = _limit(
        1.5, "gap", "closed by each of two causes on one joint: they are none, what one adds the other takes", "chosen"
    )
    least_probability: float = _limit(
        0.5, "probability", "of the first cause's class: what is rather wrong than right is not named", "derived"
    )
    sure_probability: float = _limit(
        0.6, "probability", "of the first cause's class, or it is not explained; what happens once is not named", TUNED
    )
    probability: tuple[float, float, float] = _limit(
        (-1.0, 0.35, 0.43),
        "logistic",
        "constant, by ln(1 + margin ratio), by −ln(1 − closed), of a class's probability",
        "tuned on runs of another simulation (decisions/diagnosis-probability.md)",
    )
    most_margin: float = _limit(50.0, "margins", "that count for the probability", TUNED)
    least_open: float = _limit(0.002, "excess energy", "left open, at least, for the probability", TUNED)
    path_probability: float = _limit(
        0.97,
        "probability",
        "of a cause in the path: set-points are numbers, only a log that misplaces them errs",
        "chosen",
    )

    # In plain held-out error
    plain_gain: float = _limit(
        0.5, "squared error on the causes' joints", "taken away from a small gap, half of it from a larger one", TUNED
    )
    small_gap: float = _limit(
        0.01, "nominal torque, RMS", "a gap so small that nothing closes is the model's own", TUNED
    )
    no_closure: float = _limit(1.1, "floor", "a gap below it has no closure", _CONTRACT)
    usual_error: float = _limit(
        2.0, "held-out error of the model", "from where on a joint's error is more than the model's own", TUNED
    )
    held_gap: float = _limit(
        0.5, "energy over the background", "where a torque channel stands still: it is the sensor's", "chosen: most"
    )
    path_gap: float = _limit(1e-4, "rad or m, RMS", "between planned and executed path that is notable", "chosen")
    path_rate: float = _limit(
        0.005,
        "of the speed",
        "executed faster or slower than planned by more matters",
        "chosen: as a learned law is held to",
    )
    path_time: float = _limit(0.01, "s", "executed later or rounded over longer than planned matters", "chosen")

    # Background
    stiction: float = _limit(
        1 / 3**0.5, "Coulomb level", "RMS of torque at rest", "derived: uniform within ± Coulomb, 1 / √3"
    )
    least_background: float = _limit(0.002, "nominal torque", "error that every model has", "chosen")
    unknown_error: float = _limit(
        0.04, "RMS torque", "what a model usually leaves, where no other logs tell", "tuned on simulated arms"
    )
    least_error: float = _limit(
        0.01, "RMS torque", "expected of a simulator's file, however little its numbers moved leave", "chosen"
    )
    weak_model: float = _limit(
        0.12, "torque", "that the model gets wrong by itself, from where on it is said", "chosen"
    )
    least_travel: float = _limit(3e-3, "rad or m", "that a joint travels in one log, or it never moves", "chosen")

    # Segments of time
    block: float = _limit(1.0, "s", "of motion that are drawn as one: errors last as long", "chosen")
    parity: float = _limit(0.1, "s", "held out in turn, for what happens once", "chosen")
    guard: float = _limit(0.2, "s", "either side of a border between folds of one log", "chosen: the filter's reach")
    shortest: float = _limit(3.0, "s", "of the only log", "chosen: five folds with guards")
    near_rest: float = _limit(0.05, "s", "around standstill over which the filter carries its torque", "chosen")
    long_rest: float = _limit(0.1, "s", "of standstill, or a joint only passes through a reversal", "chosen")


LIMITS = DecisionLimits()


#: How many runs get another outcome or first cause when a limit is a quarter less or more, counted by
#: `benchmarks/fit_decision_limits.py --every --cases 12`: so far the first three draws of seed 1 for comau_ns16 and for
#: a three-joint arm (`--robot RRR`). That is too few to call a limit insensitive. What was not moved says why.
_SENSITIVITY = {
    **dict.fromkeys(
        (
            "least_gain",
            "practical_torque",
            "unexplained_torque",
            "clear_of_background",
            "own_excess",
            "equal_gain",
            "further_effect",
            "rival_energy",
            "good_fit",
            "plain_gain",
        ),
        "none of 6 runs, too few to tell",
    ),
    **dict.fromkeys(
        ("least_background", "least_travel", "block", "parity", "near_rest"),
        "not measured: a step filters and fits the logs anew, which takes several times as long",
    ),
    **dict.fromkeys(
        ("unknown_error", "least_error", "guard", "shortest"),
        "not measured: decides without a model, on a simulator's file or on a single log, which no drawn run is",
    ),
}


def described(limits: DecisionLimits = LIMITS) -> tuple[Limit, ...]:
    """What is known about each."""

    def sensitivity(name: str, source: str) -> str:
        unmoved = "not moved: derived" if source.startswith("derived") else "not measured yet"
        return _SENSITIVITY.get(name, unmoved)

    return tuple(
        Limit(e.name, getattr(limits, e.name), **e.metadata, sensitivity=sensitivity(e.name, e.metadata["source"]))
        for e in fields(limits)
    )
