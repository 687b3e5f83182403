"""What a fit costs, and what consistent bodies and a prior are worth where data are few; benchmarks do the work."""

import numpy as np
import pytest

from agent.recipe import load_recipe
from benchmarks import speed
from benchmarks.evidence import few_data
from benchmarks.evidence.__main__ import RECIPE
from benchmarks.evidence.loops import FIRST_MACHINE
from benchmarks.evidence.results import Results

pytestmark = pytest.mark.verify


@pytest.mark.parametrize("seconds", [60.0, 1200.0])
def test_cost_of_an_estimation(measured, tmp_path, seconds):
    log = tmp_path / "log.mcap"
    speed.write(log, seconds)
    for method, most in (("weighted", 1.0), ("consistent", 5.0)):
        call = ["estimate", "--robot", "comau_ns16", "--method", method, "-o", str(tmp_path / "model.json"), str(log)]
        fit, peak = speed.measured(speed.ROOT, call)
        most = 1.0 + most * seconds / 60  # to start it, and to fit
        measured(f"{method} fit, {seconds:g} s x 6 joints, CPU", fit, "s", f"at most {most:g} s", fit <= most)
        measured(f"{method} fit, {seconds:g} s x 6 joints, memory", peak, "MiB", "below 1024 MiB", peak < 1024)
        assert peak < 1024


@pytest.mark.parametrize("number", [1, 2, 3])
def test_error_after_one_second_of_a_loop(measured, number, tmp_path):
    machine = FIRST_MACHINE - 1 + number
    found = few_data.measure(load_recipe(RECIPE), machine, few_data.AS_DRAWN, Results(tmp_path, "loops"), {})
    error = {method: np.mean(found[method]["1"]["error"]) for method in ("paper", "weighted", "consistent")}
    whole = {method: np.mean(found[method]["6"]["error"]) for method in ("weighted", "consistent")}
    against_plain, against_prior = (error["consistent"] / error[other] for other in ("paper", "weighted"))
    once = whole["consistent"] / whole["weighted"]
    name = f"machine {number}, consistent fit"
    measured(f"{name} over the paper's, 1 s of a loop", against_plain, "", "at most 0.7", against_plain <= 0.7)
    measured(f"{name} over weighted with prior, 1 s", against_prior, "", "below 1", against_prior < 1)
    measured(f"{name} over weighted with prior, the whole loop", once, "", "at most 1.05", once <= 1.05)
    assert against_plain <= 0.7
    assert against_prior <= 1.05
    assert once <= 1.05
