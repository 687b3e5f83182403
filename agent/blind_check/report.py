"""Results as a page: every table with its definitions above it, everything counted from the results alone."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from agent.blind_check.key import KINDS, NAME, VERSION
from agent.blind_check.scoring import OUTCOMES, PRACTICAL, Result, score
from agent.core import AgentError, InputError, write_atomically

RESULTS, PAGE = "results.jsonl", "blind_check.md"

_INTERVALS = (
    "Brackets hold the exact 95 % interval (Clopper and Pearson), as if all runs were one sample. The rules of a tool "
    "that were changed between draws, with earlier runs of the same world at hand, make the interval too favourable."
)
_OUTCOMES = (
    "Every run is counted in one column. `named`: the verdict is `explained` and the first cause is a true effect on "
    "its true joints. `in class`: the verdict is `ambiguous` and the first cause or one of its equals is. `wrong name` "
    "and `wrong class`: the same verdicts without a true effect there. `unknown` and `no gap`: verdicts without a "
    "cause. `no answer`: the tool left the run out."
)
_KINDS = {
    "none": ("healthy", "No effect is built in: `no gap` is right."),
    "one": ("one effect", "One effect of the catalogue, of any size: `named` is right, `in class` is half an answer."),
    "two": ("two effects", "Two effects of the catalogue; the columns judge the first cause."),
    "three": ("three effects", "Three effects of the catalogue; the columns judge the first cause."),
    "outside": ("outside", "An effect that the catalogue has no name for: `unknown` is right."),
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
    write_atomically(folder / RESULTS, "".join(json.dumps(one) + "\n" for one in results))
    write_atomically(folder / PAGE, page(read_results(folder / RESULTS)))


def read_results(path: Path) -> list[dict[str, Any]]:
    """Results as `write_results` keeps them.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no results of a blind check: {error}") from None


def page(results: Sequence[Result]) -> str:
    """Markdown."""
    lines = [f"# {NAME} {VERSION}: results", "", _INTERVALS, ""]
    for world in dict.fromkeys(one["world"] for one in results):
        here = [one for one in results if one["world"] == world]
        scores = score(here)
        said = f"{len({one['run'] for one in here})} runs, answered by {', '.join(scores)}."
        lines += [f"## World {world}", "", said, "", *_sections(scores)]
    return "\n".join(lines).rstrip() + "\n"


def summary_of(scores: Mapping[str, Any]) -> str:
    """The main counts for a terminal, with the definitions."""
    return "\n".join([*_outcome_tables(scores["tools"]), *_further(scores["tools"])]).rstrip()


def _sections(scores: Mapping[str, Any]) -> Iterator[str]:
    yield from ("### Verdicts by kind of run", "", *_outcome_tables(scores))
    yield from ("### Further counts", "", *_further(scores))
    for tool, one in scores.items():
        yield from (f"### {tool}: power by size", "", *_power(one["power"]))
        yield from (
            f"### {tool}: effects",
            "",
            f"Runs with one effect, of the catalogue or outside of it. {_OUTCOMES}",
            "",
        )
        yield from _table(["effect", *OUTCOMES], _rows(one["effects"]))
        if one["calibration"]["runs"]:
            yield from (f"### {tool}: calibration", "", *_calibration(one["calibration"]))


def _outcome_tables(scores: Mapping[str, Any]) -> Iterator[str]:
    yield from (_OUTCOMES, "")
    for kind in KINDS:
        counted = {tool: one["outcomes"][kind] for tool, one in scores.items()}
        if any(sum(row.values()) for row in counted.values()):
            title, meaning = _KINDS[kind]
            yield from (f"**{title}.** {meaning}", "", *_table(["tool", *OUTCOMES], _rows(counted)))
    recorders = {
        f"{tool}, {name}": row for tool, one in scores.items() for name, row in one["recorders"].items() if name
    }
    if recorders:
        yield from ("**one effect, by recorder.** How the logs are kept; columns as above.", "")
        yield from _table(["tool, logs", *OUTCOMES], _rows(recorders))


def _rows(counts: Mapping[str, Mapping[str, int]]) -> list[list[str]]:
    return [[name, *(str(row[column]) for column in OUTCOMES)] for name, row in counts.items()]


def _further(scores: Mapping[str, Any]) -> Iterator[str]:
    yield from (
        "`both of two`, `all of three`: each of the effects is a cause or an equal of one. `joint`: the first cause's"
        " joints, or the joint with the largest share where there is no cause, are among those of the true effects; "
        "`no gap` and `no answer` locate nothing; runs whose effect is of the whole arm are left out. `further cause "
        "wrong`: of answers with more than one cause, those where a later one holds no true effect. `class sizes`: "
        "members of the first cause's class, itself included, and how many `in class` answers have that size. "
        "`withheld`: the tool answers again with the true effects taken out of its catalogue, so `unknown` is right "
        "and any name is wrong.",
        "",
    )
    head = ["tool", "both of two", "all of three", "joint", "further cause wrong", "class sizes", "withheld"]
    head += ["Brier", "ECE"]
    rows = []
    for tool, one in scores.items():
        shares = [_share(one[name]) for name in ("all_of_two", "all_of_three", "joint", "further_wrong")]
        listed = [", ".join(f"{what}: {n}" for what, n in one[name].items()) or "-" for name in ("classes", "withheld")]
        fit = [_number(one["calibration"][name]) for name in ("brier", "ece")]
        rows.append([tool, *shares, *listed, *fit])
    yield from _table(head, rows)


def _power(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    yield from (
        "Runs with one effect. Size: largest root mean square change of a joint's torque against the same motion of "
        f"the same machine without the effect, in % of nominal torque. Effects below {100 * PRACTICAL:g} % are too "
        "small to matter, and count all the same: a wrong name is a wrong name. `found`: any verdict but `no gap`. "
        "`right`: `named` or `in class`. `wrong`: `wrong name` or `wrong class`. An `interpolator_mismatch` of "
        "the world mujoco has no size in torque and is left out.",
        "",
    )
    columns = ("found", "right", "wrong")
    table = [[_band(row, 100), *(_share(row[name]) for name in columns), str(row["in class"])] for row in rows]
    yield from _table(["size, %", *columns, "of right: in class"], table)


def _calibration(found: Mapping[str, Any]) -> Iterator[str]:
    yield from (
        "All answers whose first cause has a probability, on healthy runs and effects outside the catalogue too. "
        "`said`: its mean. `came`: share of answers that are `named` or `in class`. Brier score: mean squared "
        "difference of probability and truth. ECE: mean of |said − came| over the rows, weighted by runs.",
        "",
    )
    rows = [[_band(row, 1), str(row["runs"]), f"{row['said']:.2f}", f"{row['came']:.2f}"] for row in found["bins"]]
    yield from _table(["probability", "runs", "said", "came"], rows)
    yield from (f"Brier score {_number(found['brier'])}, ECE {_number(found['ece'])} ({found['runs']} answers).", "")


def _band(row: Mapping[str, Any], factor: float) -> str:
    upper = "more" if row["to"] is None else f"{factor * row['to']:g}"
    return f"{factor * row['from']:g} to {upper}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _share(figure: Mapping[str, Any]) -> str:
    if not figure["of"]:
        return "-"
    low, high = figure["interval"]
    return f"{figure['count']} of {figure['of']} [{100 * low:.0f} to {100 * high:.0f} %]"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)] + [""]
