"""Tables as people's tools write them: drive traces, spreadsheets, vectors in a cell, dates, archives of arrays."""

from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from agent.core import InputError
from agent.recording import Log, import_log, read_log
from agent.recording.tables.table_files import read_table
from agent.robot import load_robot
from tests.recording.test_importer import ROBOT, URDF

T = np.arange(120) * 0.004
Q = np.column_stack([np.sin(3 * T), 0.1 * np.cos(2 * T)])
TAU = np.column_stack([5 * np.cos(3 * T), 2 * np.sin(7 * T)])
ROWS = np.column_stack([T, Q, TAU])
NUMBERS = "time: {column: 1}\nposition: {columns: [2, 3]}\neffort: {columns: [4, 5]}\n"
NAMES = "time: {column: t}\nposition: {columns: [a, b]}\neffort: {columns: [x, y]}\n"
VECTORS = "time: {column: t}\nposition: {columns: q}\neffort: {columns: tau}\n"


def _lines(separator: str = ",", end: str = "", rows: np.ndarray = ROWS) -> str:
    return "".join(separator.join(f"{value:.12g}" for value in row) + end + "\n" for row in rows)


@pytest.fixture
def taken(tmp_path: Path):
    """Imports a table by the text of a mapping; returns the log and the notes."""
    (tmp_path / "robot.yaml").write_text(ROBOT.replace("torque_constant", "nominal_motor_torque: 2, torque_constant"))
    (tmp_path / "pair.urdf").write_text(URDF)
    robot = load_robot(tmp_path / "robot.yaml")

    def run(table: Path | str, mapping: str) -> tuple[Log, str]:
        if isinstance(table, str):
            (tmp_path / "data.csv").write_text(table, encoding="utf-8")
            table = tmp_path / "data.csv"
        (tmp_path / "map.yaml").write_text(mapping, encoding="utf-8")
        notes = import_log(robot, tmp_path / "map.yaml", [table], tmp_path / "out.mcap")
        return read_log(tmp_path / "out.mcap", robot), "\n".join(notes)

    return run


def _same(log: Log) -> None:
    np.testing.assert_allclose(log.t, T, atol=1e-6)
    np.testing.assert_allclose(log.position, Q, atol=1e-9)
    np.testing.assert_allclose(log.effort, TAU, atol=1e-9)


@pytest.mark.parametrize("mapping", [NUMBERS, NAMES])
@pytest.mark.parametrize(
    "text",
    [
        "t,a,b,x,y,,\n" + _lines(end=",,"),
        "t;a;b;x;y;\n" + _lines(";", end=";"),
        "t\ta\tb\tx\ty\n" + _lines("\t", end="\t\t"),
        "t,a,b,x,y,note,note\n" + _lines(end=",ok,-"),
        "Drive 3\nSamples;120\nInterval (ms);4\n\nt;a;b;x;y\ns;rad;m;Nm;N\n" + _lines(";"),
        "# made by a recorder\n# gains, 1, 2\n%t,a,b,x,y\n" + _lines(),
        "scope,2\nrange,10,20\nt,a,b,x,y\n" + _lines() + "summary\nmin,max\n1,2\n3,4\n",
        "t,a,b,x,y\n" + _lines() + "t2,a2,b2,x2,y2\n" + _lines(rows=ROWS[:30]),
    ],
    ids=["commas", "semicolons", "tabs", "doubled", "preamble", "comments", "summary", "two-tables"],
)
def test_the_longest_block_of_rows_is_the_table(taken, text, mapping):
    log, _ = taken(text, mapping)
    _same(log)


def test_rows_of_numbers_outside_the_table_are_counted(taken):
    _, notes = taken("Samples;120\nInterval;4\nt;a;b;x;y\n" + _lines(";"), NAMES)
    assert "data.csv: 2 rows of numbers outside the longest block, left out" in notes


def test_units_below_the_names_are_names_too(taken):
    log, _ = taken("CH1,CH2,CH3,CH4,CH5\nt,a,b,x,y\n" + _lines(), NAMES)
    _same(log)


def test_a_row_of_missing_values_does_not_end_the_table(taken):
    lines = _lines().splitlines(keepends=True)
    gap = "0.2,NaN,NaN,NaN,NaN\n0.2,,,,\nNA,NA,NA,NA,NA\n"
    log, _ = taken("t,a,b,x,y\n" + "".join(lines[:60]) + gap + "".join(lines[60:]), NAMES)
    _same(log)


