"""Two runs side by side: which parameters moved by more than their uncertainty, and what that does to torque."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.recording import AROUND

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.recording import Log

#: A parameter moved where the change is beyond this many of its standard deviations (one in a thousand by chance).
BEYOND = 3.3


@dataclass(frozen=True)
class ParameterChange:
    """A parameter before and after: values, deviation of their difference, and that difference in deviations."""

    name: str
    unit: str
    before: float
    after: float
    deviation: float

    @property
    def deviations(self) -> float:
        """The change in standard deviations of a change."""
        if self.before == self.after:
            return 0.0
        return (self.after - self.before) / max(self.deviation, 1e-300)

    @property
    def moved(self) -> bool:
        """Whether that is more than chance."""
        return abs(self.deviations) > BEYOND


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two models of one robot.

    `changes` are of parameters that both have and that were estimated in between; `only_before`, `only_after` name
    those that one alone has. `torque_rmse`,
    `torque_largest`, `nominal` (n,) [N·m]: how far the predictions are apart along `motion`, a recorded motion in the
    sub-region, and the nominal torque (NaN where there is none). `deviation` (n,) is what the stated uncertainty of
    the models explains of `torque_rmse`.
    """

    before: str
    after: str
    joints: tuple[str, ...]
    changes: tuple[ParameterChange, ...]
    only_before: tuple[str, ...]
    only_after: tuple[str, ...]
    motion: str
    torque_rmse: np.ndarray
    torque_largest: np.ndarray
    deviation: np.ndarray
    nominal: np.ndarray

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "schema": "compare/1",
            "before": self.before,
            "after": self.after,
            "parameters": [
                {
                    "name": c.name,
                    "unit": c.unit,
                    "before": c.before,
                    "after": c.after,
                    "standard_deviation": c.deviation,
                    "deviations": c.deviations,
                    "moved": c.moved,
                }
                for c in self.changes
            ],
            "only_before": list(self.only_before),
            "only_after": list(self.only_after),
            "torque": {
                "motion": self.motion,
                "joints": list(self.joints),
                "rmse": self.torque_rmse,
                "largest": self.torque_largest,
                "normalised_rmse": self.torque_rmse / self.nominal,
                "standard_deviation": self.deviation,
            },
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Comparison:
        """The inverse of `to_dict`."""
        torque = data["torque"]
        rmse, share = (np.array([np.nan if v is None else v for v in torque[k]]) for k in ("rmse", "normalised_rmse"))
        with np.errstate(divide="ignore", invalid="ignore"):
            nominal = rmse / share
        return cls(
            before=data["before"],
            after=data["after"],
            joints=tuple(torque["joints"]),
            changes=tuple(
                ParameterChange(p["name"], p["unit"], p["before"], p["after"], p["standard_deviation"])
                for p in data["parameters"]
            ),
            only_before=tuple(data["only_before"]),
            only_after=tuple(data["only_after"]),
            motion=torque["motion"],
            torque_rmse=rmse,
            torque_largest=np.array(torque["largest"]),
            deviation=np.array(torque["standard_deviation"]),
            nominal=nominal,
        )

    def text(self) -> str:
        """For people: what moved, then the torque."""
        moved = sorted((c for c in self.changes if c.moved), key=lambda c: -abs(c.deviations))
        lines = [f"{self.before} -> {self.after}"]
        if moved:
            lines.append(f"{len(moved)} of {len(self.changes)} parameters moved by more than their uncertainty:")
            lines += [
                f"  {c.name:14} {c.before:10.4g} -> {c.after:10.4g} {c.unit:10} {c.deviations:+6.1f} deviations"
                for c in moved
            ]
        else:
            lines.append(f"none of {len(self.changes)} parameters moved by more than its uncertainty")
        for title, names in (("before", self.only_before), ("after", self.only_after)):
            if names:
                lines.append(f"only {title}: {', '.join(names)}")
        lines.append(f"predicted torque along {self.motion}:")
        for k, joint in enumerate(self.joints):
            share = self.torque_rmse[k] / self.nominal[k]
            normalised = f" ({100 * share:.2f} % of nominal)" if np.isfinite(share) else ""
            lines.append(
                f"  {joint:12} differs by {self.torque_rmse[k]:.3g} N·m RMS{normalised}, at most "
                f"{self.torque_largest[k]:.3g} N·m; uncertainty explains {self.deviation[k]:.2g} N·m"
            )
        return "\n".join(lines)


