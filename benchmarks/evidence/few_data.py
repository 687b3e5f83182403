"""Few data and long data: error, interval width and coverage against seconds of motion and the quality of the prior."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np

from agent.estimation import EstimationSettings, estimate
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import Recipe
from agent.robot import RobotDescription, about_centre
from benchmarks.evidence.emulation import record, repeated
from benchmarks.evidence.judging import covered, error
from benchmarks.evidence.loops import LocalLoops, found_loop, unseen_motions
from benchmarks.evidence.results import Results
from benchmarks.evidence.tables import PageSection, each, mean_of, text
from fake_controller.plant import Plant

#: Seconds of motion in every setting, and by the description as it is.
SECONDS = (1.0, 2.0, 4.0, 6.0, 12.0)
LONG = (30.0, 60.0, 120.0)
#: How wrong the URDF's links are, in percent of the machine's own.
PRIORS = (5, 25, 50, 100)
AS_DRAWN = "URDF as it is"
_METHODS = ("weighted", "consistent", "paper")


def wrong(share: int) -> str:
    """The setting of links with an error of `share` percent."""
    return f"URDF {share} % wrong"


#: The correct description, with long data too, and descriptions with an error.
SETTINGS = [AS_DRAWN, *map(wrong, PRIORS)]


def measure(recipe: Recipe, machine: int, setting: str, loops: Results, memory: dict) -> dict:
    """By estimator and seconds of motion: error, and the share of samples within the intervals."""
    if ("few", machine) not in memory:  # the loop's record, long enough for everything, and unseen motions
        fast = LocalLoops(loop_problem(recipe, recipe.motion.speed))
        loop = found_loop(recipe, machine, "sub-region", fast, loops)
        near = [record(Plant(recipe.robot, machine), [motion]) for motion in unseen_motions(recipe, machine)]
        memory["few", machine] = repeated(Plant(recipe.robot, machine), loop, max(LONG)), near
    log, near = memory["few", machine]
    as_drawn, robot = setting == AS_DRAWN, recipe.robot
    if not as_drawn:
        own = Plant(robot, machine).machine.parameters
        robot = wrong_urdf(robot, own, int(setting.split()[1]) / 100, machine)
    found: dict = {}
    for method in _METHODS if as_drawn else _METHODS[:2]:
        found[method] = {}
        lengths = (*SECONDS, *LONG) if as_drawn and method == "weighted" else SECONDS
        for seconds in lengths if method != "consistent" else SECONDS[:4]:
            model = estimate(robot, [log.between(0.0, seconds)], EstimationSettings.create(method=method))
            found[method][f"{seconds:g}"] = {"error": error(model, near)}
            if method == "weighted":
                found[method][f"{seconds:g}"]["covered"] = covered(model, near[0])
    return found


def wrong_urdf(robot: RobotDescription, parameters: np.ndarray, share: float, seed: int) -> RobotDescription:
    """The description with links that are the machine's own (10 n,) but wrong by a `share`.

    Masses and inertias are multiplied by a factor from 1 - share to 1 + share (at least 0.05) each, and centres of mass
    moved along each axis by up to share / 2 of the link's radius of gyration.
    """
    rng = np.random.default_rng([seed, 24])
    root = ElementTree.fromstring(robot.urdf)
    links = {link.get("name"): link for link in root.findall("link")}
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for name, values in zip(robot.joint_names, parameters.reshape(-1, 10), strict=True):
        mass, centre, inertia = values[0], values[1:4] / values[0], about_centre(values)
        gyration = np.sqrt(np.trace(inertia) / 2 / mass)
        mass_factor, inertia_factor = np.maximum(1 + share * rng.uniform(-1, 1, 2), 0.05)
        centre = centre + 0.5 * share * gyration * rng.uniform(-1, 1, 3)
        element = links[joints[name].find("child").get("link")].find("inertial")
        element.find("origin").set("xyz", " ".join(map(repr, centre.tolist())))
        element.find("mass").set("value", repr(float(mass * mass_factor)))
        inertia = inertia * mass_factor * inertia_factor
        for key, (row, column) in zip(
            ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), np.argwhere(np.triu(np.ones((3, 3)))), strict=True
        ):
            element.find("inertia").set(key, repr(float(inertia[row, column])))
    return replace(robot, urdf=ElementTree.tostring(root, encoding="unicode"))


_ENOUGH = 90.0  # % of samples, of 95 % intervals


def section(results: Results) -> PageSection:
    """The section; it only names the missing runs if nothing was run."""
    part = PageSection()
    part.say("## Few data and long data")
    kept = {name: lines for name in SETTINGS if (lines := results.of(name))}
    if not kept:
        part.weak.append("few data: not run")
        return part
    part.say(
        "The first seconds of the default's loop; one pass takes about 6 s. The emulator's links are within 13 % of "
        "the URDF, so the same logs are also fitted with URDFs that are wrong by up to the given percentage in mass "
        "and inertia. Errors in percent, by estimator; `paper` has no prior and three friction terms. The friction "
        "here is of a form that `weighted` fits; on real arms [they differ less](../real-data.md):"
    )
    heads = _lengths(next(iter(kept.values())), "weighted")
    rows, short = [], []
    for name, lines in kept.items():
        for method in _METHODS if name == AS_DRAWN else _METHODS[:1]:
            errors = {s: _of(lines, method, s, "error") for s in _lengths(lines, method)}
            rows.append([name, f"`{method}`", *(text(mean_of(errors[s])) if s in errors else "-" for s in heads)])
        shares = {s: mean_of(_of(lines, "weighted", s, "covered"))[0] for s in _lengths(lines, "weighted")}
        short += [f"{name}, {s} s: {share:.0f} %" for s, share in shares.items() if share < _ENOUGH]
    part.table(["prior", "estimator", *(f"{s} s" for s in heads)], rows)
    if short:
        part.weak.append(
            f"prediction intervals of 95 % cover less than {_ENOUGH:g} % of the samples with: " + "; ".join(short)
        )
    return part


def _of(lines: dict, method: str, seconds: str, key: str) -> dict[int, float]:
    return each({m: v for m, v in lines.items() if seconds in v[method]}, lambda v: v[method][seconds][key])


def _lengths(lines: dict, method: str) -> list[str]:
    return list(next(iter(lines.values()))[method])
