"""Parquet tables, whose size is checked before they are read."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

MAX_BYTES = 384 << 20
"""What the columns that are read occupy, unpacked, each value by its column's own width ..."""
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
            limit = max(MAX_BYTES, MAX_RATIO * path.stat().st_size)
            if repeating := _check_size(file, columns, limit):
                _check_texts(path, repeating, limit)
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


def _check_size(file: pq.ParquetFile, columns: Sequence[str], limit: int) -> list[str]:
    """Raise ValueError where columns would take more than `limit` bytes, as far as the footer tells.

    Returns:
        Parquet's names of texts' and bytes' columns that could take more by repeating a long value of their
        dictionary.
    """
    metadata = file.metadata
    # Parquet's names of columns join names by dots, which LeRobot's names have, too: their order tells them.
    leaves = [(field.name, *leaf) for field in file.schema_arrow for leaf in _leaves(field.type)]
    size, could = 0, dict[str, int]()
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for index, (name, width, at_least) in enumerate(leaves):
            if name in columns:
                part = group.column(index)
                values = max(part.num_values, group.num_rows * at_least)
                size += max(values * width, part.total_uncompressed_size)
                if part.physical_type == "BYTE_ARRAY" and part.has_dictionary_page:
                    most = could.get(part.path_in_schema, 0) + values * part.total_uncompressed_size
                    could[part.path_in_schema] = most
    size = max(size, 8 * metadata.num_rows)
    if size > limit:
        raise ValueError(f"{metadata.num_rows:,} rows of {size:,} bytes are too many")
    return [name for name, most in could.items() if most > limit]


def _check_texts(path: Path, columns: Sequence[str], limit: int) -> None:
    """Raise ValueError where columns of texts or bytes, by Parquet's names, take more than `limit` bytes
    once each value stands for itself; read here with every value once."""
    with pq.ParquetFile(path, memory_map=False, read_dictionary=list(columns)) as file:
        size = 0
        for group in range(file.num_row_groups):
            for column in file.read_row_group(group, columns).columns:
                size += sum(_unpacked_bytes(chunk) for chunk in column.chunks)
                if size > limit:
                    raise ValueError(
                        f"{file.metadata.num_rows:,} rows of {size:,} bytes or more are too many"
                    )


def _unpacked_bytes(values: pa.Array) -> int:
    """What the dictionaries in an array take, each value as often as it occurs."""
    if pa.types.is_dictionary(values.type):
        lengths = pc.call_function("binary_length", [values.dictionary]).to_numpy(zero_copy_only=False)
        places = values.indices.drop_null().to_numpy()
        return int(np.bincount(places, minlength=len(lengths)) @ lengths)
    if pa.types.is_struct(values.type):
        return sum(map(_unpacked_bytes, values.flatten()))
    return _unpacked_bytes(values.flatten()) if pa.types.is_nested(values.type) else 0


def _leaves(kind: pa.DataType, at_least: int = 1) -> list[tuple[int, int]]:
    """Of every column of plain values in a column: bytes of a value, and values that a row has at least.

    A list of fixed length takes its room where it is null, too.
    """
    if isinstance(kind, pa.BaseExtensionType):
        return _leaves(kind.storage_type, at_least)
    if pa.types.is_fixed_size_list(kind):
        at_least *= kind.list_size
    elif pa.types.is_nested(kind) and not pa.types.is_struct(kind):
        at_least = 0
    if pa.types.is_nested(kind):
        fields = [kind.field(index) for index in range(kind.num_fields)]
        return [leaf for field in fields for leaf in _leaves(field.type, at_least)]
    try:
        return [(max(1, kind.bit_width // 8), at_least)]
    except ValueError:  # texts and bytes, whose lengths differ
        return [(8, at_least)]
