"""A fit of two joints on two short logs with made-up columns: small enough to write all its rows out."""

from collections.abc import Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np

from agent.diagnosis.rows.candidate import Candidate, Fold
from agent.diagnosis.rows.fit import Fit, FitRows
from agent.model import MotionSignals

PERIOD = 0.008  # s
#: Log and samples of each motion, whose first and last five are lost to the filter: the second log has a gap.
MOTIONS = ((0, 130), (1, 60), (1, 60))
ROWS = np.repeat([0, 1], [120, 100])  # log of each row
NOMINAL = np.array([40.0, 15.0])  # N·m
#: Of the bodies two parameters, of friction a level, one that is zero, and an offset; joints share the second.
INDEX = (np.array([0, 1, 2]), np.array([1, 3, 4]))


def shape(name: str, nonlinear: int = 0, usual: bool = False, transient: bool = False) -> Any:
    """As much of an effect as evidence needs: `nonlinear` parameters were chosen on the data."""
    methods = {"counted": lambda settings: nonlinear + len(settings), "is_transient": lambda settings: transient}
    methods |= {"plausible": lambda settings, values: values["a"] > len(settings) - 1}
    methods |= {
        "possible": lambda arm, joints, settings, values: values["a"] < len(joints) + len(settings) * arm.scale[0]
    }
    return SimpleNamespace(name=name, usual=usual, nonlinear=nonlinear, **methods)


def synthetic_fit(given: bool = True, of_file: bool = False, guard: int = 9) -> Fit:
    """A model that was `given`, or one drawn to its prior; the first joint stands for a while in the first log.

    `guard` rows where the logs meet are in no cell.
    """
    rng, units = np.random.default_rng(5), np.array([1.0, 0.02, 0.5, 3.0, 10.0])
    terms = [SimpleNamespace(form=form) for form in ("coulomb", "viscous", "offset")]
    values = np.array([2.0, 3.0, 8.0, 0.0, 1.0])
    own = {"independent": ["a", "b"], "noise_share": np.array([0.6, 1.0])}
    model = SimpleNamespace(terms=terms, values=values, of_file=of_file, **own)
    robot = SimpleNamespace(max_velocity=np.array([2.0, 3.0]), dof=2)
    reference: Any = SimpleNamespace(robot=robot, scale=NOMINAL, model=model, payload=None, coupling=np.eye(2))
    signals = []
    for k, (number, samples) in enumerate(MOTIONS):
        time = PERIOD * np.arange(samples) + 0.8 * (k == 2)
        clock = np.stack([time - (0 if number else np.clip(time - 0.4, 0, 0.25)), time], axis=1)
        q = np.sin(clock * [5.0 + number, 9.0] + [0.3, number])
        qd = np.gradient(q, PERIOD, axis=0)
        qdd = np.gradient(qd, PERIOD, axis=0)
        signals.append(
            MotionSignals(reference, time, q, qd, qdd, number, slice(5, -5), low_pass=lambda rows: rows[5:-5])
        )
    sigma = np.array([0.8, 0.3]) * np.where(rng.random((len(ROWS), 2)) < 0.1, 4.0, 1.0)
    rows = [np.column_stack([_smooth(rng, len(ROWS), 3), 1.5 * rng.normal(size=len(ROWS))]) for _ in INDEX]
    square = rng.normal(size=(5, 5))
    precision = (square @ square.T + np.eye(5)) * np.outer(units, units)
    shift = np.zeros(5) if given else precision @ np.array([0.5, -8.0, 1.0, 0.2, 0.1])
    cell = 2 * ROWS + np.arange(len(ROWS)) // 12 % 2
    cell[117 : 117 + guard] = -1
    tests = [np.isin(np.arange(4), held) for held in ((0, 1), (2, 3), 0, 1, 2, 3)]
    folds = [Fold(f"{number}", test, ~test) for number, test in enumerate(tests)]
    split = (cell, cell // 2, folds[:2], folds[2:])
    return Fit(FitRows(reference, signals, rows, INDEX, sigma, precision, shift, *split))


def synthetic_form(fit: Fit, effect: Any, joints: tuple[int, ...], width: int = 1, prior: Any = None) -> Candidate:
    """A candidate with `width` made-up columns on some joints, or on all of them where it is of the whole arm."""
    rng = np.random.default_rng([*effect.name.encode(), *joints])
    lasts = (
        np.abs(np.arange(len(fit.cell_of_row)) - 40) < 25 if effect.is_transient({}) else np.ones(len(fit.cell_of_row))
    )
    blocks = {joint: _smooth(rng, len(fit.cell_of_row), width) * lasts[:, None] for joint in joints or range(2)}
    return Candidate(effect, joints, {}, tuple("abc"[:width]), blocks, prior, fit.reference)


def written_out(fit: Fit, forms: Sequence[Candidate], white: bool = True) -> tuple[np.ndarray, list[slice]]:
    """(2, S, 5 + k + 1) rows over σ of each joint: columns of model and forms, and residual; and where each form is."""
    ends = 5 + np.cumsum([0, *(len(form.names) for form in forms)])
    whole, spans = np.zeros((2, len(fit.cell_of_row), ends[-1] + 1)), [slice(a, b) for a, b in pairwise(ends)]
    for j, rows in enumerate(fit.rows):
        whole[j][:, [*fit.parameter_index[j], -1]] = rows
        for form, span in zip(forms, spans, strict=True):
            whole[j][:, span] = form.blocks.get(j, 0.0)
        whole[j] = fit.whitening.whitened(j, whole[j]) if white else whole[j]
    return whole, spans


def _smooth(rng: np.random.Generator, count: int, width: int) -> np.ndarray:
    """(S, k) noise that lasts for some rows."""
    return np.array([np.convolve(one, np.ones(4), "valid") for one in rng.normal(size=(width, count + 3))]).T
