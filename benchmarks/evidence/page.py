"""`docs/measured/evidence.md` and its pictures, from the results that are there; what is not there is said."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.evidence import criteria, few_data, local, search
from benchmarks.evidence.loops import FIRST_MACHINE, SEARCHES
from benchmarks.evidence.results import Results
from benchmarks.evidence.statistics import FEWEST

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


def write(folder: Path, docs: Path, pieces: Iterable[str]) -> Path:
    """Write the page and its pictures into `docs`, from the results in `folder`."""
    results = {piece: Results(folder, piece) for piece in pieces}
    pictures = docs / "evidence"
    parts = [
        local.section(results["local"], pictures),
        criteria.section(results["criteria"], pictures),
        search.section({name: r for name, r in results.items() if name.startswith("search-")}, pictures),
        few_data.section(results["few-data"], pictures),
    ]
    weak = [_NARROW, *(line for part in parts for line in part.weak), *_thin(results), _NEVER_RUN]
    text = [
        _HEAD,
        *(line for part in parts for line in (*part.lines, "")),
        "## Limits",
        "",
        *(f"- {line}" for line in weak),
        "",
        _REPEAT.format(first=FIRST_MACHINE, loops=SEARCHES),
        *_runs(results),
    ]
    path = docs / "evidence.md"
    path.write_text("\n".join(text).rstrip() + "\n", encoding="utf-8")
    return path


def _thin(results: dict[str, Results]) -> list[str]:
    """What was run on too few machines for any claim."""
    few = []
    for piece, kept in results.items():
        settings = kept.settings()
        thin = sum(len(kept.of(setting)) < FEWEST for setting in settings)
        if thin:
            few.append(f"{piece} ({thin} of {len(settings)} settings)")
    return [f"on fewer than {FEWEST} machines, so that nothing is claimed: {', '.join(few)}"] if few else []


def _runs(results: dict[str, Results]) -> Sequence[str]:
    """What was run, and on which commits."""
    found = {
        piece: f"{piece} on {len({machine for machine, _ in kept})} machines ({', '.join(kept.commits())})"
        for piece, kept in results.items()
        if len(kept)
    }
    return [f"Run: {'; '.join(found.values()) or 'nothing'}."]
