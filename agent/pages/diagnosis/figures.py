"""Tables and plots of a diagnosis: joint by regime and frequency, errors over time, before and after, simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from agent.diagnosis import BANDS, Diagnosis, Simulated, band_shares, has_torque_gap, masks, motor_phase_share
from agent.model import REGIMES
from agent.pages.elements import Bar, Bars, Table, shaded_table
from agent.pages.phrasing import share_text
from agent.pages.plots import SERIES, Panel, Plot, Series, worst_first
from agent.recording import Log
from agent.robot import SHARE, figure_text, torque_units

_MOST_JOINTS = 3
_MOST_LOGS = 6
_BINS = 24  # of a joint's position and speed


def regime_map(diagnosis: Diagnosis) -> Table:
    """Joint × regime: error of the model over its held-out error."""
    dataset = diagnosis.dataset
    values = np.full((dataset.robot.dof, len(REGIMES)), np.nan)
    for joint in range(dataset.robot.dof):
        by_regime = masks(dataset, joint)
        relative = (diagnosis.gap.error_before[:, joint] / dataset.fit.sigma[:, joint]) ** 2
        for column, regime in enumerate(REGIMES):
            mask = by_regime[regime] & np.isfinite(relative)
            if mask.any():
                values[joint, column] = np.sqrt(np.mean(relative[mask]))
    caption = "Error by joint (rows) and regime (columns), in units of the model's held-out error. About 1 is normal."
    return shaded_table("regimes", caption, values, REGIMES, dataset.robot.joint_names)


def band_map(diagnosis: Diagnosis) -> Table:
    """Joint × frequency band, and the part that follows the motor's angle: shares of the error's energy [%]."""
    dataset = diagnosis.dataset
    values = np.full((dataset.robot.dof, len(BANDS) + 1), np.nan)
    for joint in range(dataset.robot.dof):
        error = diagnosis.gap.error_before[:, joint]
        values[joint, :-1] = 100 * band_shares(dataset, error)
        phase = motor_phase_share(dataset, error, joint)
        if phase is not None:
            values[joint, -1] = 100 * phase
    labels = [f"{low:g}-{high:g} Hz" if np.isfinite(high) else f"above {low:g} Hz" for low, high in BANDS]
    caption = (
        "Share of each joint's squared error [%] by frequency and motor angle. -: motor too fast, or turned too little."
    )
    names = dataset.robot.joint_names
    return shaded_table("bands", caption, values, [*labels, "motor angle"], names, ["%"] * len(names))


def power_map(diagnosis: Diagnosis) -> Table:
    """Effect × joint: the smallest size that would have been found, over the size that matters."""
    power = diagnosis.document.power
    effects = list(dict.fromkeys(entry.effect for entry in power))
    columns = list(dict.fromkeys(entry.joint or "arm" for entry in power))
    values = np.full((len(effects), len(columns)), np.nan)
    for entry in power:
        if entry.smallest is not None:
            at = effects.index(entry.effect), columns.index(entry.joint or "arm")
            values[at] = entry.smallest / entry.practical
    caption = (
        "Smallest size that would have been found with 80 % power, over the size that matters. At 1 or less, an effect "
        "of practical size would have been found. -: no size would have been found."
    )
    return shaded_table("power", caption, values, columns, effects, of_row="effect")


def remainder(diagnosis: Diagnosis) -> Plot | None:
    """What no cause explains on the joint that keeps most: its mean over position or speed, by direction."""
    if not diagnosis.document.remainder:
        return None
    dataset, entry = diagnosis.dataset, diagnosis.document.remainder[0]
    joint = dataset.robot.joint_names.index(entry.joint)
    error, speed = diagnosis.gap.error_after[:, joint], dataset.speed[:, joint]
    position = np.concatenate([s.q[s.kept, joint] for s in dataset.fit.signals])
    name, over = ("position", position) if entry.follows["position"] >= entry.follows["speed"] else ("speed", speed)
    edges = np.linspace(over.min(), over.max(), _BINS + 1)
    number = np.clip(np.searchsorted(edges, over) - 1, 0, _BINS - 1)
    series = []
    for words, direction, colour in (("moving up", speed > 0, SERIES[0]), ("moving down", speed < 0, SERIES[1])):
        mask = direction & np.isfinite(error)
        count = np.bincount(number[mask], minlength=_BINS)
        mean = np.bincount(number[mask], error[mask], _BINS) / np.where(count, count, np.nan)
        series.append(Series(words, mean, colour=colour))
    panel = Panel(entry.joint, torque_units(dataset.robot)[joint], series, 0.5 * (edges[1:] + edges[:-1]))
    caption = f"What remains on {entry.joint}: mean torque error over its {name}, by direction of motion."
    return Plot("remainder", caption, name, (panel,))


def timeline(diagnosis: Diagnosis) -> Plot:
    """Torque error of the joints over each log, before and after; the joint with most of the gap first."""
    dataset = diagnosis.dataset
    names = dataset.robot.joint_names
    order = [names.index(entry["joint"]) for entry in diagnosis.result["where"]]
    panels = []
    for number, log in enumerate(dataset.logs[:_MOST_LOGS]):
        rows_of_log = np.flatnonzero(dataset.log == number)
        for joint in order[:_MOST_JOINTS]:
            series = (
                Series("model alone", diagnosis.gap.error_before[rows_of_log, joint], colour=SERIES[1]),
                Series("with the effects", diagnosis.gap.error_after[rows_of_log, joint], colour=SERIES[0]),
            )
            title = f"{names[joint]}, {log_title(log)}"
            unit = torque_units(dataset.robot)[joint]
            panels.append(Panel(title, unit, series, dataset.time[rows_of_log], joint=names[joint]))
    caption = "Torque error over time, held out: each joint's, the one with most of the gap first."
    return Plot("timeline", caption, "time", tuple(panels), x_unit="s", columns=2)


def log_title(log: Log) -> str:
    """A log's name, with its run where that says more than a path."""
    return f"{log.path.parent.name}/{log.name}" if (log.path.parent / "state.json").is_file() else log.name


