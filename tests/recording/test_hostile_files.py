"""Files that were made to harm: memory is bounded, and whatever stands in them is one message or one repair."""

import os
import struct
import time
import tracemalloc
import zipfile
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings, strategies as st
from mcap.writer import CompressionType

from agent.core.errors import InputError
from agent.recording import read_log
from agent.recording.tables.table_files import read_table

MAGIC = b"\x89MCAP0\r\n"
BOMB = 300 * 2**20


@pytest.fixture(scope="module")
def bomb() -> bytes:
    """300 MiB of zeros in a few kilobytes."""
    return zstandard.ZstdCompressor(level=1).compress(bytes(BOMB))


def chunks(path: Path, data: bytes, declared: int, count: int = 1) -> Path:
    body = struct.pack("<QQQII", 0, 0, declared, 0, 4) + b"zstd" + struct.pack("<Q", len(data)) + data
    path.write_bytes(MAGIC + count * (struct.pack("<BQ", 6, len(body)) + body))
    return path


@pytest.mark.parametrize(
    ("declared", "count", "message"),
    [
        (1000, 1, "no messages in it"),
        (0, 1, "no messages in it"),
        (65_536, 1, "no messages in it"),
        (65_536, 50, "no messages in it"),
        (BOMB, 1, "a chunk of 300 MiB"),
        (BOMB, 50, "a chunk of 300 MiB"),
        (64 * 2**20 + 1, 1, "at most 64 MiB"),
        (2**63, 1, "at most 64 MiB"),
        (2**64 - 1, 1, "at most 64 MiB"),
        (60 * 2**20, 50, "500 times its size"),
    ],
)
def test_a_chunk_is_limited_in_memory(tmp_path, bomb, declared, count, message):
    path = chunks(tmp_path / "log.mcap", bomb, declared, count)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=message):
            read_log(path)
        assert tracemalloc.get_traced_memory()[1] < 200 * 2**20
    finally:
        tracemalloc.stop()


NUMBERS = st.one_of(st.just("9" * 5000), st.just("[" * 100_000), st.just("1e999"), st.just("NaN"), st.just("٣"))
TEXTS = st.one_of(NUMBERS, st.text(max_size=20), st.sampled_from(['{"a": 1}', "[null]", "[[1]]", "[1e400]", "-1"]))
KEYS = ("sample_rate_hz", "cycle_starts_s", "lost_samples", "repeated_samples", "serial", "robot", "\x1b[2J")


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.dictionaries(st.sampled_from(KEYS), TEXTS))
def test_any_metadata_is_read(tools, tmp_path, run):
    times = 1 + np.arange(50) / 100
    messages = [{"time": t, "names": ["a"], "position": [t], "effort": [t]} for t in times]
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages, {**run}))
    assert len(log.t) == 50
    assert all(text.isprintable() for repair in log.repairs for text in str(repair))
    assert all(text.isprintable() for entry in log.metadata.items() for text in entry)


def test_huge_numbers_are_not_accepted_as_cycle_starts(tools, tmp_path):
    messages = [{"time": 1 + k / 100, "names": ["a"], "position": [k], "effort": [k]} for k in range(50)]
    for text in ("[1" + "0" * 400 + "]", "[" * 100_000):
        log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages, {"cycle_starts_s": text}))
        assert log.cycle_starts == ()
        assert any("cycle_starts_s" in repair.kind for repair in log.repairs)


def test_refuses_joint_names_that_are_not_text(tools, tmp_path):
    good = {"time": 1.0, "names": ["abcd"], "position": [1.0], "effort": [1.0]}
    path = tools.write_foreign(
        tmp_path / "log.mcap", [good, {**good, "time": 1.1}], compression=CompressionType.NONE, use_chunking=False
    )
    path.write_bytes(path.read_bytes().replace(b"abcd", b"\xff\xfe\xfd\xfc"))
    with pytest.raises(InputError, match="no readable"):
        read_log(path)


def test_the_total_of_all_chunks_is_limited(tmp_path):
    """Each is small enough, and unpacks to what it says; the file is large enough for 500 times its size."""
    packed = zstandard.ZstdCompressor(level=1).compress(bytes(60 * 2**20))
    path = chunks(tmp_path / "log.mcap", packed + bytes(max(0, 2**17 - len(packed))), 60 * 2**20, 200)
    with pytest.raises(InputError, match=r"times its size \(1024 MiB\)"):
        read_log(path)


@pytest.mark.parametrize("ending", [".parquet", ".mat"])
def test_a_table_is_limited_in_memory(tmp_path, ending: str):
    """A few hundred kilobytes that would be gigabytes, refused before they are read."""
    path = tmp_path / f"bomb{ending}"
    if ending == ".parquet":
        _parquet_bomb(path)
    else:
        _mat_bomb(path)
    assert path.stat().st_size < 4 * 2**20
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="more than 67108864 values"):
            read_table(path)
        assert tracemalloc.get_traced_memory()[1] < 50 * 2**20
    finally:
        tracemalloc.stop()


