"""A result: one Parquet file with a row per robot and run, sorted by robot and run, and its model files.

    RESULT/rows.parquet          the rows; replaced as a whole, so that a reader sees one result or the next
    RESULT/_models/<hash>.json   model files of an estimate, named by their content, never changed
    RESULT/_done/<name>.parquet  rows of a run that was stopped; the next run takes them over

Programs that read a folder as a data set (Arrow, Spark, DuckDB's `*.parquet`) ignore names that begin with _.
"""

from __future__ import annotations

import contextlib
import hashlib
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from agent.core import InputError, swept_folder
from agent.fleet.store import SCRATCH, Store, StoreError

ROWS, DONE, MODELS = "rows.parquet", "_done", "_models"
#: Kinds of results, by the command that makes each row.
KINDS = ("estimate", "validate", "diagnose")
#: Keys of the file: the kind of result, and where its runs are.
META, SOURCE = b"agent.fleet", b"agent.fleet.source"
SCHEMA_NAME = "fleet/1"
#: Rows of a group; a few groups are in memory at once.
_GROUP = 128
#: Groups that are kept open while rows are sorted.
_OPEN = 8


def schema(kind: str, source: str = "") -> Any:
    """The Arrow schema of a kind of result.

    Columns that all have: `robot`, `run`; `status` (`ok`, `rejected`, `unreadable`, `unavailable`, `memory`, `killed`,
    `error`), `reason`, `exit_code` (that of the single command); `started` (UTC), `serial`, `tool`; `logs`, `page`
    (report of the run in the source), `warnings`; `joints`, and with one value per joint `rmse` [N·m] and
    `normalised_rmse` (of nominal torque); `asked` and `inputs`, by which a rerun knows what is new.
    """
    text, number, texts, numbers = pa.string(), pa.float64(), pa.list_(pa.string()), pa.list_(pa.float64())

    def table(**columns: Any) -> Any:
        return pa.list_(pa.struct(list(columns.items())))

    def columns(kind_of: Any, names: str) -> dict[str, Any]:
        return dict.fromkeys(names.split(), kind_of)

    cause = table(effect=text, joints=texts, closure=number, probability=number)
    level = columns(number, "speed value standard_deviation from_run_to_run")
    own = {
        "estimate": columns(numbers, "rmse nominal_torque")
        | columns(text, "model method")
        | columns(number, "cutoff_hz condition_number")
        | {"parameters": table(name=text, unit=text, value=number, standard_deviation=number)}
        | {"friction": table(joint=text, **level), "warm_up": table(rate_per_s=number, standard_deviation=number)},
        "validate": columns(numbers, "rmse relative_error")
        | columns(number, "relative_error_all_joints cutoff_hz")
        | {"result": text},
        "diagnose": {"verdict": text, "closure": number}
        | columns(numbers, "gap_before gap_after gap_floor")
        | {"gap_units": texts, "causes": cause, "result": text},
    }
    fields = (
        columns(text, "robot run status reason")
        | {"exit_code": pa.int32(), "started": pa.timestamp("us", tz="UTC")}
        | columns(text, "serial tool")
        | {"logs": texts, "page": text, "warnings": texts, "joints": texts, "normalised_rmse": numbers}
        | own[kind]
        | {"asked": text, "inputs": table(path=text, size=pa.int64(), stamp=text, sha256=text)}
    )
    return pa.schema(list(fields.items()), metadata={META: kind.encode(), SOURCE: source.encode()})


@dataclass(frozen=True)
class ResultRows:
    """The rows of a result: its kind, the folder or URL of its runs ("" where unknown), and its Parquet file."""

    kind: str
    source: str
    file: Any


def is_result(url: str) -> bool:
    """Whether a folder or URL holds the rows of a fleet."""
    return Store(url).find(ROWS) is not None


def open_rows(url: str, folder: Path) -> ResultRows:
    """The rows of a result; of one elsewhere a copy in `folder`.

    Raises:
        InputError: it is no result.
        StoreError: the store does not answer.
    """
    file = _find_rows(Store(url), folder)
    if file is None:
        raise InputError(f"{url}: no result of a fleet (there is no {ROWS}); `agent fleet estimate` makes one")
    return file


def _find_rows(store: Store, folder: Path) -> ResultRows | None:
    if (entry := store.find(ROWS)) is None:
        return None
    path = store.fetch(entry, folder)
    try:
        rows = pq.ParquetFile(path)
    except Exception as error:  # of Arrow: any fault of the bytes
        raise InputError(f"{store.url}/{ROWS}: no Parquet file: {str(error).splitlines()[0]}") from None
    about = {key: value.decode() for key, value in (rows.schema_arrow.metadata or {}).items()}
    if META not in about:
        raise InputError(f"{store.url}/{ROWS}: not written by `agent fleet`")
    return ResultRows(about[META], about.get(SOURCE, ""), rows)


