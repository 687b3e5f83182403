"""Scores of answers: one result a run and tool, and counts of results. The definitions are those of `report.py`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from agent.blind_check.key import KINDS, Key
from agent.core import InputError
from agent.model import CATALOGUE

Result = Mapping[str, Any]

#: Below this share of nominal torque an effect is too small to matter in practice.
PRACTICAL = 0.005
#: What can come of a run.
OUTCOMES = ("named", "in class", "wrong name", "wrong class", "unknown", "no gap", "no answer")
_WRONG = ("wrong name", "wrong class")
_SIZES = (0.0, PRACTICAL, 0.01, 0.02, 0.04, np.inf)
_PROBABILITIES = (0.0, 0.6, 0.8, 0.9, 0.95, 1.0001)


def outcome(effects: Sequence[Mapping[str, Any]], answer: Mapping[str, Any] | None) -> str:
    """What came of a run with these true effects, one of OUTCOMES."""
    if answer is None:
        return "no answer"
    if not answer["causes"]:
        return "no gap" if answer["verdict"] == "no_gap" else "unknown"
    members = class_of(answer["causes"][0])
    if answer["verdict"] == "explained":
        return "named" if among(members[:1], effects) else "wrong name"
    return "in class" if among(members, effects) else "wrong class"


def class_of(cause: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """A cause and what the data cannot distinguish from it."""
    return [cause, *cause["equivalent_to"]]


def among(members: Iterable[Mapping[str, Any]], effects: Iterable[Mapping[str, Any]]) -> bool:
    """Whether one of the members is a true effect on its true joints; the order of joints does not count."""
    true = {(effect["effect"], frozenset(effect["joints"])) for effect in effects}
    return any((member["effect"], frozenset(member["joints"])) in true for member in members)


def results_of(key: Key, answers: Mapping[str, Sequence[Mapping[str, Any]]]) -> Iterator[dict[str, Any]]:
    """One result a run and tool, of answers by tool.

    Raises:
        InputError: an answer to a run that the key does not have.
    """
    known = {run["run"] for run in key.runs}
    for tool, tool_answers in answers.items():
        if strange := [answer["run"] for answer in tool_answers if answer["run"] not in known]:
            raise InputError(f"{tool}: the key has no run {strange[0]}; are these answers to another benchmark?")
        plain = {answer["run"]: answer for answer in tool_answers if not answer["without"]}
        withheld = {answer["run"]: answer for answer in tool_answers if answer["without"]}
        for run in key.runs:
            yield {"world": key.world, **_result(tool, run, plain.get(run["run"]), withheld.get(run["run"]))}


def _result(
    tool: str, run: Mapping[str, Any], answer: Mapping[str, Any] | None, withheld: Mapping[str, Any] | None
) -> dict[str, Any]:
    effects = run["effects"]
    causes = answer["causes"] if answer else []
    result = {
        "tool": tool,
        "run": run["run"],
        "kind": run["kind"],
        "recorder": run.get("recorder", ""),
        "effects": [[effect["effect"], effect["joints"]] for effect in effects],
        "size": None if run["size"] is None else round(run["size"], 5),
        "outcome": outcome(effects, answer),
        "causes": [[cause["effect"], cause["joints"], len(class_of(cause))] for cause in causes],
        "probability": causes[0]["probability"] if causes else None,
        "more_wrong": sum(not among(class_of(cause), effects) for cause in causes[1:]),
        "all_named": bool(effects)
        and all(any(among(class_of(cause), [effect]) for cause in causes) for effect in effects),
        "joint": _joint_right(effects, answer),
        "withheld": None,
        "numbers": _numbers_held(run, answer),
    }
    if withheld is not None:
        if run["kind"] in ("none", "outside"):
            raise InputError(f"{tool}: run {run['run']}: it has no effect to be `without`; leave this answer out")
        if missing := {effect["effect"] for effect in effects} - set(withheld["without"]):
            raise InputError(f"{tool}: run {run['run']}: `without` lacks a true effect: {', '.join(sorted(missing))}")
        result["withheld"] = outcome((), withheld)
    return result


def _numbers_held(run: Mapping[str, Any], answer: Mapping[str, Any] | None) -> list[int] | None:
    """How many intervals of servos' numbers hold the truth, and of how many; None where none were asked or given."""
    if answer is None or not answer["servo"] or "numbers" not in run:
        return None
    pairs = [
        (low, true, high)
        for kind, row in answer["servo"].items()
        for interval, true in zip(row, run["numbers"][kind], strict=True)
        if interval is not None
        for _, low, high in [interval]
    ]
    return [sum(low <= true <= high for low, true, high in pairs), len(pairs)]


def _joint_right(effects: Sequence[Mapping[str, Any]], answer: Mapping[str, Any] | None) -> bool | None:
    """Whether the joint named first, or the one with the largest share, is one of a true effect; None for the arm's."""
    true = {joint for effect in effects for joint in effect["joints"]}
    if not true or any(not effect["joints"] for effect in effects):
        return None
    if answer is None or answer["verdict"] == "no_gap":
        return False
    if answer["causes"] and answer["causes"][0]["joints"]:
        return set(answer["causes"][0]["joints"]) <= true
    return bool(answer["where"]) and max(answer["where"], key=lambda entry: entry["share"])["joint"] in true