def _parquet_bomb(path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    part = pyarrow.table({f"q{k}": np.zeros(2**20) for k in range(5)})
    with parquet.ParquetWriter(path, part.schema, compression="zstd") as writer:
        for _ in range(16):
            writer.write_table(part)


def _mat_bomb(path: Path) -> None:
    """Sixty variables of 10 MiB of zeros, each in a compressed element."""
    from scipy.io import savemat

    savemat(path, {f"q{k}": np.zeros(10 * 2**17) for k in range(60)}, do_compression=True)


def test_texts_of_a_parquet_file_are_not_read(tmp_path):
    """One text, kept once and repeated, is as long as memory."""
    import pyarrow
    from pyarrow import parquet

    path = tmp_path / "texts.parquet"
    text = pyarrow.DictionaryArray.from_arrays(np.zeros(4000, np.int32), ["x" * 10**6])
    parquet.write_table(pyarrow.table({"t": np.arange(4000) / 500, "note": text}), path, store_schema=False)
    table = read_table(path)
    assert list(table.columns) == ["t"]


@pytest.mark.parametrize("kind", ["list", "fixed", "time", "bool", "decimal"])
def test_reads_columns_of_every_number_type(tmp_path, kind: str):
    import pyarrow
    from pyarrow import parquet

    values = {
        "list": pyarrow.array([[1.0, 2.0], [3.0, 4.0]]),
        "fixed": pyarrow.FixedSizeListArray.from_arrays(pyarrow.array([1.0, 2.0, 3.0, 4.0]), 2),
        "time": pyarrow.array(np.array([1, 2], "datetime64[ms]")),
        "bool": pyarrow.array([True, False]),
        "decimal": pyarrow.array([Decimal("0.25"), Decimal("1.5")]),
    }[kind]
    parquet.write_table(pyarrow.table({"t": [0.0, 0.1], "q": values}), tmp_path / "log.parquet")
    assert len(read_table(tmp_path / "log.parquet").columns) == (3 if kind in ("list", "fixed") else 2)


@pytest.mark.parametrize("rows", [1, 70])
def test_far_cells_of_a_workbook_cost_little_memory(tmp_path, rows: int, monkeypatch):
    """The last column that Excel knows, in one row far below or in many: cells are counted as they come."""
    import openpyxl

    monkeypatch.setattr("agent.recording.tables.table_files.MOST_CELLS", 2**20)

    path = tmp_path / "far.xlsx"
    book = openpyxl.Workbook()
    book.active.append([0.0, 1.0])
    book.save(path)
    first = 20_000
    cells = "".join(f'<row r="{first + k}"><c r="XFD{first + k}"><v>1</v></c></row>' for k in range(1, rows + 1))
    with zipfile.ZipFile(path) as old:
        parts = {name: old.read(name) for name in old.namelist()}
    sheet = parts["xl/worksheets/sheet1.xml"].replace(b"</sheetData>", cells.encode() + b"</sheetData>")
    parts["xl/worksheets/sheet1.xml"] = sheet.replace(b'ref="A1:B1"', b'ref="A1:XFD1048576"')
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name, part in parts.items():
            new.writestr(name, part)
    tracemalloc.start()
    try:
        if rows == 1:
            assert len(read_table(path).columns) in (2, 2**14)
        else:
            with pytest.raises(InputError, match=r"far\.xlsx: holds more than 1048576 values"):
                read_table(path)
        assert tracemalloc.get_traced_memory()[1] < 100 * 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1" * 20 * 2**20, "line 3 has 1048576 characters or more"),
        ("1," * 10 * 2**20, "line 3 has 1048576 characters or more"),
        (("1," * 100_000 + "\n") * 50, "row 3 has more than 16384 fields"),
        ("\n" * 2 * 2**20, ""),  # lists of their cells would take 112 MiB
    ],
)
def test_a_huge_line_of_text_is_not_read_to_its_end(tmp_path, text: str, says: str):
    path = tmp_path / "line.csv"
    path.write_text("t,q\n0,1\n" + text + "\n2,3\n")
    tracemalloc.start()
    try:
        if says:
            with pytest.raises(InputError, match=says):
                read_table(path)
        else:
            assert len(read_table(path).column("q")) == 2
        assert tracemalloc.get_traced_memory()[1] < 40 * 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("cell", ['<c r="A9" t="inlineStr"><is><t>{}</t></is></c>', "<c><v>{}</v></c>", '<c r="{}"/>'])
def test_a_huge_cell_of_a_workbook_is_not_read(tmp_path, cell: str):
    openpyxl = pytest.importorskip("openpyxl")
    path, book = tmp_path / "cell.xlsx", openpyxl.Workbook()
    for row in range(5):
        book.active.append([row, row])
    book.save(path)
    with zipfile.ZipFile(path) as old:
        parts = {name: old.read(name) for name in old.namelist()}
    sheet = parts["xl/worksheets/sheet1.xml"]
    row = f'<row r="9">{cell.format("1" * 10 * 2**20)}</row></sheetData>'.encode()
    parts["xl/worksheets/sheet1.xml"] = sheet.replace(b"</sheetData>", row)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name, part in parts.items():
            new.writestr(name, part)
    with pytest.raises(InputError, match=r"cell\.xlsx: xl/worksheets/sheet1\.xml holds a text of 1 MiB or more"):
        read_table(path)


@pytest.mark.parametrize("text", ["[" * 9, "(" * 9, "[;" * 9, "1," * 9 + "[", '"' * 9, "9" * 9, ",1" * 9 + "(", "()-,"])
def test_long_lines_are_read_in_linear_time(tmp_path, text: str):
    """Four times the text takes four times as long, not sixteen."""

    def seconds(times: int) -> float:
        path = tmp_path / "line.csv"
        path.write_text("t,q\n0,1\n1,2\n" + text * times + "\n2,3\n")
        began = time.process_time()
        read_table(path)
        return time.process_time() - began

    least = min(seconds(400) for _ in range(3))
    assert min(seconds(1600) for _ in range(2)) < 10 * least + 0.05


@pytest.mark.parametrize("name", ["pipe.csv", "pipe.mcap", "pipe.npz"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, name: str):
    os.mkfifo(tmp_path / name)
    (tmp_path / f"link-{name}").symlink_to(tmp_path / name)
    for path in (tmp_path / name, tmp_path / f"link-{name}"):
        with pytest.raises(InputError, match=f"{name}: a folder, pipe or device"):
            (read_log if name.endswith("mcap") else read_table)(path)
