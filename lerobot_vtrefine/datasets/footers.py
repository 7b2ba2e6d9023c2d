"""Reads Parquet files whose writer died before it wrote the footer.

LeRobot writes one row group per episode and, at the end of the session, a footer that says where the groups
are. Without it the pages are all there, each behind a header of its own: the footer can be made again from
those headers and from the columns that the dataset is known to have. Footer and headers are Thrift structures
in the compact protocol (https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md).
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.feature_utils import get_hf_features_from_features

MAGIC = b"PAR1"
TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)
DATA_PAGE, DICTIONARY_PAGE = 0, 2

BROKEN = (pa.ArrowException, OSError)
"""What reading a damaged file raises."""

Struct = dict[int, tuple[int, Any]]
"""Field number -> type and value; a list is (type of its elements, elements)."""


def read_without_footer(path: Path, features: dict[str, Any]) -> list[pa.Table | None]:
    """The complete row groups of a data file, None in place of one of which a page is damaged.

    Args:
        path: A file of LeRobot's writer without its footer.
        features: The dataset's features, as in ``info.json``.
    """
    data = path.read_bytes()
    schema = get_hf_features_from_features(features).arrow_schema
    footer = _template(schema)
    columns = footer[4][1][1][0][1][1][1]
    values = [_values_per_row(column, features) for column in columns]
    groups: list[Any] = []
    end, num_rows = len(MAGIC), 0
    while found := _read_group(data, end, values):
        chunks, end = found
        rows = chunks[0].num_values // (values[0] or 1)
        groups.append(_group(columns, chunks, rows))
        num_rows += rows
    if not groups:
        return []
    footer[3] = (I64, num_rows)
    footer[4] = (LIST, (STRUCT, groups))
    text = _encode(footer)
    whole = data[:end] + text + struct.pack("<I", len(text)) + MAGIC
    with pq.ParquetFile(pa.BufferReader(whole)) as file:
        found = list(read_groups(file))
    return [None if group is None else group.replace_schema_metadata(schema.metadata) for group in found]


def read_groups(file: pq.ParquetFile) -> Iterator[pa.Table | None]:
    """Every row group of a file, None in place of one of which a page is damaged; each is read when asked
    for, as images can be large.
    """
    for number in range(file.num_row_groups):
        try:
            group = file.read_row_group(number)
        except BROKEN:
            group = None
        yield group


@dataclass
class _Chunk:
    """Where a column's pages of one row group are."""

    begin: int
    dictionary: int | None = None
    first_data: int = 0
    end: int = 0
    num_values: int = 0
    uncompressed: int = 0
    encodings: set[int] = field(default_factory=lambda: {3})  # levels are run lengths


def _template(schema: pa.Schema) -> Struct:
    """The footer of a file with these columns and one row group."""
    empty = pa.table([pa.nulls(1, column.type) for column in schema], schema=schema)
    stream = BytesIO()
    pq.write_table(empty, stream, compression="snappy", use_dictionary=True)
    data = stream.getvalue()
    (length,) = struct.unpack("<I", data[-8:-4])
    return _Reader(data, len(data) - 8 - length).struct()


def _values_per_row(column: Struct, features: dict[str, Any]) -> int | None:
    """Values of a leaf column in every row; None where rows differ."""
    path = [name.decode() for name in column[3][1][3][1][1]]
    feature = features[path[0]]
    if feature["dtype"] in ("image", "string"):
        return 1
    return None if feature["dtype"] == "language" else prod(feature["shape"])


def _read_group(data: bytes, begin: int, values: list[int | None]) -> tuple[list[_Chunk], int] | None:
    """The columns of the row group at ``begin`` and where it ends; None where not all of it is there."""
    chunks: list[_Chunk] = []
    rows: int | None = None
    try:
        for count in values:
            chunk = _read_chunk(data, begin, None if None in (rows, count) else (rows or 0) * (count or 0))
            if rows is None and count is not None:
                rows = chunk.num_values // count
            if not chunk.num_values or (count is not None and chunk.num_values != (rows or 0) * count):
                return None
            chunks.append(chunk)
            begin = chunk.end
    except (IndexError, struct.error, KeyError, ValueError):
        return None
    return chunks, begin


