"""Two runs side by side: which parameters moved by more than their uncertainty, and what that does to torque."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from agent.core import and_list
from agent.estimation import FilterSettings, conditional_covariance, motions
from agent.model import IdentifiedModel
from agent.recording import Log
from agent.validation.torque import filtered_columns

#: A parameter moved where the change is beyond this many of its standard deviations (one in a thousand by chance).
BEYOND = 3.3


@dataclass(frozen=True)
class ParameterChange:
    """A parameter before and after: values, and the standard deviation of their difference."""

    name: str
    unit: str
    before: float
    after: float
    standard_deviation: float

    @property
    def deviations(self) -> float:
        """The change in standard deviations of a change."""
        if self.before == self.after:
            return 0.0
        return (self.after - self.before) / max(self.standard_deviation, 1e-300)

    @property
    def moved(self) -> bool:
        """Whether that is more than chance."""
        return abs(self.deviations) > BEYOND


@dataclass(frozen=True, eq=False)
class TorqueChange:
    """Difference between two models' predictions along `motion`, a recorded motion in the sub-region.

    `rmse`, `largest` (n,) [N·m]; `normalised_rmse` (n,) by nominal torque, NaN where there is none;
    `standard_deviation` (n,) is what the stated uncertainty of the models explains of `rmse`.
    """

    motion: str
    joints: tuple[str, ...]
    rmse: np.ndarray
    largest: np.ndarray
    normalised_rmse: np.ndarray
    standard_deviation: np.ndarray


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two models of one robot.

    `machines` are their serials where these differ: the differences are between two machines then, no change of one.
    `parameters` are those that both have and that were estimated in between; `only_before`, `only_after` name those
    that one alone has.
    """

    before: str
    after: str
    parameters: tuple[ParameterChange, ...]
    only_before: tuple[str, ...]
    only_after: tuple[str, ...]
    torque: TorqueChange
    machines: tuple[str, ...] = ()

    @property
    def between_machines(self) -> str:
        """What two machines make of a comparison, in a sentence; empty for one."""
        named = and_list(self.machines)
        return f"These are two machines ({named}): the figures say how they differ, not what changed." if named else ""

    def to_dict(self) -> dict[str, Any]:
        """Plain data and arrays."""
        changes = [asdict(c) | {"deviations": c.deviations, "moved": c.moved} for c in self.parameters]
        return {"schema": "compare/1", **asdict(self), "parameters": changes}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Comparison:
        """The inverse of `to_dict`, from JSON."""
        motion, joints, *arrays = (data["torque"][field.name] for field in fields(TorqueChange))
        torque = TorqueChange(motion, tuple(joints), *(np.array(values, dtype=float) for values in arrays))
        names = [field.name for field in fields(ParameterChange)]
        parameters = tuple(ParameterChange(**{key: entry[key] for key in names}) for entry in data["parameters"])
        only_before, only_after = tuple(data["only_before"]), tuple(data["only_after"])
        machines = tuple(data.get("machines", ()))
        return cls(data["before"], data["after"], parameters, only_before, only_after, torque, machines)

    def text(self) -> str:
        """For people: what moved, then the torque."""
        moved = sorted((c for c in self.parameters if c.moved), key=lambda c: -abs(c.deviations))
        lines = [f"{self.before} -> {self.after}", *([self.between_machines] if self.machines else [])]
        if moved:
            width = max(len(change.name) for change in moved)
            lines.append(f"{len(moved)} of {len(self.parameters)} parameters moved by more than their uncertainty:")
            lines += [
                f"  {c.name:{width}} {c.before:10.4g} -> {c.after:10.4g} {c.unit:10} {c.deviations:+6.1f} deviations"
                for c in moved
            ]
        else:
            lines.append(f"none of {len(self.parameters)} parameters moved by more than its uncertainty")
        for title, names in (("before", self.only_before), ("after", self.only_after)):
            if names:
                lines.append(f"only {title}: {', '.join(names)}")
        width = max(map(len, self.torque.joints))
        lines.append(f"predicted torque along {self.torque.motion}:")
        for k, joint in enumerate(self.torque.joints):
            share = self.torque.normalised_rmse[k]
            normalised = f" ({100 * share:.2f} % of nominal)" if np.isfinite(share) else ""
            lines.append(
                f"  {joint:{width}} differs by {self.torque.rmse[k]:.3g} N·m RMS{normalised}, at most "
                f"{self.torque.largest[k]:.3g} N·m; uncertainty explains {self.torque.standard_deviation[k]:.2g} N·m"
            )
        return "\n".join(lines)


