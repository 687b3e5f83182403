"""The pieces, and `docs/measured/evidence.md` from the results that are there; what is not there is said."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

from agent.core import one_blas_thread
from agent.recipe import Recipe
from benchmarks.evidence import criteria, few_data, local, search
from benchmarks.evidence.loops import FIRST_MACHINE, SEARCHES
from benchmarks.evidence.results import Results
from benchmarks.evidence.tables import FEWEST

#: What is measured, by name: its settings, and how one of them is measured.
PIECES: dict[str, tuple[list[str], Callable]] = {
    "local": (list(local.WORLDS), local.measure),
    "few-data": (few_data.SETTINGS, few_data.measure),
    "criteria": (list(criteria.SETTINGS), criteria.measure),
    **{
        f"search-{budget}": ([search.setting(method, budget) for method in search.METHODS], search.measure)
        for budget in search.BUDGETS
    },
}

_HEAD = """# Evidence

Is local calibration worth it, and do criterion, search and prior matter? Measured on the emulated COMAU NS16 by
`benchmarks/evidence`; nothing here is of a real robot.

Errors are RMSE in percent of nominal joint torque on other motions in the sub-region at 0.1 m/s, standstill included,
means over joints. Square brackets are 95 % bootstrap intervals over machines, drawn in pairs where two settings are
compared. A ratio whose interval holds 1 shows no difference; fewer than six machines show none. A loop is the best of a
genetic search of 400 candidates. No constant of the agent was chosen on these runs.
"""
_NARROW = "one type of arm, one sub-region, and an emulator whose effects are of an assumed size"
_NEVER_RUN = (
    "not run: loops over the whole workspace at full joint speed, 5 and 10 points, more than two minutes of motion, "
    "other arms"
)
_REPEAT = """## Repeat it

```text
python -m benchmarks.evidence run local --machines 10   # few-data, criteria, search-500, search-2000, search-20000
python -m benchmarks.evidence page
```

Results are in `benchmarks/evidence/measured`, one line a machine and setting; the page is made of all of them. What is
there is not computed again. Machines are drawn from seeds {first} on; {loops} searches of each setting are made, and
machines take their loops in turn.
"""


def complete(machine: int, piece: str, folder: Path, recipe: Recipe, end: float) -> int:
    """Compute what is missing of a machine in a piece, and keep it; returns how many lines are left.

    At `end`, a time [s] as of `time.time`, nothing new is started.
    """
    results, loops = Results(folder, piece), Results(folder, "loops")
    settings, measure = PIECES[piece]
    memory: dict = {}
    missing = [setting for setting in settings if results.get(machine, setting) is None]
    for done, setting in enumerate(missing):
        if time.time() > end:
            return len(missing) - done
        started = time.process_time()
        with one_blas_thread():
            values = measure(recipe, machine, setting, loops, memory)
        seconds = time.process_time() - started
        results.keep(machine, setting, values, seconds)
        print(f"{piece}: machine {machine}, {setting}: {seconds:.0f} s", file=sys.stderr, flush=True)
    return 0


def write(folder: Path, docs: Path) -> Path:
    """Write the page into `docs`, from the results in `folder`."""
    results = {piece: Results(folder, piece) for piece in PIECES}
    parts = [
        local.section(results["local"]),
        criteria.section(results["criteria"]),
        search.section({name: r for name, r in results.items() if name.startswith("search-")}),
        few_data.section(results["few-data"]),
    ]
    weak = [_NARROW, *(line for part in parts for line in part.weak), *_thin(results), _NEVER_RUN]
    runs = [
        f"{piece} on {len(kept.machines)} machines ({', '.join(kept.commits)})"
        for piece, kept in results.items()
        if len(kept)
    ]
    text = [
        _HEAD,
        *(line for part in parts for line in (*part.lines, "")),
        "## Limits",
        "",
        *(f"- {line}" for line in weak),
        "",
        _REPEAT.format(first=FIRST_MACHINE, loops=SEARCHES),
        f"Run: {'; '.join(runs)}.",
    ]
    path = docs / "evidence.md"
    path.write_text("\n".join(text).rstrip() + "\n", encoding="utf-8")
    return path


def _thin(results: dict[str, Results]) -> list[str]:
    """What was run on too few machines for any claim."""
    few = []
    for piece, kept in results.items():
        thin = sum(len(kept.of(setting)) < FEWEST for setting in kept.settings)
        if thin:
            few.append(f"{piece} ({thin} of {len(kept.settings)} settings)")
    return [f"on fewer than {FEWEST} machines, so that nothing is claimed: {', '.join(few)}"] if few else []
