"""Figures of a diagnosis: joint by regime, bands of frequency, errors over time, before and after, simulated torque."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.diagnosis.forward import Simulated
from agent.diagnosis.regimes import BANDS, SHOWN, band_shares, masks, motor_phase_share
from agent.diagnosis.result import Diagnosis
from agent.report.figures import SERIES, Figure, new_plot, to_figure
from agent.robot.torque_figures import SHARE

_POINTS = 1500  # of a line, at most
_MOST_LOGS = 6


def regime_map(diagnosis: Diagnosis) -> Figure:
    """Joint × regime: error of the model in units of its own background."""
    dataset = diagnosis.dataset
    values = np.full((dataset.robot.dof, len(SHOWN)), np.nan)
    for joint in range(dataset.robot.dof):
        found = masks(dataset, joint)
        relative = (diagnosis.gap.raw[:, joint] / dataset.fit.sigma[:, joint]) ** 2
        for column, regime in enumerate(SHOWN):
            here = found[regime] & np.isfinite(relative)
            if here.any():
                values[joint, column] = np.sqrt(np.mean(relative[here]))
    caption = (
        "Error of the model by joint (rows) and regime (columns), in units of its own held-out error: about 1 where "
        "nothing is wrong."
    )
    labels = [regime.replace("_", "\n") for regime in SHOWN]
    return _map("regimes", caption, values, labels, dataset.robot.joint_names)


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
        "Share of each joint's squared error by frequency, and that of it which goes with the angle of the motor "
        "(- where the motor turns too fast or too little to tell), in %."
    )
    return _map("bands", caption, values, [*labels, "motor angle"], dataset.robot.joint_names)


def timeline(diagnosis: Diagnosis, joint: int) -> Figure:
    """Torque error of one joint over each log, before and after."""
    dataset = diagnosis.dataset
    logs = dataset.logs[:_MOST_LOGS]
    plot, axes = new_plot(height=1.6 * len(logs) + 0.4, rows=len(logs))
    rows = []
    for number, (log, axis) in enumerate(zip(logs, axes[:, 0], strict=True)):
        here = np.flatnonzero(dataset.log == number)
        here = here[:: max(1, len(here) // _POINTS)]
        before, after = diagnosis.gap.raw[here, joint], diagnosis.gap.left[here, joint]
        axis.plot(dataset.time[here], before, label="model alone", color=SERIES[1])
        axis.plot(dataset.time[here], after, label="with the effects", color=SERIES[0])
        axis.set_ylabel(f"{log.name}\n[N·m]")
        for start in log.cycle_starts[:50]:
            axis.axvline(start, linewidth=0.6, linestyle=":", color=SERIES[5])
        rows.append(np.column_stack([np.full(len(here), number), dataset.time[here], before, after]))
    axes[0, 0].legend(ncols=2, fontsize=7, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    axes[-1, 0].set_xlabel("time [s]")
    plot.align_ylabels()
    name = dataset.robot.joint_names[joint]
    caption = f"Torque error of {name} over time, held out; dotted lines are where cycles start."
    return to_figure("timeline", caption, plot, ("log", "t_s", "before", "after"), np.concatenate(rows))


def before_and_after(diagnosis: Diagnosis) -> Figure:
    """Bars of the held-out torque error of every joint, with the floor as a mark."""
    gap = diagnosis.result["gap"]
    count = np.arange(len(gap["joints"]))
    shares = np.array(gap["units"]) == SHARE
    # a torque cannot be drawn on an axis of shares; the table has it
    scale = np.where(shares, 100.0, np.nan) if shares.any() else np.ones(len(count))
    before, after = (scale * np.array(gap[side]) for side in ("before", "after"))
    floor = np.full(len(count), np.nan) if gap["floor"] is None else scale * np.array(gap["floor"])
    plot, axes = new_plot(height=0.42 * len(count) + 1.2)
    axis = axes[0, 0]
    axis.barh(count - 0.18, before, 0.34, label="model alone", color=SERIES[1])
    axis.barh(count + 0.18, after, 0.34, label="with the effects", color=SERIES[0])
    axis.plot(floor, count, "|", markersize=16, markeredgewidth=2, color=SERIES[3], label="floor", linestyle="none")
    axis.set_yticks(count, gap["joints"])
    axis.invert_yaxis()
    axis.grid(visible=False, axis="y")
    unit = "% of nominal" if shares.any() else "N·m"
    axis.set_xlabel(f"torque error held out [{unit}]")
    axis.legend(fontsize=7, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    caption = "Torque error before and after, and the floor: what does not even repeat from cycle to cycle."
    rows = np.column_stack([before, after, floor])
    return to_figure("before-after", caption, plot, ("before", "after", "floor"), rows)


def simulated_torque(diagnosis: Diagnosis, simulated: Sequence[Simulated]) -> Figure:
    """Torque and position error of the simulation on the joint where the effects change most, first log."""
    one = simulated[0]
    change = np.sqrt(np.mean((one.torque_before - one.torque_after) ** 2, axis=0))
    nominal = diagnosis.dataset.robot.nominal_torque
    unit = np.where(np.isfinite(nominal), nominal, 1.0)
    joint = int(np.argmax(change / unit))
    part = slice(None, None, max(1, len(one.time) // _POINTS))
    plot, axes = new_plot(height=3.6, rows=2, sharex=True)
    rows = [one.time[part]]
    for axis, kind, scale, label in (
        (axes[0, 0], "torque", 1.0, "torque [N·m]"),
        (axes[1, 0], "position", 1e3, "position [mrad, mm]"),
    ):
        for side, colour, word in (("before", SERIES[1], "model alone"), ("after", SERIES[0], "with the effects")):
            error = scale * getattr(one, f"{kind}_{side}")[part, joint]
            axis.plot(one.time[part], error, color=colour, label=word, linewidth=1.0)
            rows.append(error)
        axis.set_ylabel(label)
    axes[0, 0].legend(ncols=2, fontsize=7, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    axes[1, 0].set_xlabel("time [s]")
    plot.align_ylabels()
    name = diagnosis.dataset.robot.joint_names[joint]
    caption = f"Measured less simulated on {name}, {one.log}: torque and position."
    header = ("t_s", "torque_before", "torque_after", "position_before", "position_after")
    return to_figure("simulation-error", caption, plot, header, np.column_stack(rows))


def _map(name: str, caption: str, values: np.ndarray, columns: Sequence[str], rows: Sequence[str]) -> Figure:
    """Cells shaded by value, which read on light and on dark."""
    from matplotlib.patches import Rectangle

    plot, axes = new_plot(height=0.42 * len(rows) + 1.1)
    axis = axes[0, 0]
    axis.grid(visible=False)
    largest = max(float(np.nanmax(values)), 1e-9) if np.isfinite(values).any() else 1.0
    for row, column in np.ndindex(values.shape):
        value = values[row, column]
        text = "-"
        if np.isfinite(value):
            text = f"{value:.0f}" if value >= 9.95 else f"{value:.1f}"
            shade = min(0.06 + 0.84 * max(float(value), 0.0) / largest, 1.0)
            axis.add_patch(
                Rectangle((column - 0.48, row - 0.46), 0.96, 0.92, facecolor=SERIES[1], alpha=shade, linewidth=0)
            )
        axis.text(column, row, text, ha="center", va="center")
    axis.set_xlim(-0.5, values.shape[1] - 0.5)
    axis.set_ylim(values.shape[0] - 0.5, -0.5)
    axis.set_xticks(range(len(columns)), columns, fontsize=8)
    axis.set_yticks(range(len(rows)), rows)
    header = tuple(column.replace("\n", "_") for column in columns)
    return to_figure(name, caption, plot, header, values)
