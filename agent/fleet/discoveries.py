"""Which of very many findings are no chance, and which properties of machines go with them.

Over a fleet a level per series would raise false alarms by the number of series. So the false discovery rate is
controlled (Benjamini and Hochberg 1995): of what is called a finding, at most `RATE` is expected to be chance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, needed

#: Share of findings that may be chance, expected. Low, as a fleet of few worn machines has few findings to share it.
RATE = 0.01
#: Difference between the median relative changes of a family and the others that matters. Wear of one axle is seen on
#: the others of its machine, by which warm-up is separated, with a tenth of its size: that is no family.
PRACTICAL = 0.015
#: Fewest machines that make a family.
FEWEST = 3


def false_discovery_levels(p_values: np.ndarray) -> np.ndarray:
    """(M,) for each of the probabilities (M,) by chance the smallest rate of false discoveries at which it is one."""
    count = len(p_values)
    order = np.argsort(p_values)
    ranked = p_values[order] * count / np.arange(1, count + 1)
    levels = np.empty(count)
    levels[order] = np.minimum(np.minimum.accumulate(ranked[::-1])[::-1], 1.0)
    return levels


@dataclass(frozen=True)
class Family:
    """Machines with a property in common on which a joint changes more than on the others.

    `change`, `others`: median relative change of these and of the others; `alarms` of its `machines` have an alarm;
    `level`: smallest rate of false discoveries at which it is one.
    """

    column: str
    value: str
    joint: str
    machines: int
    alarms: int
    change: float
    others: float
    level: float
    robots: tuple[str, ...]

    def text(self) -> str:
        """One sentence."""
        return (
            f"{self.column} {self.value}: {self.joint} changed by {100 * self.change:+.1f} % (median of "
            f"{self.machines} machines; the others: {100 * self.others:+.1f} %)"
        )


def read_columns(paths: Sequence[Path]) -> dict[str, dict[str, str]]:
    """Columns of CSV or Parquet tables by name: the value of every robot.

    Raises:
        InputError: a table that cannot be read, or has no column `robot`.
    """
    needed("pyarrow", "a fleet")
    import pyarrow.csv
    import pyarrow.parquet

    found: dict[str, dict[str, str]] = {}
    for path in paths:
        read: Any = pyarrow.parquet.read_table if path.suffix == ".parquet" else pyarrow.csv.read_csv
        try:
            table = read(path)
            names = table.column_names
        except UnicodeDecodeError:
            names = None
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as a table: {str(error).splitlines()[0]}") from None
        if names is None or any(pyarrow.types.is_binary(kind) for kind in table.schema.types):
            raise InputError(f"{path}: is not UTF-8 text; save it as CSV in UTF-8")
        if "robot" not in names:
            raise InputError(f"{path}: has no column `robot`, by which its rows belong to machines")
        robots = [str(robot) for robot in table["robot"].to_pylist()]
        for name in names:
            if name != "robot":
                values = zip(robots, table[name].to_pylist(), strict=True)
                found[name] = {robot: str(value) for robot, value in values if value is not None}
    return found


def find_families(
    columns: Mapping[str, Mapping[str, str]],
    robots: Sequence[str],
    joints: Sequence[str],
    changes: np.ndarray,
    deviations: np.ndarray,
    alarms: np.ndarray,
) -> list[Family]:
    """Families among M series: of a robot and joint each, with the change (M,) over time, its deviation and alarm.

    Every value of every column against all other machines, joint by joint, by the rank-sum test on change over
    deviation (Wilcoxon 1945); small changes of many machines show that no machine alone would.
    """
    tried: list[tuple[float, Family]] = []
    names = np.array(robots, dtype=object)
    for joint in sorted(set(joints)):
        chosen = np.flatnonzero(np.array([one == joint for one in joints]))
        ranks = _ranks(changes[chosen] / np.maximum(deviations[chosen], 1e-300))
        for column, values in columns.items():
            here = np.array([values.get(robot, "") for robot in names[chosen]], dtype=object)
            for value in sorted(set(here) - {""}):
                members = here == value
                inside, outside = int(members.sum()), int((~members).sum())
                if inside < FEWEST or outside < FEWEST:
                    continue
                found = Family(
                    column,
                    value,
                    joint,
                    inside,
                    int(alarms[chosen][members].sum()),
                    float(np.median(changes[chosen][members])),
                    float(np.median(changes[chosen][~members])),
                    1.0,
                    tuple(sorted(names[chosen][members])),
                )
                tried.append((_rank_sum(ranks, members), found))
    if not tried:
        return []
    levels = false_discovery_levels(np.array([p_value for p_value, _ in tried]))
    kept = [
        (level, family)
        for level, (_, family) in zip(levels, tried, strict=True)
        if level <= RATE and abs(family.change - family.others) >= PRACTICAL
    ]
    kept.sort(key=lambda one: one[0])
    return [Family(**{**family.__dict__, "level": float(level)}) for level, family in kept]


def _ranks(values: np.ndarray) -> np.ndarray:
    """(M,) from 1; equal values share theirs."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2)[place]


def _rank_sum(ranks: np.ndarray, members: np.ndarray) -> float:
    """Probability by chance that the members' ranks are as far from the others'; normal approximation."""
    from math import erfc, sqrt

    inside, outside = int(members.sum()), int((~members).sum())
    spread = sqrt(inside * outside * (inside + outside + 1) / 12)
    return erfc(abs(float(ranks[members].sum()) - inside * (inside + outside + 1) / 2) / spread / sqrt(2))
