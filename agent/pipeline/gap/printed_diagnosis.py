"""A diagnosis as text for a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from shutil import get_terminal_size
from textwrap import fill, wrap
from typing import Any

from agent.core import counted, plus_minus
from agent.diagnosis import forward_lines, has_torque_gap, reported_parameters, size_text
from agent.pages import RATIO_TITLES, SUMMARY_KEYS, chances_text, next_text, place, summary, verdict_name
from agent.robot import SHARE, figure_text

#: Numbers of servos that are told in thousandths.
_TITLES = {"delay_s": "delay [ms]", "offset": "offset [mrad]"}
_WIDEST = 60  # characters of a step of the attribution in a line


def diagnosis_text(result: dict[str, Any]) -> str:
    """A diagnosis for people: the four things of the page's first screen, then the figures."""
    texts = result.get("summary") or summary(result)
    lines = [f"{'Verdict':10}{verdict_name(result)}"]
    lines += [_wrapped(f"{title:10}{texts[key]}") for key, title in SUMMARY_KEYS.items() if key != "next"]
    lines += [*_next_lines(texts), ""]
    for cause in result["causes"]:
        sizes: list[list[str]] = []
        for key in reported_parameters(cause):
            sizes += [[]] if not sizes or key.startswith("link_") else []  # a line for every push of a contact
            value = cause["parameters"][key]
            log = key.split("_")[0] == "log"
            sizes[-1].append(f"in log {value + 1:g}" if log else f"{key} {size_text(cause, key, value)}")
        lines += [f"{cause['effect']} on {place(cause)}", *(f"  {'  '.join(line)}" for line in sizes)]
    gap = result["gap"]
    width = max(12, *map(len, gap["joints"]))
    of = gap.get("of", "torque")
    drift = list(forward_lines(result["forward"])) if result.get("forward") else []
    lines += list(_servo_lines(result))
    unit = "" if of == "position" else ", in % of nominal torque if known"
    lines.append(f"{of} error on held-out motion{unit} (repeatability: between cycles)")
    lines.append(f"{'joint':{width}} {'before':>11} {'after':>11} {'repeatability':>13} {'share':>7}   mostly in")
    shares = {entry["joint"]: entry for entry in result["where"]}
    somewhere = has_torque_gap(result)
    for k, name in enumerate(gap["joints"]):
        before, after, floor = (
            "-" if gap[side] is None else figure_text(gap[side][k], gap["units"][k])
            for side in ("before", "after", "floor")
        )
        regimes = [r["name"] for r in shares[name]["regimes"] if somewhere and r["share"] > 1.5 * r["of_samples"]][:2]
        share = f"{100 * shares[name]['share']:6.1f}%" if somewhere else f"{'-':>7}"
        lines.append(f"{name:{width}} {before:>11} {after:>11} {floor:>13} {share}   {', '.join(regimes)}".rstrip())
    if result["closure"] is not None and somewhere:
        lines.append(f"explained: {100 * result['closure']:.1f} % of the {of} gap")
    lines += list(_waterfall_lines(result.get("waterfall", [])))
    if result.get("simulation"):
        torque, units = result["simulation"]["torque"], gap["units"]
        own = [gap["joints"].index(joint) for cause in result["causes"][:1] for joint in cause["joints"]]
        worst = max(own or range(len(units)), key=lambda k: (units[k] == SHARE, torque["before"][k]))
        before, after = (figure_text(torque[side][worst], units[worst]) for side in ("before", "after"))
        lines.append(f"torque error of {gap['joints'][worst]} in simulation: {before}, with the effects {after}")
    lines += drift
    lines += _planned_lines(result)
    if result["not_testable"]:
        names = sorted({entry["effect"] for entry in result["not_testable"]})
        lines.append(f"effects that these logs may miss on some joints: {', '.join(names)}")
    return "\n".join(lines)


