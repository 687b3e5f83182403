"""Scores of a blind check: plain counts of plain entries, by definitions that docs/blind-check.md repeats."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from agent.diagnosis import in_torque

Entry = Mapping[str, Any]

#: An ambiguous answer counts as right where its class has no more members than this and holds the truth.
LARGEST_CLASS = 3
_POWER_EDGES = (0.0, 0.005, 0.01, 0.02, 0.04, np.inf)  # of nominal torque
_PROBABILITY_EDGES = (0.0, 0.6, 0.8, 0.9, 0.95, 1.0001)


def outcome(entry: Entry) -> str:
    """What became of one run, in a word or two.

    `right`, `in class` (ambiguous, with the truth among at most three), `no class` (ambiguous without it or with too
    many), `wrong name`, `missed` (no gap seen), `unknown` (abstained), `false alarm`, `not recorded`.
    """
    if "error" in entry:
        return "not recorded"
    result, kind = entry["result"], entry["kind"]
    verdict = result["verdict"]
    if kind == "none":
        return "right" if verdict == "no_gap" else "false alarm"
    if kind == "outside":
        return {"unknown": "right", "no_gap": "missed", "ambiguous": "no class"}.get(verdict, "wrong name")
    if kind == "small" and verdict == "no_gap":
        return "right"
    if verdict in ("no_gap", "unknown"):
        return "missed" if verdict == "no_gap" else "unknown"
    first = result["causes"][0]
    members = class_of(first)
    if verdict == "explained":
        return "right" if _among(members[:1], entry["effects"]) else "wrong name"
    return "in class" if len(members) <= LARGEST_CLASS and _among(members, entry["effects"]) else "no class"


def class_of(cause: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """A cause and what the data cannot tell from it."""
    return [cause, *cause["equivalent_to"]]


def _same(member: Mapping[str, Any], effect: Mapping[str, Any]) -> bool:
    return member["effect"] == effect["effect"] and set(member["joints"]) == set(effect["joints"])


def _among(members: Iterable[Mapping[str, Any]], effects: Iterable[Mapping[str, Any]]) -> bool:
    return any(_same(member, effect) for member in members for effect in effects)


def clopper_pearson(hits: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval of a proportion (Clopper, Pearson, Biometrika 1934)."""
    from scipy.stats import beta

    tail = 0.5 * (1.0 - confidence)
    lower = 0.0 if hits == 0 else float(beta.ppf(tail, hits, trials - hits + 1))
    upper = 1.0 if hits == trials else float(beta.ppf(1.0 - tail, hits + 1, trials - hits))
    return lower, upper


def score(entries: Sequence[Entry]) -> dict[str, Any]:
    """All figures, and a line for every run."""
    done = [entry for entry in entries if "error" not in entry]
    free, outside, small, two, named = (_of(done, *k.split()) for k in ("none", "outside", "small", "two", "one two"))
    seconds = [e["seconds"] for e in done]
    return {
        "runs": len(entries),
        "kinds": dict(Counter(e["kind"] for e in entries)),
        "outcomes": {
            kind: dict(Counter(e["outcome"] for e in entries if e["kind"] == kind)) for kind in _kinds(entries)
        },
        "not_recorded": [{"run": e["number"], "why": e["error"]} for e in entries if "error" in e],
        **_main_figures(done),
        "top_3": _proportion(named, _in_top_three),
        "both_of_two": _proportion(two, _both_named),
        "joint": _proportion([e for e in named + outside if _joints_of(e)], _joint_right),
        "unknowns_named": _proportion(outside, lambda e: e["outcome"] == "wrong name"),
        "too_small_left_alone": _proportion(small, lambda e: e["outcome"] in ("right", "in class")),
        "withheld": _withheld(named),
        "closure": _closures(named),
        "power": _power([e for e in named + small if len(e["effects"]) == 1]),
        "calibration": _calibration([e for e in done if e["kind"] != "small" and e["result"]["causes"]]),
        "confusion": _confusion([e for e in done if len(e["effects"]) == 1 and e["kind"] != "small"], free),
        "diagnosis_cpu_seconds": float(np.median(seconds)) if seconds else None,
        "recorders": {name: _recorder(done, name) for name in sorted({e["recorder"] for e in done if "recorder" in e})},
        "cases": [_line(e) for e in entries],
    }


def _main_figures(done: Sequence[Entry]) -> dict[str, Any]:
    """Of runs that were diagnosed, by what was there."""
    named = _of(done, "one", "two")
    return {
        "false_alarms": _proportion(_of(done, "none"), lambda e: e["result"]["verdict"] != "no_gap"),
        "top_1": _proportion(named, lambda e: e["outcome"] in ("right", "in class")),
        "wrong_names": _proportion(named, lambda e: e["outcome"] == "wrong name"),
        "unknowns_recognised": _proportion(_of(done, "outside"), lambda e: e["outcome"] == "right"),
    }


def _recorder(done: Sequence[Entry], name: str) -> dict[str, Any]:
    """The main figures of the runs whose logs were kept in one way."""
    entries = [e for e in done if e.get("recorder") == name]
    return {
        "runs": len(entries),
        **_main_figures(entries),
        "of_oracle": _closures(_of(entries, "one", "two"))["of_oracle"],
        "brier": _calibration([e for e in entries if e["kind"] != "small" and e["result"]["causes"]])["brier"],
    }


def _of(entries: Sequence[Entry], *kinds: str) -> list[Entry]:
    return [e for e in entries if e["kind"] in kinds]


def _kinds(entries: Sequence[Entry]) -> list[str]:
    return sorted({e["kind"] for e in entries})