def test_reads_rows_filled_by_several_topics_in_turn(taken):
    """As plotting tools export messages of different rates: most cells are empty."""
    head = "t,imu.x,imu.y,imu.z,a,b,x,y,wrench.x,wrench.y,wrench.z,wrench.w\n"
    rows = "".join(
        f"{t - 1e-3:.9g},1,2,3,,,,,,,,\n"
        f"{t:.9g},,,,{','.join(f'{v:.12g}' for v in row)},,,,\n"
        f"{t + 1e-3:.9g},,,,,,,,1,2,3,4\n"
        for t, row in zip(T, ROWS[:, 1:], strict=True)
    )
    log, notes = taken(head + rows, NAMES)
    _same(log)
    assert "240 rows without a number in every column, dropped" in notes


def test_accepts_indexed_names_and_unused_duplicates(taken):
    """As a robot maker's logger writes arrays: one of its columns stands there twice."""
    text = "t,q[0],q[1],dq[0],dq[0],tau[0],tau[1]\n" + _lines(rows=np.column_stack([T, Q, T, T, TAU]))
    for q, tau in (("q", "tau"), ("['q[0]', 'q[1]']", "['tau[0]', 'tau[1]']")):
        log, _ = taken(text, f"time: {{column: t}}\nposition: {{columns: {q}}}\neffort: {{columns: {tau}}}\n")
        _same(log)


def test_selects_columns_by_number(taken):
    """As data frames without names are saved: an index, then 0, 1, 2, …."""
    indexed = np.column_stack([np.arange(len(T)), ROWS])
    text = ",0,1,2,3,4\n" + _lines(rows=indexed)
    log, _ = taken(text, "time: {column: '0'}\nposition: {columns: ['1', '2']}\neffort: {columns: [5, 6]}\n")
    _same(log)


def test_a_duplicate_name_used_by_the_map_is_refused(taken):
    with pytest.raises(InputError, match=r"position\.columns: data\.csv: several columns are named a"):
        taken("t,a,a,x,y\n" + _lines(), "time: {column: t}\nposition: {columns: [a, b]}\n")


def _vectors(write) -> str:
    return "".join(f"{t:.12g},{write(q)},{write(tau)}\n" for t, q, tau in zip(T, Q, TAU, strict=True))


@pytest.mark.parametrize(
    "text",
    [
        "t,q,tau\n" + _vectors(lambda v: '"[{:.12g}, {:.12g}]"'.format(*v)),
        "t,q,tau\n" + _vectors(lambda v: "[{:.12g},{:.12g}]".format(*v)),
        "t,q,tau\n" + _vectors(lambda v: '"[{:.12g}\n {:.12g}]"'.format(*v)),
        "t,q,tau\n" + _vectors(lambda v: "\"array('d', [{:.12g}, {:.12g}])\"".format(*v)),
        "t,q,tau\n" + _vectors(lambda v: '"({:.12g}, {:.12g})"'.format(*v)),
        "t,q,tau\n" + _vectors(lambda v: "{:.12g} {:.12g}".format(*v)),
        ("t,q,tau\n" + _vectors(lambda v: "[{:.12g}:{:.12g}]".format(*v))).replace(",", ";").replace(":", ", "),
    ],
    ids=["quoted", "bare", "over-lines", "array", "tuple", "blanks", "semicolons"],
)
def test_a_vector_in_one_cell_is_a_column_per_joint(taken, text):
    log, _ = taken(text, VECTORS)
    _same(log)


def test_seconds_and_nanoseconds_are_added(taken):
    ns = np.rint(T * 1e9).astype(int) + 1_700_000_000_900_000_000
    rows = "".join(f"{n // 10**9},{n % 10**9},{a:.12g},{b:.12g}\n" for n, (a, b) in zip(ns, Q, strict=True))
    text = "stamp.sec,stamp.nanosec,a,b\n" + rows
    log, _ = taken(text, "time: {columns: [stamp.sec, stamp.nanosec]}\nposition: {columns: [a, b]}\n")
    np.testing.assert_allclose(log.t, T, atol=1e-6)
    milli = "".join(f"{n // 10**9};{n % 10**9 / 1e6:.6f};{a:.12g};{b:.12g}\n" for n, (a, b) in zip(ns, Q, strict=True))
    log, _ = taken(milli, "time: {columns: [1, 2], unit: [s, ms]}\nposition: {columns: [3, 4]}\n")
    np.testing.assert_allclose(log.t, T, atol=1e-6)
    with pytest.raises(InputError, match=r"whole seconds.*columns: \[stamp.sec, stamp.nanosec\]"):
        taken(text, "time: {column: stamp.sec}\nposition: {columns: [a, b]}\n")