def clopper_pearson(hits: int, trials: int) -> tuple[float, float]:
    """Exact 95 % interval of a proportion (Clopper, Pearson, Biometrika 1934)."""
    from scipy.stats import binomtest

    low, high = binomtest(hits, trials).proportion_ci(0.95, method="exact")
    return float(low), float(high)


def score(results: Sequence[Result]) -> dict[str, Any]:
    """All counts, by tool."""
    return {
        tool: _scores([result for result in results if result["tool"] == tool]) for tool in _distinct(results, "tool")
    }


def _scores(results: Sequence[Result]) -> dict[str, Any]:
    of = {kind: [result for result in results if result["kind"] == kind] for kind in KINDS}
    single = of["one"] + of["outside"]
    located = [result for result in results if result["joint"] is not None]
    asked = [result for result in results if result["withheld"] is not None]
    sizes = Counter(result["causes"][0][2] for result in results if result["outcome"] == "in class")
    return {
        "runs": len(results),
        "outcomes": {kind: counts(of_kind) for kind, of_kind in of.items()},
        "all_of_two": share(of["two"], lambda result: result["all_named"]),
        "all_of_three": share(of["three"], lambda result: result["all_named"]),
        "further_wrong": share(
            [result for result in results if len(result["causes"]) > 1], lambda result: result["more_wrong"] > 0
        ),
        "joint": share(located, lambda result: result["joint"]),
        "numbers": _share_of_numbers(results),
        "classes": {str(size): times for size, times in sorted(sizes.items())},
        "withheld": dict(Counter(result["withheld"] for result in asked)),
        "power": _power([result for result in of["one"] if result["size"] is not None]),
        "recorders": {
            name: counts([result for result in of["one"] if result["recorder"] == name])
            for name in _distinct(of["one"], "recorder")
        },
        "calibration": _calibration([result for result in results if result["probability"] is not None]),
        "effects": {
            name: counts([result for result in single if result["effects"][0][0] == name])
            for name in sorted({result["effects"][0][0] for result in single})
        },
    }


def _share_of_numbers(results: Sequence[Result]) -> dict[str, Any]:
    """Of runs whose effects, if any, are numbers: of others no number of a file is true."""
    tallies = [
        result["numbers"]
        for result in results
        if result["numbers"]
        and all(effect in CATALOGUE and CATALOGUE[effect].numbers for effect, _ in result["effects"])
    ]
    held, of = (sum(part[k] for part in tallies) for k in (0, 1))
    return {"count": held, "of": of, "interval": list(clopper_pearson(held, of)) if of else None}


def counts(results: Sequence[Result]) -> dict[str, int]:
    """Runs by outcome, all outcomes in order."""
    outcomes = Counter(result["outcome"] for result in results)
    return {name: outcomes[name] for name in OUTCOMES}


def share(results: Sequence[Result], holds: Callable[[Result], bool]) -> dict[str, Any]:
    """Of how many runs something holds, with its exact 95 % interval."""
    hits = sum(bool(holds(result)) for result in results)
    return {
        "count": hits,
        "of": len(results),
        "interval": list(clopper_pearson(hits, len(results))) if results else None,
    }


def _distinct(results: Sequence[Result], name: str) -> list[str]:
    return list(dict.fromkeys(result[name] for result in results))


def _power(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Runs with one effect by its size; the smallest ones count as any other."""
    rows = []
    for low, high in pairwise(_SIZES):
        in_bin = [result for result in results if low <= result["size"] < high]
        detected = share(in_bin, lambda result: result["outcome"] not in ("no gap", "no answer"))
        right = share(in_bin, lambda result: result["outcome"] in ("named", "in class"))
        wrong = share(in_bin, lambda result: result["outcome"] in _WRONG)
        upper = None if np.isinf(high) else high
        rows.append({"from": low, "to": upper, "found": detected, "right": right, "wrong": wrong, **counts(in_bin)})
    return rows


def _calibration(results: Sequence[Result]) -> dict[str, Any]:
    """How often the first cause's class holds a true effect, against its probability: bins, Brier score and ECE."""
    stated = np.array([result["probability"] for result in results], dtype=float)
    true = np.array([result["outcome"] in ("named", "in class") for result in results], dtype=float)
    rows, error = [], 0.0
    for low, high in pairwise(_PROBABILITIES):
        in_bin = (stated >= low) & (stated < high)
        if count := int(in_bin.sum()):
            mean, came = float(stated[in_bin].mean()), float(true[in_bin].mean())
            error += abs(mean - came) * count / len(stated)
            rows.append({"from": low, "to": min(high, 1.0), "runs": count, "said": mean, "came": came})
    if not len(stated):
        return {"runs": 0, "bins": [], "brier": None, "ece": None}
    return {"runs": len(stated), "bins": rows, "brier": float(np.mean((stated - true) ** 2)), "ece": error}