def compare_models(
    before: IdentifiedModel, after: IdentifiedModel, log: Log, before_name: str, after_name: str
) -> Comparison:
    """Compare two models of one robot along the motion of a log, one of its cycles where it repeats.

    Args:
        before, after: models of one robot.
        log: whose motion they are compared along.
        before_name, after_name: as results call them.
    """
    places = [{name: k for k, name in enumerate(model.names)} for model in (before, after)]
    deviation = _change_deviations(before, after)
    shared = set(after.names[: len(after.independent)]) if _share_base(before, after) else set()
    units = [row[4] for row in after.rows()[1:]]
    changes = tuple(
        ParameterChange(name, units[k], float(before.values[places[0][name]]), float(after.values[k]), deviation[name])
        for name, k in places[1].items()
        if name in places[0] and name not in shared
    )
    difference, uncertainty = _torque_difference(before, after, log.middle_part())
    rmse = np.sqrt(np.mean(difference**2, axis=0))
    torque = TorqueChange(
        motion=("a cycle of " if log.cycle_starts else "") + f"{log.path.parent.name}/{log.name}",
        joints=after.robot.joint_names,
        rmse=rmse,
        largest=np.abs(difference).max(axis=0),
        normalised_rmse=rmse / after.robot.nominal_torque,
        standard_deviation=uncertainty,
    )
    only_before, only_after = (
        tuple(name for name in own if name not in other) for own, other in (places, places[::-1])
    )
    first, second = (tuple(model.provenance.get("serial", ())) for model in (before, after))
    machines = first + second if first and second and first != second else ()
    return Comparison(before_name, after_name, changes, only_before, only_after, torque, machines)


def _change_deviations(before: IdentifiedModel, after: IdentifiedModel) -> dict[str, float]:
    """Standard deviation of the change of every parameter that both models have."""
    variances = [np.diag(covariance) for covariance in _covariances(before, after)]
    by_name = [dict(zip(model.names, v, strict=True)) for model, v in zip((before, after), variances, strict=True)]
    return {name: float(np.sqrt(by_name[0][name] + by_name[1][name])) for name in by_name[1] if name in by_name[0]}


def _covariances(before: IdentifiedModel, after: IdentifiedModel) -> list[np.ndarray]:
    """(p, p) of each model; of two that share their base parameters, what friction alone may be off."""
    if not _share_base(before, after):
        return [before.covariance, after.covariance]
    covariances = []
    for model in (before, after):
        b = len(model.independent)
        covariances.append(np.zeros_like(model.covariance))
        covariances[-1][b:, b:] = conditional_covariance(model)
    return covariances


def _share_base(before: IdentifiedModel, after: IdentifiedModel) -> bool:
    """Whether one model took its base parameters from the other, or both from a third."""
    return np.array_equal(before.base_values, after.base_values)


def _torque_difference(before: IdentifiedModel, after: IdentifiedModel, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """(S, n) difference of the predictions [N·m], and (n,) root mean square of what uncertainty makes of it."""
    settings, covariances = FilterSettings(after.cutoff, after.order), _covariances(before, after)
    parts, variance, count = [], np.zeros(after.robot.dof), 0
    for m in motions(log, settings):
        apart = [model.predict(m.q, m.qd, m.qdd, m.time) for model in (before, after)]
        parts.append(m.low_pass(apart[1] - apart[0]))
        for model, covariance in zip((before, after), covariances, strict=True):
            columns = filtered_columns(model, m)
            variance += np.einsum("snp,pq,snq->n", columns, covariance, columns, optimize=True)
        count += len(parts[-1])
    return np.concatenate(parts), np.sqrt(variance / count)
