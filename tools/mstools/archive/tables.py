"""Tables of an archive: their columns, and a writer of Parquet files with bounded memory.

A table is a folder of Parquet files, one for each log, which pandas, polars and DuckDB read as one table. A file has a
row group for each UTC day of a log, and a further one every `MAX_ROWS` rows: a query for a day reads the groups of that
day alone. `SCHEMA_VERSION` is in the metadata of each file, and part of the key of each result: a table never has rows
of two schemas. Columns are described in docs/archives.md, which a test compares with this module.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Self

import pyarrow as pa
import pyarrow.parquet as pq

from modelserver.errors import ModelServerError
from modelserver.server.recordings import CSV_HEADER

SCHEMA_VERSION: Final = 1

MAX_ROWS: Final = 1 << 17
"""Rows of a group at most: some 40 MB of columns, whatever the length of a log."""

BATCH_ROWS: Final = 1 << 12
"""Rows that are Python values, before they become columns: a row of `poses` is 1.2 kB as values, 0.3 kB in columns."""

_TIME = pa.timestamp("us", tz="UTC")
_TEXT, _REAL, _COUNT = pa.string(), pa.float64(), pa.int64()

_COLUMNS: Final[Mapping[str, Mapping[str, pa.DataType]]] = {
    "drives": {
        "log": _TEXT,
        "content": _TEXT,
        "vehicle": _TEXT,
        "time": _TIME,
        "seconds": _REAL,
        "distance": _REAL,
        "messages": _COUNT,
        "samples": _COUNT,
        "poses": _COUNT,
        "valid": _COUNT,
        "size": _COUNT,
        "error": _TEXT,
    },
    "poses": {
        "log": _TEXT,
        "time": _TIME,
        **dict.fromkeys(CSV_HEADER.split(",")[1:], _REAL),
        "pose_valid": pa.bool_(),
        "invalid_reasons": pa.int32(),
    },
    "decisions": {
        "log": _TEXT,
        "time": _TIME,
        "source": _TEXT,
        "kind": _TEXT,
        "verdict": _TEXT,
        "reason": _TEXT,
        "statistic": _REAL,
        "dof": pa.int32(),
    },
    "events": {"log": _TEXT, "time": _TIME, "seconds": _REAL, "kind": _TEXT, "level": _TEXT, "text": _TEXT},
    "metrics": {"log": _TEXT, "time": _TIME, "seconds": _REAL, "name": _TEXT, "label": _TEXT, "value": _REAL},
    "rejections": {"log": _TEXT, "time": _TIME, "source": _TEXT, "reason": _TEXT, "count": _COUNT},
}

TABLES: Final[Mapping[str, pa.Schema]] = {
    name: pa.schema(list(columns.items()), {"modelserver_schema": str(SCHEMA_VERSION)})
    for name, columns in _COLUMNS.items()
}
"""Schemas of the tables by name. `drives` is the last one written: a log without a row there has no result."""


class ArchiveError(ModelServerError):
    """An archive that cannot be written: no log's fault, so the run ends."""


@contextmanager
def explain_errors(place: object) -> Iterator[None]:
    """Raise what writing raises as an ArchiveError: each file system has its own errors."""
    try:
        yield
    except ModelServerError:
        raise
    except Exception as error:
        why = getattr(error, "strerror", "") or f"{type(error).__name__}: {error}"
        raise ArchiveError(f"{place} cannot be written: {why}; free space or permission, and run again") from None


class TableWriter:
    """Writes the rows of a log to one Parquet file for each table, in a folder that exists. A context manager.

    Raises ArchiveError.
    """

    def __init__(self, folder: Path, log: str):
        self._log, self._folder = log, folder
        with explain_errors(folder):
            self._writers = {
                name: pq.ParquetWriter(folder / f"{name}.parquet", schema, compression="zstd")
                for name, schema in TABLES.items()
            }
        self._rows: dict[str, list[tuple[Any, ...]]] = {name: [] for name in TABLES}
        self._batches: dict[str, list[pa.RecordBatch]] = {name: [] for name in TABLES}
        self._days = dict.fromkeys(TABLES, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for name, writer in self._writers.items():
            self._flush(name)
            with explain_errors(self._folder):
                writer.close()

    def add(self, table: str, utime: int, *values: Any) -> None:
        """Add a row: its time, and the columns after `log` and `time` in their order."""
        day = utime // 86_400_000_000
        if day > self._days[table] or len(self._batches[table]) * BATCH_ROWS >= MAX_ROWS:
            self._flush(table)
        self._days[table] = max(day, self._days[table])
        self._rows[table].append((self._log, utime, *values))
        if len(self._rows[table]) >= BATCH_ROWS:
            self._close_batch(table)

    def add_drive(self, content: str, vehicle: str, utime: int, *values: Any) -> None:
        self._rows["drives"].append((self._log, content, vehicle, utime, *values))

    def _close_batch(self, table: str) -> None:
        rows, schema = self._rows[table], TABLES[table]
        if rows:
            self._rows[table] = []
            columns = zip(*rows, strict=True)
            arrays = [pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)]
            self._batches[table].append(pa.RecordBatch.from_arrays(arrays, schema=schema))

    def _flush(self, table: str) -> None:
        self._close_batch(table)
        if batches := self._batches[table]:
            self._batches[table] = []
            with explain_errors(self._folder):
                self._writers[table].write_table(pa.Table.from_batches(batches))
