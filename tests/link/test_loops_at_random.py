"""Loops with tool, base and user frame at random, on every wire: what is programmed is what the arm does."""

import hashlib
import json
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fake_controller.servers import WIRES
from tests.conftest import ROOT, end_with_tests, environment

SCRIPT = Path(__file__).with_name("loops_at_random.py")
LOOPS, AT_A_TIME = 680, 40  # on each wire
BEYOND = 0.01  # mm; a curve is judged by its samples
#: What a result depends on: those of other versions of it are run again.
SOURCES = ("agent/motion", "agent/robot", "agent/safety", "drivers", "fake_controller")


def fault(one: dict) -> str:
    """What is wrong with a loop; empty where nothing is."""
    if one["ended"]:
        return "not run: " + one["ended"]
    if max(one["beyond_mm"], one["start_off_mm"]) > BEYOND or one["end_off"] > 1e-6:
        return "a position was missed"
    return "" if one["clear_mm"] > 0 else "the arm was in a box"


def kept(store: Path, version: str) -> list[dict]:
    """What was run on this version of the sources."""
    lines = store.read_text(encoding="utf-8").splitlines() if store.exists() else []
    return [one for one in map(json.loads, lines) if one["version"] == version]


def version() -> str:
    """Digest of the sources."""
    files = [SCRIPT, *sorted(path for folder in SOURCES for path in (ROOT / folder).rglob("*.py"))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]


def run(wire: str, first: int, store: Path, version: str) -> None:
    """So many loops on one wire that are not in the store, appended to it one by one."""
    done = {(one["wire"], one["seed"]) for one in kept(store, version)}
    missing = [seed for seed in range(first, first + AT_A_TIME) if (wire, seed) not in done]
    if not missing:
        return
    command = [sys.executable, str(SCRIPT), wire, str(missing[0]), str(missing[-1])]
    with (
        subprocess.Popen(
            command, env=environment(), stdout=subprocess.PIPE, text=True, cwd=ROOT, preexec_fn=end_with_tests
        ) as worker,
        store.open("a", encoding="utf-8", buffering=1) as out,
    ):
        assert worker.stdout is not None
        for line in worker.stdout:
            out.write(json.dumps({**json.loads(line), "version": version}) + "\n")


@pytest.mark.verify
def test_every_programmed_position_is_passed(measured):
    """Two workers at a time; interrupted, it goes on where it stopped."""
    store, now = ROOT / ".verify" / "loops_at_random.jsonl", version()
    store.parent.mkdir(exist_ok=True)
    firsts = [
        (wire, k * LOOPS + first) for first in range(0, LOOPS, AT_A_TIME) for k, wire in enumerate(WIRES)
    ]  # in turn: what is there when it is interrupted is of all wires
    with ThreadPoolExecutor(2) as two:
        list(two.map(lambda one: run(*one, store, now), firsts))
    loops = kept(store, now)
    faults = Counter(found for one in loops if (found := fault(one)))
    ran = [one for one in loops if not one["ended"]]
    second = sum(one["interpolator"] == "second" for one in loops)
    worst = max(one["beyond_mm"] for one in ran)
    clear = min(one["clear_mm"] for one in ran)
    measured("loops with tool, base and user frame at random, all wires", len(loops), "", "2 000", len(loops) >= 2000)
    measured("of them on the emulator's second interpolator", second)
    measured("of them run", len(ran), "", "all", len(ran) == len(loops))
    measured(
        "farthest that a position was passed beyond $FLY_DIST", worst, "mm", f"at most {BEYOND} mm", worst <= BEYOND
    )
    measured("least clearance of a box that the plan kept clear of", clear, "mm", "above 0", clear > 0)
    assert not faults
    assert len(loops) == LOOPS * len(WIRES)


@pytest.mark.parametrize(("seed", "interpolator"), [(1, "ours"), (4, "second")])
def test_random_loops_pass_on_each_interpolator(seed, interpolator):
    """One on each interpolator."""
    from tests.link import loops_at_random

    one = loops_at_random.run("tcp", seed, None)
    assert fault(one) == ""
    assert one["interpolator"] == interpolator
