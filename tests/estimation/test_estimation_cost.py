"""Time and memory from a log file to a model file, as figures; the benchmark does the work."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks/speed.py"


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("speed", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.verify
@pytest.mark.parametrize("seconds", [60.0, 1200.0])
def test_cost_of_an_estimation(benchmark, measured, tmp_path, seconds):
    log = tmp_path / "log.mcap"
    benchmark.write(log, seconds)
    for method, most in (("weighted", 1.0), ("consistent", 5.0)):
        call = [
            "estimate",
            "--robot",
            "comau_ns16",
            "--method",
            method,
            "-o",
            str(tmp_path / f"{method}.json"),
            str(log),
        ]
        fit, peak = benchmark.measured(benchmark.ROOT, call)
        most = 1.0 + most * seconds / 60  # to start it, and to fit
        measured(f"{method} fit, {seconds:g} s x 6 joints, CPU", fit, "s", f"at most {most:g} s", fit <= most)
        measured(f"{method} fit, {seconds:g} s x 6 joints, memory", peak, "MiB", "below 1024 MiB", peak < 1024)
        assert peak < 1024
