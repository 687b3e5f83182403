"""Properties of machines that go with a change, such as a lubricant batch, a cell or a program."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv
import pyarrow.parquet
from scipy.stats import false_discovery_control, ranksums

from agent.core import InputError
from agent.runs import Trend

#: False discovery rate: the expected share of findings that are chance. Low, as few worn machines give few findings.
RATE = 0.01
#: Smallest difference between the median relative changes of a family and of the others. Wear of one axle shows on the
#: other axles of its machine with a tenth of its size, as these separate warm-up from wear; that is no family.
PRACTICAL = 0.015
#: Fewest machines that make a family.
FEWEST = 3


@dataclass(frozen=True)
class Family:
    """Machines with a common property on which a joint changes more than on the others.

    `change`, `others`: median relative change of these and of the others; `alarms`: how many of its `machines` have an
    alarm; `level`: smallest false discovery rate at which it is a finding.
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
    columns: dict[str, dict[str, str]] = {}
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
                columns[name] = {robot: str(value) for robot, value in values if value is not None}
    return columns


def find_families(columns: Mapping[str, Mapping[str, str]], axles: Sequence[Trend]) -> list[Family]:
    """Families among the axles of a fleet.

    Every value of every column is compared with all other machines, joint by joint, by the rank-sum test on change over
    deviation (Wilcoxon 1945), so that small changes shared by many machines are found. The false discovery rate is
    controlled over all these tests (Benjamini and Hochberg 1995).
    """
    tried = [
        family
        for joint in sorted({trend.joint for trend in axles})
        for column, values in columns.items()
        for family in _families_of(column, values, joint, [trend for trend in axles if trend.joint == joint])
    ]
    levels = false_discovery_control([family.level for family in tried]).tolist() if tried else []
    families = [replace(family, level=level) for family, level in zip(tried, levels, strict=True)]
    practical = [
        family for family in families if family.level <= RATE and abs(family.change - family.others) >= PRACTICAL
    ]
    return sorted(practical, key=lambda family: family.level)


def _families_of(column: str, values: Mapping[str, str], joint: str, axles: Sequence[Trend]) -> Iterator[Family]:
    """The machines of every value of a column as a family, with the p-value of the test as level."""
    values_of_machines = np.array([values.get(trend.runs.machine, "") for trend in axles], dtype=object)
    changes = np.array([trend.found.drift for trend in axles])
    scores = changes / np.maximum([trend.found.drift_deviation for trend in axles], 1e-300)
    for value in sorted(set(values_of_machines) - {""}):
        inside = values_of_machines == value
        if min(inside.sum(), (~inside).sum()) < FEWEST:
            continue
        members = [trend for trend, chosen in zip(axles, inside, strict=True) if chosen]
        change, others = float(np.median(changes[inside])), float(np.median(changes[~inside]))
        p_value = float(ranksums(scores[inside], scores[~inside]).pvalue)
        alarms, robots = sum(trend.alarm for trend in members), tuple(sorted(trend.runs.machine for trend in members))
        yield Family(column, value, joint, len(members), alarms, change, others, p_value, robots)