@pytest.mark.parametrize("style", ["%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%d %H:%M:%S.%f", "%H:%M:%S.%f", "%Y%m%dT%H%M%S.%f"])
def test_dates_and_times_of_day_are_seconds(taken, style):
    start = datetime(2031, 5, 6, 23, 58, 1, tzinfo=UTC)
    stamps = [(start + timedelta(seconds=t)).strftime(style) for t in T]
    rows = "".join(f"{s},{a:.12g},{b:.12g}\n" for s, (a, b) in zip(stamps, Q, strict=True))
    log, _ = taken("when,a,b\n" + rows, "time: {column: when}\nposition: {columns: [a, b]}\n")
    np.testing.assert_allclose(log.t, T, atol=2e-6)
    if "Y" in style:
        assert log.date is not None
        assert log.date.replace(microsecond=0) == start


def test_reads_messages_printed_one_per_line(taken):
    """As `ros2 topic echo --csv` prints joint states: stamp, frame, names, positions, velocities, efforts."""
    ns = np.rint(T * 1e9).astype(int) + 1_700_000_000_000_000_000
    rows = "".join(
        f"{n // 10**9},{n % 10**9},,turn,slide,{q[0]:.12g},{q[1]:.12g},nan,nan,{e[0]:.12g},{e[1]:.12g}\n"
        for n, q, e in zip(ns, Q, TAU, strict=True)
    )
    log, _ = taken(rows, "time: {columns: [1, 2]}\nposition: {columns: [6, 7]}\neffort: {columns: [10, 11]}\n")
    _same(log)


def test_fractions_of_dates_may_have_nine_digits(taken):
    rows = "".join(f"2031-05-06T07:08:{t:012.9f}+02:00;{a:.12g};{b:.12g}\n" for t, (a, b) in zip(T, Q, strict=True))
    log, _ = taken("when;a;b\n" + rows, "time: {column: when}\nposition: {columns: [a, b]}\n")
    np.testing.assert_allclose(log.t, T, atol=2e-6)


def test_fields_of_a_struct_in_parquet_are_columns(taken, tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="reading Parquet is an extra: pip install '.[tables]'")
    from pyarrow import parquet

    state = [{"q": q.tolist(), "tau": tau.tolist()} for q, tau in zip(Q, TAU, strict=True)]
    parquet.write_table(pyarrow.table({"t": T, "state": state}), tmp_path / "a.parquet")
    log, _ = taken(tmp_path / "a.parquet", VECTORS.replace("s: q", "s: state.q").replace("s: tau", "s: state.tau"))
    _same(log)


def test_the_percent_sign_of_a_column_name_is_optional(taken):
    text = "%time,field.q0,field.q1\n" + "".join(
        f"{1.7e18 + 1e9 * t:.0f},{a:.12g},{b:.12g}\n" for t, (a, b) in zip(T, Q, strict=True)
    )
    for name in ("'%time'", "time"):
        log, _ = taken(text, f"time: {{column: {name}, unit: ns}}\nposition: {{columns: [field.q0, field.q1]}}\n")
        np.testing.assert_allclose(log.t, T, atol=1e-6)


