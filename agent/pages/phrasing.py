"""The words for a diagnosis that terminal, page and JSON share.

What an effect is and where to look is data of the effect's class. A result is plain data of schema diagnosis/1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from agent.core import and_list
from agent.diagnosis import (
    LIMITS,
    NextKind,
    amplitude,
    could_show,
    has_torque_gap,
    leading_parameter,
    shows_in_torque,
    size_text,
    testable_counts,
)
from agent.model import CATALOGUE
from agent.pages.elements import NextStep
from agent.robot import SHARE, figure_text

REGIMES = {
    "standstill": "at standstill",
    "reversal": "around reversals",
    "low_speed": "at low speed",
    "high_speed": "at high speed",
    "high_load": "under high load",
    "acceleration": "while accelerating",
    "position_low": "in the lower third of its range",
    "position_middle": "in the middle of its range",
    "position_high": "in the upper third of its range",
    "motor_phase": "with the motor's angle",
}
#: The four things, by their key in a result's `summary`.
SUMMARY_KEYS = {"where": "Where", "what": "What", "how_sure": "How sure", "next": "Next"}
#: Title of the page's section on what these motions cannot show.
NOT_TESTABLE = "Not testable here"
_NO_GAP = "no gap: model and robot agree within what may differ on a healthy arm"
_NOT_SHOWN = "no change found that these logs could show"
_NO_SHAPE = "no smooth function of position, speed, acceleration or time explains it"
_UNKNOWN = "there is a gap that no known effect explains"
_NOT_JUDGED = "the model cannot judge these motions"
#: Equivalents of a cause that are named, regimes and steps of an attribution, at most.
_MOST_OTHERS, _MOST_REGIMES, _MOST_STEPS = 2, 2, 3
#: Shares of the gap from which a joint is a main carrier, is described, and a step of the attribution is named.
_MUCH, _SOME, _STEP = 0.25, 0.15, 0.05
_LIKELY = 0.7  # probability from which a cause is called likely


def place(entry: Mapping[str, Any]) -> str:
    """Where a cause of a result, or one of its equivalents, sits."""
    return and_list(entry["joints"]) or "the whole arm"


def effect_phrase(effect: str, result: Mapping[str, Any]) -> str:
    """Description of an effect, with its name in brackets."""
    return f"{_words(effect, result)[0]} ({effect})"


def look_at(cause: Mapping[str, Any], result: Mapping[str, Any]) -> str:
    """Checks on the arm, at the joint of a cause."""
    return _words(cause["effect"], result)[1].replace("this joint", place(cause))


def _words(effect: str, result: Mapping[str, Any]) -> tuple[str, str]:
    known = CATALOGUE[effect]
    by_servos = known.of_servos if result.get("gap", {}).get("of") == "position" else None
    return by_servos or (known.phrase, known.look_at)


def verdict_text(result: Mapping[str, Any]) -> str:
    """What a verdict without causes means; the causes in a line where it has any.

    Corrected parameters of a simulator may close nearly all of a gap though no effect of the catalogue was found.
    """
    if result["causes"]:
        return "; ".join(f"{effect_phrase(cause['effect'], result)} on {place(cause)}" for cause in result["causes"])
    closed = sum(step["closes"] for step in result.get("waterfall", ())[:-1])
    if result["verdict"] == "unknown" and closed > 0:
        return (
            f"corrected simulator parameters close {100 * closed:.1f} % of the gap; no known effect explains the rest"
        )
    if result["verdict"] == "no_gap":
        return _NO_GAP if could_show(result) else _NOT_SHOWN
    return _NOT_JUDGED if _not_judged(result) else _UNKNOWN


def _not_judged(result: Mapping[str, Any]) -> bool:
    """Whether a gap may be all due to what the model's fit leaves open."""
    return (result.get("next_experiment") or {}).get("kind") == NextKind.TOGETHER


def verdict_name(result: Mapping[str, Any]) -> str:
    """The verdict in words, with the joints on which something else remains."""
    return f"{result['verdict'].replace('_', ' ')}{_exception(result)}"


