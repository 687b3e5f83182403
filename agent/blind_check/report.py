"""A blind check in words: weak spots first, then figures as measured, then what was said of every run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

Scores = Mapping[str, Any]

#: Figure, what it is called, which share is wanted, and whether more is better.
_TARGETS = (
    ("top_1", "first cause right (or in a class of at most three)", 0.9, True),
    ("joint", "right joint", 0.95, True),
    ("unknowns_recognised", "effects outside the catalogue called unknown", 0.8, True),
)
_BY_RECORDER = ("top_1", "false_alarms", "unknowns_recognised", "wrong_names")


def weak_spots(scores: Scores) -> list[str]:
    """What misses its mark, and every effect that was not always named."""
    spots = []
    alarms = scores["false_alarms"]
    if alarms["count"] > max(1, round(alarms["of"] / 150)):
        spots.append(f"{alarms['count']} false alarms in {alarms['of']} effect-free runs; one in 150 is wanted")
    for key, what, wanted, _ in _TARGETS:
        if scores[key]["of"] and scores[key]["share"] < wanted:
            spots.append(f"{what}: {_share(scores[key])}; at least {100 * wanted:.0f} % is wanted")
    withheld = scores["withheld"]["confident_wrong_names"]
    if withheld["of"] and withheld["share"] > 0.1:
        spots.append(f"confident wrong names with the true effect withheld: {_share(withheld)}; at most 10 % is wanted")
    closure = scores["closure"]["of_oracle"]
    if closure is not None and closure < 0.9:
        spots.append(f"median closure is {closure:.3f} of the oracle's; at least 0.9 is wanted")
    if scores["not_recorded"]:
        spots.append(f"{len(scores['not_recorded'])} of {scores['runs']} runs could not be recorded or diagnosed")
    for effect, said in scores["confusion"].items():
        total = sum(said.values())
        others = {name: times for name, times in said.items() if name != _right(effect)}
        if others:
            told = ", ".join(f"{name} ({times})" for name, times in sorted(others.items(), key=lambda x: -x[1]))
            spots.append(f"{effect}: {sum(others.values())} of {total} named as {told}")
    return spots


def _right(effect: str) -> str:
    from agent.model import CATALOGUE

    return "no_gap" if effect == "nothing" else effect if effect in CATALOGUE else "unknown"


def summary_text(scores: Scores) -> str:
    """Figures for a terminal."""
    recorders = [*_recorders(scores), ""] if scores["recorders"] else []
    return "\n".join([*_figures(scores), "", *recorders, *_matrix(scores)])


def _recorders(scores: Scores) -> Iterator[str]:
    """A table of the main figures by how the logs were kept."""
    yield "| logs | runs | first cause right | false alarms | outside: unknown | wrong name | of the oracle's | Brier |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    for name, row in scores["recorders"].items():
        counts = (f"{row[key]['count']} of {row[key]['of']}" for key in _BY_RECORDER)
        closure, brier = (_plain(row[key]) for key in ("of_oracle", "brier"))
        yield f"| {name} | {row['runs']} | {' | '.join(counts)} | {closure} | {brier} |"


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def report_text(scores: Scores) -> str:
    """Markdown."""
    lines = [
        "# Blind check",
        "",
        f"{scores['runs']} runs of {scores['world']} ({scores['robot']}), diagnosed against a model of the same "
        "machine without the effect.",
        "Written by `agent blind-check`; results as measured.",
        f"SHA-256 of the key, noted before the first diagnosis: `{scores['key_sha256']}`.",
        "",
        "## Weak spots",
        "",
    ]
    lines += [f"- {spot}" for spot in weak_spots(scores)] or ["None in what was run."]
    lines += ["", "## Figures", "", "```", *_figures(scores), "```", ""]
    if scores["recorders"]:
        lines += ["## By recorder", "", *_recorders(scores), ""]
    lines += ["## Confusion", ""]
    lines += ["Rows: what was there. First the number of runs, then what was said, most often first.", ""]
    lines += ["```", *_matrix(scores), "```", "", "## Power", ""]
    lines += [
        "Size: root mean square change of the worst joint's torque against the same motion without the effect.",
        "",
    ]
    lines += ["| size, % of nominal | found | named |", "| --- | --- | --- |"]
    for row in scores["power"]:
        upper = "more" if row["to"] is None else f"{100 * row['to']:.1f}"
        lines.append(f"| {100 * row['from']:.1f} to {upper} | {_share(row['found'])} | {_share(row['named'])} |")
    lines += ["", "## Calibration of `probability`", "", "| said | runs | mean | true |", "| --- | --- | --- | --- |"]
    for row in scores["calibration"]["bins"]:
        lines.append(
            f"| {row['from']:.2f} to {row['to']:.2f} | {row['runs']} | {row['mean_probability']:.2f} "
            f"| {row['share_true']:.2f} |"
        )
    lines += ["", "## Runs that went wrong", ""]
    wrong = [line for line in scores["cases"] if line["outcome"] not in ("right", "in class")]
    lines += [f"- {case_text(line)}" for line in wrong] or ["None."]
    lines += ["", "## Confident wrong names with the effect withheld", ""]
    lines += [f"- {name}: {times}" for name, times in scores["withheld"]["names"].items()] or ["None."]
    return "\n".join(lines) + "\n"


def case_text(line: Mapping[str, Any]) -> str:
    """One run: what was there, what was said."""
    there = " + ".join(_effect(effect) for effect in line["effects"]) or "nothing"
    size = "" if line.get("size") is None else f", torque changed by {100 * line['size']:.1f} %"
    text = f"run {line['number']} ({line['kind']}), {there}{size}: {line['outcome']}"
    if "said" not in line:
        return text
    said = line["said"]
    causes = " + ".join(
        f"{_place(c)} p {c['probability']:.2f}" + "".join(f" ~ {_place(e)}" for e in c["equivalent_to"])
        for c in said["causes"]
    )
    largest = max(said["before"])
    closure = "-" if said["closure"] is None else f"{said['closure']:.2f}"
    text += f"; said {said['verdict']} {causes}, closure {closure}, largest gap {100 * largest:.2f} %"
    where = sorted(said["where"].items(), key=lambda entry: -entry[1])[:2]
    text += " (" + ", ".join(f"{joint} {100 * share:.0f} %" for joint, share in where) + ")"
    oracle = line.get("closures", {}).get("oracle")
    return text + (f", oracle {oracle:.2f}" if oracle is not None else "")


def _place(cause: Mapping[str, Any]) -> str:
    return f"{cause['effect']}@{','.join(cause['joints']) or 'arm'}"


def _effect(effect: Mapping[str, Any]) -> str:
    values = ", ".join(f"{name} {_value(value)}" for name, value in effect["parameters"].items() if name != "seed")
    return f"{_place(effect)} ({values})"


def _value(value: Any) -> str:
    if isinstance(value, list):
        return "[" + " ".join(_value(entry) for entry in value) + "]"
    return f"{value:.3g}"


def _share(figure: Mapping[str, Any]) -> str:
    if not figure["of"]:
        return "no such run"
    low, high = figure["interval"]
    return f"{figure['count']} of {figure['of']} ({100 * figure['share']:.0f} %, {100 * low:.0f} to {100 * high:.0f} %)"


def _figures(scores: Scores) -> Iterator[str]:
    """Intervals are Clopper and Pearson's, 95 %."""
    rows = (
        ("false alarms on effect-free runs", "false_alarms"),
        ("first cause right", "top_1"),
        ("truth among the first three", "top_3"),
        ("both effects of two named", "both_of_two"),
        ("right joint", "joint"),
        ("confident wrong name", "wrong_names"),
        ("outside the catalogue: called unknown", "unknowns_recognised"),
        ("outside the catalogue: given a name", "unknowns_named"),
        ("too small to matter: left alone", "too_small_left_alone"),
    )
    yield f"{'runs':42} {scores['runs']} ({', '.join(f'{n} {kind}' for kind, n in sorted(scores['kinds'].items()))})"
    for what, key in rows:
        yield f"{what:42} {_share(scores[key])}"
    withheld = scores["withheld"]
    yield f"{'true effect withheld: confident wrong name':42} {_share(withheld['confident_wrong_names'])}"
    closure = scores["closure"]
    for what, key in (
        ("median closure", "diagnosis"),
        ("  of the oracle's", "of_oracle"),
        ("  oracle", "oracle"),
        ("  wrong effect, as many parameters", "wrong_effect"),
        ("  black box, as many parameters", "black_box"),
    ):
        yield f"{what:42} {_plain(closure[key])}"
    brier = scores["calibration"]["brier"]
    yield f"{'Brier score of probability':42} {_plain(brier)}"
    if scores["diagnosis_cpu_seconds"] is not None:
        yield f"{'CPU time of a diagnosis':42} {scores['diagnosis_cpu_seconds']:.1f} s (median)"


def _matrix(scores: Scores) -> Iterator[str]:
    for effect, said in scores["confusion"].items():
        told = ", ".join(f"{name} {times}" for name, times in sorted(said.items(), key=lambda x: -x[1]))
        yield f"{effect:24} {sum(said.values()):3}   {told}"
