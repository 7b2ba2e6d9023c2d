"""Arrays out of .npy and .npz files: every header is read and checked against the bytes that are there."""

import io
import math
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

MAX_ARRAY_BYTES = 256 << 20
"""For all arrays of a file together: five hours of a robot's joints at 100 Hz are 230 MB."""
_MAX_HEADER_BYTES = 10_000
_MAGIC = b"\x93NUMPY"
_DTYPE = re.compile(r"'descr': *'([<>|=][a-zA-Z]\d+)'")
_ORDER = re.compile(r"'fortran_order': *(True|False)")
_SHAPE = re.compile(r"'shape': *\(([\d, ]*)\)")

NUMBERS, WHOLE, TEXTS = "iuf", "iu", "U"
"""Kinds of dtypes that an array may have."""


def read_arrays(path: Path, kinds: Mapping[str, str] | str) -> dict[str, NDArray]:
    """Arrays of a .npz by name; a .npy has one, named "array".

    Args:
        kinds: for every array that is wanted the kinds of dtypes that it may have; others are not read, and
            those that are absent are left out. Text in place of a mapping holds for all there are.

    Raises:
        OSError: the file is not there or cannot be read.
        ValueError: it is not such a file, or an array is of another kind; names file and array.
    """
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is not a regular file")
    with path.open("rb") as file:
        try:
            return dict(_archived(file, kinds) if zipfile.is_zipfile(file) else _alone(file, kinds))
        except _UNREADABLE as error:
            reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            raise ValueError(f"{path} cannot be read as arrays: {reason}") from error


_UNREADABLE = (ValueError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError)
"""What zip files raise that are cut, encrypted or packed in other ways."""


def _alone(file: io.BufferedReader, kinds: Mapping[str, str] | str) -> Iterator[tuple[str, NDArray]]:
    if not isinstance(kinds, str):
        raise ValueError("it is no .npz")
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    _check_size(size)
    yield "array", _parse("array", file.read(size), kinds)


def _archived(file: io.BufferedReader, kinds: Mapping[str, str] | str) -> Iterator[tuple[str, NDArray]]:
    with zipfile.ZipFile(file) as archive:
        members = {item.filename.removesuffix(".npy"): item for item in archive.infolist()}
        if len(members) < len(archive.infolist()):
            raise ValueError("an array is there twice")
        wanted = dict.fromkeys(members, kinds) if isinstance(kinds, str) else kinds
        wanted = {name: kind for name, kind in wanted.items() if name in members}
        _check_size(sum(members[name].file_size for name in wanted))
        for name, kind in wanted.items():
            with archive.open(members[name]) as member:
                yield name, _parse(name, member.read(members[name].file_size), kind)


def _check_size(size: int) -> None:
    if size > MAX_ARRAY_BYTES:
        raise ValueError(f"its arrays take {size:,} bytes, more than {MAX_ARRAY_BYTES:,}")


def _parse(name: str, data: bytes, kinds: str) -> NDArray:
    """The array of a .npy's bytes."""
    if data[:6] != _MAGIC or len(data) < 12:
        raise ValueError(f"array {name[:60]!r} is no .npy")
    start = 10 if data[6] == 1 else 12
    length = int.from_bytes(data[8:start], "little")
    header = data[start : start + length].decode("latin-1")
    found = [pattern.search(header) for pattern in (_DTYPE, _ORDER, _SHAPE)]
    if length > _MAX_HEADER_BYTES or len(header) < length or None in found:
        raise ValueError(
            f"array {name[:60]!r} holds no plain numbers or texts: {' '.join(header[:80].split())}"
        )
    code, order, axes = (match[1] for match in found if match is not None)
    dtype = np.dtype(code)
    if dtype.kind not in kinds or not dtype.itemsize:
        raise ValueError(f"array {name[:60]!r} holds {dtype.name}, not {_words(kinds)}")
    shape = tuple(int(axis) for axis in axes.split(",") if axis.strip())
    body = data[start + length :]
    if math.prod(shape) * dtype.itemsize != len(body):
        raise ValueError(f"array {name[:60]!r} should be {shape} {dtype.name}, but has {len(body):,} bytes")
    return np.frombuffer(body, dtype).reshape(shape, order="F" if order == "True" else "C")


def _words(kinds: str) -> str:
    return {NUMBERS: "numbers", WHOLE: "whole numbers", TEXTS: "texts"}.get(kinds, "what it should")