def compare_models(
    before: IdentifiedModel, after: IdentifiedModel, log: Log, before_name: str, after_name: str
) -> Comparison:
    """Compare two models of one robot along the motion of a log, one of its cycles where it repeats."""
    places = [{name: k for k, name in enumerate(model.names)} for model in (before, after)]
    deviation = change_deviations(before, after)
    kept = set(after.names[: len(after.independent)]) if share_base(before, after) else set()
    units = [row[4] for row in after.rows()[1:]]
    changes = tuple(
        ParameterChange(name, units[k], float(before.values[places[0][name]]), float(after.values[k]), deviation[name])
        for name, k in places[1].items()
        if name in places[0] and name not in kept
    )
    start, stop = log.middle_cycle()
    part = log.between(start - AROUND, stop + AROUND)
    difference, uncertainty = _torque_difference(before, after, part)
    return Comparison(
        before=before_name,
        after=after_name,
        joints=after.robot.joint_names,
        changes=changes,
        only_before=tuple(name for name in places[0] if name not in places[1]),
        only_after=tuple(name for name in places[1] if name not in places[0]),
        motion=("a cycle of " if log.cycle_starts else "") + f"{log.path.parent.name}/{log.name}",
        torque_rmse=np.sqrt(np.mean(difference**2, axis=0)),
        torque_largest=np.abs(difference).max(axis=0),
        deviation=uncertainty,
        nominal=after.robot.nominal_torque,
    )


def change_deviations(before: IdentifiedModel, after: IdentifiedModel) -> dict[str, float]:
    """Standard deviation of the change of every parameter that both models have.

    Friction of two models that share their base parameters differs by what friction alone may be off.
    """
    from agent.estimation import conditional_covariance

    variances = [np.diag(model.covariance).copy() for model in (before, after)]
    if share_base(before, after):
        for model, variance in zip((before, after), variances, strict=True):
            b = len(model.independent)
            variance[:b] = 0.0
            variance[b:] = np.diag(conditional_covariance(model))
    found = [dict(zip(model.names, v, strict=True)) for model, v in zip((before, after), variances, strict=True)]
    return {name: float(np.sqrt(found[0][name] + found[1][name])) for name in found[1] if name in found[0]}


def share_base(before: IdentifiedModel, after: IdentifiedModel) -> bool:
    """Whether one model took its base parameters from the other, or both from a third."""
    return np.array_equal(before.base_values, after.base_values)


def _torque_difference(before: IdentifiedModel, after: IdentifiedModel, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """(S, n) difference of the predictions [N·m], and (n,) root mean square of what uncertainty makes of it."""
    from agent.estimation import FilterSettings, conditional_covariance, motions

    settings = FilterSettings(after.cutoff, after.order)
    parts, variance, count = [], np.zeros(after.robot.dof), 0
    for m in motions(log, settings):
        apart = [model.predict(m.q, m.qd, m.qdd, m.time) for model in (before, after)]
        parts.append(m.low_pass(apart[1] - apart[0]))
        for model in (before, after):
            covariance = model.covariance
            if share_base(before, after):
                b = len(model.independent)
                covariance = np.zeros_like(model.covariance)
                covariance[b:, b:] = conditional_covariance(model)
            columns = model.columns(m.q, m.qd, m.qdd)
            columns = m.low_pass(columns.reshape(len(columns), -1)).reshape(-1, *columns.shape[1:])
            variance += np.einsum("snp,pq,snq->n", columns, covariance, columns, optimize=True)
        count += len(parts[-1])
    return np.concatenate(parts), np.sqrt(variance / count)