def _exception(result: Mapping[str, Any]) -> str:
    """What an explanation leaves; empty where that is what a healthy arm leaves."""
    joints = [entry["joint"] for entry in result.get("remainder", ())] if result["verdict"] == "explained" else []
    return f", but for what is left on {and_list(joints)}" if joints else ""


def in_short(result: Mapping[str, Any]) -> str:
    """Verdict and causes in a line."""
    verdict, text = verdict_name(result), verdict_text(result)
    return text if text.startswith(verdict) else f"{verdict}: {text}"


def headline(result: Mapping[str, Any]) -> str:
    """The verdict: which joint, and what it is; a sentence for each cause."""
    if not result["causes"]:
        on = f", on {worst_joints(result)}" if result["verdict"] == "unknown" and result["where"] else ""
        return capital(f"{verdict_text(result)}{on}.")
    cause = result["causes"][0]
    sure = "" if cause["equivalent_to"] else ", most likely" if cause["probability"] >= _LIKELY else ", perhaps"
    agrees = "" if has_torque_gap(result) else f" {_in_torque(result)}"
    more = "".join(
        f" Also on {and_list([place(result['causes'][k]) for k in numbers])}: {effect_phrase(effect, result)}."
        for effect, numbers in _further(result).items()
    )
    more += f" Explained{exception}." if (exception := _exception(result)) else ""
    return f"{_numbers_first(result)}{_opening(cause)}{sure}: {_one_of(cause, result)}.{more}{agrees}"


def _further(result: Mapping[str, Any]) -> dict[str, list[int]]:
    """The causes after the first, by number, those of one effect together."""
    numbers: dict[str, list[int]] = {}
    for number, cause in enumerate(result["causes"][1:], start=1):
        numbers.setdefault(cause["effect"], []).append(number)
    return numbers


def _numbers_first(result: Mapping[str, Any]) -> str:
    """Numbers of a simulator that close more than its first cause, such as a rotor that no cause names; or nothing."""
    steps = {step["step"]: step["closes"] for step in result.get("waterfall", ())[:-1]}
    named = {_step_of(cause) for cause in result["causes"]}
    first = steps.get(_step_of(result["causes"][0]), result["causes"][0]["closure"] or 0.0)
    bodies = [name for name in steps if name not in named and not name.startswith("friction") and steps[name] > first]
    larger = sorted(bodies, key=lambda name: -steps[name])[:1]
    return "".join(f"{capital(name)}: {100 * steps[name]:.0f} % of the gap. " for name in larger)


def _in_torque(result: Mapping[str, Any]) -> str:
    """What a result without a gap in torque says of torque."""
    return "In torque, model and robot agree." if could_show(result) else "In torque, these logs show no change."


def capital(text: str) -> str:
    """Begun with a capital."""
    return text[:1].upper() + text[1:]


def _opening(cause: Mapping[str, Any]) -> str:
    """Where a cause sits, at the beginning of a sentence: the name of a joint stays as it is."""
    return place(cause) if cause["joints"] else capital(place(cause))


def _one_of(cause: Mapping[str, Any], result: Mapping[str, Any]) -> str:
    """A cause and the rivals that these logs cannot distinguish from it, with their joints if these differ."""
    others = [
        effect_phrase(other["effect"], result) + ("" if other["joints"] == cause["joints"] else f" on {place(other)}")
        for other in cause["equivalent_to"]
    ]
    more = [f"one of {len(others) - _MOST_OTHERS} others"] if len(others) > _MOST_OTHERS + 1 else others[_MOST_OTHERS:]
    return ", or ".join([effect_phrase(cause["effect"], result), *others[:_MOST_OTHERS], *more])


