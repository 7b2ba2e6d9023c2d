"""Parquet tables, whose size is checked before they are read."""

from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

MAX_VALUES_BYTES = 384 << 20
"""Values of the columns that are read, unpacked, eight bytes each ..."""
MAX_RATIO = 100
"""... unless the file itself is so large that this is no more than this many times its size."""


def read_table(path: Path, columns: Sequence[str] | None = None, *, without: Sequence[str] = ()) -> pa.Table:
    """The table, or some of its columns; those in `without` are not even opened.

    Raises:
        ValueError: the file cannot be read or is too large; does not name it.
        OSError: there is no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with pq.ParquetFile(path, memory_map=False) as file:
            names = file.schema_arrow.names
            if repeated := [name for name in set(names) if names.count(name) > 1]:
                raise ValueError(f"column {repeated[0][:60]} appears twice")
            columns = names if columns is None else columns
            columns = [name for name in columns if name not in without]
            _check_size(file.metadata, columns, path.stat().st_size)
            return file.read(columns)
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise ValueError(reason) from error


def read_columns(path: Path, columns: Sequence[str], *, others: bool = False) -> pa.Table:
    """These columns of a table, all of which must be there; with `others`, what else it has, too.

    Raises:
        ValueError: names the file, and why it cannot be read or which column it lacks.
        OSError: there is no such file.
    """
    try:
        table = read_table(path, None if others else columns)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if missing := [name for name in columns if name not in table.column_names]:
        raise ValueError(f"{path} has no column {missing[0]}")
    return table


def _check_size(metadata: pq.FileMetaData, columns: Sequence[str], file_bytes: int) -> None:
    values = 0
    for group in range(metadata.num_row_groups):
        part = metadata.row_group(group)
        for index in range(part.num_columns):
            column = part.column(index)
            if column.path_in_schema.split(".")[0] in columns:
                values += max(column.num_values * 8, column.total_uncompressed_size)
    values = max(values, 8 * metadata.num_rows)
    if values > max(MAX_VALUES_BYTES, MAX_RATIO * file_bytes):
        raise ValueError(f"{metadata.num_rows:,} rows of {values:,} bytes in {file_bytes:,} are too many")