@contextlib.contextmanager
def open_result(url: str, kind: str, source: str) -> Iterator[Result]:
    """A result to bring up to date; leaving it by an error keeps what was finished for the next run.

    Raises:
        InputError: there is a file, or a result of another kind.
    """
    store = Store(url)
    if store.local is not None and store.local.is_file():
        raise InputError(f"{url}: is a file; name a folder for the result")
    with swept_folder(SCRATCH) as folder:
        rows = _find_rows(store, folder)
        if rows is not None and rows.kind != kind:
            raise InputError(f"{url}: holds a result of `fleet {rows.kind}`; name another folder with -o")
        result = Result(store, schema(kind, Store(source).absolute), folder, None if rows is None else rows.file)
        try:
            yield result
        except BaseException:
            with contextlib.suppress(StoreError):  # the error that is on its way says more
                result.keep()
            raise


class Result:
    """A result in the making: knows the existing rows, takes new ones, and writes all at the end.

    Memory does not grow with the number of rows.
    """

    def __init__(self, store: Store, columns: Any, folder: Path, before: Any):
        self.written = 0  # bytes
        self._store = store
        self._schema = columns
        self._folder = folder
        self._before = before
        self._fresh: list[dict[str, Any]] = []
        self._parts = self._done_parts()

    def known(self) -> dict[str, dict[str, Any]]:
        """The columns `run`, `status`, `reason`, `asked` and `inputs` of every row, by run."""
        columns = ["run", "status", "reason", "asked", "inputs"]
        batches = (batch for file in self._files() for batch in file.iter_batches(_GROUP, columns=columns))
        return {row["run"]: row for batch in batches for row in batch.to_pylist()}

    def add(self, row: dict[str, Any]) -> None:
        """Take a finished row in; it replaces the one of the same run."""
        self._fresh.append(row)
        if len(self._fresh) >= _GROUP:
            self.keep()

    def add_model(self, content: bytes) -> str:
        """Keep a model file; returns its name in the result."""
        name = f"{MODELS}/{hashlib.sha256(content).hexdigest()[:32]}.json"
        self._store.put(name, content)
        self.written += len(content)
        return name

    def keep(self) -> None:
        """Save the finished rows, so that the next run can go on if this one is stopped."""
        if not self._fresh:
            return
        self._fresh.sort(key=lambda row: (row["robot"], row["run"]))
        name = f"{uuid.uuid4().hex}.parquet"
        path = self._folder / name
        pq.write_table(pa.Table.from_pylist(self._fresh, self._schema), path, compression="zstd")
        self._store.put(f"{DONE}/{name}", path)
        self._parts.append(name)
        self._fresh = []

    def commit(self) -> int:
        """Write all rows, sorted by robot and run; returns their number.

        Raises:
            AgentError: they cannot be written; the old result is unchanged.
        """
        self.keep()
        files = self._files()
        order = _order(files)
        if self._before is not None and not self._parts:
            return len(order)

        @lru_cache(maxsize=_OPEN)
        def group_of(file: int, group: int) -> Any:
            return files[file].read_row_group(group).select(self._schema.names).cast(self._schema)

        path = self._folder / "committed.parquet"
        with pq.ParquetWriter(path, self._schema, compression="zstd") as writer:
            for first in range(0, len(order), _GROUP):
                rows = [group_of(file, group).slice(row, 1) for *_, file, group, row in order[first:][:_GROUP]]
                writer.write_table(pa.concat_tables(rows).combine_chunks())
        self.written += path.stat().st_size
        self._store.put(ROWS, path)
        for name in self._parts:
            self._store.remove(f"{DONE}/{name}")
        return len(order)

    def _files(self) -> list[Any]:
        """The result as it stands, then what was finished since; later rows replace earlier ones."""
        parts = [pq.ParquetFile(self._folder / name) for name in self._parts]
        return parts if self._before is None else [self._before, *parts]

    def _done_parts(self) -> list[str]:
        """Fetch the rows of earlier runs that were stopped; returns their file names."""
        names = []
        for name in self._store.names(DONE):
            path = self._folder / name
            path.write_bytes(self._store.read(f"{DONE}/{name}"))
            with contextlib.suppress(Exception):  # of Arrow; not a result file
                if pq.read_schema(path).names == self._schema.names:
                    names.append(name)
        return names


def _order(files: Sequence[Any]) -> list[tuple[str, str, int, int, int]]:
    """Robot, run, file, row group and index in it of the newest row of every run, sorted."""
    newest: dict[str, tuple[str, str, int, int, int]] = {}
    for number, file in enumerate(files):
        for group in range(file.num_row_groups):
            keys = file.read_row_group(group, columns=["robot", "run"])
            pairs = zip(keys["robot"].to_pylist(), keys["run"].to_pylist(), strict=True)
            newest |= {run: (robot, run, number, group, row) for row, (robot, run) in enumerate(pairs)}
    return sorted(newest.values())
