"""`docs/measured/evidence.md` and its pictures, from the results that are there; what is not there is said."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from agent.recipe import Recipe
from benchmarks.evidence import few_data_section, local_section, loop_sections
from benchmarks.evidence.results import Results
from benchmarks.evidence.statistics import FEWEST

READING = Path(__file__).with_name("reading.md")
_HEAD = """# Evidence

Whether local calibration, this criterion, this search and the prior are worth what is claimed of them, measured on the
emulated COMAU NS16 by `benchmarks/evidence`. Nothing here is of a real robot. Errors are RMSE in percent of nominal
joint torque on motions in the sub-region at 0.1 m/s that no fit saw, means over joints unless said otherwise;
standstill counts. Square brackets are 95 % bootstrap intervals over machines, drawn again in pairs where two ways are
compared: a ratio whose interval holds 1 shows no difference, and of fewer than six machines none is claimed, as the
interval is then hardly more than their range. A loop is the best of a genetic search of 400 candidates (20 by 20; a
recipe's default is 2 000). No constant of the agent was chosen on these runs.
"""
_NARROW = (
    "one type of arm, one sub-region, and an emulator whose effects are as large as somebody thought they usually are: "
    "which of them a machine has decides what local calibration is worth on it"
)
_NEVER_RUN = (
    "not in any piece: loops over the whole workspace at full joint speed, 5 and 10 points, stops at other numbers of "
    "points, pymoo (differential evolution is written here), more than two minutes of motion, arms other than the NS16"
)
_REPEAT = """## Repeat it

```text
python -m benchmarks.evidence run local --machines 10   # few-data, criteria, search-500, search-2000, search-20000
python -m benchmarks.evidence page
```

Every machine and setting is a line of its piece in `benchmarks/evidence/measured`. These files are kept with the page
and it is made of all of them: commit both. What is there is not computed again; to measure a piece anew, remove its
file. `loops.jsonl` has the loops that the other pieces share. A command starts nothing new after ten minutes
(`--minutes`) and takes `--workers 2`; the same goes on where it stopped, and with more `--machines` it adds. Machines
are drawn from seeds {first} on, which nothing else here uses. {loops} searches of each setting are made and machines
take their loops in turn (but for the pieces of searches, where every machine has its own): how much loops differ is in
the intervals, but only for so many.
"""


def write(folder: Path, docs: Path, recipe: Recipe, pieces: Iterable[str]) -> Path:
    """Write the page and its pictures into `docs`, from the results in `folder`."""
    from benchmarks.evidence.loops import FIRST_MACHINE, SEARCHES

    results = {piece: Results(folder, piece) for piece in pieces}
    pictures = docs / "evidence"
    parts = [
        local_section.section(results["local"], recipe, pictures),
        loop_sections.criteria(results["criteria"], pictures),
        loop_sections.searches({name: r for name, r in results.items() if name.startswith("search-")}, pictures),
        few_data_section.section(results["few-data"], pictures),
    ]
    weak = [_NARROW, *(line for part in parts for line in part.weak), *_thin(results), _NEVER_RUN]
    text = [
        _HEAD,
        "## Weak spots first",
        "",
        *(f"- {line}" for line in weak),
        "",
        READING.read_text(encoding="utf-8") if READING.exists() else "",
        *(line for part in parts for line in (*part.lines, "")),
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
    lines = ["| piece | machines | lines | CPU [min] | commits |", "| --- | --- | --- | --- | --- |"]
    for piece, kept in results.items():
        machines = len({machine for machine, _ in kept})
        commits = ", ".join(kept.commits()) or "not run"
        lines.append(f"| {piece} | {machines} | {len(kept)} | {kept.seconds() / 60:.0f} | {commits} |")
    return lines
