"""Properties of machines that go with a change, such as a lubricant batch, a cell or a program."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, needed

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
    """Families among M series, each of a robot and joint, with its change (M,) over time, deviation and alarm.

    Every value of every column is compared with all other machines, joint by joint, by the rank-sum test on change over
    deviation (Wilcoxon 1945), so that small changes shared by many machines are found. The false discovery rate is
    controlled over all these tests (Benjamini and Hochberg 1995).
    """
    from scipy.stats import false_discovery_control, ranksums

    scores = changes / np.maximum(deviations, 1e-300)
    tried = [
        (float(ranksums(scores[members], scores[others]).pvalue), family)
        for family, members, others in _candidates(columns, robots, joints, changes, alarms)
    ]
    if not tried:
        return []
    levels = false_discovery_control([p_value for p_value, _ in tried]).tolist()
    found = [replace(family, level=level) for level, (_, family) in zip(levels, tried, strict=True)]
    kept = [one for one in found if one.level <= RATE and abs(one.change - one.others) >= PRACTICAL]
    return sorted(kept, key=lambda one: one.level)


def _candidates(
    columns: Mapping[str, Mapping[str, str]],
    robots: Sequence[str],
    joints: Sequence[str],
    changes: np.ndarray,
    alarms: np.ndarray,
) -> Iterator[tuple[Family, np.ndarray, np.ndarray]]:
    """Possible families, with the numbers of their series and of the other machines' on the same joint."""
    for joint in sorted(set(joints)):
        chosen = np.array([k for k, one in enumerate(joints) if one == joint])
        for column, values in columns.items():
            here = np.array([values.get(robots[k], "") for k in chosen], dtype=object)
            for value in sorted(set(here) - {""}):
                members, others = chosen[here == value], chosen[here != value]
                if min(len(members), len(others)) < FEWEST:
                    continue
                change, rest = float(np.median(changes[members])), float(np.median(changes[others]))
                names, worn = tuple(sorted(robots[k] for k in members)), int(alarms[members].sum())
                yield Family(column, value, joint, len(members), worn, change, rest, 1.0, names), members, others