def _read_chunk(data: bytes, begin: int, expected: int | None) -> _Chunk:
    """A column's pages: as many as hold the expected values, else up to the next column's dictionary."""
    chunk = _Chunk(begin, end=begin)
    while expected is None or chunk.num_values < expected:
        if expected is None and chunk.num_values and chunk.end == len(data):
            break
        reader = _Reader(data, chunk.end)
        header = reader.struct()
        kind, page_end = header[1][1], reader.position + header[3][1]
        if kind not in (DATA_PAGE, DICTIONARY_PAGE) or page_end > len(data):
            raise ValueError("no page")
        if kind == DICTIONARY_PAGE:
            if chunk.num_values:
                if expected is None:
                    break
                raise ValueError("a dictionary within a column")
            chunk.dictionary = chunk.end
            chunk.encodings.add(header[7][1][2][1])
        else:
            chunk.first_data = chunk.first_data or chunk.end
            chunk.num_values += header[5][1][1][1]
            chunk.encodings.add(header[5][1][2][1])
        chunk.uncompressed += header[2][1] + reader.position - chunk.end
        chunk.end = page_end
    return chunk


def _group(columns: list[Struct], chunks: list[_Chunk], rows: int) -> Struct:
    """The footer's description of a row group."""
    described = [_described(column, chunk) for column, chunk in zip(columns, chunks, strict=True)]
    size = sum(chunk.uncompressed for chunk in chunks)
    return {1: (LIST, (STRUCT, described)), 2: (I64, size), 3: (I64, rows)}


def _described(column: Struct, chunk: _Chunk) -> Struct:
    known: Struct = column[3][1]
    meta: Struct = {number: known[number] for number in (1, 3, 4)}  # type, path, codec
    meta[2] = (LIST, (I32, sorted(chunk.encodings)))
    meta[5] = (I64, chunk.num_values)
    meta[6] = (I64, chunk.uncompressed)
    meta[7] = (I64, chunk.end - chunk.begin)
    meta[9] = (I64, chunk.first_data)
    if chunk.dictionary is not None:
        meta[11] = (I64, chunk.dictionary)
    return {2: (I64, 0), 3: (STRUCT, meta)}


# --- Thrift's compact protocol -----------------------------------------------------------------------------


class _Reader:
    def __init__(self, data: bytes, position: int) -> None:
        self.data, self.position = data, position

    def byte(self) -> int:
        self.position += 1
        return self.data[self.position - 1]

    def varint(self) -> int:
        value = shift = 0
        while True:
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7
            if shift > 63:
                raise ValueError("no number")

    def integer(self) -> int:
        value = self.varint()
        return value >> 1 ^ -(value & 1)

    def struct(self) -> Struct:
        fields: Struct = {}
        number = 0
        while head := self.byte():
            number = number + (head >> 4) if head >> 4 else self.integer()
            kind = head & 0x0F
            value = kind == TRUE if kind in (TRUE, FALSE) else self.value(kind)
            fields[number] = (kind, value)
        return fields

    def value(self, kind: int) -> Any:
        if kind in (TRUE, FALSE, BYTE):
            return self.byte()
        if kind in (I16, I32, I64):
            return self.integer()
        if kind in (DOUBLE, BINARY):
            length = 8 if kind == DOUBLE else self.varint()
            self.position += length
            return self.data[self.position - length : self.position]
        if kind in (LIST, SET):
            head = self.byte()
            length = self.varint() if head >> 4 == 15 else head >> 4
            if length > len(self.data):
                raise ValueError("no list")
            return head & 0x0F, [self.value(head & 0x0F) for _ in range(length)]
        if kind == STRUCT:
            return self.struct()
        raise ValueError("no type")


def _varint(value: int) -> bytes:
    text = bytearray()
    while value > 0x7F:
        text.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*text, value])


def _integer(value: int) -> bytes:
    return _varint(value << 1 ^ value >> 63)


def _encode(fields: Struct) -> bytes:
    text, before = bytearray(), 0
    for number, (kind, value) in sorted(fields.items()):
        step = number - before
        text += bytes([step << 4 | kind]) if 0 < step < 16 else bytes([kind]) + _integer(number)
        text += b"" if kind in (TRUE, FALSE) else _value(kind, value)
        before = number
    return bytes(text) + b"\0"


def _value(kind: int, value: Any) -> bytes:
    if kind in (TRUE, FALSE, BYTE):
        return bytes([value])
    if kind in (I16, I32, I64):
        return _integer(value)
    if kind == DOUBLE:
        return value
    if kind == BINARY:
        return _varint(len(value)) + value
    if kind in (LIST, SET):
        element, values = value
        head = bytes([len(values) << 4 | element]) if len(values) < 15 else bytes([0xF0 | element])
        head += b"" if len(values) < 15 else _varint(len(values))
        return head + b"".join(_value(element, each) for each in values)
    return _encode(value)
