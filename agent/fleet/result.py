"""A result: one Parquet file of a row a robot and run, in the order of robot and run, and the model files beside it.

    RESULT/rows.parquet          the rows; replaced as a whole, so that a reader sees one result or the next
    RESULT/_models/<hash>.json   model files of an estimate, named by their content: none is ever changed
    RESULT/_done/<name>.parquet  rows of a run of the fleet that has not come to its end; the next one takes them in

Names that begin with _ are left out by what reads a folder as a data set (Arrow, Spark, DuckDB's `*.parquet`).
"""

from __future__ import annotations

import hashlib
import uuid
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from agent.core import InputError, needed, swept_folder
from agent.fleet.store import SCRATCH, Store, StoreError

ROWS, DONE, MODELS = "rows.parquet", "_done", "_models"
#: Keys of the file: the kind of result, and where its runs are.
META, SOURCE = b"agent.fleet", b"agent.fleet.source"
SCHEMA_NAME = "fleet/1"
#: Rows of a group: what is in memory at once, times a few.
_GROUP = 128
#: Groups that are kept open while rows are put in order.
_OPEN = 8


def schema(kind: str) -> Any:
    """The Arrow schema of a kind of result.

    Columns that all have: `robot`, `run`; `status` (`ok`, `rejected`, `unreadable`, `unavailable`, `memory`, `killed`,
    `error`), `reason`, `exit_code` (that of the single command); `started` (UTC), `serial`, `tool`; `logs`, `page`
    (report of the run in the source), `warnings`; `joints` and lists as long: `rmse` [N·m], `normalised_rmse` (of
    nominal torque); `asked` and `inputs`, by which a rerun knows what is new.
    """
    pa = needed("pyarrow", "a fleet")
    text, number, texts, numbers = pa.string(), pa.float64(), pa.list_(pa.string()), pa.list_(pa.float64())

    def table(**columns: Any) -> Any:
        return pa.list_(pa.struct(list(columns.items())))

    common = {
        "robot": text,
        "run": text,
        "status": text,
        "reason": text,
        "exit_code": pa.int32(),
        "started": pa.timestamp("us", tz="UTC"),
        "serial": text,
        "tool": text,
        "logs": texts,
        "page": text,
        "warnings": texts,
        "joints": texts,
        "normalised_rmse": numbers,
    }
    level = {"joint": text, "speed": number, "value": number, "standard_deviation": number, "from_run_to_run": number}
    own = {
        "estimate": {
            "rmse": numbers,
            "nominal_torque": numbers,
            "model": text,
            "method": text,
            "cutoff_hz": number,
            "condition_number": number,
            "parameters": table(name=text, unit=text, value=number, standard_deviation=number),
            "friction": table(**level),
            "warm_up": table(rate_per_s=number, standard_deviation=number),
        },
        "validate": {
            "rmse": numbers,
            "relative_error": numbers,
            "relative_error_all_joints": number,
            "cutoff_hz": number,
            "result": text,
        },
        "diagnose": {
            "verdict": text,
            "closure": number,
            "gap_before": numbers,
            "gap_after": numbers,
            "gap_floor": numbers,
            "gap_units": texts,
            "causes": table(effect=text, joints=texts, closure=number, probability=number),
            "result": text,
        },
    }
    inputs = {"asked": text, "inputs": table(path=text, size=pa.int64(), stamp=text, sha256=text)}
    return pa.schema([*common.items(), *own[kind].items(), *inputs.items()], metadata={META: kind.encode()})


def open_rows(url: str, folder: Path) -> tuple[str, Any]:
    """Kind and Parquet file of the rows of a result; of one elsewhere a copy in `folder`.

    Raises:
        InputError: it is no result.
        StoreError: the store does not answer.
    """
    found = _find_rows(Store(url), folder)
    if found is None:
        raise InputError(f"{url}: no result of a fleet (there is no {ROWS}); `agent fleet estimate` makes one")
    return found


def _find_rows(store: Store, folder: Path) -> tuple[str, Any] | None:
    needed("pyarrow", "a fleet")
    import pyarrow.parquet as pq

    try:
        file = store.find(ROWS)
    except (FileNotFoundError, NotADirectoryError):
        return None
    path = store.fetch(file, folder)
    try:
        rows = pq.ParquetFile(path)
    except Exception as error:  # of Arrow: whatever is wrong with the bytes
        raise InputError(f"{store.url}/{ROWS}: no Parquet file: {str(error).splitlines()[0]}") from None
    kind = (rows.schema_arrow.metadata or {}).get(META)
    if kind is None:
        raise InputError(f"{store.url}/{ROWS}: not written by `agent fleet`")
    return kind.decode(), rows