def _proportion(entries: Sequence[Entry], holds: Callable[[Entry], bool]) -> dict[str, Any]:
    hits = sum(bool(holds(e)) for e in entries)
    if not entries:
        return {"count": 0, "of": 0, "share": None, "interval": None}
    return {
        "count": hits,
        "of": len(entries),
        "share": hits / len(entries),
        "interval": list(clopper_pearson(hits, len(entries))),
    }


def _in_top_three(entry: Entry) -> bool:
    members = [member for cause in entry["result"]["causes"][:3] for member in class_of(cause)]
    return _among(members[:LARGEST_CLASS], entry["effects"])


def _both_named(entry: Entry) -> bool:
    members = [member for cause in entry["result"]["causes"] for member in class_of(cause)[:LARGEST_CLASS]]
    return all(_among(members, [effect]) for effect in entry["effects"])


def _joints_of(entry: Entry) -> list[set[str]]:
    return [set(effect["joints"]) for effect in entry["effects"] if effect["joints"]]


def _joint_right(entry: Entry) -> bool:
    """The first cause sits on a true joint; where no cause is named, the joint with the largest share is one."""
    result = entry["result"]
    if result["verdict"] == "no_gap":
        return False
    if result["causes"]:
        said = set(result["causes"][0]["joints"])
        if not said:  # an arm effect named first, rightly or not
            return _among([result["causes"][0]], entry["effects"])
        return any(said == joints for joints in _joints_of(entry))
    return any(result["where"][0]["joint"] in joints for joints in _joints_of(entry))


def _withheld(entries: Sequence[Entry]) -> dict[str, Any]:
    """With every true effect out of the catalogue: what was said instead."""
    asked = [e for e in entries if "withheld" in e]
    verdicts = Counter(e["withheld"]["verdict"] for e in asked)
    return {
        "verdicts": dict(verdicts),
        "confident_wrong_names": _proportion(asked, lambda e: e["withheld"]["verdict"] == "explained"),
        "names": dict(
            Counter(
                f"{' + '.join(x['effect'] for x in e['effects'])} → {e['withheld']['causes'][0]['effect']}"
                for e in asked
                if e["withheld"]["verdict"] == "explained"
            )
        ),
    }


def _closures(entries: Sequence[Entry]) -> dict[str, Any]:
    """Medians over runs, and of the diagnosis over the oracle."""
    both = [e for e in entries if e.get("closures", {}).get("oracle") and e["result"]["closure"] is not None]

    def median(values: list[float]) -> float | None:
        return float(np.median(values)) if values else None

    def of(name: str) -> list[float]:
        return [e["closures"][name] for e in both if e["closures"][name] is not None]

    return {
        "runs": len(both),
        "diagnosis": median([e["result"]["closure"] for e in both]),
        "oracle": median(of("oracle")),
        "of_oracle": median([e["result"]["closure"] / e["closures"]["oracle"] for e in both]),
        "wrong_effect": median(of("wrong")),
        "black_box": median(of("black_box")),
    }


def _power(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Share found and named by how much the effect changes the torque; the set-points have no such size."""
    seen = [e for e in entries if in_torque(e["effects"][0])]
    rows = []
    for low, high in pairwise(_POWER_EDGES):
        here = [e for e in seen if low <= e["size"] < high]
        rows.append(
            {
                "from": low,
                "to": None if np.isinf(high) else high,
                "found": _proportion(here, lambda e: e["result"]["verdict"] != "no_gap"),
                "named": _proportion(here, _in_class_or_named),
            }
        )
    return rows


def _in_class_or_named(entry: Entry) -> bool:
    return bool(entry["result"]["causes"]) and entry["outcome"] in ("right", "in class")


def _calibration(entries: Sequence[Entry]) -> dict[str, Any]:
    """Of all runs with a cause: how often the first one's class held the truth, against its probability."""
    said = np.array([e["result"]["causes"][0]["probability"] for e in entries])
    true = np.array([_among(class_of(e["result"]["causes"][0]), e["effects"]) for e in entries], dtype=float)
    rows = []
    for low, high in pairwise(_PROBABILITY_EDGES):
        here = (said >= low) & (said < high)
        if here.any():
            rows.append(
                {
                    "from": low,
                    "to": min(high, 1.0),
                    "runs": int(here.sum()),
                    "mean_probability": float(said[here].mean()),
                    "share_true": float(true[here].mean()),
                }
            )
    return {"bins": rows, "brier": float(np.mean((said - true) ** 2)) if len(said) else None}


def _confusion(single: Sequence[Entry], free: Sequence[Entry]) -> dict[str, dict[str, int]]:
    """Rows: what was there; columns: what was said (the first cause, or the verdict where there is none)."""
    table: dict[str, Counter[str]] = {}
    for entry in [*free, *single]:
        row = entry["effects"][0]["effect"] if entry["effects"] else "nothing"
        table.setdefault(row, Counter())[_said(entry)] += 1
    return {row: dict(counts) for row, counts in sorted(table.items())}


def _said(entry: Entry) -> str:
    result = entry["result"]
    if entry["outcome"] == "in class":
        return entry["effects"][0]["effect"]
    return result["causes"][0]["effect"] if result["causes"] else result["verdict"]


def _line(entry: Entry) -> dict[str, Any]:
    """One run without its gaps and regimes."""
    line = {key: entry.get(key) for key in ("number", "kind", "recorder", "strength", "size", "effects", "outcome")}
    for name in ("result", "withheld"):
        if name in entry:
            found = entry[name]
            line["said" if name == "result" else "said_without"] = {
                "verdict": found["verdict"],
                "closure": found["closure"],
                "causes": found["causes"],
                "where": {w["joint"]: round(w["share"], 3) for w in found["where"]},
                "before": found["gap"]["before"],
                "after": found["gap"]["after"],
            }
    if "closures" in entry:
        line["closures"] = entry["closures"]
    return line