def closes(cause: Mapping[str, Any], result: Mapping[str, Any]) -> str:
    """Part of a gap that a cause closes: its step in the attribution, if there is one; empty if unknown."""
    steps = {step["step"]: step["closes"] for step in result.get("waterfall", ())}
    step = steps.get(_step_of(cause), cause["closure"])
    if step is None:
        return ""
    closure = step if result["closure"] is None else min(step, result["closure"])
    part = "all" if closure > 0.995 else "less than 1 %" if abs(closure) < 0.005 else f"{100 * closure:.0f} %"
    if not shows_in_torque(cause):
        return f"closes {part} of the gap between planned and executed path"
    own = cause.get("closure_of_joints") if closure < _STEP and cause["joints"] else None  # named by its own joints
    if own is not None:  # little of the arm's gap is much of its own joints'
        return f"closes {100 * own:.0f} % of what the other causes leave on {place(cause)} ({part} of the arm's gap)"
    part = part if closure > -0.005 else "a part"  # the order of the steps gives its part to the others
    return f"closes {part} of the gap"


def _step_of(cause: Mapping[str, Any]) -> str:
    """Name of a cause's step in the attribution."""
    return " of ".join(part for part in (cause["effect"], ", ".join(cause["joints"])) if part)


def sized(result: Mapping[str, Any], number: int = 0, label: bool = True) -> str:
    """How large a cause is, with its interval, after what that is; empty where no one figure says it."""
    cause = result["causes"][number]
    key = leading_parameter(cause)
    if key is None:
        return ""
    if (whole := amplitude(cause, _intervals(result, number))) is not None:
        name, size, interval = whole
        text = size_text(cause, key, size, interval)
    else:
        name, text = key.rstrip("0123456789").replace("_", " ").strip(), parameter_text(result, number, key)
    return f"{name} {text}" if label else text


def parameter_text(result: Mapping[str, Any], number: int, key: str) -> str:
    """A parameter of a cause with interval and unit; of one without an interval two digits, except for times."""
    cause = result["causes"][number]
    interval = _intervals(result, number).get(key)
    value, about = float(cause["parameters"][key]), ""
    if interval is None and not value.is_integer() and not CATALOGUE[cause["effect"]].transient:
        value, about = float(f"{value:.2g}"), "about "
    return about + size_text(cause, key, value, interval)


def _intervals(result: Mapping[str, Any], number: int) -> Mapping[str, tuple[float, float]]:
    known = result.get("intervals", ())
    return known[number] if number < len(known) else {}


def worst_joints(result: Mapping[str, Any]) -> str:
    """The joints that carry the gap, in words."""
    largest = [entry["joint"] for entry in result["where"] if entry["share"] > _MUCH]
    return and_list(largest or [result["where"][0]["joint"]])


def share_text(entry: Mapping[str, Any]) -> str:
    """A share of the gap, with its interval where that says more."""
    text = f"{100 * entry['share']:.0f} %"
    interval = entry.get("interval")
    within = "" if interval is None else f"{100 * interval[0]:.0f} to {100 * interval[1]:.0f}"
    return text if within in ("", f"{text[:-2]} to {text[:-2]}") else f"{text} ({within})"


def where_sentences(result: Mapping[str, Any]) -> Iterator[str]:
    """The joints that carry the gap, each with the regimes in which more of it lies than time is spent there."""
    if not has_torque_gap(result):
        return
    for entry in result["where"]:
        if entry["share"] < _SOME:
            continue
        marked = [r for r in entry["regimes"] if r["name"] in REGIMES and r["share"] > 1.4 * r["of_samples"]]
        marked += [r for r in entry["regimes"] if r["name"] == "motor_phase" and r["share"] > 0.3]
        named = ", ".join(f"{100 * r['share']:.0f} % of that {REGIMES[r['name']]}" for r in marked[:_MOST_REGIMES])
        yield f"{entry['joint']} has {share_text(entry)} of the gap{f': {named}' if named else ''}."


def summary(result: Mapping[str, Any], steps: Sequence[NextStep] = ()) -> dict[str, Any]:
    """The first screen of page and terminal: which joint, what, how sure, and (a list of lines) what comes next.

    `steps` are commands that whoever asked can run.
    """
    return {
        "where": " ".join(_where(result)),
        "what": " ".join(_what(result)),
        "how_sure": " ".join(_how_sure(result)),
        "next": [f"{capital(step.what)} {step.command}".rstrip() for step in (*measures(result), *steps)],
    }