def _wrapped(text: str) -> str:
    """A line of the first screen with a hanging indent; off a terminal as it is."""
    width = get_terminal_size().columns if sys.stdout.isatty() else len(text) + 1
    return fill(text, width, subsequent_indent=10 * " ", break_long_words=False, break_on_hyphens=False)


def planned_text(result: dict[str, Any]) -> str:
    """What was planned after the verdict, and the commands that come next."""
    return "\n".join([*_planned_lines(result), *_next_lines(result["summary"])])


def _next_lines(texts: dict[str, Any]) -> Iterator[str]:
    for number, step in enumerate(texts["next"]):
        yield f"{'' if number else 'Next':10}{step}"


def _planned_lines(result: dict[str, Any]) -> Iterator[str]:
    """What further motions came to, and the expected result of a planned motion."""
    if result.get("rounds_end"):
        yield f"after {counted(len(result['rounds']), 'further motion')}: {result['rounds_end']}"
    experiment = result["next_experiment"]
    if experiment is None or not experiment.get("program"):  # without one, "Next" says it
        return
    text = next_text(experiment)
    yield f"{text[0].lower()}{text[1:]}"
    for entry in experiment.get("probability", ()):
        pair, before, after, smallest = chances_text(entry)
        detects = "" if smallest == "-" else f"; detects {smallest} of the smallest size that matters"
        yield f"  {pair}: probability of the right answer {before} now, {after} after it{detects}"
    if "with_a_mass" in experiment:
        text = experiment["with_a_mass"]["text"]
        yield f"{text[0].lower()}{text[1:]}"


def _servo_lines(result: dict[str, Any]) -> Iterator[str]:
    """Numbers of joints and servos to copy, with what 95 % of such intervals hold."""
    if not (table := result.get("servo")):
        return
    scale = {"gravity": "gravity of the file's masses", "kp": "the known kp", "none": "nothing: ratios to kp only"}
    yield f"numbers for the simulator, ± 95 %; their scale comes from {scale[result['scale_from']]}"
    names = result["gap"]["joints"]
    width = max(12, *map(len, names))
    yield f"{'joint':{width}} " + " ".join(f"{_TITLES.get(kind, kind):>16}" for kind in table)
    for k, name in enumerate(names):
        cells = []
        for kind, row in table.items():
            cells.append(_number(row[k], 1e3 if kind in _TITLES else 1.0))
        yield f"{name:{width}} " + " ".join(f"{cell:>16}" for cell in cells)
    if over_kp := result.get("servo_over_kp"):
        yield "over kp: with any kp and these ratios to it, the simulator moves as the arm does"
        yield f"{'joint':{width}} " + " ".join(f"{RATIO_TITLES[kind]:>22}" for kind in over_kp)
        for k, name in enumerate(names):
            cells = [_number(row[k], 1.0) for row in over_kp.values()]
            yield f"{name:{width}} " + " ".join(f"{cell:>22}" for cell in cells)


def _number(entry: Sequence[float] | None, scale: float) -> str:
    return "class only" if entry is None else plus_minus(scale * entry[0], scale * (entry[2] - entry[1]) / 2)


def _waterfall_lines(steps: Sequence[dict[str, Any]]) -> Iterator[str]:
    """A bar for what each step closes of the held-out gap, in the order found."""
    if not steps:
        return
    yield "what each step closes of the gap on held-out motion (90 % interval), and alone"
    texts = [wrap(entry["step"], _WIDEST) for entry in steps]
    width = max(len(line) for lines in texts for line in lines)
    for entry, (*above, last) in zip(steps, texts, strict=True):
        yield from (f"  {line}" for line in above)
        closes, (low, high) = 100 * entry["closes"], entry["interval"]
        by_itself = "" if entry["alone"] is None else f"{100 * entry['alone']:6.1f} %"
        bar = "#" * round(min(max(closes, 0), 100) * 0.3)
        inside = f"({100 * low:5.1f} to {100 * high:5.1f})"
        yield f"  {last:{width}} {closes:6.1f} % {inside} {by_itself:>9}  {bar}".rstrip()
