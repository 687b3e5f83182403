"""Criteria and searches, as the page tells them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from benchmarks.evidence import figures
from benchmarks.evidence.criteria import DEFAULT, SECONDS, SETTINGS
from benchmarks.evidence.results import Results
from benchmarks.evidence.search import METHODS, setting
from benchmarks.evidence.section import PageSection
from benchmarks.evidence.statistics import each, mean_of, ratio_of, text, verdict

_SHORT, _LONG = (f"{seconds:g}" for seconds in SECONDS)


def criteria(results: Results, pictures: Path) -> PageSection:
    """What a loop is searched for."""
    part = PageSection()
    part.say("## What a loop is searched for")
    kept = {name: lines for name in SETTINGS if (lines := results.of(name))}
    if DEFAULT not in kept:
        part.weak.append("criteria, numbers of points, stops and speeds: not run")
        return part
    part.say(
        "Equal genetic searches, each with one thing changed from the default (log det of HᵀH/M with rows weighted by "
        f"nominal torque, 6 points, FLY, 1 m/s). Models of {_SHORT} and {_LONG} s of each loop on the emulator's "
        "machine as it is. Ratios are over the default; interval width is what the parameters' uncertainty has in the "
        "95 % interval of a prediction. Inverse torque is the metric of the paper's eq. 8; learned noise is what a "
        "first fit leaves of each joint; A, E and the condition number are of columns scaled to the size that they "
        "have over the arm's range."
    )
    rows, picture = [], {}
    for name, lines in kept.items():
        errors = {s: each(lines, lambda v, s=s: v[s]["error"]) for s in (_SHORT, _LONG)}
        ratios = {s: ratio_of(errors[s], each(kept[DEFAULT], lambda v, s=s: v[s]["error"])) for s in errors}
        width = ratio_of(*(each(group, lambda v: v[_SHORT]["parameters"]) for group in (lines, kept[DEFAULT])))
        worst = mean_of({m: max(v[_SHORT]["error"]) for m, v in lines.items()})[0]
        covered = mean_of(each(lines, lambda v: v[_SHORT]["covered"]))[0]
        rows.append(
            [
                name,
                str(len(lines)),
                text(mean_of(errors[_SHORT])),
                f"{worst:.2f}",
                *(text(r) for r in ratios.values()),
                text(width),
                f"{covered:.0f}",
            ]
        )
        if name != DEFAULT:
            said = {s: verdict(ratio, len(lines)) for s, ratio in ratios.items()}
            picture[name] = ratios[_SHORT], said[_SHORT]
            if "better" in said.values():
                part.weak.append(
                    f"{name} led to better models than the default: {text(ratios[_SHORT])} times its error after "
                    f"{_SHORT} s, {text(ratios[_LONG])} after {_LONG} s ({len(lines)} machines)"
                )
    part.table(
        [
            "loop",
            "machines",
            f"error after {_SHORT} s [%]",
            "worst axis",
            f"ratio, {_SHORT} s",
            f"ratio, {_LONG} s",
            f"interval width, {_SHORT} s",
            "covered [%]",
        ],
        rows,
    )
    if picture:
        figures.ratios(pictures / "criteria.svg", picture, f"error after {_SHORT} s over that of the default")
        part.picture("criteria", "Ratio of errors by what the loop was searched for")
    return part


def searches(results: Mapping[str, Results], pictures: Path) -> PageSection:
    """How it is searched."""
    part = PageSection()
    part.say("## How it is searched")
    rows, picture = [], {}
    for piece, kept in results.items():
        budget = int(piece.rsplit("-", 1)[1])
        base = kept.of(setting("genetic", budget))
        if not base:
            part.weak.append(f"searches of {budget} candidates: not run")
            continue
        for method in METHODS:
            if not (lines := kept.of(setting(method, budget))):
                continue
            error = each(lines, lambda v: v[_SHORT]["error"])
            ratio = ratio_of(error, each(base, lambda v: v[_SHORT]["error"]))
            width = ratio_of(*(each(group, lambda v: v[_SHORT]["parameters"]) for group in (lines, base)))
            fitness = mean_of({m: v["fitness"] for m, v in lines.items()})
            rows.append(
                [method, str(budget), str(len(lines)), text(fitness, 1), text(mean_of(error)), text(ratio), text(width)]
            )
            if method != "genetic":
                picture[f"{method}, {budget}"] = ratio, verdict(ratio, len(lines))
    if rows:
        part.say(
            f"Every search has the seed of its machine; models of {_SHORT} s of the best loop of each. Ratios are over "
            "the genetic search of equal size. Fitness is the criterion itself: how well a search does its own job."
        )
        part.table(
            ["search", "candidates", "machines", "fitness", f"error after {_SHORT} s [%]", "ratio", "interval width"],
            rows,
        )
        figures.ratios(pictures / "search.svg", picture, f"error after {_SHORT} s over that of the genetic search")
        part.picture("search", "Ratio of errors by search")
    return part