def test_reads_numpy_arrays(taken, tmp_path):
    np.save(tmp_path / "rows.npy", ROWS)
    _same(taken(tmp_path / "rows.npy", NUMBERS)[0])
    np.savez(tmp_path / "a.npz", t=T, q=Q, tau=TAU)
    _same(taken(tmp_path / "a.npz", VECTORS)[0])
    np.savez_compressed(tmp_path / "b.npz", t=T, q=Q.T, tau=TAU, gain=3.0)
    _same(taken(tmp_path / "b.npz", VECTORS)[0])
    fields = np.array([tuple(row) for row in ROWS], [(name, float) for name in "tabxy"])
    np.save(tmp_path / "fields.npy", fields)
    _same(taken(tmp_path / "fields.npy", NAMES)[0])
    np.save(tmp_path / "objects.npy", np.array([{"t": T}], object))
    with pytest.raises(InputError, match=r"save plain arrays"):
        taken(tmp_path / "objects.npy", NUMBERS)
    (tmp_path / "torn.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:300])
    with pytest.raises(InputError, match="not a readable NumPy file"):
        taken(tmp_path / "torn.npz", VECTORS)


def test_reads_the_longest_sheet_of_a_workbook(taken, tmp_path):
    openpyxl = pytest.importorskip("openpyxl", reason="reading Excel is an extra: pip install '.[tables]'")
    book = openpyxl.Workbook()
    book.active.append(["about", "a trace"])
    sheet = book.create_sheet("trace")
    sheet.append(["Axis 2", None, None, None, None])
    sheet.append(["t", "a", "b", "x", "y"])
    start = datetime(2031, 5, 6, 7, 8)
    for t, row in zip(T, ROWS, strict=True):
        sheet.append([start + timedelta(seconds=t), *row[1:].tolist()])
    book.save(tmp_path / "book.xlsx")
    _same(taken(tmp_path / "book.xlsx", NAMES)[0])
    (tmp_path / "bad.xlsx").write_bytes(b"PK\3\4 nothing")
    with pytest.raises(InputError, match=r"not a readable \.xlsx file"):
        taken(tmp_path / "bad.xlsx", NAMES)


def test_reads_hdf5_files(taken, tmp_path):
    h5py = pytest.importorskip("h5py", reason="reading HDF5 is an extra: pip install '.[tables]'")
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["log/t"], file["log/q"], file["log/tau"] = T, Q, TAU
    mapping = "time: {column: log.t}\nposition: {columns: log.q}\neffort: {columns: log.tau}\n"
    _same(taken(tmp_path / "run.h5", mapping)[0])
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        for name, values in (("log/t", T[None]), ("log/q", Q.T), ("log/tau", TAU.T)):
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["text"] = np.array([[97, 98]], np.uint16)
        file["text"].attrs["MATLAB_class"] = np.bytes_("char")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    content = (tmp_path / "run.mat").read_bytes()
    (tmp_path / "run.mat").write_bytes(head + content[len(head) :])
    _same(taken(tmp_path / "run.mat", mapping)[0])
    (tmp_path / "run.h5").rename(tmp_path / "bare.mat")  # of h5py: without MATLAB's header
    _same(taken(tmp_path / "bare.mat", mapping)[0])


def test_names_how_to_save_a_mat_file_that_is_text(taken, tmp_path):
    (tmp_path / "run.mat").write_text("# Created by Octave 8.4.0\n# name: q\n# type: matrix\n" + _lines(" "))
    with pytest.raises(InputError, match=r"save -v7 FILE\.mat"):
        taken(tmp_path / "run.mat", VECTORS)


@pytest.mark.parametrize(("ending", "module"), [("xlsx", "openpyxl"), ("h5", "h5py")])
def test_a_missing_library_is_named_with_its_command(taken, tmp_path, monkeypatch, ending, module):
    import sys

    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / f"data.{ending}").touch()
    with pytest.raises(InputError, match=rf"needs {module}.*pip install 'calibration-agent\[tables\]'"):
        taken(tmp_path / f"data.{ending}", NUMBERS)


@pytest.mark.parametrize(("unit", "part"), [('"%"', 1e-2), ("‰", 1e-3), ("per mille", 1e-3)])
def test_converts_shares_of_nominal_torque(taken, unit, part):
    mapping = f"time: {{column: t}}\nposition: {{columns: [a, b]}}\neffort: {{columns: [x, y], unit: {unit}}}\n"
    log, _ = taken("t,a,b,x,y\n" + _lines(), mapping)
    np.testing.assert_allclose(log.effort, TAU * part * 2 * [50, 200], atol=1e-9)
    log, _ = taken("t,a,b,x,y\n" + _lines(), mapping.replace("unit:", "side: motor, unit:"))
    coupling = np.array([[1, 0], [0.25, 1]])
    np.testing.assert_allclose(log.effort, (TAU * part * 2 * [-50, 200]) @ coupling, atol=1e-9)


def test_rows_are_selected_by_a_column(taken):
    runs = np.repeat([4, 5, 6], len(T))
    table = np.column_stack(
        [np.tile(T, 3), runs, np.tile(Q, (3, 1)) * (1 + (runs == 6))[:, None], np.tile(TAU, (3, 1))]
    )
    text = "t,episode_index,a,b,x,y\n" + _lines(rows=table)
    log, notes = taken(text, NAMES + "rows: {column: episode_index, equals: 5}\n")
    _same(log)
    assert "120 of 360 rows have episode_index 5" in notes
    with pytest.raises(InputError, match=r"episode_index numbers several recordings: take one with rows.*equals: 4"):
        taken(text, NAMES)
    with pytest.raises(InputError, match=r"rows\.equals: no row has episode_index 7; there are 4, 5, 6"):
        taken(text, NAMES + "rows: {column: episode_index, equals: 7}\n")


