"""How a loop should be searched: methods at equal numbers of candidates, judged by the models they lead to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from agent.excitation import LoopScore, ranking
from agent.excitation.genetic import genetic, random_search
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import Recipe
from benchmarks.evidence.criteria import SHORT, judged
from benchmarks.evidence.loops import LocalLoops, best_loop
from benchmarks.evidence.results import Results
from benchmarks.evidence.tables import FEWEST, PageSection, difference_of, each, mean_of, ratio_of, text, verdict

Evaluate = Callable[[np.ndarray], Sequence[LoopScore]]
Note = Callable[[np.ndarray, Sequence[LoopScore]], None]


def cma_es(
    evaluate: Evaluate, genes: int, population: int, generations: int, rng: np.random.Generator, note: Note
) -> None:
    """The (μ/μ_w, λ)-CMA-ES from the middle of the unit cube.

    Formulas and default constants of Hansen's tutorial (arXiv:1604.00772). Candidates outside the unit cube are moved
    to its surface before they are evaluated.
    """
    parents = population // 2
    weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    effective = 1 / np.sum(weights**2)
    c_sigma = (effective + 2) / (genes + effective + 5)
    d_sigma = 1 + 2 * max(0.0, np.sqrt((effective - 1) / (genes + 1)) - 1) + c_sigma
    c_c = (4 + effective / genes) / (genes + 4 + 2 * effective / genes)
    c_1 = 2 / ((genes + 1.3) ** 2 + effective)
    c_mu = min(1 - c_1, 2 * (effective - 2 + 1 / effective) / ((genes + 2) ** 2 + effective))
    expected = np.sqrt(genes) * (1 - 1 / (4 * genes) + 1 / (21 * genes**2))

    mean, sigma, covariance = np.full(genes, 0.5), 0.3, np.eye(genes)
    path_sigma, path_c = np.zeros(genes), np.zeros(genes)
    for generation in range(generations):
        values, axes = np.linalg.eigh(covariance)
        lengths = np.sqrt(np.maximum(values, 1e-20))
        genomes = mean + sigma * (rng.standard_normal((population, genes)) * lengths) @ axes.T
        genomes = np.clip(genomes, 0.0, 1.0)
        scores = list(evaluate(genomes))
        note(genomes, scores)
        steps = (genomes[ranking(scores)[:parents]] - mean) / sigma
        step = weights @ steps
        mean = mean + sigma * step
        path_sigma = (1 - c_sigma) * path_sigma + np.sqrt(c_sigma * (2 - c_sigma) * effective) * (
            axes @ ((axes.T @ step) / lengths)
        )
        length = np.linalg.norm(path_sigma) / np.sqrt(1 - (1 - c_sigma) ** (2 * (generation + 1)))
        going = float(length < (1.4 + 2 / (genes + 1)) * expected)
        path_c = (1 - c_c) * path_c + going * np.sqrt(c_c * (2 - c_c) * effective) * step
        covariance = (
            (1 - c_1 - c_mu + c_1 * (1 - going) * c_c * (2 - c_c)) * covariance
            + c_1 * np.outer(path_c, path_c)
            + c_mu * (weights * steps.T) @ steps
        )
        sigma *= np.exp(c_sigma / d_sigma * (np.linalg.norm(path_sigma) / expected - 1))


GENETIC = "genetic"
METHODS: dict[str, Callable] = {
    GENETIC: genetic,
    "CMA-ES": cma_es,
    "random": random_search,
}
#: Candidates of a search, and how many of them make a generation.
BUDGETS = {500: 25, 2000: 50, 20_000: 100}


def setting(method: str, budget: int) -> str:
    """Name of one."""
    return f"{method} at {budget}"


def measure(recipe: Recipe, machine: int, name: str, loops: Results, memory: dict) -> dict:
    """Fitness that a search reaches, and what its loop is worth; search and machine have the same seed."""
    method, budget = name.rsplit(" at ", 1)
    candidates = memory.setdefault("candidates", LocalLoops(loop_problem(recipe, recipe.motion.speed)))
    population = BUDGETS[int(budget)]
    found = best_loop(candidates, METHODS[method], population, int(budget) // population, machine)
    loop = candidates.loop(np.array(found["genome"])).trajectory
    return {"fitness": found["fitness"], **judged(recipe, machine, loop, memory)}


def section(results: Mapping[str, Results]) -> PageSection:
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
    if not kept:
        return part
    part.say(
        f"Models use {SHORT} s of the best loop of each search. Ratios are over the genetic search of equal size. "
        "Fitness is the criterion itself, in decades of the determinant."
    )
    rows = []
    for budget, methods in kept.items():
        base = methods[GENETIC]
        for method, lines in methods.items():
            ratio = ratio_of(_error(lines), _error(base))
            above = difference_of(*({m: v["fitness"] for m, v in of.items()} for of in (lines, base)))
            figures = [text(above, 1), text(mean_of(_error(lines))), text(ratio)]
            rows.append([method, str(budget), str(len(lines)), *figures])
            fitter = len(lines) >= FEWEST and above[1] > 0
            did = ["found fitter loops"] * fitter
            did += ["led to better models"] * (verdict(ratio, len(lines)) == "better")
            if method != GENETIC and did:
                part.weak.append(
                    f"{method} of {budget} candidates {' and '.join(did)} than the genetic search: by {text(above, 1)} "
                    f"decades, at {text(ratio)} times the error after {SHORT} s ({len(lines)} machines)"
                )
    error = f"error after {SHORT} s [%]"
    part.table(["search", "candidates", "machines", "fitness above genetic", error, "ratio"], rows)
    for few, many in pairwise(kept):
        fewer, more = (kept[budget][GENETIC] for budget in (few, many))
        both = len(fewer.keys() & more.keys())
        if both and verdict(ratio := ratio_of(_error(more), _error(fewer)), both) != "better":
            part.weak.append(
                f"genetic searches of {many} candidates led to models that are not shown to be better than those "
                f"of {few}: {text(ratio)} times their error ({both} machines)"
            )
    return part


def _error(lines: dict) -> dict[int, float]:
    return each(lines, lambda v: v[SHORT]["error"])
