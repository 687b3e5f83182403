"""Plots of a report: matplotlib SVG that follows the page's light or dark colours, each with its data."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

#: A colour no plot uses: replaced by `currentColor`, so axes and text follow the page.
_INK = "#010203"
#: Colours that read on white and on near-black.
SERIES = ("#3b82c4", "#d9822b", "#4f9d69", "#c75d8a", "#8f75d6", "#a0823c", "#3fa7a3")


@dataclass(frozen=True)
class Figure:
    """A plot ready for a page: SVG text, caption, and the data behind it as a table."""

    name: str
    caption: str
    svg: str
    header: tuple[str, ...]
    rows: np.ndarray


def to_figure(
    name: str, caption: str, plot: Any, header: tuple[str, ...], rows: np.ndarray, fitted: bool = True
) -> Figure:
    """Turn a matplotlib figure into SVG without fixed ink, and close it.

    `fitted` margins follow their texts, which draws the plot twice.
    """
    import matplotlib.pyplot as plt

    buffer = io.StringIO()
    box = "tight" if fitted else None
    plot.savefig(buffer, format="svg", transparent=True, bbox_inches=box, metadata={"Date": None})
    plt.close(plot)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(_INK, "currentColor")
    # ids repeat from plot to plot on one page, and a clip path would then be another plot's
    svg = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{name}-", svg)
    return Figure(name, caption, svg, header, np.asarray(rows))


def new_plot(width: float = 10.0, height: float = 3.2, rows: int = 1, columns: int = 1, **options: Any) -> Any:
    """A figure and its axes in the house's style, drawn without a display."""
    import matplotlib as mpl
    from cycler import cycler

    mpl.use("svg")
    import matplotlib.pyplot as plt

    style = {
        "text.color": _INK,
        "axes.labelcolor": _INK,
        "axes.edgecolor": _INK,
        "xtick.color": _INK,
        "ytick.color": _INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.prop_cycle": cycler(color=SERIES),
        "font.size": 9,
        "svg.fonttype": "none",
        "svg.hashsalt": "calibration",
        "font.family": "sans-serif",
        "legend.frameon": False,
        "grid.alpha": 0.25,
        "grid.color": _INK,
        "axes.grid": True,
        "lines.linewidth": 1.3,
    }
    mpl.rcParams.update(style)  # type: ignore[arg-type]  # its stub lists every key
    return plt.subplots(rows, columns, figsize=(width, height), squeeze=False, **options)


def search_history(best: np.ndarray, mean: np.ndarray) -> Figure:
    """Fitness over the generations (the paper's Fig. 4a): best (G,) and mean of the feasible (G,)."""
    plot, axes = new_plot()
    generation = np.arange(1, len(best) + 1)
    axes[0, 0].plot(generation, best, label="best")
    axes[0, 0].plot(generation, mean, label="mean of the feasible", linestyle="--")
    axes[0, 0].set_xlabel("generation")
    axes[0, 0].xaxis.get_major_locator().set_params(integer=True)
    axes[0, 0].set_ylabel("log10 det(HᵀH / M)")
    axes[0, 0].legend()
    rows = np.column_stack([generation, best, mean])
    return to_figure(
        "search-history", "Fitness over the generations; higher is better.", plot, ("generation", "best", "mean"), rows
    )


def speed_profile(t: np.ndarray, speed: np.ndarray, wanted: float) -> Figure:
    """TCP speed (S,) [m/s] over time, against the programmed one."""
    plot, axes = new_plot(height=2.4)
    axes[0, 0].plot(t, speed)
    axes[0, 0].axhline(wanted, linestyle=":", color=SERIES[1])
    axes[0, 0].set_xlabel("time [s]")
    axes[0, 0].set_ylabel("TCP speed [m/s]")
    rows = np.column_stack([t, speed])
    caption = "Speed of the tool along one cycle; dots: as programmed."
    return to_figure("speed", caption, plot, ("t_s", "speed_m_s"), rows)


