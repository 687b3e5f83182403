"""What a physically consistent fit and its prior are worth where data are few; the benchmark does the work."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks/few_data.py"


@pytest.mark.verify
@pytest.mark.parametrize("machine", [1, 2, 3])
def test_a_fifth_of_a_loop(measured, machine):
    spec = importlib.util.spec_from_file_location("few_data", BENCHMARK)
    few_data = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(few_data)
    found = few_data.errors(machine)
    plain, prior, consistent = (found[name] for name in few_data.FITS)
    against_plain, against_prior = (np.mean(consistent[0]) / np.mean(other[0]) for other in (plain, prior))
    whole = consistent[1] / prior[1]
    name = f"machine {machine}, consistent fit"
    measured(f"{name} over the paper's, a fifth of a loop", against_plain, "", "at most 0.7", against_plain <= 0.7)
    measured(f"{name} over weighted with prior, a fifth", against_prior, "", "below 1", against_prior < 1)
    measured(f"{name} over weighted with prior, the whole loop", whole, "", "at most 1.05", whole <= 1.05)
    assert against_plain <= 0.7
    assert against_prior <= 1.05
    assert whole <= 1.05