def gap_table(result: Mapping[str, Any]) -> Table:
    """Held-out torque error of every joint before and after, its repeatability, and the share of the gap."""
    gap = result["gap"]
    entries = {entry["joint"]: entry for entry in result["where"]}
    floors = gap["floor"] or [float("nan")] * len(gap["joints"])
    rows: list[tuple[str | Bars, ...]] = []
    for joint, unit, *errors in zip(gap["joints"], gap["units"], gap["before"], gap["after"], floors, strict=True):
        before, after, floor = (100 * error if unit == SHARE else error for error in errors)
        bars = [Bar(0.0, before, SERIES[1], 0.05, 0.4), Bar(0.0, after, SERIES[0], 0.5, 0.4)]
        share = share_text(entries[joint]) if has_torque_gap(result) else "-"
        picture = Bars(bars, [(floor, SERIES[3])], unit)
        rows.append((joint, *(figure_text(error, unit) for error in errors), share, picture))
    rows.sort(key=lambda row: -entries[str(row[0])]["share"])
    header = ("joint", "before", "after", "repeatability", "share of the gap", "before, after; stroke: repeatability")
    caption = "Torque error before and after, and repeatability: the difference between cycles."
    return Table("gap", header, rows, caption=caption)


def waterfall(steps: Sequence[Mapping[str, Any]]) -> tuple[str, Table]:
    """The share of the gap that each step closes, in words, and as a table with bars."""
    text = (
        "Share of the gap that each step closes on held-out motion, in addition to the steps before it. The steps and "
        "the rest sum to the whole gap. Alone: what a step closes by itself."
    )
    rows: list[tuple[str | Bars, ...]] = []
    remaining = 100.0
    for entry in steps:
        closes, (low, high) = 100 * entry["closes"], entry["interval"]
        is_remainder = entry is steps[-1]
        bar = Bar(0.0, closes, SERIES[1]) if is_remainder else Bar(remaining - closes, remaining, SERIES[0])
        by_itself = "-" if entry["alone"] is None else f"{100 * entry['alone']:.1f} %"
        rows.append(
            (entry["step"], f"{closes:.1f} %", f"{100 * low:.1f} to {100 * high:.1f} %", by_itself, Bars([bar]))
        )
        remaining -= closes
    caption = "Each step removes its bar from the gap; the last bar remains."
    header = ("step", "closes", "90 % interval", "alone", "gap that remains")
    return text, Table("waterfall", header, rows, caption=caption)


def simulated_torque(diagnosis: Diagnosis, simulated: Sequence[Simulated]) -> Plot:
    """Torque and position error of the simulation on the joint where the effects change most, first log."""
    first, robot = simulated[0], diagnosis.dataset.robot
    change = np.sqrt(np.mean((first.torque_before - first.torque_after) ** 2, axis=0))
    joint = worst_first(robot, change)[0]
    panels = []
    for kind, scale, unit in (
        ("torque", 1.0, torque_units(robot)[joint]),
        ("position", 1e3, "mm" if robot.joints[joint].prismatic else "mrad"),
    ):
        series = [
            Series(word, scale * getattr(first, f"{kind}_{side}")[:, joint], colour=colour)
            for side, colour, word in (("before", SERIES[1], "model alone"), ("after", SERIES[0], "with the effects"))
        ]
        panels.append(Panel(kind, unit, series))
    caption = f"Measured less simulated on {robot.joint_names[joint]}, {first.log}: torque and position."
    return Plot("simulation-error", caption, "time", tuple(panels), first.time, "s")
