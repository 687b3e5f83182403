"""Criteria and searches, as the page tells them."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

from benchmarks.evidence import figures
from benchmarks.evidence.criteria import DEFAULT, SECONDS, SETTINGS
from benchmarks.evidence.results import Results
from benchmarks.evidence.search import GENETIC, METHODS, setting
from benchmarks.evidence.section import PageSection
from benchmarks.evidence.statistics import FEWEST, difference_of, each, mean_of, ratio_of, text, verdict

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
        "Equal genetic searches, each with one change from the default: log det of HᵀH/M with rows weighted by nominal "
        f"torque, 6 points, FLY, 1 m/s. Models use {_SHORT} and {_LONG} s of each loop. Ratios are over the default. "
        "Inverse torque is the metric of the paper's eq. 8. Learned noise is what a first fit leaves of each joint."
    )
    rows, picture = [], {}
    for name, lines in kept.items():
        errors = {s: each(lines, lambda v, s=s: v[s]["error"]) for s in (_SHORT, _LONG)}
        ratios = {s: ratio_of(errors[s], each(kept[DEFAULT], lambda v, s=s: v[s]["error"])) for s in errors}
        rows.append([name, str(len(lines)), *(text(r) for r in ratios.values())])
        if name != DEFAULT:
            said = {s: verdict(ratio, len(lines)) for s, ratio in ratios.items()}
            picture[name] = ratios[_SHORT], said[_SHORT]
            if "better" in said.values():
                part.weak.append(
                    f"{name} led to better models than the default: {text(ratios[_SHORT])} times its error after "
                    f"{_SHORT} s, {text(ratios[_LONG])} after {_LONG} s ({len(lines)} machines)"
                )
    part.table(
        ["loop", "machines", f"ratio, {_SHORT} s", f"ratio, {_LONG} s"],
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
    kept: dict[int, dict[str, dict]] = {}
    for piece, lines in results.items():
        budget = int(piece.rsplit("-", 1)[1])
        kept[budget] = {method: found for method in METHODS if (found := lines.of(setting(method, budget)))}
        if GENETIC not in kept[budget]:
            del kept[budget]
            part.weak.append(f"searches of {budget} candidates: not run")
    if kept:
        _methods(part, kept, pictures)
        _budgets(part, kept)
    return part


def _error(lines: dict) -> dict[int, float]:
    return each(lines, lambda v: v[_SHORT]["error"])


def _fitness(lines: dict) -> dict[int, float]:
    return {machine: values["fitness"] for machine, values in lines.items()}


def _methods(part: PageSection, kept: dict, pictures: Path) -> None:
    rows, picture = [], {}
    for budget, methods in kept.items():
        base = methods[GENETIC]
        for method, lines in methods.items():
            ratio = ratio_of(_error(lines), _error(base))
            above = difference_of(_fitness(lines), _fitness(base))
            row = [text(above, 1), text(mean_of(_error(lines))), text(ratio)]
            rows.append([method, str(budget), str(len(lines)), *row])
            if method == GENETIC:
                continue
            said = verdict(ratio, len(lines))
            picture[f"{method}, {budget}"] = ratio, said
            fitter = len(lines) >= FEWEST and above[1] > 0
            did = ["found fitter loops"] * fitter + ["led to better models"] * (said == "better")
            if did:
                part.weak.append(
                    f"{method} of {budget} candidates {' and '.join(did)} than the genetic search: by {text(above, 1)} "
                    f"decades, at {text(ratio)} times the error after {_SHORT} s ({len(lines)} machines)"
                )
    part.say(
        f"Models use {_SHORT} s of the best loop of each search. Ratios are over the genetic search of equal size. "
        "Fitness is the criterion itself, in decades of the determinant."
    )
    error = f"error after {_SHORT} s [%]"
    largest = str(max(kept))
    shown = [row for row in rows if row[1] == largest]
    part.table(["search", "candidates", "machines", "fitness above genetic", error, "ratio"], shown)
    figures.ratios(pictures / "search.svg", picture, f"error after {_SHORT} s over that of the genetic search")
    part.picture("search", "Ratio of errors by search")


def _budgets(part: PageSection, kept: dict) -> None:
    """What more candidates gain, on machines that have both."""
    for few, many in pairwise(kept):
        fewer, more = (kept[budget][GENETIC] for budget in (few, many))
        both = len(fewer.keys() & more.keys())
        if both and verdict(ratio := ratio_of(_error(more), _error(fewer)), both) != "better":
            part.weak.append(
                f"genetic searches of {many} candidates led to models that are not shown to be better than those "
                f"of {few}: {text(ratio)} times their error ({both} machines)"
            )
