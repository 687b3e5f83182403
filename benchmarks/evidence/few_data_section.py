"""Few and long data, as the page tells them."""

from __future__ import annotations

from pathlib import Path

from benchmarks.evidence import figures
from benchmarks.evidence.few_data import AS_DRAWN, PRIORS, wrong
from benchmarks.evidence.results import Results
from benchmarks.evidence.section import PageSection
from benchmarks.evidence.statistics import each, mean_of, text

_ENOUGH = 90.0  # % of samples, of 95 % intervals


def section(results: Results, pictures: Path) -> PageSection:
    """The section; empty but for what is missing where nothing was run."""
    part = PageSection()
    part.say("## Few data and long data")
    kept = {name: lines for name in (AS_DRAWN, *map(wrong, PRIORS)) if (lines := results.of(name))}
    if not kept:
        part.weak.append("few data: not run")
        return part
    part.say(
        "The first seconds of the default's loop; one pass takes about 6 s. The emulator's links are within 13 % of "
        "the URDF, so the same logs are also fitted with URDFs that are wrong by up to the given percentage in mass "
        "and inertia."
    )
    _errors(part, kept, pictures)
    _coverage(part, kept)
    _estimators(part, kept)
    return part


def _of(lines: dict, method: str, seconds: str, key: str) -> dict[int, float]:
    return each({m: v for m, v in lines.items() if seconds in v[method]}, lambda v: v[method][seconds][key])


def _lengths(lines: dict, method: str = "weighted") -> list[str]:
    return list(next(iter(lines.values()))[method])


def _errors(part: PageSection, kept: dict, pictures: Path) -> None:
    drawn = {
        name: {float(s): mean_of(_of(lines, "weighted", s, "error")) for s in _lengths(lines)}
        for name, lines in kept.items()
    }
    figures.curves(pictures / "few-data.svg", drawn, ("seconds of motion", "error [% of nominal torque]"), "xy")
    part.picture("few-data", "Error against seconds of motion, by quality of the prior")


def _coverage(part: PageSection, kept: dict) -> None:
    short = [
        f"{name}, {s} s: {share:.0f} %"
        for name, lines in kept.items()
        for s in _lengths(lines)
        if (share := mean_of(_of(lines, "weighted", s, "covered"))[0]) < _ENOUGH
    ]
    if short:
        part.weak.append(
            f"prediction intervals of 95 % cover less than {_ENOUGH:g} % of the samples with: " + "; ".join(short)
        )


def _estimators(part: PageSection, kept: dict) -> None:
    if AS_DRAWN not in kept:
        return
    lines = kept[AS_DRAWN]
    heads = _lengths(lines)
    rows = []
    for method in ("weighted", "consistent", "paper"):
        errors = {s: _of(lines, method, s, "error") for s in _lengths(lines, method)}
        rows.append([f"`{method}` [%]", *(text(mean_of(errors[s])) if s in errors else "-" for s in heads)])
    part.say("By estimator, with the URDF as it is. `paper` has no prior and three friction terms:")
    part.table(["estimator", *(f"{s} s" for s in heads)], rows)