def limit_margins(t: np.ndarray, use: dict[str, np.ndarray], names: tuple[str, ...]) -> Figure:
    """Use of each kind of limit over time, fraction of the limit: {kind: (S, n)}."""
    plot, axes = new_plot(height=1.9 * len(use), rows=len(use), sharex=True)
    for axis, (kind, values) in zip(axes[:, 0], use.items(), strict=True):
        for joint, name in enumerate(names):
            axis.plot(t, values[:, joint], label=name)
        axis.axhline(1.0, linestyle=":", color=SERIES[3])
        axis.set_ylabel(kind)
        axis.set_ylim(0, 1.1)
    axes[0, 0].legend(ncols=len(names), fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 1.3))
    axes[-1, 0].set_xlabel("time [s]")
    header = ("t_s", *(f"{kind} {name}" for kind in use for name in names))
    rows = np.column_stack([t, *use.values()])
    return to_figure(
        "margins", "Use of the limits along one cycle, as a fraction of each; dots: the limit.", plot, header, rows
    )


def motion_box_plot(rmse: np.ndarray, nominal: np.ndarray, names: tuple[str, ...], gate: float, caption: str) -> Figure:
    """RMSE (motions, n) of several motions per axis, over the nominal torque (n,) where there is one (Fig. 5b)."""
    plot, axes = new_plot(height=3.0)
    known = np.isfinite(nominal)
    values = np.where(known, 100.0 * rmse / np.where(known, nominal, 1.0), rmse)
    kinds = ["" if has or not known.any() else "\n[N·m]" for has in known]
    ink = {"color": _INK}
    axes[0, 0].boxplot(
        values,
        tick_labels=[name + kind for name, kind in zip(names, kinds, strict=True)],
        boxprops=ink,
        whiskerprops=ink,
        capprops=ink,
        flierprops={"markeredgecolor": SERIES[3], "markersize": 4},
        medianprops={"color": SERIES[0], "linewidth": 2},
    )
    axes[0, 0].set_ylabel("RMSE / nominal torque [%]" if known.any() else "RMSE [N·m]")
    axes[0, 0].set_ylim(bottom=0)
    if known.any():
        axes[0, 0].axhline(100.0 * gate, linestyle=":", color=SERIES[3], label="gate")
        axes[0, 0].legend()
    header = tuple(f"{name} [{'%' if has else 'N·m'}]" for name, has in zip(names, known, strict=True))
    return to_figure("validation-box", caption, plot, header, values)


def torque_prediction(
    t: np.ndarray,
    measured: np.ndarray,
    predicted: np.ndarray,
    half_width: np.ndarray,
    names: tuple[str, ...],
    caption: str,
) -> Figure:
    """Measured and predicted torque (S, n) (the paper's Fig. 6); beside it what is left, and the 95 % bounds on it."""
    n = len(names)
    plot, axes = new_plot(height=1.5 * n, rows=n, columns=2, sharex=True)
    for joint, (torque, left) in enumerate(axes):
        torque.plot(t, measured[:, joint], label="measured")
        torque.plot(t, predicted[:, joint], label="predicted", linewidth=0.9)
        torque.set_ylabel(f"{names[joint]}\n[N·m]")
        low, high = -half_width[:, joint], half_width[:, joint]
        left.fill_between(t, low, high, color=SERIES[2], alpha=0.3, linewidth=0, label="95 % bounds")
        left.plot(t, measured[:, joint] - predicted[:, joint], color=SERIES[3], linewidth=0.7, label="left over")
    for axis in axes[0]:
        axis.legend(ncols=2, fontsize=7, loc="upper center", bbox_to_anchor=(0.5, 1.4))
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    kinds = ("measured", "predicted", "half_width_95")
    header = ("t_s", *(f"{kind} {name}" for kind in kinds for name in names))
    rows = np.column_stack([t, measured, predicted, half_width])
    plot.subplots_adjust(left=0.08, right=0.99, bottom=0.3 / n, top=1 - 0.25 / n, wspace=0.12)
    return to_figure("prediction", caption, plot, header, rows, fitted=False)
