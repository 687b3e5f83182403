"""Essential parameters: base parameters and friction terms that the data can do without are taken out.

Backward elimination (after Pham and Gautier, IROS 1991), judged by held-out error instead of an F-test, which would
take autocorrelated rows for independent ones: the parameter with the smallest value in units of its deviation goes
first, and the reduced model is kept as long as leaving folds out does not show it to be worse.
"""

from __future__ import annotations

import numpy as np

from agent.estimation.problem import Estimate, Problem, Solver
from agent.estimation.solving import solve_sum

_TOLERANCE = 1e-3  # a reduced model may be this much worse than the best one met


def essential(problem: Problem) -> Estimate:
    """Weighted least squares on the parameters that matter."""
    moments, prior = problem.moments, problem.prior
    weights = problem.weights()
    total = moments.weighted(weights)
    kept = np.arange(moments.parameters)
    best, chosen = np.inf, kept
    while len(kept):
        error = float(np.sum(weights * problem.held_out(weights, _on(problem, kept))))
        best = min(best, error)
        if error <= (1 + _TOLERANCE) * best:
            chosen = kept
        elif error > 1.05 * best:
            break
        matrix = total[np.ix_(kept, kept)] + problem.prior_weight * prior.precision[np.ix_(kept, kept)]
        parameters = _on(problem, kept)(total)[kept]
        significance = np.abs(parameters) / np.sqrt(np.diag(np.linalg.inv(matrix)))
        kept = np.delete(kept, np.argmin(significance))
    note = f"{len(chosen)} of {moments.parameters} parameters are essential; the others are zero."
    return problem.estimate(weights, note, _on(problem, chosen))


def _on(problem: Problem, kept: np.ndarray) -> Solver:
    """A solver that leaves all but the kept parameters at zero."""
    prior = problem.prior.select(kept)
    place = np.append(kept, problem.moments.parameters)

    def solver(total: np.ndarray) -> np.ndarray:
        parameters = np.zeros(len(total) - 1)
        parameters[kept] = solve_sum(total[np.ix_(place, place)], prior, problem.prior_weight)
        return parameters

    return solver
