"""A real S3 server that answers with errors and half files gives the same result as a local folder."""

import sys
from pathlib import Path

import pytest

from agent.core.errors import InputError
from agent.fleet.store import Store, StoredFile, StoreError
from tests.fleet.conftest import FlakyProxy, estimate, rows_of

SAME = ("robot", "run", "status", "started", "rmse", "parameters", "friction", "warm_up", "model", "warnings")


def _upload(folder: Path, url: str) -> None:
    there = Store(url)
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            there.put(path.relative_to(folder).as_posix(), path)


def _fetched(url: str, folder: Path) -> list[dict]:
    there = Store(url)
    folder.mkdir()
    there.fetch(there.find("rows.parquet"), folder)
    return rows_of(folder)


def test_reads_and_writes_s3_despite_errors_and_partial_files(
    s3: FlakyProxy, plant: Path, estimated: Path, tmp_path: Path, monkeypatch
):
    import s3fs

    monkeypatch.delenv("AWS_MAX_ATTEMPTS")
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 5)
    s3fs.S3FileSystem.clear_instance_cache()
    for robot in ("robot_0002", "robot_0003"):
        _upload(plant / robot, f"s3://plant/hall/{robot}")

    here = ("s3://plant/hall", "s3://plant/result")
    s3.fault = lambda number, method, _: {2: "500", 5: "cut"}.get(number % 7, "") if method == "GET" else ""
    summary = estimate(*here)
    assert s3.faults > 3
    assert (summary.done, len(summary.failed)) == (5, 1)
    ours = [{key: row[key] for key in SAME} for row in _fetched("s3://plant/result", tmp_path / "s3")]
    assert ours == [{key: row[key] for key in SAME} for row in rows_of(estimated) if row["robot"] >= "robot_0002"]
    names = {row["model"].split("/")[1] for row in ours if row["model"]}
    assert set(Store("s3://plant/result").names("_models")) == names
    assert Store("s3://plant/result").names("_done") == []
    assert (estimate(*here).done, estimate(*here).kept) == (0, 5)


def test_a_file_that_cannot_be_fetched_is_a_row_that_is_retried(s3, plant, tmp_path):
    _upload(plant / "robot_0001", "s3://plant/hall/robot_0001")
    here = ("s3://plant/hall", tmp_path / "out")
    s3.fault = lambda _, method, path: "500" if method == "GET" and path.endswith("excitation.mcap") else ""
    summary = estimate(*here)
    assert [one["status"] for one in summary.failed] == ["unavailable"] * 2
    assert "cannot be fetched: " in summary.failed[0]["reason"]
    s3.fault = lambda *_: ""
    assert (estimate(*here).done, estimate(*here).failed) == (2, [])


def test_an_unanswering_store_is_a_usage_error(s3: FlakyProxy, tmp_path: Path):
    s3.fault = lambda *_: "500"
    for source, out in (("s3://plant/hall", str(tmp_path)), (str(tmp_path), "s3://plant/out")):
        with pytest.raises(InputError, match=r"s3://plant/(hall|out.*): cannot be (listed|found): "):
            estimate(source, out)


def test_a_partial_file_is_not_accepted(tmp_path: Path, s3: FlakyProxy):
    there = Store("s3://plant/x")
    there.put("a/b.bin", b"0123456789")
    (file,) = there.files()
    assert there.fetch(file, tmp_path).read_bytes() == b"0123456789"
    with pytest.raises(StoreError, match="10 of 11 bytes came"):
        there.fetch(StoredFile(file.path, 11, file.stamp), tmp_path)


def test_a_local_file_is_written_atomically(tmp_path: Path):
    there = Store(str(tmp_path / "folder"))
    there.put("a/b", b"one")
    there.put("a/b", b"two")
    assert [path.name for path in (tmp_path / "folder" / "a").iterdir()] == ["b"]
    assert there.read("a/b") == b"two"
    there.remove("a/b")
    there.remove("a/b")
    assert there.names("a") == []
    assert there.names("nothing") == []


def test_an_unreachable_store_is_a_usage_error(monkeypatch):
    import fsspec.core

    def refused(url: str) -> None:
        raise ConnectionRefusedError(111, "Connection refused")

    monkeypatch.setattr(fsspec.core, "url_to_fs", refused)
    with pytest.raises(InputError, match="no store answers there: Connection refused"):
        Store("ftp://nobody/logs")


def test_a_store_whose_package_is_missing_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(InputError, match=r"needs s3fs, .*: pip install 'calibration-agent\[fleet\]'"):
        Store("s3://bucket/logs")
