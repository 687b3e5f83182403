"""The columns that a mapping names: found in tables, on one clock, on the joint side, in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatch
from typing import Any

import numpy as np

from agent.core import Dimension, InputError, comma_list, counted, parse_quantity
from agent.recording.column_names import contradiction, named_joints
from agent.recording.joined_columns import TimedColumn, join, one_clock
from agent.recording.log import ARRAYS, NANO
from agent.recording.mapping import (
    CURRENT,
    OF_NOMINAL,
    USABLE,
    Columns,
    EffortColumns,
    Mapping,
    PositionColumns,
    units_of,
)
from agent.recording.mcap.log_file import CURRENTS, nanoseconds
from agent.recording.repair.clock import unwrapped
from agent.recording.repair.stamps import stand_still
from agent.recording.tables.text_tables import ColumnTable
from agent.robot import RobotDescription

#: Columns whose lengths differ by more than this part do not belong together.
_SAME_LENGTH = 0.01
#: Characters of a field, and values of a column, that are shown.
_SHOWN, _SHOWN_VALUES = 40, 8
#: With more rows a second, whole seconds lack their fractions.
_ROWS_A_SECOND = 5
#: Squared correlation from which a moment is a current times a constant; of constants, less is rounding.
_PROPORTIONAL, _ROUNDED = 0.999, 0.02
#: Latest time that a header stamp can hold [s].
_LATEST = 2.0**31
#: A slower recording [Hz] does not show a motion: an arm crosses its range in a few seconds. No drive is faster.
_SLOWEST, _FASTEST = 0.5, 50e3


def position_columns(mapping: Mapping, tables: Sequence[ColumnTable]) -> list[str]:
    """Names of the columns of positions, as the tables have them; of a matrix, those of its columns.

    Raises:
        InputError: no table has any of them.
    """
    names = mapping.entries.position.columns
    if not any(table.column(name) is not None or table.matrix(str(name)) for table in tables for name in names):
        mapping.fault("position.columns", "; ".join(table.missing(names) for table in tables))
    if len(names) == 1 and isinstance(names[0], str):
        names = next((matrix for table in tables if (matrix := table.matrix(names[0]))), names)
    titles = [[table.name(name) for table in tables] for name in names]
    return [next(filter(None, known), str(name)) for known, name in zip(titles, names, strict=True)]


def tables_of_joints(mapping: Mapping, tables: list[ColumnTable]) -> list[ColumnTable]:
    """The tables; those with rows of one joint each, as `rows:` says, with a column for each joint instead.

    Raises:
        InputError: a value of `rows:` stands in no row.
    """
    wanted, time = mapping.entries.rows, mapping.entries.time
    if wanted is None or not isinstance(wanted.equals, list):
        return tables
    if time is None:
        mapping.fault("rows", "rows of one joint each are joined by their times: name the column with time:, not rate:")
    parts = [table.of_each(wanted.column, wanted.equals, time.names()) for table in tables]
    if not any(parts):
        table = next((table for table in tables if table.column(wanted.column) is not None), tables[0])
        name = table.name(wanted.column)
        if name is None:
            mapping.fault("rows.column", table.missing([wanted.column]))
        values = np.unique(table.words.get(name, table.columns[name]))
        mapping.fault(
            "rows.equals", f"{table.path.name}: not all of these are in column {name}; there are {_values_text(values)}"
        )
    return [part or table for part, table in zip(parts, tables, strict=True)]


def one_joint_a_row(tables: Sequence[ColumnTable]) -> str:
    """What to write in the mapping if a column has few values, as where it says which joint a row is of; else empty."""
    for table in tables:
        for name, column in table.columns.items():
            values = np.array(list(dict.fromkeys(table.words.get(name, np.unique(column)))))
            if 1 < len(values) <= _SHOWN_VALUES and "" not in values:
                return (
                    f". If each row of {table.path.name} is of one joint, write "
                    f"rows: {{column: {name}, equals: [{_values_text(values)}]}}, the joints from base to tip"
                )
    return ""


def _values_text(values: np.ndarray) -> str:
    first_values = values[: _SHOWN_VALUES + 1].tolist()
    return comma_list(
        [f"{value:g}" if isinstance(value, float) else str(value) for value in first_values], _SHOWN_VALUES
    )


class Source:
    """The columns that a mapping names, on the joint side, SI."""

    def __init__(self, robot: RobotDescription, mapping: Mapping, tables: Sequence[ColumnTable]):
        self.robot = robot
        self.mapping = mapping
        self.tables = tables
        self.clock = str(mapping.path)  # what says when a row was, for messages
        self.notes = [f"{table.path.name}: {note}" for table in tables for note in table.notes]
        self.tables_of: dict[str, list[ColumnTable]] = {}
        self._titles: dict[str, list[str]] = {}

    def rows(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Time (S,) [s] of the rows, and the columns (S, k) of each quantity that the mapping names, of `rows` too."""
        by_key = {
            key: self._find_columns(key, columns) for key in ARRAYS if (columns := getattr(self.mapping.entries, key))
        }
        self._check_apart(by_key)
        if (wanted := self.mapping.entries.rows) is not None and not isinstance(wanted.equals, list):
            by_key["rows"] = self._columns("rows", "rows.column", wanted.file, [wanted.column])
        columns = [(key, table, column) for key, pairs in by_key.items() for table, column in pairs]
        if self.mapping.entries.rate is not None:
            time = np.arange(max(len(column) for *_, column in columns)) / self.mapping.entries.rate
            arrays = self._row_by_row(columns, {"": time})[1:]
            self._check_late(time, "rate")
        else:
            time, *arrays = self._by_time(columns)
        time = time[: len(arrays[0])]
        stacked = {key: [a for (k, *_), a in zip(columns, arrays, strict=True) if k == key] for key in by_key}
        return time, {key: np.column_stack(parts) for key, parts in stacked.items()}

    def _check_apart(self, by_key: dict[str, list[tuple[ColumnTable, np.ndarray]]]) -> None:
        """Refuse a column that stands for two joints, or for position and torque of one."""
        key_by_column: dict[int, str] = {}
        for key in ("position", "velocity", "effort"):
            for table, column in by_key.get(key, ()):
                name = next(name for name, other in table.columns.items() if other is column)
                if id(column) in key_by_column:
                    what = f"column {name} of {table.path.name} stands in {key_by_column[id(column)]} already"
                    self.mapping.fault(f"{key}.columns", f"{what}; each has a column of its own")
                key_by_column[id(column)] = key

    def _by_time(self, columns: Sequence[tuple[str, ColumnTable, np.ndarray]]) -> list[np.ndarray]:
        """Time (S,) and each column (S,): row by row where all have one clock, else joined by time."""
        entries = self.mapping.entries
        assert entries.time is not None  # or a rate is there: `ImportMap`
        names = entries.time.names()
        key = "time.column" if len(names) == 1 else "time.columns"
        clock_table = self._columns("time", key, entries.time.file, names)[0][0]
        clocks = {id(clock_table): (first := self._clock(clock_table, key))}
        for table in self.tables:  # others have clocks of their own, or the rows of the first
            own = all(isinstance(name, str) and table.column(name) is not None for name in names)
            used = any(table is other for _, other, _ in columns) and table is not clock_table
            clocks[id(table)] = self._clock(table, key) if own and used else first
        self.clock = str(clock_table.path)
        shared = [column for column in columns if clocks[id(column[1])] is first]
        short, *others = self._row_by_row(shared, {"time": first}) if shared else [first]
        by_row, timed = iter(others), []
        for what, table, column in columns:
            time = clocks[id(table)]
            time, values = (short, next(by_row)) if time is first else (time, column)
            rows = min(len(time), len(values))
            timed.append(TimedColumn(time[:rows] if rows < len(time) else time, values[:rows], what != "rows"))
        for time in clocks.values():  # as of a file in seconds that is read as milliseconds
            known = time[np.isfinite(time)]
            mean = (len(known) - 1) / max(np.ptp(known), 1 / NANO)
            self.check_rate(mean, mean, slowest=0.0)
        if one_clock(timed):
            return [timed[0].time, *(each.values for each in timed)]
        joined = join(timed)
        if joined is None:
            ranges = {table.path.name: each.known.time for (_, table, _), each in zip(columns, timed, strict=True)}
            spans = "; ".join(f"{name} {t[0]:.10g} s to {t[-1]:.10g} s" for name, t in ranges.items() if len(t))
            self.mapping.fault(key, f"the columns have no time in common ({spans}): are clocks and units the same?")
        time, arrays = joined
        files = ", ".join(dict.fromkeys(table.path.name for _, table, _ in columns))
        self.notes.append(f"{files}: columns have stamps of their own, joined by time: {counted(len(time), 'row')}")
        return [time, *arrays]

    def check_rate(self, rate: float, mean: float, slowest: float = _SLOWEST) -> None:
        """Raise InputError if rows come at a usual rate [Hz] that no recording of an arm has; `mean` counts pauses."""
        assert self.mapping.entries.time is not None
        if slowest <= rate <= _FASTEST:
            return
        slow, units_named = rate < slowest, self.mapping.entries.time.units()
        what = "too far for a motion" if slow else "too near for an arm"
        rows = f"rows are {1 / rate:.3g} s apart ({rate:.3g} Hz), {what}"
        if not slow and _SLOWEST <= mean <= _FASTEST:
            what = f"{rows}, with pauses in between: stamps of arrival? If the rows were sampled evenly, write rate: "
            self.mapping.fault("time", f"{what}{mean:.3g} Hz instead of time")
        units = ", ".join(unit for unit in (("ms", "us", "ns") if slow else ("s", "ms")) if unit not in units_named)
        self.mapping.fault("time.unit", f"{rows}: is {', '.join(units_named)} right, or is it {units}?")

    def _check_late(self, time: np.ndarray, key: str) -> None:
        """Times (S,) [s] that no header holds become NaN, or raise InputError where they are more than a few."""
        late = np.abs(time) > _LATEST
        if np.count_nonzero(late) > 0.01 * len(time):
            self.mapping.fault(key, f"times go up to {np.nanmax(np.abs(time)):.3g} s: is the unit right?")
        time[late] = np.nan

    def _row_by_row(
        self, columns: Sequence[tuple[str, ColumnTable, np.ndarray]], clock: dict[str, np.ndarray]
    ) -> list[np.ndarray]:
        """The clock and columns (S,) with as many rows as the shortest."""
        several = len({id(table) for _, table, _ in columns}) > 1
        names = [f"{key} ({table.path.name})" if several else key for key, table, _ in columns]
        lengths = {name: len(time) for name, time in clock.items() if name}
        lengths |= {name: len(column) for name, (*_, column) in zip(names, columns, strict=True)}
        rows, longest = min(lengths.values()), max(lengths.values())
        if longest - rows > _SAME_LENGTH * longest:
            listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
            self.mapping.fault("position", f"columns of different length: {listed} rows; they are not of one recording")
        if longest > rows:
            self.notes.append(f"{counted(longest - rows, 'last row')} in some columns only, dropped")
        return [values[:rows] for values in (*clock.values(), *(column for *_, column in columns))]

    def _clock(self, table: ColumnTable, key: str) -> np.ndarray:
        """(S,) [s] the time of a table's rows; a clock that wraps goes on."""
        entries = self.mapping.entries
        assert entries.time is not None
        factor = Dimension.TIME.value.factors | {"ns": 1e-9}
        if unknown := [unit for unit in entries.time.units() if unit not in factor]:
            self.mapping.fault("time.unit", f"{unknown[0]!r} is no unit of time: {', '.join(factor)}")
        names = entries.time.names()
        columns = [column for _, column in self._columns("time", key, table.path.name, names)]
        time = np.sum([c * factor[u] for c, u in zip(columns, entries.time.units(), strict=True)], axis=0)
        known = time[np.isfinite(time)]
        what, values = f"{table.path}: column {names[-1]}", len(np.unique(known))
        if 1 < values < len(known) / _ROWS_A_SECOND and np.all(known % 1 == 0):
            parts = [name for name in table.columns if "nano" in name.lower() or "nsec" in name.lower()]
            columns_text = ", ".join(map(str, [*names, *(parts[:1] or ["nanosec"])]))
            what += f" holds whole seconds, {len(known)} rows with {values} values"
            self.mapping.fault(key, f"{what}; add the column of their fractions, such as columns: [{columns_text}]")
        if len(known) > 1 and stand_still(np.sort(np.rint(known * NANO))):
            what += f" stands still at {known.min():.9g} s ({len(known)} rows)"
            self.mapping.fault(key, f"{what}; name the column of time and its unit")
        self._check_late(time, "time")
        rows = np.isfinite(time)
        stamp, wrapped = unwrapped(nanoseconds(time[rows]))
        if wrapped:
            time[rows] = stamp / NANO
            self.notes += map(str, wrapped)
        return time

    def selected(self, time: np.ndarray, marks: np.ndarray | None) -> np.ndarray:
        """(S,) which of the rows at times (S,) [s] `rows:`, by its column (S, 1), and `window:` take; of a preset, each
        time once."""
        entries, fault = self.mapping.entries, self.mapping.fault
        selected = np.ones(len(time), bool)
        if (wanted := entries.rows) is not None and marks is not None:
            column = marks[:, 0]
            selected = column == wanted.equals
            if not selected.any():
                values = np.unique(column[np.isfinite(column)])
                fault("rows.equals", f"no row has {wanted.column} {wanted.equals}; there are {_values_text(values)}")
            self.notes.append(f"{selected.sum()} of {len(time)} rows have {wanted.column} {wanted.equals}")
        repeats = selected & np.append(False, np.diff(time) == 0)
        if self.mapping.preset and repeats.any():
            selected = selected & ~repeats
            self.notes.append(f"{counted(int(repeats.sum()), 'row')} with the time of the row before, dropped")
        if entries.window is not None:
            selected = selected & ~(time < entries.window.start) & ~(time >= entries.window.stop)
            known = time[np.isfinite(time)]
            if not np.isfinite(time[selected]).any():
                span = f"{known.min():.15g} s to {known.max():.15g} s" if len(known) else "nowhere"
                fault("window", f"no row is in it; the rows go from {span}")
        return selected

    def check_one_recording(self) -> None:
        """Raise InputError if a table holds several recordings, each with its own clock, and all rows are taken."""
        for table in self.tables if self.mapping.entries.rows is None else ():
            for name, column in table.columns.items():
                if "episode" in name.lower() and len(np.unique(column)) > 1:
                    what = f"{table.path}: the time goes back, and {name} numbers several recordings"
                    self.mapping.fault("time", f"{what}: take one with rows: {{column: {name}, equals: {column[0]:g}}}")

    def position(self, key: str, columns: PositionColumns, raw: np.ndarray) -> np.ndarray:
        """(S, n) of columns (S, n). Side and offset of set-points are those of the positions unless given."""
        measured = self.mapping.entries.position
        side = columns.side or measured.side or self.mapping.entries.side
        offsets = self._offsets(f"{key}.offset", columns.offset or measured.offset or [0.0])
        return self._to_joints(self._si(key, "position", columns, side, raw), side) + offsets

    def velocity(self, columns: Columns, raw: np.ndarray) -> np.ndarray:
        """(S, n) of columns (S, n)."""
        side = columns.side or self.mapping.entries.side
        return self._to_joints(self._si("velocity", "velocity", columns, side, raw), side)

    def effort(self, columns: EffortColumns, raw: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Efforts (S, n), None for currents of a known recorder without torque constants; currents (S, n) [A]."""
        units = self._per_joint("effort.unit", columns.unit)
        is_current, is_share = (np.array([unit in kind for unit in units]) for kind in (CURRENT, OF_NOMINAL))
        side = columns.side or ("motor" if is_current.any() else self.mapping.entries.side)
        if is_current.any() and side == "joint":
            self.mapping.fault("effort.side", "currents are on the motor side")
        effort = self._si("effort", "effort", columns, side, raw)
        current = effort if is_current.all() else None
        if is_current.any():
            constants = self._torque_constants(columns)
            if constants is None:
                return None, current
            effort = effort * np.where(is_current, constants, 1.0)
        if is_share.any():
            nominal = self.robot.nominal_torque
            if missing := self._missing(nominal):
                what = f"shares of nominal torque need nominal_motor_torque of {missing} in robot.yaml"
                self.mapping.fault("effort.unit", what)
            whole = nominal / np.abs(self.robot.gear_ratios) if side == "motor" else nominal
            effort = effort * np.where(is_share, whole, 1.0)
        if side == "motor":
            effort = (effort * self.robot.gear_ratios) @ self.robot.coupling
        return effort, current

    def _missing(self, values: np.ndarray) -> str:
        """Names of the joints whose value is not known."""
        return ", ".join(name for name, value in zip(self.robot.joint_names, values, strict=True) if np.isnan(value))

    def _to_joints(self, values: np.ndarray, side: str) -> np.ndarray:
        if side == "joint":
            return values
        return np.linalg.solve(self.robot.coupling, (values / self.robot.gear_ratios).T).T

    def _find_columns(self, key: str, columns: Columns) -> list[tuple[ColumnTable, np.ndarray]]:
        """The table and the column (S,) of each joint."""
        n, joints = self.robot.dof, self.robot.joint_names
        names = columns.columns
        if len(names) == 1 and isinstance(names[0], str):  # one name may stand for a matrix with a column per joint
            matrices = [matrix for table in self.tables if len(matrix := table.matrix(names[0])) == n]
            names = [*matrices[0]] if matrices else names
        if len(names) != n:
            if not any(table.column(name) is not None for table in self.tables for name in names):
                self.mapping.fault(f"{key}.columns", "; ".join(table.missing(names) for table in self.tables))
            what = f"{counted(len(names), 'column')} for {counted(n, 'joint')} ({', '.join(joints)})"
            self.mapping.fault(f"{key}.columns", what)
        located = self._columns(key, f"{key}.columns", columns.file, names)
        titles = [str(table.name(name)) for (table, _), name in zip(located, names, strict=True)]
        if (named := named_joints(titles, joints)) is not None and (*named,) != joints:
            of = ", ".join(f"{title} is of {name}" for title, name in zip(titles, named, strict=True))
            self.mapping.fault(
                f"{key}.columns", f"the joints are {', '.join(joints)}, but {of}; write them in that order"
            )
        if differ := contradiction(titles, self._titles.get("position", titles), "position"):
            self.mapping.fault(f"{key}.columns", f"the columns {differ}; name those of the same joints")
        self._titles[key] = titles
        files = [table.path.name for table, _ in located]
        titles = titles if len({*files}) == 1 else [f"{a} of {b}" for a, b in zip(titles, files, strict=True)]
        pairs = ", ".join(f"{name} from {title}" for name, title in zip(joints, titles, strict=True))
        self.notes.append(f"{key}: {pairs}")
        self.tables_of[key] = [table for table, _ in located]
        return located

    def _si(self, key: str, quantity: str, columns: Columns, side: str, raw: np.ndarray) -> np.ndarray:
        """Columns (S, n) of the side that they are of, SI."""
        factors = []
        for joint, unit in zip(self.robot.joints, self._per_joint(f"{key}.unit", columns.unit), strict=True):
            allowed = units_of(quantity, joint.prismatic and side == "joint")
            unit = next(iter(allowed)) if unit is None else unit
            if unit not in allowed:
                what = f"{unit!r} is no unit of {quantity} for {joint.name} on the {side} side"
                self.mapping.fault(f"{key}.unit", f"{what}; allowed are {', '.join(allowed)}")
            factors.append(allowed[unit])
        scales_and_tables = zip(self._per_joint(f"{key}.scale", columns.scale), self.tables_of[key], strict=True)
        scales = [self._scale(key, scale, table) for scale, table in scales_and_tables]
        return raw * (np.array(scales) * np.array(factors))

    def _columns(
        self, key: str, columns_key: str, file: str | Sequence[str] | None, names: Sequence[str | int]
    ) -> list[tuple[ColumnTable, np.ndarray]]:
        """The one table that `file` names, or that has the columns, and each of these columns (S,); or columns of one
        file each."""
        if not isinstance(file, str | None):
            if len(file) != len(names):
                self.mapping.fault(f"{key}.file", f"{counted(len(file), 'file')} for {counted(len(names), 'column')}")
            each = zip(file, names, strict=True)
            return [pair for source, name in each for pair in self._columns(key, columns_key, source, [name])]
        table = self._table(key, columns_key, file, names)
        columns = [column for name in names if (column := table.column(name)) is not None]
        for name, column in zip(names, columns, strict=True):
            if len(column) >= 2 > np.count_nonzero(np.isfinite(column)):
                word = next(filter(None, table.words.get(table.name(name) or "", ())), None)
                if word is None:
                    self.mapping.fault(columns_key, f"{table.path}: column {name} is empty: nothing was recorded in it")
                what = f"{table.path}: column {name} is not of numbers ({word[:_SHOWN]!r} is not a number)"
                what += "; numbers are written like 1234.5, times in seconds or another unit"
                self.mapping.fault(columns_key, what)
        return [(table, column) for column in columns]

    def _table(self, key: str, columns_key: str, pattern: str | None, names: Sequence[str | int]) -> ColumnTable:
        """The one table of that name, or of those the one with all of the columns."""
        fault = self.mapping.fault
        tables = [table for table in self.tables if pattern is None or fnmatch(table.path.name, pattern)]
        if not tables:
            inputs = ", ".join(table.path.name for table in self.tables)
            fault(f"{key}.file", f"no input is named {pattern!r}; given were {inputs}")
        having = [table for table in tables if all(table.column(name) is not None for name in names)]
        if len(having) > 1 and key != "time":  # of several clocks the first is that of all that have none
            listed = ", ".join(table.path.name for table in having)
            fault(columns_key, f"{listed} all have these columns; say which with `file:`, one or a list")
        table = (having or tables)[0]
        missing = [str(name) for name in names if table.column(name) is None]
        if doubled := [name for name in missing if name in table.doubled]:
            what = f"several columns are named {doubled[0]}; make them differ, or use numbers"
            fault(columns_key, f"{table.path.name}: {what}")
        if missing:
            fault(columns_key, table.missing(missing))
        return table

    def _scale(self, key: str, scale: float | str, table: ColumnTable) -> float:
        if not isinstance(scale, str):
            return scale
        if scale not in table.constants:
            known = ", ".join(table.constants) or "none"
            what = f"{table.path.name} has no constant {scale!r}; its constants are {known}"
            self.mapping.fault(f"{key}.scale", what)
        value = table.constants[scale]
        if not np.isfinite(value) or value == 0:
            self.mapping.fault(f"{key}.scale", f"{table.path.name}: {scale!r} is {value:g}; {USABLE}")
        return value

    def _offsets(self, key: str, offsets: Sequence[float | str]) -> np.ndarray:
        """(n,) [rad, m]."""
        result = []
        for joint, value in zip(self.robot.joints, self._per_joint(key, offsets), strict=True):
            try:
                result.append(parse_quantity(value, Dimension.LENGTH if joint.prismatic else Dimension.ANGLE))
            except InputError as error:
                self.mapping.fault(key, f"{joint.name}: {error}")
        return np.array(result)

    def _torque_constants(self, columns: EffortColumns) -> np.ndarray | None:
        """(n,) [N·m/A, motor side]; None where a known recorder's robot has none."""
        described = [np.nan if joint.torque_constant is None else joint.torque_constant for joint in self.robot.joints]
        of_joints = self._per_joint("effort.torque_constant", columns.torque_constant or described)
        constants = np.array(of_joints, dtype=float)
        if self.mapping.preset:
            constants = self._constants_of_file(columns, constants)
        if missing := self._missing(constants):
            if self.mapping.preset:
                self.notes.append(f"currents are kept on {CURRENTS}; torques need the torque_constant of {missing}")
                return None
            self.mapping.fault("effort.unit", f"currents need the torque_constant of {missing}, here or in robot.yaml")
        if self.mapping.preset:
            used = ", ".join(f"{constant:g}" for constant in constants)
            self.notes.append(f"torques are currents times the torque constants {used} N·m/A (motor side)")
        return constants

    def _constants_of_file(self, columns: EffortColumns, described: np.ndarray) -> np.ndarray:
        """(n,) torque constants [N·m/A, motor side]: moment over current of the plan where they are in proportion."""
        constants = described.copy()
        for joint, name in enumerate(columns.columns):
            current, moment = (
                next((c for table in self.tables if (c := table.column(str(name).replace(*words))) is not None), None)
                for words in (("actual", "target"), ("actual_current", "target_moment"))
            )
            if current is None or moment is None or len(current) != len(moment):
                continue
            known = np.isfinite(current) & np.isfinite(moment)
            square, product = float(np.sum(current[known] ** 2)), float(current[known] @ moment[known])
            if product**2 > _PROPORTIONAL * square * float(np.sum(moment[known] ** 2)) > 0:
                constants[joint] = product / square / self.robot.gear_ratios[joint]
        others = [
            f"{name} {own:.3g} instead of {ours:.3g}"
            for name, own, ours in zip(self.robot.joint_names, constants, described, strict=True)
            if abs(own - ours) > _ROUNDED * abs(ours)
        ]
        if others:
            self.notes.append(
                f"torque constants [N·m/A] by target_moment over target_current of this file, as they contradict those "
                f"of the description: {', '.join(others)}"
            )
        return constants

    def _per_joint(self, key: str, values: Sequence[Any]) -> list[Any]:
        """One value a joint from one for all, or one a joint."""
        n = self.robot.dof
        if len(values) not in (1, n):
            what = f"{counted(len(values), 'value')} for {counted(n, 'joint')}"
            self.mapping.fault(key, f"{what}; give one for all, or one a joint")
        return [*values] * (n // len(values))
