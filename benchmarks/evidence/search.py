"""How a loop should be searched: methods at equal numbers of candidates, judged by the models they lead to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from agent.excitation.genetic import genetic
from agent.excitation.loop_search import random_search
from agent.pipeline.planning import loop_problem
from agent.recipe import Recipe
from benchmarks.evidence.criteria import judged
from benchmarks.evidence.loops import LocalLoops, Search
from benchmarks.evidence.results import Results
from benchmarks.evidence.searches import cma_es, differential_evolution, multi_start

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
