"""How a loop should be searched: methods at equal numbers of candidates, judged by the models they lead to.

A method whose course does not depend on its budget is run once; its best loop after fewer candidates is that of a
shorter search. The genetic search, whose mutations shrink over its generations, is run for every budget.
"""

from __future__ import annotations

import time
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

BUDGETS = (500, 2000)
#: A piece of its own, as one seed of it takes hours.
LONG = (20_000,)
METHODS: dict[str, Callable] = {
    "genetic": genetic,
    "CMA-ES": cma_es,
    "differential evolution": differential_evolution,
    "multi-start": multi_start,
    "random": random_search,
}
_POPULATION = {500: 25, 2000: 50, 20_000: 100}


def settings(recipe: Recipe) -> list[str]:
    """Method at budget."""
    return [f"{method} at {budget}" for budget in BUDGETS for method in METHODS]


def measure(recipe: Recipe, machine: int, setting: str, loops: Results, memory: dict) -> dict:
    """Fitness that a search reaches, and what its loop is worth on the machine of the same number."""
    method, budget = setting.rsplit(" at ", 1)
    candidates = memory.setdefault("candidates", LocalLoops(loop_problem(recipe, recipe.motion.speed)))
    key = f"search: {setting}"
    if loops.get(machine, key) is None:
        started = time.process_time()
        # One course of a search gives the loops of all its budgets.
        longest = int(budget) if method == "genetic" else max(int(budget), *(BUDGETS if int(budget) in BUDGETS else ()))
        population = _POPULATION[int(budget)] if method == "genetic" else _POPULATION[min(BUDGETS)]
        search = Search(candidates).run(METHODS[method], population, longest // population, machine)
        budgets = [b for b in (*BUDGETS, *LONG) if b <= longest] if method != "genetic" else [longest]
        seconds = time.process_time() - started
        for reached in budgets:
            found = search.best(reached)
            loops.keep(machine, f"search: {method} at {reached}", found, seconds * reached / longest)
    found = loops.get(machine, key)
    loop = candidates.loop(np.array(found["genome"])).trajectory
    return {"fitness": found["fitness"], **judged(recipe, machine, loop, memory)}
