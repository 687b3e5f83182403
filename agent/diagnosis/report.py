"""The page of a diagnosis: for the technician first, then every step of the procedure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.diagnosis.effects import CATALOGUE
from agent.diagnosis.forward import Simulated
from agent.diagnosis.procedure import Step
from agent.diagnosis.regimes import masks
from agent.diagnosis.result import Diagnosis
from agent.report.figures import SERIES, Figure, new_plot, to_figure
from agent.report.page import Page, Section, Table, render

_HEADLINES = {
    "no_gap": "No gap: model and robot agree within what the model's own prediction error allows.",
    "unknown": "There is a gap, and no effect of the catalogue closes it.",
}
_REGIMES = ("standstill", "reversal", "low_speed", "high_speed", "high_load", "acceleration")


def diagnosis_report(diagnosis: Diagnosis, simulated: Sequence[Simulated] = ()) -> str:
    """HTML text of the report."""
    result = diagnosis.result
    verdict = result["verdict"]
    sections = [_findings(diagnosis), _where(diagnosis), _figures(diagnosis), _steps(diagnosis), _testable(diagnosis)]
    colour = {"no_gap": "good", "explained": "bad"}.get(verdict, "plain")
    title = f"Gap between model and {diagnosis.dataset.robot.name}"
    return render(Page(title, _headline(diagnosis), colour, sections))


def _headline(diagnosis: Diagnosis) -> str:
    result = diagnosis.result
    if not result["causes"]:
        return _HEADLINES.get(result["verdict"], _HEADLINES["unknown"])
    cause = result["causes"][0]
    where = " and ".join(cause["joints"]) or "the whole arm"
    sure = "most likely" if result["verdict"] == "explained" else "possibly"
    return f"{where}: {sure} {_plain(cause['effect'])} (probability {cause['probability']:.2f})."


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _findings(diagnosis: Diagnosis) -> Section:
    result = diagnosis.result
    text = list(diagnosis.warnings)
    rows = []
    for cause in result["causes"]:
        effect = CATALOGUE[cause["effect"]]
        text.append(f"{_plain(cause['effect'])}: look at {effect.look_at}.")
        others = ", ".join(f"{_plain(e['effect'])} {' '.join(e['joints'])}".strip() for e in cause["equivalent_to"])
        closure = "-" if cause["closure"] is None else f"{100 * cause['closure']:.0f} %"
        parameters = ", ".join(f"{key} {value:.4g}" for key, value in cause["parameters"].items())
        where = ", ".join(cause["joints"]) or "arm"
        rows.append((_plain(cause["effect"]), where, f"{cause['probability']:.2f}", closure, others or "-", parameters))
    if result["next_experiment"] is not None:
        text.append(f"Run next: {result['next_experiment']['motion']}.")
    header = ("cause", "where", "probability", "closes", "as good", "parameters")
    return Section("What it is", text, (Table("causes", header, rows),) if rows else ())


def _where(diagnosis: Diagnosis) -> Section:
    result, names = diagnosis.result, diagnosis.dataset.robot.joint_names
    gap = result["gap"]
    share = {entry["joint"]: entry["share"] for entry in result["where"]}
    floor = gap["floor"] or [float("nan")] * len(names)
    rows = [
        (name, *(f"{100 * part[k]:.3f}" for part in (gap["before"], gap["after"], floor)), f"{100 * share[name]:.1f}")
        for k, name in enumerate(names)
    ]
    header = ("joint", "before [%]", "after [%]", "floor [%]", "share of the gap [%]")
    text = ["Torque error held out, over nominal joint torque (in N·m / 100 where a joint has none)."]
    motion = result["motion_gap"]
    if motion["before"] is not None:
        worst = 1e3 * max(motion["before"])
        text.append(f"Planned against executed set-points: {worst:.3f} mrad root mean square on the worst joint.")
    return Section("Where it is", text, (Table("gap", header, rows), _map(diagnosis), _timeline(diagnosis)))


def _map(diagnosis: Diagnosis) -> Figure:
    """Joint × regime: error of the model in units of its own background."""
    dataset = diagnosis.dataset
    values = np.full((dataset.robot.dof, len(_REGIMES)), np.nan)
    for joint in range(dataset.robot.dof):
        found = masks(dataset, joint)
        relative = (diagnosis.before[:, joint] / dataset.fit.sigma[:, joint]) ** 2
        for column, name in enumerate(_REGIMES):
            if np.any(found[name] & np.isfinite(relative)):
                values[joint, column] = np.sqrt(np.nanmean(relative[found[name]]))
    plot, axes = new_plot(height=0.5 * dataset.robot.dof + 1.2)
    axis = axes[0, 0]
    image = axis.imshow(values, cmap="viridis", aspect="auto", vmin=0, vmax=max(3.0, float(np.nanmax(values))))
    axis.set_xticks(range(len(_REGIMES)), [_plain(name) for name in _REGIMES])
    axis.set_yticks(range(dataset.robot.dof), list(dataset.robot.joint_names))
    axis.grid(False)
    for joint in range(values.shape[0]):
        for column in range(values.shape[1]):
            if np.isfinite(values[joint, column]):
                axis.text(column, joint, f"{values[joint, column]:.1f}", ha="center", va="center", color="white")
    plot.colorbar(image, ax=axis, label="error / background")
    caption = "Error of the model, joint by regime, in units of its own held-out error: about 1 where nothing is wrong."
    return to_figure("regimes", caption, plot, tuple(_REGIMES), values)


def _timeline(diagnosis: Diagnosis) -> Figure:
    """Error over time on the worst joint of each log, before and after."""
    dataset = diagnosis.dataset
    names = [entry["joint"] for entry in diagnosis.result["where"]]
    joint = dataset.robot.joint_names.index(names[0])
    plot, axes = new_plot(height=1.7 * len(dataset.logs), rows=len(dataset.logs))
    rows = []
    for number, (log, axis) in enumerate(zip(dataset.logs, axes[:, 0], strict=True)):
        here = np.flatnonzero(dataset.log == number)
        here = here[:: max(1, len(here) // 1500)]
        before, after = diagnosis.before[here, joint], diagnosis.after[here, joint]
        axis.plot(dataset.time[here], before, label="before", color=SERIES[1])
        axis.plot(dataset.time[here], after, label="after", color=SERIES[0])
        axis.set_ylabel(f"{log.name}\n[N·m]")
        rows.append(np.column_stack([np.full(len(here), number), dataset.time[here], before, after]))
    axes[0, 0].legend(ncols=2, fontsize=7)
    axes[-1, 0].set_xlabel("time [s]")
    header = ("log", "t_s", "before", "after")
    return to_figure("timeline", f"Torque error of {names[0]} over time.", plot, header, np.concatenate(rows))


def _figures(diagnosis: Diagnosis) -> Section:
    result = diagnosis.result
    text = [f"Held out: {fold['held_out']}, fitted on {', '.join(fold['fitted_on'])}." for fold in result["folds"]]
    if result["closure"] is not None:
        text.append(f"Closure of the torque gap: {result['closure']:.3f}.")
    return Section("How far it shrinks", text)


def _steps(diagnosis: Diagnosis) -> Section:
    tables = []
    rows_of = diagnosis.dataset.fit.count.sum()
    for number, step in enumerate(diagnosis.finding.steps[:8]):
        tables.append(_step_table(number, step, rows_of, diagnosis.dataset.robot.joint_names))
    text = (
        "Each scan adds every effect, everywhere, to what is chosen already, fitted together with the model under the "
        "uncertainty stored in it and scored on motions left out. Gain: held-out squared error taken away, in units of "
        "the model's own background.",
    )
    return Section("Steps", text, tables)


def _step_table(number: int, step: Step, rows: float, names: tuple[str, ...]) -> Table:
    chosen = " + ".join(_plain(c.effect.name) for c in step.chosen) or "model alone"
    could = {id(score) for score in step.eligible}
    lines = [
        (
            _plain(score.candidate.effect.name),
            ", ".join(names[j] for j in score.candidate.joints) or "arm",
            f"{score.gain / rows:.4f}",
            "yes" if id(score) in could else "no",
        )
        for score in step.scores[:8]
    ]
    return Table(f"scan {number + 1}: {chosen}", ("effect", "where", "gain", "can be named"), lines)


def _testable(diagnosis: Diagnosis) -> Section:
    rows = [(_plain(e["effect"]), e["joint"] or "arm", e["why"]) for e in diagnosis.result["not_testable"]]
    text = ("Smallest effect that would stand out of the background here against the smallest that matters.",)
    return Section(
        "Not testable here", text, (Table("not-testable", ("effect", "where", "why"), rows),) if rows else ()
    )
