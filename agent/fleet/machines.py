"""The machines of a result, read one after the other, so that the rows of one alone are in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import groupby
from typing import Any

import numpy as np

from agent.runs import (
    WINDOW,
    Background,
    MachineRuns,
    RunFigures,
    Trend,
    comparable_runs,
    errors_by_joint,
    friction_trends,
    named_causes,
)

#: Columns with the figures of each kind of result, the prediction error first.
_FIGURES = {
    "estimate": ("normalised_rmse", "friction", "warm_up", "nominal_torque"),
    "validate": ("normalised_rmse",),
    "diagnose": ("gap_before", "verdict", "causes"),
}
_VERDICTS = {
    "explained": "the gap between model and robot is explained",
    "ambiguous": "there is a gap between model and robot that several causes explain equally well",
    "unknown": "there is a gap between model and robot that no known effect explains",
}
#: Relative change of a prediction error that matters.
_PRACTICAL_ERROR = 0.25
#: Rows that are read at once.
_BATCH = 256
#: Comes before every run whose time is known.
_UNKNOWN = datetime.min.replace(tzinfo=UTC)


class FleetMachine:
    """What the latest runs of one machine say.

    Attributes
    ----------
    joints : n of them; none where no run has figures.
    nominal, errors : (n,) nominal torque [N·m] and latest prediction error, NaN where unknown.
    runs : name, day, status, reason and page of every run, oldest first.
    failed : why the latest run, or one without a date, has no figures; "" where it has.
    gap : what the latest diagnosis says; "" without one.
    trends : of every axle with enough runs, the likeliest change of its series.
    """

    def __init__(self, kind: str, rows: list[dict[str, Any]]):
        rows = sorted(rows, key=lambda row: (row["started"] or _UNKNOWN, row["run"]))[-WINDOW:]
        known = [k for k, row in enumerate(rows) if row["status"] == "ok"]
        latest, error = rows[known[-1]] if known else {}, _FIGURES[kind][0]
        self.robot: str = rows[0]["robot"]
        self.joints: tuple[str, ...] = tuple(latest.get("joints", ()))
        self.nominal, self.errors = (self._by_joint(latest.get(name)) for name in ("nominal_torque", error))
        self.runs = [
            (row["run"], str(row["started"] or "")[:10], row["status"], row["reason"], row["page"]) for row in rows
        ]
        failed = [
            f"{status}: {reason}"
            for k, (_, day, status, reason, _) in enumerate(self.runs)
            if status != "ok" and (not day or k > max(known, default=-1))
        ]
        self.failed = failed[-1] if failed else ""
        self.gap = _gap(rows[-1])
        figures = [_figures(rows[k], error) for k in known]
        if kind == "estimate":
            series = friction_trends(comparable_runs(figures, "friction"), self.robot)
        else:
            series = _error_trends(comparable_runs(figures, "errors"), self.robot)
        joints = dict.fromkeys(trend.joint for trend in series)
        self.trends = [_likeliest([trend for trend in series if trend.joint == joint]) for joint in joints]

    def _by_joint(self, values: list[float | None] | None) -> np.ndarray:
        fit = values is not None and len(values) == len(self.joints)
        return np.array(values if fit else [None] * len(self.joints), dtype=float)


def read_machines(kind: str, file: Any) -> Iterator[FleetMachine]:
    """Machines of a result's Parquet file, in the order of its rows."""
    columns = ["robot", "run", "started", "status", "reason", "page", "joints", *_FIGURES[kind]]
    rows = (row for batch in file.iter_batches(_BATCH, columns=columns, use_threads=False) for row in batch.to_pylist())
    yield from (FleetMachine(kind, list(of_one)) for _, of_one in groupby(rows, key=lambda row: row["robot"]))


def _figures(row: dict[str, Any], error: str) -> RunFigures:
    rates = row.get("warm_up") or ()
    warm_up = {key: [rate[key] for rate in rates] for key in ("rate_per_s", "standard_deviation")}
    return RunFigures(row["run"], row["started"], row["joints"], row[error] or (), row.get("friction") or (), warm_up)


def _error_trends(figures: Sequence[RunFigures], robot: str) -> list[Trend]:
    """A series for every axle that has an error in each of these runs."""
    runs, nothing = MachineRuns(robot, figures), np.zeros(len(figures))
    return [
        Trend(runs, "prediction error", joint, "", values, nothing, Background(nothing), practical=_PRACTICAL_ERROR)
        for joint, values in (errors_by_joint(figures) if figures else {}).items()
        if np.all(values > 0)  # and no number is missing
    ]


def _likeliest(series: list[Trend]) -> Trend:
    """The series of an axle with the likeliest change, which pays for all of them (Bonferroni)."""
    best = min(series, key=lambda trend: trend.probability)
    best.alternatives = len(series)
    return best


def _gap(row: dict[str, Any]) -> str:
    """What a run says about the gap; empty where there is none, or the run is no diagnosis."""
    verdict, causes = _VERDICTS.get(row.get("verdict") or "", ""), named_causes(row)
    return f"{verdict}: {causes}" if verdict and causes else verdict