class Result:
    """A result that is being made: knows the rows that are there, takes new ones, and puts all in place at the end.

    A context; leaving it by an error keeps what was finished for the next run. Memory does not grow with the rows.
    """

    def __init__(self, url: str, kind: str, source: str):
        self.kind = kind
        self.store = Store(url)
        self.written = 0  # bytes
        self._schema = schema(kind).with_metadata({META: kind.encode(), SOURCE: Store(source).absolute.encode()})
        self._fresh: list[dict[str, Any]] = []
        self._same: dict[str, list[dict[str, Any]]] = {}

    def __enter__(self) -> Result:
        if self.store.local is not None and self.store.local.is_file():
            raise InputError(f"{self.store.url}: is a file; name a folder for the result")
        with ExitStack() as opened:
            self._folder = opened.enter_context(swept_folder(SCRATCH))
            found = _find_rows(self.store, self._folder)
            if found is not None and found[0] != self.kind:
                raise InputError(f"{self.store.url}: holds a result of `fleet {found[0]}`; name another folder with -o")
            self._before = None if found is None else found[1]
            self._parts = self._done_parts()
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is not None:
                self.keep()
        except StoreError:
            pass  # the error that is on its way says more
        finally:
            self._opened.close()

    def known(self) -> dict[str, dict[str, Any]]:
        """Of every run that has a row: `status`, `reason`, `asked`, and `inputs`."""
        found: dict[str, dict[str, Any]] = {}
        columns = ["run", "status", "reason", "asked", "inputs"]
        for file in self._files():
            for batch in file.iter_batches(batch_size=_GROUP, columns=columns):
                for row in batch.to_pylist():
                    found[row["run"]] = row
        return found

    def add(self, row: dict[str, Any]) -> None:
        """Take a finished row in; it replaces the one of the same run."""
        self._fresh.append(row)
        if len(self._fresh) >= _GROUP:
            self.keep()

    def same(self, run: str, inputs: list[dict[str, Any]]) -> None:
        """The row of a run stands: its inputs have other stamps and the same content."""
        self._same[run] = inputs

    def add_model(self, content: bytes) -> str:
        """Keep a model file; returns its name in the result."""
        name = f"{MODELS}/{hashlib.sha256(content).hexdigest()[:32]}.json"
        self.store.put(name, content)
        self.written += len(content)
        return name

    def keep(self) -> None:
        """Write what is finished, for whoever goes on if this run does not come to its end."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not self._fresh:
            return
        self._fresh.sort(key=lambda row: (row["robot"], row["run"]))
        table = pa.Table.from_pylist(self._fresh, self._schema)
        name = f"{uuid.uuid4().hex}.parquet"
        path = self._folder / name
        pq.write_table(table, path, compression="zstd")
        self.store.put(f"{DONE}/{name}", path)
        self._parts.append(name)
        self._fresh = []

    def commit(self) -> int:
        """Put all rows in place, in the order of robot and run; returns their number.

        Raises:
            AgentError: they cannot be written; the result before stands.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        self.keep()
        order = self._order()
        if self._before is not None and not self._parts and not self._same:
            return len(order)
        path = self._folder / "committed.parquet"
        with pq.ParquetWriter(path, self._schema, compression="zstd") as writer:
            waiting: list[Any] = []
            for table in self._in_order(order):
                waiting.append(table)
                if len(waiting) >= _GROUP:
                    writer.write_table(pa.concat_tables(waiting).combine_chunks())
                    waiting = []
            if waiting:
                writer.write_table(pa.concat_tables(waiting).combine_chunks())
        self.written += path.stat().st_size
        self.store.put(ROWS, path)
        for name in self._parts:
            self.store.remove(f"{DONE}/{name}")
        return len(order)

    def _order(self) -> list[tuple[str, str, int, int, int]]:
        """Robot, run, file, group of rows and place in it of every row, the newest of each run."""
        newest: dict[str, tuple[str, str, int, int, int]] = {}
        for number, file in enumerate(self._files()):
            for group in range(file.num_row_groups):
                keys = file.read_row_group(group, columns=["robot", "run"])
                pairs = zip(keys["robot"].to_pylist(), keys["run"].to_pylist(), strict=True)
                for place, (robot, run) in enumerate(pairs):
                    newest[run] = (robot, run, number, group, place)
        return sorted(newest.values())

    def _in_order(self, order: Sequence[tuple[str, str, int, int, int]]) -> Iterator[Any]:
        """A table of one row each."""
        import pyarrow as pa

        files = self._files()
        groups: OrderedDict[tuple[int, int], Any] = OrderedDict()
        for _, run, number, group, place in order:
            key = (number, group)
            if key not in groups:
                table = files[number].read_row_group(group)
                groups[key] = table.select(self._schema.names).cast(self._schema)
                if len(groups) > _OPEN:
                    groups.popitem(last=False)
            groups.move_to_end(key)
            row = groups[key].slice(place, 1)
            if run in self._same:
                field = self._schema.field("inputs")
                inputs = pa.array([self._same[run]], field.type)
                row = row.set_column(self._schema.get_field_index("inputs"), field, inputs)
            yield row

    def _files(self) -> list[Any]:
        """The result as it stands, then what was finished since; later rows replace earlier ones."""
        import pyarrow.parquet as pq

        parts = [pq.ParquetFile(self._folder / name) for name in self._parts]
        return parts if self._before is None else [self._before, *parts]

    def _done_parts(self) -> list[str]:
        """What earlier runs finished and did not put in place, fetched."""
        import pyarrow.parquet as pq

        names = []
        for name in self.store.names(DONE):
            path = self._folder / name
            path.write_bytes(self.store.read(f"{DONE}/{name}"))
            try:
                columns = pq.read_schema(path).names
            except Exception:  # of Arrow; a file of nobody's
                continue
            if columns == self._schema.names:
                names.append(name)
        return names
