"""Local against global, as the page tells it."""

from __future__ import annotations

from pathlib import Path

from benchmarks.evidence import figures
from benchmarks.evidence.emulation import WORLDS
from benchmarks.evidence.local import DISTANCES, SECONDS
from benchmarks.evidence.results import Results
from benchmarks.evidence.section import PageSection
from benchmarks.evidence.statistics import each, mean_of, ratio_of, text, verdict

LOCAL, GLOBAL = "sub-region", "workspace"
_ENOUGH = 90.0  # % of samples, of 95 % intervals
_ALIKE = 1.05  # a ratio that nobody would notice


def section(results: Results, pictures: Path) -> PageSection:
    """The section; empty but for what is missing where nothing was run."""
    part = PageSection()
    part.say("## Local against global")
    worlds = {world: lines for world in WORLDS if (lines := results.of(world))}
    if not worlds:
        part.weak.append("local against global: not run")
        return part
    part.say(
        f"Each machine is calibrated from {max(SECONDS):g} s in the sub-region (straight lines at 1 m/s) and from the "
        "same time over the whole workspace (joint by joint, at 40 % of its speeds). Searches, criterion and estimator "
        "are the same. Ratios are local over global: below 1, local is better. `covered` is the share of moving "
        "samples within the 95 % intervals, local / global."
    )
    _errors(part, worlds, pictures)
    _outside(part, worlds, pictures)
    part.say("The worlds:", "", *(f"- **{name}**: {what}" for name, what in WORLDS.items()))
    return part


def _near(way: str):
    return lambda lines: each(lines, lambda values: values[way]["near"]["error"])


def _errors(part: PageSection, worlds: dict, pictures: Path) -> None:
    rows, found, short = [], {}, []
    for world, lines in worlds.items():
        local, wide = _near(LOCAL)(lines), _near(GLOBAL)(lines)
        ratio = ratio_of(local, wide)
        wins = sum(local[m] < wide[m] for m in lines)
        covered = [
            mean_of(each(lines, lambda v, way=way: v[way]["intervals"]["covered"]))[0] for way in (LOCAL, GLOBAL)
        ]
        rows.append(
            [
                world,
                str(len(lines)),
                text(mean_of(local)),
                text(mean_of(wide)),
                text(ratio),
                f"{wins} of {len(lines)}",
                " / ".join(f"{share:.0f}" for share in covered),
            ]
        )
        found[world] = ratio, verdict(ratio, len(lines))
        if covered[0] < _ENOUGH:
            short.append(f"{world} {covered[0]:.0f} % ({covered[1]:.0f} %)")
        if found[world][1] != "better":
            part.weak.append(
                f"{world}: local calibration is {_compared(*found[world])} global in the sub-region itself, "
                f"{text(ratio)} times its error ({len(lines)} machines)"
            )
    if short:
        part.weak.append(
            "intervals know nothing of what the model has no term for; those of a local (global) calibration cover: "
            + ", ".join(short)
        )
    part.table(
        [
            "world",
            "machines",
            "local [%]",
            "global [%]",
            "ratio",
            "local won",
            "covered [%]",
        ],
        rows,
    )
    better = sum(said == "better" for _, said in found.values())
    part.say(f"Local calibration is better in {better} of {len(found)} worlds.")
    figures.ratios(pictures / "local.svg", found, "error of local over error of global calibration")
    part.picture("local", "Ratio of errors by world")


def _compared(ratio: tuple[float, float, float], said: str) -> str:
    if ratio[2] < _ALIKE:
        return "as wrong as"
    return "worse than" if said == "worse" else "not shown to be better than"


def _outside(part: PageSection, worlds: dict, pictures: Path) -> None:
    part.say(
        "### Away from the sub-region",
        "",
        "Boxes of the same size at growing distance, at 0.25 m/s; then motions over the whole workspace.",
    )
    at = {
        world: {
            d: ratio_of(*(each(lines, lambda v, way=way, d=d: v[way]["away"][f"{d:g}"]) for way in (LOCAL, GLOBAL)))
            for d in DISTANCES
        }
        for world, lines in worlds.items()
    }
    far = {
        world: ratio_of(*(each(lines, lambda v, way=way: v[way]["far"]) for way in (LOCAL, GLOBAL)))
        for world, lines in worlds.items()
    }
    figures.curves(pictures / "distance.svg", at, ("distance from the sub-region [m]", "error, local over global"), "y")
    part.picture("distance", "Ratio of errors against distance from the sub-region")
    part.table(["world", "motions over the whole workspace"], [[world, text(ratio)] for world, ratio in far.items()])
