"""Results as a page: every table with its definitions above it, everything counted from the results alone."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from agent.blind_check.key import KINDS, NAME, VERSION
from agent.blind_check.scoring import OUTCOMES, PRACTICAL, Result, score
from agent.core import AgentError, InputError, write_atomically

RESULTS, PAGE = "results.jsonl", "blind_check.md"
#: Values that a line of results leaves out.
_USUAL: dict[str, Any] = {"recorder": "", "effects": [], "size": None, "causes": [], "probability": None}
_USUAL |= {"more_wrong": 0, "all_named": False, "joint": None, "withheld": None, "numbers": None}

_DEFINITIONS = f"""Every run is counted in one column.

| term | meaning |
| --- | --- |
| `named` | the verdict is `explained`, and the first cause is a true effect on its true joints |
| `in class` | the verdict is `ambiguous`, and the first cause or one of its equivalents is a true effect |
| `wrong name`, `wrong class` | the same verdicts without a true effect there |
| `unknown`, `no gap` | verdicts without a cause |
| `no answer` | the tool left the run out |
| `both of two`, `all of three` | each of the effects is a cause or an equivalent of one |
| `joint` | the first cause or the largest share is on a true joint; effects of the whole arm are left out |
| `numbers` | intervals of servos' numbers that hold the true ones, of runs whose effects are such numbers, or none |
| `further cause wrong` | of answers with several causes, those where a later one holds no true effect |
| `class sizes` | members of the first cause's class: how many `in class` answers have that size |
| `withheld` | answers with the true effects taken out of the catalogue: `unknown` is right, any name is wrong |
| Brier, ECE | mean squared difference of probability and truth; expected calibration error |
| `found` | runs with one effect: any verdict but `no gap` |
| `right`, `wrong` | `named` or `in class`; `wrong name` or `wrong class` |
| size | largest RMS change of a joint's torque by the effect, in % of nominal torque; below {100 * PRACTICAL:g} % it \
is too small to matter, but a wrong name still counts |

For healthy runs `no gap` is right, for effects outside the catalogue `unknown`. An `interpolator_mismatch` has no size
in torque. Brackets hold the exact 95 % interval (Clopper and Pearson), as if all runs were one sample. It is too
favourable for a tool whose rules were changed between draws.
"""
_KINDS = {
    "none": "healthy",
    "one": "one effect",
    "two": "two effects",
    "three": "three effects",
    "outside": "outside the catalogue",
}


def write_results(folder: Path, results: Sequence[Result]) -> None:
    """Keep results as JSON Lines, and the page that is made of them.

    Raises:
        AgentError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AgentError(f"{folder}: cannot be made: {error.strerror}") from None
    reduced = ({name: value for name, value in result.items() if _USUAL.get(name, ...) != value} for result in results)
    write_atomically(folder / RESULTS, "".join(json.dumps(entry, separators=(",", ":")) + "\n" for entry in reduced))
    write_atomically(folder / PAGE, page(read_results(folder / RESULTS)))


def read_results(path: Path) -> list[dict[str, Any]]:
    """Results as `write_results` keeps them.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        return [_USUAL | json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no results of a blind check: {error}") from None


def page(results: Sequence[Result]) -> str:
    """Markdown, in which names of tools, worlds and recorders are text."""
    results = [
        {**result, **{key: _as_text(result[key]) for key in ("tool", "world", "recorder")}} for result in results
    ]
    lines = [f"# {NAME} {VERSION}: results", "", _DEFINITIONS]
    for world in dict.fromkeys(result["world"] for result in results):
        of_world = [result for result in results if result["world"] == world]
        scores = score(of_world)
        introduction = f"{len({result['run'] for result in of_world})} runs, answered by {', '.join(scores)}."
        lines += [f"## World {world}", "", introduction, "", *_verdicts(scores), *_further(scores), *_power(scores)]
    return "\n".join(lines).rstrip() + "\n"


def _as_text(name: object) -> str:
    """A name without the characters that Markdown or HTML act on."""
    return re.sub(r"([\\`*\[\]<>|#!&~])", r"\\\1", " ".join(str(name).split()))


def summary_of(scores: Mapping[str, Any]) -> str:
    """The main counts for a terminal, with the definitions."""
    return "\n".join([_DEFINITIONS, *_verdicts(scores["tools"]), *_further(scores["tools"])]).rstrip()


def _verdicts(scores: Mapping[str, Any]) -> Iterator[str]:
    rows: dict[str, Mapping[str, int]] = {}
    for kind in KINDS:
        counted = {f"{_KINDS[kind]}: {tool}": figures["outcomes"][kind] for tool, figures in scores.items()}
        rows |= counted if any(sum(row.values()) for row in counted.values()) else {}
    yield from _table(["runs: tool", *OUTCOMES], _rows(rows))
    recorders = {
        f"{tool}, {name}": row for tool, figures in scores.items() for name, row in figures["recorders"].items() if name
    }
    if recorders:
        yield from ("Runs with one effect, by recorder:", "")
        yield from _table(["tool, logs", *OUTCOMES], _rows(recorders))


def _rows(counts: Mapping[str, Mapping[str, int]]) -> list[list[str]]:
    return [[name, *(str(row[column]) for column in OUTCOMES)] for name, row in counts.items()]


def _further(scores: Mapping[str, Any]) -> Iterator[str]:
    head = ["tool", "both of two", "all of three", "joint", "numbers", "further cause wrong", "class sizes", "withheld"]
    head += ["Brier", "ECE"]
    rows = []
    for tool, figures in scores.items():
        shares = [_share(figures[name]) for name in ("all_of_two", "all_of_three", "joint", "numbers", "further_wrong")]
        listed = [
            ", ".join(f"{what}: {n}" for what, n in figures[name].items()) or "-" for name in ("classes", "withheld")
        ]
        fit = [_number(figures["calibration"][name]) for name in ("brier", "ece")]
        rows.append([tool, *shares, *listed, *fit])
    yield from _table(head, rows)


def _power(scores: Mapping[str, Any]) -> Iterator[str]:
    columns = ("found", "right", "wrong")
    rows = [
        [tool, _band(row), *(_share(row[name]) for name in columns)]
        for tool, figures in scores.items()
        for row in figures["power"]
        if row["found"]["of"] and any(band["right"]["count"] for band in figures["power"])
    ]
    if rows:
        yield from ("Runs with one effect by its size, of tools that found a true cause:", "")
        yield from _table(["tool", "size, %", *columns], rows)


def _band(row: Mapping[str, Any]) -> str:
    return f"{100 * row['from']:g} to {'more' if row['to'] is None else format(100 * row['to'], 'g')}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _share(figure: Mapping[str, Any]) -> str:
    if not figure["of"]:
        return "-"
    low, high = figure["interval"]
    return f"{figure['count']} of {figure['of']} [{100 * low:.0f} to {100 * high:.0f} %]"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)] + [""]