def _where(result: Mapping[str, Any]) -> Iterator[str]:
    worst = result["where"][0]["joint"] if result["where"] else ""
    sentences = list(where_sentences(result))
    if result["causes"] and not any(sentence.startswith(f"{place(result['causes'][0])} has") for sentence in sentences):
        yield f"{_opening(result['causes'][0])}."
    if not has_torque_gap(result):
        yield _in_torque(result)
        if worst:
            of = _judged(result).lower()
            yield f"The largest {of} error on held-out motion is {_error(result, worst)}, on {worst}."
        return
    yield from sentences
    own = result["causes"][0]["joints"] if result["causes"] else []
    named_joints = [worst] if worst in own or len(own) != 1 else [own[0], worst]
    for joint in filter(None, named_joints):
        yield f"{_judged(result)} error of {joint} on held-out motion: {_error(result, joint)}."


def _judged(result: Mapping[str, Any]) -> str:
    """What the gap is in: torque, or position."""
    return capital(str(result["gap"].get("of", "torque")))


def _error(result: Mapping[str, Any], joint: str) -> str:
    gap, k = result["gap"], result["gap"]["joints"].index(joint)
    before, after = (figure_text(gap[side][k], gap["units"][k]) for side in ("before", "after"))
    if gap["units"][k] == SHARE:
        before += " of nominal torque"
    return before + (f"; {after} with what was found" if result["causes"] and has_torque_gap(result) else "")


def _what(result: Mapping[str, Any]) -> Iterator[str]:
    if not result["causes"]:
        yield capital(f"{verdict_text(result)}.")
        if result["verdict"] == "unknown" and result.get("warnings"):
            yield f"Warning: {result['warnings'][0]}."
    for cause in result["causes"][:1]:
        on = f"on {place(cause)}: " if len(result["causes"]) > 1 else ""
        yield capital(f"{on}{_one_of(cause, result)}.")
        if figures := _figures(result, 0):
            yield f"{'The first' if cause['equivalent_to'] else 'It'} {figures}."
    for effect, numbers in _further(result).items():
        if len(numbers) == 1:
            figures, where = _figures(result, numbers[0]), [place(result["causes"][numbers[0]])]
        else:
            figures, where = "", [_place_and_size(result, number) for number in numbers]
        which = f", which {figures}" if figures else ""
        yield f"Also on {and_list(where)}: {effect_phrase(effect, result)}{which}."
    if result["gap"].get("of") == "position":
        yield "No torque was measured: the simulator runs under the recorded command, and its motion is judged."
    yield from remainder_sentences(result)
    steps = [step for step in result.get("waterfall", ())[:-1] if step["closes"] >= _STEP]
    if {step["step"] for step in steps} - set(map(_step_of, result["causes"])):
        largest = sorted(steps, key=lambda step: -step["closes"])[:_MOST_STEPS]
        closing = ", ".join(f"{step['step']} ({100 * step['closes']:.0f} %)" for step in largest)
        yield f"Most of the gap closes with: {closing}."


def _figures(result: Mapping[str, Any], number: int) -> str:
    """What a cause closes, and its size."""
    return ", ".join(part for part in (closes(result["causes"][number], result), sized(result, number)) if part)


def _place_and_size(result: Mapping[str, Any], number: int) -> str:
    size = sized(result, number, label=False)
    return place(result["causes"][number]) + (f" ({size})" if size else "")


