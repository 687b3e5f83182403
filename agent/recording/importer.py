"""From columns of tables to a log, by a mapping file (docs/import.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import Dimension, InputError, counted, parse_quantity
from agent.recording.log import ARRAYS, MACHINE, NANO, Log
from agent.recording.mapping import (
    CURRENT,
    OF_NOMINAL,
    USABLE,
    Columns,
    EffortColumns,
    Mapping,
    PositionColumns,
    load_mapping,
    preset_map,
    units_of,
)
from agent.recording.mcap.log_file import CURRENTS, nanoseconds, write_log
from agent.recording.repair.outliers import LIMITS, impossible
from agent.recording.repair.stamps import put_in_order, spacing_of, stand_still
from agent.recording.tables import read_table
from agent.recording.text_tables import ColumnTable
from agent.robot import RobotDescription

_SET_POINTS = ("reference_position", "planned_position")
#: Columns whose lengths differ by more than this part do not belong together.
_SAME_LENGTH = 0.01
#: Characters of a field, and values of a column, that are shown.
_SHOWN, _SHOWN_VALUES = 40, 8
#: With more rows a second, whole seconds lack their fractions.
_ROWS_A_SECOND = 5
#: Latest time that a header stamp can hold [s].
_LATEST = 2.0**31


def import_log(
    robot: RobotDescription, map_or_preset: Path | str, inputs: Sequence[Path], output: Path
) -> tuple[str, ...]:
    """Turn columns of one or more tables into a log, by a mapping file, or by the name of a recorder (`PRESETS`).

    Motor-side columns come to the joints by the robot's gear ratios g and coupling C: q = C⁻¹ diag(1/g) q_m and
    τ = Cᵀ diag(g) τ_m; a current i by its torque constant first, τ_m = k i.

    Returns:
        Notes on rows, samples and repairs.

    Raises:
        InputError: a table cannot be read, the mapping does not fit it or the robot, or the output is not an .mcap.
        RecordingError: the log cannot be written.
    """
    if output.suffix != ".mcap":
        raise InputError(f"{output}: the log to write comes last and ends in .mcap")
    given = None if isinstance(map_or_preset, str) else load_mapping(map_or_preset)
    tables = [read_table(path) for path in inputs]
    mapping, said = preset_map(str(map_or_preset), tables) if given is None else (given, [])
    source = _Source(robot, mapping, tables)
    source.notes += said
    log, current = _assembled(source, output)
    entries = mapping.entries
    if entries.decimate is not None:
        if entries.decimate > len(log.t) // 10:
            mapping.fault("decimate", f"{len(log.t)} samples would leave fewer than ten")
        log = _decimated(log, entries.decimate, source.notes)
    if entries.cycle_period is not None:
        if entries.cycle_period * log.sample_rate < 10:
            mapping.fault("cycle_period", f"a cycle has at least ten samples, of {1 / log.sample_rate:g} s here")
        log = replace(log, cycle_starts=tuple(np.arange(0.0, log.t[-1], entries.cycle_period).tolist()))
    further = {} if current is None or entries.decimate else {CURRENTS: (log.t, None, None, current)}
    write_log(output, log, further)
    source.notes.append(f"{len(log.t)} samples, {log.t[-1]:.3f} s at {log.sample_rate:.6g} Hz")
    return tuple(f"{output.name}: {note}" for note in source.notes)


def mapped_joints(map_or_preset: Path | str) -> int:
    """How many joints a map has columns for; seven, the most that an arm has, where one column is a whole matrix."""
    if isinstance(map_or_preset, str):
        return len(preset_map(map_or_preset, [])[0].entries.position.columns)
    columns = load_mapping(map_or_preset).entries.position.columns
    return 7 if len(columns) == 1 else len(columns)


def _assembled(source: _Source, output: Path) -> tuple[Log, np.ndarray | None]:
    """The log, and motor currents (S, n) [A] where the columns are currents."""
    robot, mapping, notes = source.robot, source.mapping, source.notes
    entries = mapping.entries
    values = {key: source.position(key, getattr(entries, key)) for key in ("position", *_SET_POINTS)}
    values["velocity"] = None if entries.velocity is None else source.velocity(entries.velocity)
    values["effort"], values["current"] = (None, None) if entries.effort is None else source.effort(entries.effort)
    present = {key: array for key in (*ARRAYS, "current") if (array := values[key]) is not None}
    time = source.time()
    late = np.abs(time) > _LATEST
    if np.count_nonzero(late) > 0.01 * len(time):
        key = "rate" if entries.time is None else "time"
        mapping.fault(key, f"times go up to {np.nanmax(np.abs(time)):.3g} s: is the unit right?")
    time[late] = np.nan
    lengths = ({"time": len(time)} if entries.time is not None else {}) | {k: len(v) for k, v in present.items()}
    rows, longest = min(lengths.values()), max(lengths.values())
    if longest - rows > _SAME_LENGTH * longest:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        mapping.fault("position", f"columns of different length: {listed} rows; they are not of one recording")
    cut_off = [f"{counted(longest - rows, 'last row')} in some columns only, dropped"] if longest > rows else []
    time, present = time[:rows], {name: array[:rows] for name, array in present.items()}
    inside = source.selected(time)
    notes += cut_off
    keep = _usable(mapping, time, present, inside, notes)
    present = {name: array[keep] for name, array in present.items()}
    stamp = nanoseconds(time[keep])
    if np.any(np.diff(stamp) < 0):
        source.check_one_recording()
    order = put_in_order(stamp, [present[name] for name in ("position", "effort") if name in present], source.clock)
    present = {name: array[order.rows] for name, array in present.items()}
    spacing = spacing_of(order.stamp, entries.rate)
    repairs = (*order.repairs, *spacing.repairs)
    notes += map(str, repairs)
    machine = {key: value for key in MACHINE if (value := getattr(entries, key)) is not None}
    arrays: dict[str, Any] = {name: present.get(name) for name in ARRAYS}
    log = Log(
        path=output,
        joint_names=robot.joint_names,
        t=(order.stamp - order.stamp[0]) / NANO,
        **arrays,
        sample_rate=spacing.rate,
        stamp=int(order.stamp[0]) / NANO,
        segments=spacing.segments,
        metadata={"robot": robot.name, "motion": entries.motion, **machine},
        repairs=repairs,
    )
    return log, present.get("current")


def _usable(
    mapping: Mapping, time: np.ndarray, values: dict[str, np.ndarray], inside: np.ndarray, notes: list[str]
) -> np.ndarray:
    """(S,) rows of those `inside` with a possible number in every column."""
    whole, torn = np.isfinite(time), np.zeros(len(time), bool)
    for name, array in values.items():
        whole &= np.all(np.isfinite(array), axis=1)
        torn |= impossible(array, name if name in LIMITS else "position")
    keep = inside & whole & ~torn
    if np.count_nonzero(keep) < 2:
        reason = "fewer than two rows hold a number in every column that the mapping names"
        if np.count_nonzero(inside & whole) >= 2:
            reason = "nearly every row holds a number that no arm can have: are the units right?"
        mapping.fault("position", reason)
    for broken, kind in (
        (inside & ~whole, "without a number in every column"),
        (inside & whole & torn, "with a number that no arm can have"),
    ):
        if broken.any():
            first = np.argmax(broken) + 1
            notes.append(f"{counted(int(np.count_nonzero(broken)), 'row')} {kind}, dropped; the first is row {first}")
    return keep


def _decimated(log: Log, factor: int, notes: list[str]) -> Log:
    """Every `factor`-th sample, after a zero-phase Butterworth filter of order 8 (forward and backward) at 0.8 of the
    new Nyquist frequency, the same on every column; it never sees what lies outside the window.

    A log that had to be repaired is laid on an even grid first, segment by segment: by cubic splines (not-a-knot),
    effort by a monotone cubic (Fritsch and Carlson, SIAM J. Numer. Anal. 17, 1980), which does not overshoot where
    friction steps.
    """
    from scipy.interpolate import CubicSpline, PchipInterpolator
    from scipy.signal import butter, sosfiltfilt

    cutoff = 0.4 * log.sample_rate / factor
    sections = butter(8, cutoff, fs=log.sample_rate, output="sos")
    segments = [slice(*segment) for segment in log.segments if segment[1] - segment[0] > 1]
    grids = [log.t[part] for part in segments]
    if log.repairs:
        grids = [np.arange(t[0], t[-1] + 1e-9, 1 / log.sample_rate) for t in grids]
        notes.append(f"interpolated to even {log.sample_rate:.6g} Hz before it was filtered")

    def thinned(values: np.ndarray, curve: Callable[..., Any] = CubicSpline) -> np.ndarray:
        parts = []
        for part, grid in zip(segments, grids, strict=True):
            t, even = log.t[part], values[part]
            if log.repairs:
                even = curve(t, even)(np.minimum(grid, t[-1]))
            parts.append(sosfiltfilt(sections, even, axis=0, padlen=min(20 * factor, len(even) - 1))[::factor])
        return np.concatenate(parts)

    t = np.concatenate([grid[::factor] for grid in grids])
    spacing = spacing_of(nanoseconds(t), log.sample_rate / factor)
    notes.append(f"every {factor}th sample, after a zero-phase filter at {cutoff:.4g} Hz")
    effort = None if log.effort is None else thinned(log.effort, PchipInterpolator)
    return log.with_arrays(thinned, effort=effort, t=t, sample_rate=spacing.rate, segments=spacing.segments)


class _Source:
    """The columns that a mapping names, on the joint side, SI."""

    def __init__(self, robot: RobotDescription, mapping: Mapping, tables: Sequence[ColumnTable]):
        self.robot = robot
        self.mapping = mapping
        self.tables = tables
        self.clock = str(mapping.path)  # what says when a row was, for messages
        self.notes = [f"{table.path.name}: {note}" for table in tables for note in table.notes]

    def time(self) -> np.ndarray:
        """(S,) [s]."""
        entries = self.mapping.entries
        if entries.time is None:
            assert entries.rate is not None  # one of both is there: `ImportMap`
            return np.arange(max(len(c) for table in self.tables for c in table.columns.values())) / entries.rate
        factor = Dimension.TIME.value.factors | {"ns": 1e-9}
        if unknown := [unit for unit in entries.time.units() if unit not in factor]:
            self.mapping.fault("time.unit", f"{unknown[0]!r} is no unit of time: {', '.join(factor)}")
        names = entries.time.names()
        key = "time.column" if len(names) == 1 else "time.columns"
        table, columns = self._columns("time", key, entries.time.file, names)
        time = np.sum([c * factor[u] for c, u in zip(columns, entries.time.units(), strict=True)], axis=0)
        known = time[np.isfinite(time)]
        what, values = f"{table.path}: column {names[-1]}", len(np.unique(known))
        if 1 < values < len(known) / _ROWS_A_SECOND and np.all(known % 1 == 0):
            parts = [name for name in table.columns if "nano" in name.lower() or "nsec" in name.lower()]
            both = ", ".join(map(str, [*names, *(parts[:1] or ["nanosec"])]))
            what += f" holds whole seconds, {len(known)} rows with {values} values"
            self.mapping.fault(key, f"{what}; add the column of their fractions, such as columns: [{both}]")
        if len(known) > 1 and stand_still(np.sort(np.rint(known * NANO))):
            what += f" stands still at {known.min():.9g} s ({len(known)} rows)"
            self.mapping.fault(key, f"{what}; name the column of time and its unit")
        self.clock = str(table.path)
        return time

    def selected(self, time: np.ndarray) -> np.ndarray:
        """(S,) which of the rows at times (S,) [s] `rows:` and `window:` take; of a preset, each time once."""
        entries, fault = self.mapping.entries, self.mapping.fault
        selected = np.ones(len(time), bool)
        if (wanted := entries.rows) is not None:
            table, (column,) = self._columns("rows", "rows.column", wanted.file, [wanted.column])
            if len(column) < len(time):
                fault("rows.column", f"{table.path}: {len(column)} rows, where other columns have {len(time)}")
            selected = column[: len(time)] == wanted.equals
            if not selected.any():
                values = np.unique(column[np.isfinite(column)])
                listed = ", ".join(f"{value:g}" for value in values[:_SHOWN_VALUES])
                listed += ", …" if len(values) > _SHOWN_VALUES else ""
                fault("rows.equals", f"no row has {wanted.column} {wanted.equals:g}; there are {listed}")
            self.notes.append(f"{selected.sum()} of {len(time)} rows have {wanted.column} {wanted.equals:g}")
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

    def position(self, key: str, columns: PositionColumns | None) -> np.ndarray | None:
        """(S, n), None without an entry. Side and offset of set-points are those of the positions unless given."""
        if columns is None:
            return None
        measured = self.mapping.entries.position
        side = columns.side or measured.side or self.mapping.entries.side
        offsets = self._offsets(f"{key}.offset", columns.offset or measured.offset or [0.0])
        return self._to_joints(self._raw(key, "position", columns, side), side) + offsets

    def velocity(self, columns: Columns) -> np.ndarray:
        """(S, n)."""
        side = columns.side or self.mapping.entries.side
        return self._to_joints(self._raw("velocity", "velocity", columns, side), side)

    def effort(self, columns: EffortColumns) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Efforts (S, n), None for currents of a known recorder without torque constants; currents (S, n) [A]."""
        units = self._per_joint("effort.unit", columns.unit)
        is_current, is_share = (np.array([unit in kind for unit in units]) for kind in (CURRENT, OF_NOMINAL))
        side = columns.side or ("motor" if is_current.any() else self.mapping.entries.side)
        if is_current.any() and side == "joint":
            self.mapping.fault("effort.side", "currents are on the motor side")
        effort = self._raw("effort", "effort", columns, side)
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

    def _raw(self, key: str, quantity: str, columns: Columns, side: str) -> np.ndarray:
        """(S, n) of the side that the columns are of, SI."""
        n = self.robot.dof
        names = columns.columns
        if len(names) == 1 and isinstance(names[0], str):  # one name may stand for a matrix with a column per joint
            matrices = [matrix for table in self.tables if len(matrix := table.matrix(names[0])) == n]
            names = [*matrices[0]] if matrices else names
        if len(names) != n:
            if not any(table.column(name) is not None for table in self.tables for name in names):
                self.mapping.fault(f"{key}.columns", "; ".join(table.missing(names) for table in self.tables))
            joints = f"{counted(n, 'joint')} ({', '.join(self.robot.joint_names)})"
            self.mapping.fault(f"{key}.columns", f"{counted(len(names), 'column')} for {joints}")
        table, found = self._columns(key, f"{key}.columns", columns.file, names)
        rows = min(map(len, found))
        values = np.column_stack([column[:rows] for column in found])
        factors = []
        for joint, unit in zip(self.robot.joints, self._per_joint(f"{key}.unit", columns.unit), strict=True):
            allowed = units_of(quantity, joint.prismatic and side == "joint")
            unit = next(iter(allowed)) if unit is None else unit
            if unit not in allowed:
                what = f"{unit!r} is no unit of {quantity} for {joint.name} on the {side} side"
                self.mapping.fault(f"{key}.unit", f"{what}; allowed are {', '.join(allowed)}")
            factors.append(allowed[unit])
        scales = [self._scale(key, scale, table) for scale in self._per_joint(f"{key}.scale", columns.scale)]
        return values * (np.array(scales) * np.array(factors))

    def _columns(
        self, key: str, columns_key: str, pattern: str | None, names: Sequence[str | int]
    ) -> tuple[ColumnTable, list[np.ndarray]]:
        """The one table that `file` names, or that has the columns, and these columns, each (S,)."""
        fault = self.mapping.fault
        tables = [table for table in self.tables if pattern is None or fnmatch(table.path.name, pattern)]
        if not tables:
            given = ", ".join(table.path.name for table in self.tables)
            fault(f"{key}.file", f"no input is named {pattern!r}; given were {given}")
        having = [table for table in tables if all(table.column(name) is not None for name in names)]
        if len(having) > 1:
            listed = ", ".join(table.path.name for table in having)
            fault(columns_key, f"{listed} all have these columns; say which with `file:`")
        table = (having or tables)[0]
        missing = [str(name) for name in names if table.column(name) is None]
        if doubled := [name for name in missing if name in table.doubled]:
            what = f"several columns are named {doubled[0]}; make them differ, or use numbers"
            fault(columns_key, f"{table.path.name}: {what}")
        if missing:
            fault(columns_key, table.missing(missing))
        columns = [column for name in names if (column := table.column(name)) is not None]
        for name, column in zip(names, columns, strict=True):
            if len(column) >= 2 > np.count_nonzero(np.isfinite(column)):
                word = table.words.get(table.name(name) or "")
                if word is None:
                    fault(columns_key, f"{table.path}: column {name} is empty: nothing was recorded in it")
                what = f"{table.path}: column {name} is not of numbers ({word[:_SHOWN]!r} is not a number)"
                fault(columns_key, f"{what}; numbers are written like 1234.5, times in seconds or another unit")
        return table, columns

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
        given = self._per_joint("effort.torque_constant", columns.torque_constant or described)
        constants = np.array(given, dtype=float)
        if missing := self._missing(constants):
            if self.mapping.preset:
                self.notes.append(f"currents are kept on {CURRENTS}; torques need the torque_constant of {missing}")
                return None
            self.mapping.fault("effort.unit", f"currents need the torque_constant of {missing}, here or in robot.yaml")
        if self.mapping.preset:
            used = ", ".join(f"{constant:g}" for constant in constants)
            self.notes.append(f"torques are currents times the torque constants {used} N·m/A (motor side)")
        return constants

    def _per_joint(self, key: str, values: Sequence[Any]) -> list[Any]:
        """One value a joint from one for all, or one a joint."""
        n = self.robot.dof
        if len(values) not in (1, n):
            what = f"{counted(len(values), 'value')} for {counted(n, 'joint')}"
            self.mapping.fault(key, f"{what}; give one for all, or one a joint")
        return [*values] * (n // len(values))