PIECES = st.sampled_from(
    ["1.5", "-2", "1e3", "", "nan", "NA", "x", "[1, 2]", '"[1 2]"', '"', "(", "]", "2,5", "12:00:01", "#"]
)
LINES = st.lists(st.lists(PIECES, max_size=5), max_size=12)


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(LINES, st.sampled_from([",", ";", "\t", "|", " "]), st.sampled_from([".csv", ".tsv"]))
def test_any_text_gives_a_table_or_one_message(tmp_path, lines, separator, ending):
    path = tmp_path / f"any{ending}"
    path.write_text("\n".join(separator.join(line) for line in lines), encoding="utf-8")
    with suppress(InputError):
        table = read_table(path)
        assert len({len(column) for column in table.columns.values()}) == 1
        assert all(column.dtype == float for column in table.columns.values())


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    st.lists(st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3), min_size=4, max_size=20),
    st.sampled_from([",", ";", "\t", "|"]),
    st.lists(st.sampled_from(["Drive 4", "Samples;20", "Interval,4", "", "a b c d", "2031"]), max_size=3),
    st.integers(0, 2),
    st.booleans(),
)
def test_numbers_come_back_as_they_were_written(tmp_path, rows, separator, preamble, empty, vectors):
    """Whatever separates them, whatever stands above them, alone or as a vector in a cell."""
    head = ["t", "q"] if vectors else ["t", "q1", "q2"]
    cells = [[repr(a), f'"[{b!r}, {c!r}]"'] if vectors else [repr(a), repr(b), repr(c)] for a, b, c in rows]
    lines = [*preamble, *(separator.join([*line, *[""] * empty]) for line in [head, *cells])]
    path = tmp_path / "table.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    table = read_table(path)
    names = ("t", "q[1]", "q[2]") if vectors else ("t", "q1", "q2")
    np.testing.assert_array_equal(np.column_stack([table.column(name) for name in names]), rows)


def test_exponents_of_fortran_are_numbers(taken):
    rows = "".join(",".join(f"{value:.12E}".replace("E", "D") for value in row) + "\n" for row in ROWS)
    log, _ = taken("t,a,b,x,y\n" + rows, NAMES)
    _same(log)


@pytest.mark.parametrize("kind", ["duration", "timestamp", "time"])
def test_times_of_parquet_are_seconds(taken, tmp_path, kind: str):
    import pyarrow
    from pyarrow import parquet

    micro = np.rint(T * 1e6).astype(np.int64)
    types = {"duration": pyarrow.duration("us"), "timestamp": pyarrow.timestamp("us"), "time": pyarrow.time64("us")}
    columns = {"t": pyarrow.array(micro).cast(types[kind]), "a": Q[:, 0], "b": Q[:, 1], "x": TAU[:, 0], "y": TAU[:, 1]}
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    log, _ = taken(tmp_path / "log.parquet", NAMES)
    _same(log)


def test_a_matrix_that_is_not_there_is_named_with_what_is(taken, tmp_path):
    np.savez(tmp_path / "log.npz", t=T, q_actual=Q, tau=TAU)
    with pytest.raises(InputError, match=r"log.npz has no column q; it has t, q_actual \(120 x 2\), tau \(120 x 2\)"):
        taken(tmp_path / "log.npz", VECTORS)


def test_a_dataset_may_be_written_as_its_path(taken, tmp_path):
    import h5py

    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["demo/t"], file["demo/q"], file["demo/tau"] = T, Q, TAU
    mapping = "time: {column: demo/t}\nposition: {columns: /demo/q}\neffort: {columns: demo.tau}\n"
    log, _ = taken(tmp_path / "log.h5", mapping)
    _same(log)


def test_an_object_of_matlab_is_named_with_how_to_save_it(taken, tmp_path):
    """As MATLAB 7.3 stores a `timeseries`: a reference to its class, not its numbers."""
    import h5py

    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["t"] = T
        item = file.create_dataset("run", data=np.array([[3707764736, 2, 1, 1, 1, 1]], np.uint32))
        item.attrs["MATLAB_class"], item.attrs["MATLAB_object_decode"] = np.bytes_(b"timeseries"), np.int32(3)
    with pytest.raises(InputError, match=r"no column run; it has t, and run, a MATLAB timeseries: save plain arrays"):
        taken(tmp_path / "log.h5", VECTORS.replace("columns: q", "columns: run"))
