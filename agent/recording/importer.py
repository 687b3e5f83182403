"""From columns of tables to a log, by a mapping file (docs/import.md)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, counted
from agent.recording.log import ARRAYS, EFFORT, MACHINE, NANO, Log
from agent.recording.map_columns import Source, one_joint_a_row, position_columns, tables_of_joints
from agent.recording.mapping import (
    CURRENT,
    OF_NOMINAL,
    Mapping,
    load_mapping,
    preset_map,
)
from agent.recording.mcap.log_file import CURRENTS, nanoseconds, write_log
from agent.recording.repair.clock import with_lost_rows
from agent.recording.repair.effort import TORQUE
from agent.recording.repair.outliers import LIMITS, impossible
from agent.recording.repair.stamps import put_in_order, spacing_of
from agent.recording.tables.table_files import read_table
from agent.robot import RobotDescription

_SET_POINTS = ("reference_position", "planned_position")


def import_log(
    robot: RobotDescription | Callable[[Sequence[str]], RobotDescription],
    map_or_preset: Path | str,
    inputs: Sequence[Path],
    output: Path,
    effort: str | None = None,
) -> tuple[str, ...]:
    """Turn columns of one or more tables into a log, by a mapping file, or by the name of a recorder (`PRESETS`).

    Motor-side columns come to the joints by the robot's gear ratios g and coupling C: q = C⁻¹ diag(1/g) q_m and
    τ = Cᵀ diag(g) τ_m; a current i by its torque constant first, τ_m = k i.

    Args:
        robot: description, or what finds it by the names of the columns of positions.
        map_or_preset: mapping file, or name of a recorder.
        inputs: tables.
        output: the log.
        effort: what the log says its torque is.

    Returns:
        Notes on rows, samples and repairs.

    Raises:
        InputError: a table cannot be read, the mapping does not fit it or the robot, or the output is not an .mcap.
        RecordingError: the log cannot be written.
    """
    if output.suffix != ".mcap":
        raise InputError(f"{output}: the log to write comes last and ends in .mcap")
    mapping_file = None if isinstance(map_or_preset, str) else load_mapping(map_or_preset)
    tables = [read_table(path) for path in inputs]
    mapping, notes = preset_map(str(map_or_preset), tables) if mapping_file is None else (mapping_file, [])
    tables = tables_of_joints(mapping, tables)
    try:
        described = robot if isinstance(robot, RobotDescription) else robot(position_columns(mapping, tables))
        source = Source(described, mapping, tables)
        log, current = _assembled(source, output)
    except InputError as error:
        if mapping.entries.rows is None and len(mapping.entries.position.columns) == 1:
            raise InputError(f"{error}{one_joint_a_row(tables)}") from None
        raise
    source.notes += notes
    entries = mapping.entries
    if effort is not None:
        units = [] if entries.effort is None else [unit for unit in entries.effort.unit if unit in CURRENT | OF_NOMINAL]
        if log.effort is None or (units and effort != TORQUE):
            what = f"is {units[0]}, which becomes torque" if units else "gives the log none"
            mapping.fault("effort", f"it {what}; leave out --effort {effort}")
        log = replace(log, metadata=log.metadata | {EFFORT: effort})
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


def _assembled(source: Source, output: Path) -> tuple[Log, np.ndarray | None]:
    """The log, and motor currents (S, n) [A] where the columns are currents."""
    robot, mapping, notes = source.robot, source.mapping, source.notes
    entries = mapping.entries
    time, raw = source.rows()
    values: dict[str, np.ndarray | None] = {
        key: source.position(key, getattr(entries, key), raw[key]) for key in ("position", *_SET_POINTS) if key in raw
    }
    if entries.velocity is not None:
        values["velocity"] = source.velocity(entries.velocity, raw["velocity"])
    if entries.effort is not None:
        values["effort"], values["current"] = source.effort(entries.effort, raw["effort"])
    present = {key: array for key, array in values.items() if array is not None}
    inside = source.selected(time, raw.get("rows"))
    keep = _usable(mapping, time, present, inside, notes)
    present = {name: array[keep] for name, array in present.items()}
    stamp = nanoseconds(time[keep])
    if entries.rate is not None:
        stamp, lost = with_lost_rows(stamp, present["position"], present.get("velocity"))
        notes += map(str, lost)
    if np.any(np.diff(stamp) < 0):
        source.check_one_recording()
    order = put_in_order(stamp, [present[name] for name in ("position", "effort") if name in present], source.clock)
    present = {name: array[order.rows] for name, array in present.items()}
    spacing = spacing_of(order.stamp, entries.rate)
    if entries.time is not None:
        source.check_rate(spacing.rate, (len(order.stamp) - 1) / max(float(np.ptp(order.stamp)) / NANO, 1 / NANO))
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
