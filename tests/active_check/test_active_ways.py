"""The motion that is planned against other uses of the same robot time, the D-optimal pieces among them."""

import json
import os
import subprocess
import sys

import pytest

from tests.conftest import ROOT

_RUNS, _SEED = 5, 730219
_LONGEST = 570  # s; a check that is stopped goes on with the next call


@pytest.mark.verify
def test_planned_motions_name_at_least_as_many_effects_as_d_optimal_pieces(measured):
    """Bounded: where the time is not enough it is skipped, and goes on at the same commit when it is called again."""
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    folder = ROOT / ".verify" / f"active_{commit.strip()[:12]}"
    command = [sys.executable, "-m", "benchmarks.active", "--cases", str(_RUNS), "--seed", str(_SEED)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen([*command, "-o", str(folder)], cwd=ROOT, env=environment) as run:
        try:
            assert run.wait(_LONGEST) == 0
        except subprocess.TimeoutExpired:
            run.terminate()  # what it has started ends with it
            pytest.skip(f"not done after {_LONGEST} s: call it again, it goes on in {folder}")
    scores = json.loads((folder / "active_check.json").read_text(encoding="utf-8"))
    found = {way: row["right"]["count"] for way, row in scores["ways"].items()}
    for way, count in found.items():
        measured(f"right after one further motion, {way}", count, f"of {scores['ambiguous']} ambiguous")
    assert found["planned"] >= found["d_optimal_pieces"]
    assert scores["ways"]["planned"]["wrong_names"]["count"] <= scores["wrong_names_first"]["count"]
