"""The benchmarks' parallel work: the same answers, in the same order, whoever does it."""

from __future__ import annotations

import argparse
import importlib.util
import math
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def test_answers_come_in_order_from_one_process_and_from_two():
    spec = importlib.util.spec_from_file_location("workers", BENCHMARKS / "workers.py")
    workers = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(workers)
    parser = argparse.ArgumentParser()
    workers.add_options(parser)
    tasks = range(20)
    for asked in ([], ["--workers", "2"]):
        assert list(workers.worked(math.sqrt, tasks, parser.parse_args(asked))) == [math.sqrt(k) for k in tasks]
