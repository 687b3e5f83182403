"""Scores of a check with further motions: what each way to spend the robot's time made of what was open before it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from agent.blind_check import class_of, clopper_pearson, outcome

Entry = Mapping[str, Any]
#: The motion planned for what is open, and other uses of the same time: the excitation loop again, and pieces of the
#: kinds that a plan has, at random or D-optimal.
WAYS = ("planned", "loop_again", "random_pieces", "d_optimal_pieces")


def active_scores(entries: Sequence[Entry]) -> dict[str, Any]:
    """All figures, of entries as `ActiveRun.entry` has them."""
    done = [entry for entry in entries if "error" not in entry]
    one = [e for e in done if e["kind"] == "one"]
    ambiguous = [e for e in one if e["first"]["verdict"] == "ambiguous"]
    unnamed = [e for e in one if e["first"]["verdict"] in ("no_gap", "unknown")]
    planning = [e["ways"]["planned"]["planning_s"] for e in done if "planned" in e["ways"]]
    return {
        "runs": len(entries),
        "not_recorded": [
            {"run": e["number"], "why": why}
            for e in entries
            for why in ([e["error"]] if "error" in e else e.get("missing", ()))
        ],
        "first": dict(Counter(e["first"]["verdict"] for e in done)),
        "ambiguous": len(ambiguous),
        "unnamed": len(unnamed),
        "no_motion": sum("planned" not in e["ways"] for e in ambiguous),
        "wrong_names_first": _share(_outcome(e, e["first"]) == "wrong name" for e in done),
        "ways": {way: _way(way, done, ambiguous, unnamed) for way in WAYS},
        "calibration": _calibration(list(_asked(done))),
        "planning_s": float(np.median(planning)) if planning else None,
        "cases": [_line(e) for e in done],
    }


def _way(way: str, done: Sequence[Entry], ambiguous: Sequence[Entry], unnamed: Sequence[Entry]) -> dict[str, Any]:
    """Shares of the runs that were `ambiguous` at first, of those with an effect of which nothing was named, of all."""
    return {
        "right": _share(_outcome(e, _after(e, way)) == "right" for e in ambiguous),
        "right_with_tests": _share(_outcome(e, _with_tests(e, way)) == "right" for e in ambiguous),
        "found": _share(_outcome(e, _after(e, way)) == "right" for e in unnamed),
        "wrong_names": _share(_outcome(e, _after(e, way)) == "wrong name" for e in done),
        "robot_s": float(sum(e["ways"][way]["seconds"] for e in done if way in e["ways"])),
    }


def _after(entry: Entry, way: str) -> Mapping[str, Any]:
    """The result after the motion of a way; the first result where there was none."""
    return entry["ways"][way]["result"] if way in entry["ways"] else entry["first"]


def _with_tests(entry: Entry, way: str) -> Mapping[str, Any]:
    """For the planned way, the result with the drives off or with the mass that the tool asks for."""
    return (entry.get("tests") if way == "planned" else None) or _after(entry, way)


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

    The prediction for that side, where there is one: how often either side is the truth is up to the draw.
    """
    for entry in done:
        truths = [_text(effect) for effect in entry["effects"]]
        planned = entry["ways"].get("planned", {"expected": ()})
        for pair in planned["expected"]:
            sides = [side for side in pair["pair"] if side in truths]
            if len(sides) == 1:
                (rival,) = (side for side in pair["pair"] if side != sides[0])
                said = pair["after_if"][pair["pair"].index(sides[0])]
                if said is not None:
                    yield said, _answers(planned["result"], sides[0], rival)


def _answers(result: Mapping[str, Any], truth: str, rival: str) -> bool:
    """Whether a result has the truth, and not the rival, among the causes and their equivalents."""
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
    """One run, without numbers of its diagnosis."""
    line = {key: entry[key] for key in ("number", "kind", "effects", "strength")}
    ways = {way: _outcome(entry, one["result"]) for way, one in entry["ways"].items()}
    return {**line, "first": _outcome(entry, entry["first"]), **ways}


def active_text(scores: Mapping[str, Any]) -> str:
    """Figures for a terminal."""
    first = ", ".join(f"{count} {verdict}" for verdict, count in sorted(scores["first"].items()))
    wrong, overall = scores["wrong_names_first"], scores["calibration"]["overall"]
    lines = [
        f"{scores['runs']} runs; after the first recording: {first}",
        f"ambiguous, and no motion of the sub-region would settle it: {scores['no_motion']} of {scores['ambiguous']}",
        f"wrong names without further motions: {wrong['count']} of {wrong['of']}",
        "",
        "Of ambiguous runs: named rightly after one motion, and with the tests that the tool asks for (drives off, a",
        "known mass). Of runs with an effect and no name: named rightly. Wrong names in all runs.",
        "",
        " " * 18 + "     right   and tests   no name     wrong    robot",
    ]
    for way, row in scores["ways"].items():
        shares = [f"{row[key]['count']} of {row[key]['of']}" for key in ("right", "right_with_tests", "found")]
        shares.append(f"{row['wrong_names']['count']} of {row['wrong_names']['of']}")
        cells = " ".join(share.rjust(width) for share, width in zip(shares, (9, 11, 9, 9), strict=True))
        lines.append(f"{way.replace('_', ' '):18} {cells} {row['robot_s']:>6.0f} s")
    if overall is not None:
        lines.append(
            f"probability of the right answer: predicted {overall['said']:.2f}, came {overall['came']:.2f} "
            f"({scores['calibration']['pairs']} pairs, Brier score {overall['brier']:.3f})"
        )
    return "\n".join(lines)
