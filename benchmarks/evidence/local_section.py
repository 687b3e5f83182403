"""Local against global, as the page tells it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from agent.recipe import Recipe
from benchmarks.evidence import figures
from benchmarks.evidence.emulation import WORLDS
from benchmarks.evidence.local import DISTANCES, SECONDS
from benchmarks.evidence.results import Results
from benchmarks.evidence.section import PageSection
from benchmarks.evidence.statistics import each, mean_of, ratio_of, text, verdict
from fake_controller.actuation.machine import COULOMB

LOCAL, GLOBAL = "sub-region", "workspace"
_ENOUGH = 90.0  # % of samples, of 95 % intervals
_ALIKE = 1.05  # a ratio that nobody would notice
_FIRST, _LAST = slice(0, 3), slice(3, None)


def section(results: Results, recipe: Recipe, pictures: Path) -> PageSection:
    """The section; empty but for what is missing where nothing was run."""
    part = PageSection()
    part.say("## Local against global")
    worlds = {world: lines for world in WORLDS if (lines := results.of(world))}
    if not worlds:
        part.weak.append("local against global: not run")
        return part
    part.say(
        f"Each machine is calibrated from {max(SECONDS):g} s of motion in the sub-region (straight lines at 1 m/s) and "
        "from as many over the whole workspace (joint by joint between points anywhere in its ranges, at 40 % of its "
        "speeds), by searches, criterion and estimator that are the same. Ratios are local over global: below 1 local "
        "is better; `covered` is the share of samples in motion within the 95 % intervals of either."
    )
    _errors(part, worlds, pictures)
    _outside(part, worlds, pictures)
    _seconds(part, worlds)
    _axes(part, worlds, recipe, pictures)
    part.say("The worlds:", "", *(f"- **{name}**: {what}" for name, what in WORLDS.items()))
    return part


def _near(way: str, joints: slice = slice(None)):
    return lambda lines: each(lines, lambda values: values[way]["near"]["error"], joints)


def _errors(part: PageSection, worlds: dict, pictures: Path) -> None:
    rows, found, short = [], {}, []
    for world, lines in worlds.items():
        local, wide = _near(LOCAL)(lines), _near(GLOBAL)(lines)
        ratios = {
            name: ratio_of(_near(LOCAL, joints)(lines), _near(GLOBAL, joints)(lines))
            for name, joints in (("all", slice(None)), ("1 to 3", _FIRST), ("4 to 6", _LAST))
        }
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
                *(text(ratio) for ratio in ratios.values()),
                f"{wins} of {len(lines)}",
                " / ".join(f"{share:.0f}" for share in covered),
            ]
        )
        found[world] = ratios["all"], verdict(ratios["all"], len(lines))
        if covered[0] < _ENOUGH:
            short.append(f"{world} {covered[0]:.0f} % ({covered[1]:.0f} %)")
        if found[world][1] != "better":
            part.weak.append(
                f"{world}: local calibration is {_compared(*found[world])} global in the sub-region itself, "
                f"{text(ratios['all'])} times its error ({len(lines)} machines)"
            )
    if short:
        part.weak.append(
            "95 % intervals know nothing of what the model has no term for; of the samples in motion those of a local "
            "calibration (a global one) cover: " + ", ".join(short)
        )
    part.table(
        [
            "world",
            "machines",
            "local [%]",
            "global [%]",
            "ratio",
            "joints 1 to 3",
            "joints 4 to 6",
            "local won",
            "covered [%]",
        ],
        rows,
    )
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
        "Boxes of the same size whose middle lies further and further away, at 0.25 m/s; and "
        "motions over the whole workspace.",
    )
    rows, lines_drawn = [], {}
    for world, lines in worlds.items():
        at = {
            d: ratio_of(*(each(lines, lambda v, way=way, d=d: v[way]["away"][f"{d:g}"]) for way in (LOCAL, GLOBAL)))
            for d in DISTANCES
        }
        far = ratio_of(*(each(lines, lambda v, way=way: v[way]["far"]) for way in (LOCAL, GLOBAL)))
        rows.append([world, *(text(ratio) for ratio in at.values()), text(far)])
        lines_drawn[world] = at
    part.table(["world", *(f"{d:g} m" for d in DISTANCES), "whole workspace"], rows)
    figures.curves(
        pictures / "distance.svg", lines_drawn, ("distance from the sub-region [m]", "error, local over global"), "y"
    )
    part.picture("distance", "Ratio of errors against distance from the sub-region")


def _seconds(part: PageSection, worlds: dict) -> None:
    part.say(
        "### Seconds of motion for the same error",
        "",
        f"Error in the sub-region after so many seconds, and on how many machines a local calibration of "
        f"{SECONDS[0]:g} s is at least as good as a global one of {SECONDS[-1]:g} s, and the other way round.",
    )
    rows = []
    for world, lines in worlds.items():
        cells = []
        for way in (LOCAL, GLOBAL):
            errors = [mean_of(each(lines, lambda v, s=s, way=way: v[way]["after"][f"{s:g}"]))[0] for s in SECONDS]
            cells.append(", ".join(f"{value:.2f}" for value in errors))
        short, long = f"{SECONDS[0]:g}", f"{SECONDS[-1]:g}"
        for first, second in ((LOCAL, GLOBAL), (GLOBAL, LOCAL)):
            won = sum(np.mean(v[first]["after"][short]) <= np.mean(v[second]["after"][long]) for v in lines.values())
            cells.append(f"{won} of {len(lines)}")
        rows.append([world, *cells])
    heads = [f"{way} after {', '.join(f'{s:g}' for s in SECONDS)} s [%]" for way in ("local", "global")]
    part.table(["world", *heads, "local first", "global first"], rows)


def _axes(part: PageSection, worlds: dict, recipe: Recipe, pictures: Path) -> None:
    world = next(iter(worlds))
    lines = worlds[world]
    part.say(
        "### The last three axes, and why",
        "",
        "By axis, local calibration, machine as it is: error of "
        "all samples, of samples in which the joint moves, in which it rests, and the share of those; what the bodies' "
        "parameters alone get wrong; RMS torque and the type's Coulomb friction. In percent of nominal torque but for "
        "the share and the last row.",
    )
    figures_of = [values[LOCAL]["near"] for values in lines.values()]
    table = {key: np.nanmean([near[key] for near in figures_of], axis=0) for key in figures_of[0]}
    table["share at rest"] = np.mean([_share_at_rest(near) for near in figures_of], axis=0)
    if recipe.robot.name in COULOMB:
        table["Coulomb friction"] = 100 * np.array(COULOMB[recipe.robot.name]) / recipe.robot.nominal_torque
    names = {"relative": "error over torque", "bodies": "bodies' part"}
    order = ("error", "moving", "resting", "share at rest", "bodies", "torque", "Coulomb friction", "relative")
    part.table(
        ["", *(f"J{k + 1}" for k in range(recipe.robot.dof))],
        [[names.get(key, key), *(f"{value:.2f}" for value in table[key])] for key in order if key in table],
    )
    groups = {key: (np.nanmean(table[key][_FIRST]), np.nanmean(table[key][_LAST])) for key in order[:5]}
    part.say(
        f"Joints 4 to 6 have {groups['error'][1]:.2f} % against {groups['error'][0]:.2f} % of joints 1 to 3. In motion "
        f"it is {groups['moving'][1]:.2f} against {groups['moving'][0]:.2f} %, at rest {groups['resting'][1]:.2f} "
        f"against {groups['resting'][0]:.2f} %; the bodies' parameters are wrong by {groups['bodies'][1]:.3f} and "
        f"{groups['bodies'][0]:.3f} %."
    )
    figures.bars(
        pictures / "axes.svg",
        [f"J{k + 1}" for k in range(recipe.robot.dof)],
        {names.get(key, key): table[key].tolist() for key in ("error", "moving", "resting", "bodies")},
        "% of nominal torque",
    )
    part.picture("axes", "Error by axis, in motion and at rest")


def _share_at_rest(near: dict) -> np.ndarray:
    """(n,) [%] of the samples, from e² = (1 - s) moving² + s resting²."""
    error, moving, resting = (np.array(near[key]) ** 2 for key in ("error", "moving", "resting"))
    return 100 * np.nan_to_num((error - moving) / (resting - moving)).clip(0.0, 1.0)
