"""Scores of a check with further motions: what each way to spend the robot's time made of what was open before it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from agent.blind_check import class_of, clopper_pearson, outcome

Entry = Mapping[str, Any]
#: The motion that is planned for what is open, and other ways to spend the same time: the excitation loop again, loops
#: of the sub-region at random, the D-optimal ones, and both of these with pieces of all the kinds that a plan has.
WAYS = ("planned", "loop_again", "random_loops", "d_optimal_loops", "random_pieces", "d_optimal_pieces")


def active_scores(entries: Sequence[Entry]) -> dict[str, Any]:
    """All figures, of entries with `first` and per way its `rounds`, each with a `result`."""
    done = [entry for entry in entries if "error" not in entry]
    one = [e for e in done if e["kind"] == "one"]
    ambiguous = [e for e in one if e["first"]["verdict"] == "ambiguous"]
    unnamed = [e for e in one if e["first"]["verdict"] in ("no_gap", "unknown")]
    asked = list(_asked(done))
    planned = [one for e in done for one in e["ways"].get("planned", ())]
    return {
        "runs": len(entries),
        "not_recorded": [
            {"run": e["number"], "why": why}
            for e in entries
            for why in ([e["error"]] if "error" in e else e.get("missing", ()))
        ],
        "first": dict(Counter(e["first"]["verdict"] for e in done)),
        "first_outcomes": dict(Counter(_outcome(e, e["first"]) for e in done)),
        "ambiguous": len(ambiguous),
        "unnamed": len(unnamed),
        "no_motion": sum(not e["ways"].get("planned") for e in ambiguous),
        "wrong_names_first": _share(_outcome(e, e["first"]) == "wrong name" for e in done),
        "ways": {way: _way(way, done, ambiguous, unnamed) for way in WAYS},
        "smallest_sizes": {way: _smallest(way, done) for way in WAYS},
        "calibration": _calibration(asked),
        "planning_s": float(np.median([one["planning_s"] for one in planned])) if planned else None,
        "cases": [_line(e) for e in done],
    }


def _way(way: str, done: Sequence[Entry], ambiguous: Sequence[Entry], unnamed: Sequence[Entry]) -> dict[str, Any]:
    """Shares of the runs that were `ambiguous` at first, of those with an effect of which nothing was named
    (`found_after_one`), and of all."""
    return {
        "right_after_one": _share(_outcome(e, _after(e, way, 1)) == "right" for e in ambiguous),
        "right_after_two": _share(_outcome(e, _after(e, way, 2)) == "right" for e in ambiguous),
        "found_after_one": _share(_outcome(e, _after(e, way, 1)) == "right" for e in unnamed),
        "wrong_names": _share(_outcome(e, _after(e, way, 2)) == "wrong name" for e in done),
        "right_with_tests": _share(_outcome(e, _with_tests(e, way)) == "right" for e in ambiguous),
        "wrong_with_tests": _share(_outcome(e, _with_tests(e, way)) == "wrong name" for e in done),
        "robot_s": float(sum(r["seconds"] for e in done for r in e["ways"].get(way, ()))),
    }


def _smallest(way: str, done: Sequence[Entry]) -> dict[str, Any]:
    """Of places that the first motion of a run without a gap leaves weak, more than a practical size being needed
    there, how the smallest size that would be found changes with one further motion; null was none of any size."""
    pairs = [
        (size, one["result"]["smallest"][place])
        for e in done
        for one in e["ways"].get(way, ())[:1]
        if "smallest" in e["first"] and "smallest" in one["result"]
        for place, size in e["first"]["smallest"].items()
        if size is None or size > 1
    ]
    both = [after / before for before, after in pairs if before is not None and after is not None]
    without = [after for before, after in pairs if before is None]
    return {
        "weak": len(pairs),
        "had_a_size": len(both),
        "of_before": float(np.exp(np.mean(np.log(both)))) if both else None,
        "had_none": len(without),
        "have_one": sum(after is not None for after in without),
        "halved": sum(after is not None and (before is None or 2 * after <= before) for before, after in pairs),
    }


def _after(entry: Entry, way: str, rounds: int) -> Mapping[str, Any]:
    """The result after so many further motions; what was said before stands where there was none."""
    results = [entry["first"], *(one["result"] for one in entry["ways"].get(way, ())[:rounds])]
    return results[-1]


def _with_tests(entry: Entry, way: str) -> Mapping[str, Any]:
    """The result after one further motion, and after seconds on the brakes where the first answer asks for them; of
    the planned way, with the mass that it asks for otherwise."""
    mass = entry.get("mass") if way == "planned" else None
    return entry.get("brakes", {}).get(way) or mass or _after(entry, way, 1)


def _outcome(entry: Entry, result: Mapping[str, Any]) -> str:
    came = outcome(entry["effects"], result)
    if entry["kind"] == "none":
        return "right" if came == "no gap" else "false alarm"
    return {"named": "right", "no gap": "missed", "wrong class": "no class"}.get(came, came)


def _share(hits: Iterable[bool]) -> dict[str, Any]:
    found = list(hits)
    interval = list(clopper_pearson(sum(found), len(found))) if found else None
    return {"count": sum(found), "of": len(found), "interval": interval}


def _asked(done: Sequence[Entry]) -> Iterator[tuple[float, bool]]:
    """Predicted probability of the right answer and whether it came, of pairs of which one side is the truth.

    What was predicted for that side, if anything was: how often either side is the truth is up to the draw.
    """
    for entry in done:
        truths = [_text(effect) for effect in entry["effects"]]
        for one in entry["ways"].get("planned", ()):
            for pair in one["expected"]:
                sides = [side for side in pair["pair"] if side in truths]
                if len(sides) == 1:
                    (rival,) = (side for side in pair["pair"] if side != sides[0])
                    said = pair["after_if"][pair["pair"].index(sides[0])]
                    if said is not None:
                        yield said, _answers(one["result"], sides[0], rival)


def _answers(result: Mapping[str, Any], truth: str, rival: str) -> bool:
    """Whether a result has the truth among the causes and what equals them, and the rival not."""
    members = [_text(member) for cause in result["causes"] for member in class_of(cause)]
    return truth in members and rival not in members


def _text(effect: Mapping[str, Any]) -> str:
    joints = ", ".join(effect["joints"])
    return f"{effect['effect']} on {joints}" if joints else str(effect["effect"])


def _calibration(asked: Sequence[tuple[float, bool]]) -> dict[str, Any]:
    if not asked:
        return {"pairs": 0, "overall": None}
    said, came = np.array(asked, dtype=float).T
    overall = {"said": float(said.mean()), "came": float(came.mean()), "brier": float(np.mean((said - came) ** 2))}
    return {"pairs": len(asked), "overall": overall}


def _line(entry: Entry) -> dict[str, Any]:
    """One run, without gaps."""
    line = {key: entry[key] for key in ("number", "kind", "effects", "strength")}
    line["first"] = _outcome(entry, entry["first"])
    for way in WAYS:
        line[way] = [_outcome(entry, one["result"]) for one in entry["ways"].get(way, ())]
    return line


def active_text(scores: Mapping[str, Any]) -> str:
    """Figures for a terminal."""
    first = ", ".join(f"{count} {verdict}" for verdict, count in sorted(scores["first"].items()))
    lines = [
        f"{scores['runs']} runs; after the first recording: {first}",
        f"ambiguous, and no motion of the sub-region would settle it: {scores['no_motion']} of {scores['ambiguous']}",
        "",
    ]
    lines += [
        "of runs ambiguous then: named rightly after one motion; after one and the tests that the tool asks for beside",
        "it, which are seconds on the brakes where an offset of a torque channel is open, and a known mass for the",
        "planned motion; after two motions; of those with an effect and no name: named rightly after one; wrong names",
        "in all runs, without the tests and with them",
        "",
        " " * 18 + "  after one   and tests  after two    no name     wrong     wrong    robot",
    ]
    for way, row in scores["ways"].items():
        shares = (f"{row[k]['count']} of {row[k]['of']}".rjust(width) for k, width in _COLUMNS.items())
        lines.append(f"{way.replace('_', ' '):18} {' '.join(shares)} {row['robot_s']:>6.0f} s")
    lines += ["", "smallest size that would be found, where nothing was and more than a practical one was needed"]
    for way, row in scores["smallest_sizes"].items():
        of_before = "" if row["of_before"] is None else f", {row['of_before']:.2f} of before on average"
        lines.append(
            f"{way.replace('_', ' '):25} halved for {row['halved']} of {row['weak']}{of_before}; "
            f"of {row['had_none']} that had none {row['have_one']} have one"
        )
    wrong = scores["wrong_names_first"]
    lines += ["", f"wrong names without further motions: {wrong['count']} of {wrong['of']}"]
    overall = scores["calibration"]["overall"]
    if overall is not None:
        lines.append(
            f"probability of the right answer: predicted {overall['said']:.2f}, came {overall['came']:.2f} "
            f"({scores['calibration']['pairs']} pairs, Brier score {overall['brier']:.3f})"
        )
    return "\n".join(lines)


_COLUMNS = {
    "right_after_one": 10,
    "right_with_tests": 11,
    "right_after_two": 10,
    "found_after_one": 10,
    "wrong_names": 9,
    "wrong_with_tests": 9,
}