def remainder_sentences(result: Mapping[str, Any]) -> Iterator[str]:
    """What no named cause explains, joint by joint: how large it is, in which regimes, and what it follows."""
    for entry in result.get("remainder", ())[:_MOST_OTHERS]:
        marked = [r for r in entry["regimes"] if r["name"] in REGIMES and r["share"] > 1.4 * r["of_samples"]]
        where = and_list([REGIMES[r["name"]] for r in marked[:_MOST_REGIMES]])
        name, share = max(entry["follows"].items(), key=lambda entry_: entry_[1])
        shape = f"a smooth function of {name} explains {100 * share:.0f} % of it" if share > _MUCH else _NO_SHAPE
        text = f"{entry['joint']} keeps {entry['size']:.1f} times what a healthy arm may leave"
        yield f"{text}{f', mostly {where}' if where else ''}; {shape}."
    for entry in result.get("rejected", ()):
        yield f"Not named: {effect_phrase(entry['effect'], result)} on {place(entry)}, as {entry['why']}."


def _how_sure(result: Mapping[str, Any]) -> Iterator[str]:
    if not result["causes"]:
        if result["verdict"] == "no_gap":
            yield _found_if_there(result)
        elif _not_judged(result):
            yield "The gap may be all due to the model: the motions of its fit leave the torque of these logs open."
        else:
            yield "The gap is certain; its cause is not known."
        return
    cause = result["causes"][0]
    probability = f"probability {cause['probability']:.2f}"
    if cause["equivalent_to"]:
        yield f"These logs cannot distinguish them: together {probability}."
    else:
        yield f"{'Likely' if cause['probability'] >= _LIKELY else 'Not sure'}: {probability}."


def _found_if_there(result: Mapping[str, Any]) -> str:
    """Confidence in "no gap": the effects that would have been found, joint by joint, and the model's own error."""
    detectable, count = testable_counts(result)
    detectable_text = f"{detectable} of {count} effects, counted joint by joint,"
    known = "Every effect" if detectable == count else detectable_text if detectable else "No effect"
    error = result.get("model_error") or 0.0
    limits = f" The model errs by {100 * error:.0f} % of the torque." if error > LIMITS.weak_model else ""
    return f"{known} of practical size would have been found (80 % power).{limits}"


def measures(result: Mapping[str, Any]) -> list[NextStep]:
    """Inspections of the arm, and commands to run if no motion was planned for them."""
    causes, experiment = result["causes"], result["next_experiment"]
    steps = [NextStep(f"look at {look_at(cause, result)}.") for cause in causes[:1]]
    for effect, numbers in _further(result).items():
        where = and_list([place(causes[number]) for number in numbers])
        steps.append(NextStep(f"on {where}, look at {_words(effect, result)[1].replace('this joint', where)}."))
    if experiment is not None and not experiment.get("program"):  # a planned motion has its own command
        steps.append(NextStep(f"{'' if 'program' in experiment else 'record '}{experiment['motion']}."))
    return steps


def diagnosis_summary(result: Mapping[str, Any]) -> str:
    """Headline, and the share of the gap that each cause closes."""
    figures = [f"{place(cause)}: {closing}." for cause in result["causes"] if (closing := closes(cause, result))]
    return " ".join([headline(result), *figures])


def next_text(experiment: Mapping[str, Any]) -> str:
    """`next_experiment` of a result as a sentence without its full stop: what to run, or why there is no motion."""
    motion = str(experiment["motion"])
    if "program" in experiment and experiment["program"] is None:
        return capital(motion)
    took = f" ({experiment['duration_s']:.0f} s, {experiment['program']})" if "program" in experiment else ""
    return f"Record next: {motion}{took}"


def said_by_rounds(result: Mapping[str, Any]) -> bool:
    """Whether the next experiment says only why the rounds ended."""
    experiment = result["next_experiment"]
    return experiment is not None and experiment["motion"] == result.get("rounds_end")


def chances_text(entry: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Row of a planned motion: the pair, both probabilities of the right answer, and the smallest size."""
    smallest = entry["smallest_over_practical"]
    size = "-" if smallest is None else f"{smallest:.2g}"
    sides = [f"{side:.2f}" for side in entry["after_if"] if side is not None]
    after = f"{entry['after']:.2f}" + (f" ({' or '.join(sides)})" if len(set(sides)) > 1 else "")
    return " or ".join(entry["pair"]), f"{entry['before']:.2f}", after, size
