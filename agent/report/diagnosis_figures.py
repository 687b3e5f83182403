"""Figures of a diagnosis: joint by regime, bands of frequency, errors over time, before and after, simulated torque."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.diagnosis import BANDS, Diagnosis, Simulated, band_shares, masks, motor_phase_share
from agent.model import REGIMES
from agent.recording import Log
from agent.report.bars import Bar, lying_bars
from agent.report.figures import Figure, cell_map
from agent.report.plots import SERIES, Panel, Plot, Series
from agent.report.torque_section import worst_first
from agent.robot import SHARE, torque_units

_MOST_JOINTS = 3
_MOST_LOGS = 6


def regime_map(diagnosis: Diagnosis) -> Figure:
    """Joint × regime: error of the model in units of its own background."""
    dataset = diagnosis.dataset
    values = np.full((dataset.robot.dof, len(REGIMES)), np.nan)
    for joint in range(dataset.robot.dof):
        found = masks(dataset, joint)
        relative = (diagnosis.gap.raw[:, joint] / dataset.fit.sigma[:, joint]) ** 2
        for column, regime in enumerate(REGIMES):
            here = found[regime] & np.isfinite(relative)
            if here.any():
                values[joint, column] = np.sqrt(np.mean(relative[here]))
    caption = "Error by joint (rows) and regime (columns), in units of the model's held-out error. About 1 is normal."
    labels = [regime.replace("_", "\n") for regime in REGIMES]
    return cell_map("regimes", caption, values, labels, dataset.robot.joint_names)


def band_map(diagnosis: Diagnosis) -> Figure:
    """Joint × frequency band, and what goes with the motor's angle: shares of the error's energy [%]."""
    dataset = diagnosis.dataset
    values = np.full((dataset.robot.dof, len(BANDS) + 1), np.nan)
    for joint in range(dataset.robot.dof):
        error = diagnosis.gap.raw[:, joint]
        values[joint, :-1] = 100 * band_shares(dataset, error)
        phase = motor_phase_share(dataset, error, joint)
        if phase is not None:
            values[joint, -1] = 100 * phase
    labels = [f"{low:g}-{high:g} Hz" if np.isfinite(high) else f"above {low:g} Hz" for low, high in BANDS]
    caption = (
        "Share of each joint's squared error [%] by frequency and motor angle. -: motor too fast, or turned too little."
    )
    names = dataset.robot.joint_names
    return cell_map("bands", caption, values, [*labels, "motor angle"], names, ["%"] * len(names))


def timeline(diagnosis: Diagnosis) -> Plot:
    """Torque error of the joints over each log, before and after; the joint with most of the gap first."""
    dataset = diagnosis.dataset
    names = dataset.robot.joint_names
    order = [names.index(entry["joint"]) for entry in diagnosis.result["where"]]
    panels = []
    for number, log in enumerate(dataset.logs[:_MOST_LOGS]):
        here = np.flatnonzero(dataset.log == number)
        for joint in order[:_MOST_JOINTS]:
            series = (
                Series("model alone", diagnosis.gap.raw[here, joint], colour=SERIES[1]),
                Series("with the effects", diagnosis.gap.left[here, joint], colour=SERIES[0]),
            )
            title = f"{names[joint]}, {log_title(log)}"
            unit = torque_units(dataset.robot)[joint]
            panels.append(Panel(title, unit, series, dataset.time[here], joint=names[joint]))
    caption = "Torque error over time, held out: each joint's, the one with most of the gap first."
    return Plot("timeline", caption, "time", tuple(panels), x_unit="s", columns=2)


def log_title(log: Log) -> str:
    """A log's name, with its run where that says more than a path."""
    return f"{log.path.parent.name}/{log.name}" if (log.path.parent / "state.json").is_file() else log.name


def before_and_after(diagnosis: Diagnosis) -> Figure:
    """Bars of the held-out torque error of every joint, with the floor as a mark."""
    gap = diagnosis.result["gap"]
    count = len(gap["joints"])
    shares = np.array(gap["units"]) == SHARE
    # a torque cannot be drawn on an axis of shares; the table has it
    scale = np.where(shares, 100.0, np.nan) if shares.any() else np.ones(count)
    before, after = (scale * np.array(gap[side]) for side in ("before", "after"))
    floor = np.full(count, np.nan) if gap["floor"] is None else scale * np.array(gap["floor"])
    rows = np.column_stack([before, after, floor])
    unit = "% of nominal" if shares.any() else "N·m"
    sides = (("model alone", SERIES[1], before), ("with the effects", SERIES[0], after))
    svg = lying_bars(
        gap["joints"],
        [_sides(joint, row, unit) for joint, row in zip(gap["joints"], rows, strict=True)],
        [
            Bar(row, 0.0, float(size), colour, lane)
            for lane, (_, colour, sizes) in enumerate(sides)
            for row, size in enumerate(sizes)
        ],
        f"torque error held out [{unit}]",
        lanes=2,
        legend=(*((name, colour) for name, colour, _ in sides), ("repeatability", SERIES[3])),
        marks=floor,
    )
    caption = "Torque error before and after, and the repeatability: the difference between cycles."
    return Figure("before-after", caption, svg, ("before", "after", "repeatability"), rows)


def _sides(joint: str, row: np.ndarray, unit: str) -> str:
    known = zip(("before", "after", "repeatability"), row, strict=True)
    said = [f"{what} {value:.3g}" for what, value in known if np.isfinite(value)]
    return f"{joint}: {', '.join(said)} {unit}" if said else f"{joint}: in the table"


def simulated_torque(diagnosis: Diagnosis, simulated: Sequence[Simulated]) -> Plot:
    """Torque and position error of the simulation on the joint where the effects change most, first log."""
    one, robot = simulated[0], diagnosis.dataset.robot
    change = np.sqrt(np.mean((one.torque_before - one.torque_after) ** 2, axis=0))
    joint = worst_first(robot, change)[0]
    panels = []
    for kind, scale, unit in (
        ("torque", 1.0, torque_units(robot)[joint]),
        ("position", 1e3, "mm" if robot.joints[joint].prismatic else "mrad"),
    ):
        series = [
            Series(word, scale * getattr(one, f"{kind}_{side}")[:, joint], colour=colour)
            for side, colour, word in (("before", SERIES[1], "model alone"), ("after", SERIES[0], "with the effects"))
        ]
        panels.append(Panel(kind, unit, series))
    caption = f"Measured less simulated on {robot.joint_names[joint]}, {one.log}: torque and position."
    return Plot("simulation-error", caption, "time", tuple(panels), one.time, "s")
