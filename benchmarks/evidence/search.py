"""How a loop should be searched: methods at equal numbers of candidates, judged by the models they lead to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from agent.excitation import LoopScore, ranking
from agent.excitation.genetic import genetic
from agent.excitation.loop_search import random_search
from agent.pipeline.plan import loop_problem
from agent.recipe import Recipe
from benchmarks.evidence import figures
from benchmarks.evidence.criteria import SHORT, judged
from benchmarks.evidence.loops import LocalLoops, Search
from benchmarks.evidence.results import Results
from benchmarks.evidence.statistics import FEWEST, difference_of, each, mean_of, ratio_of, text, verdict

Evaluate = Callable[[np.ndarray], Sequence[LoopScore]]
Note = Callable[[np.ndarray, Sequence[LoopScore]], None]
#: Candidates of one climb of the multi-start search.
CLIMB = 500


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


def differential_evolution(
    evaluate: Evaluate, genes: int, population: int, generations: int, rng: np.random.Generator, note: Note
) -> None:
    """DE/rand/1/bin of Storn and Price (1997) with dither: F from [0.5, 1) a generation, CR 0.7, as SciPy's defaults.

    Written here because SciPy's own knows no ranking by feasibility. Genes outside the cube are drawn anew.
    """
    genomes = rng.random((population, genes))
    scores = list(evaluate(genomes))
    note(genomes, scores)
    for _ in range(1, generations):
        factor = rng.uniform(0.5, 1.0)
        picked = np.array(
            [rng.choice(np.delete(np.arange(population), k), 3, replace=False) for k in range(population)]
        )
        first, second, third = (genomes[picked[:, k]] for k in range(3))
        mutants = first + factor * (second - third)
        mutants = np.where((mutants < 0) | (mutants > 1), rng.random(mutants.shape), mutants)
        crossed = rng.random(mutants.shape) < 0.7
        crossed[np.arange(population), rng.integers(genes, size=population)] = True
        trials = np.where(crossed, mutants, genomes)
        tried = list(evaluate(trials))
        note(trials, tried)
        for k, score in enumerate(tried):
            if ranking([score, scores[k]])[0] == 0:
                genomes[k], scores[k] = trials[k], score


def multi_start(
    evaluate: Evaluate, genes: int, population: int, generations: int, rng: np.random.Generator, note: Note
) -> None:
    """Climbs of `CLIMB` candidates each, each from the best of `population` random ones, by steps of one normal
    deviate a gene whose size follows the one-fifth rule (Rechenberg)."""
    left = population * generations
    while left > 0:
        genomes = rng.random((min(population, left), genes))
        scores = list(evaluate(genomes))
        note(genomes, scores)
        left -= len(genomes)
        best = int(ranking(scores)[0])
        here, worth, step = genomes[best], scores[best], 0.2
        for _ in range(min(CLIMB - population, left)):
            there = here + step * rng.standard_normal(genes)
            there = np.abs(there - 2.0 * np.round(there / 2.0))[None]
            score = evaluate(there)[0]
            note(there, [score])
            left -= 1
            if ranking([score, worth])[0] == 0:
                here, worth, step = there[0], score, step * np.exp(1 / 3)
            else:
                step *= np.exp(-1 / 12)


GENETIC = "genetic"
METHODS: dict[str, Callable] = {
    GENETIC: genetic,
    "CMA-ES": cma_es,
    "differential evolution": differential_evolution,
    "multi-start": multi_start,
    "random": random_search,
}
#: Candidates of a search, and how many of them make a generation.
BUDGETS = {500: 25, 2000: 50, 20_000: 100}


def settings_at(budget: int) -> Callable[[Recipe], list[str]]:
    """The settings of a piece: every method with so many candidates."""
    return lambda recipe: [setting(method, budget) for method in METHODS]


def setting(method: str, budget: int) -> str:
    """Name of one."""
    return f"{method} at {budget}"


def measure(recipe: Recipe, machine: int, name: str, loops: Results, memory: dict) -> dict:
    """Fitness that a search reaches, and what its loop is worth; search and machine have the same seed."""
    method, budget = name.rsplit(" at ", 1)
    candidates = memory.setdefault("candidates", LocalLoops(loop_problem(recipe, recipe.motion.speed)))
    population = BUDGETS[int(budget)]
    found = Search(candidates).run(METHODS[method], population, int(budget) // population, machine).best()
    loop = candidates.loop(np.array(found["genome"])).trajectory
    return {"fitness": found["fitness"], **judged(recipe, machine, loop, memory)}


def section(results: Mapping[str, Results], pictures: Path) -> figures.PageSection:
    """How it is searched."""
    part = figures.PageSection()
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
    return each(lines, lambda v: v[SHORT]["error"])


def _fitness(lines: dict) -> dict[int, float]:
    return {machine: values["fitness"] for machine, values in lines.items()}


def _methods(part: figures.PageSection, kept: dict, pictures: Path) -> None:
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
                    f"decades, at {text(ratio)} times the error after {SHORT} s ({len(lines)} machines)"
                )
    part.say(
        f"Models use {SHORT} s of the best loop of each search. Ratios are over the genetic search of equal size. "
        "Fitness is the criterion itself, in decades of the determinant."
    )
    error = f"error after {SHORT} s [%]"
    largest = str(max(kept))
    shown = [row for row in rows if row[1] == largest]
    part.table(["search", "candidates", "machines", "fitness above genetic", error, "ratio"], shown)
    figures.ratios(pictures / "search.svg", picture, f"error after {SHORT} s over that of the genetic search")
    part.picture("search", "Ratio of errors by search")


def _budgets(part: figures.PageSection, kept: dict) -> None:
    """What more candidates gain, on machines that have both."""
    for few, many in pairwise(kept):
        fewer, more = (kept[budget][GENETIC] for budget in (few, many))
        both = len(fewer.keys() & more.keys())
        if both and verdict(ratio := ratio_of(_error(more), _error(fewer)), both) != "better":
            part.weak.append(
                f"genetic searches of {many} candidates led to models that are not shown to be better than those "
                f"of {few}: {text(ratio)} times their error ({both} machines)"
            )
