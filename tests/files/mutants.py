"""Damage to files, by format: seeded generators that turn a sound file into mutants of it."""

import copy
import io
import json
import random
import zipfile
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

Damage = tuple[str, bytes]
"""What was done, and the damaged file."""

JUNK: dict[str, Any] = {
    "a text": "many",
    "a number as text": "1.5",
    "no text": "",
    "a mapping": {"a": 1},
    "a list": [1, 2],
    "no list": [],
    "nested lists": [[1, 2], [3]],
    "null": None,
    "true": True,
    "nan": float("nan"),
    "infinity": float("inf"),
    "minus infinity": float("-inf"),
    "negative": -1,
    "zero": 0,
    "a half": 0.5,
    "huge": 1e300,
    "a huge whole number": 10**400,
    "tiny": 1e-300,
    "overflowing": "@1e999@",
    "a long text": "x" * 100_000,
    "a deep list": "@deep@",
    "path upwards": "../../../../etc/passwd",
    "an absolute path": "/etc/passwd",
    "a device": "/dev/zero",
    "a NUL": "a\0b",
    "a surrogate": "\ud800",
    "an escape": "\x1b[31mred\nline",
}
DEEP = 30_000


def json_text(content: Any) -> bytes:
    text = json.dumps(content)
    text = text.replace('"@1e999@"', "1e999").replace('"@deep@"', "[" * DEEP + "]" * DEEP)
    return text.encode()


def yaml_text(content: Any) -> bytes:
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=False)
    return text.replace("'@1e999@'", "1e999").replace("'@deep@'", "[" * 5000 + "]" * 5000).encode()


def places(content: Any, path: tuple = ()) -> Iterator[tuple]:
    """Paths of all values within nested containers."""
    if isinstance(content, dict | list):
        items = content.items() if isinstance(content, dict) else enumerate(content)
        for key, value in items:
            yield (*path, key)
            yield from places(value, (*path, key))


def _parent(content: Any, path: tuple) -> Any:
    for key in path[:-1]:
        content = content[key]
    return content


def changed(rng: random.Random, content: Any) -> tuple[str, Any]:
    """One value, key or item of a nested structure changed."""
    content = copy.deepcopy(content)
    spots = list(places(content))
    path = rng.choice(spots)
    holder, key = _parent(content, path), path[-1]
    where = ".".join(map(str, path))
    action = rng.choice(["junk"] * 7 + ["missing", "extra", "typo", "longer", "shorter"])
    if action == "junk":
        name = rng.choice(list(JUNK))
        holder[key] = JUNK[name]
        return f"{where} = {name}", content
    if action == "missing":
        del holder[key]
        return f"{where} missing", content
    if isinstance(holder, dict) and action in ("extra", "typo"):
        if action == "extra":
            holder["unheard_of"] = 1
            return f"{where}: extra field", content
        holder[f"{key}s"] = holder.pop(key)
        return f"{where}: typo", content
    value = holder[key]
    if isinstance(value, list) and value:
        holder[key] = value + value if action == "longer" else value[:-1]
        return f"{where}: {action} list", content
    holder[key] = [value]
    return f"{where} in a list", content


def damaged_bytes(rng: random.Random, data: bytes) -> Damage:
    """Damage that knows nothing of the format."""
    noise = bytes(rng.randrange(256) for _ in range(300))
    at = rng.randrange(max(1, len(data)))
    ways: list[tuple[str, Callable[[], bytes]]] = [
        ("empty", lambda: b""),
        ("blank", lambda: b" \n\n"),
        ("cut", lambda: data[:at]),
        ("noise", lambda: noise),
        ("noise in the middle", lambda: data[:at] + noise[:20] + data[at:]),
        ("a byte changed", lambda: data[:at] + noise[:1] + data[at + 1 :]),
        ("UTF-16", lambda: data.decode("latin-1").encode("utf-16")),
        ("not UTF-8", lambda: data[:at] + b"\xff\xfe\xc0" + data[at:]),
        ("byte order mark", lambda: b"\xef\xbb\xbf" + data),
        ("twice", lambda: data + data),
        ("trailing garbage", lambda: data + b"}]%"),
        ("10 MB of text", lambda: b'"' + b"x" * 10_000_000 + b'"'),
        ("30 MB of blanks", lambda: data + b" " * 30_000_000),
        ("NUL bytes", lambda: data.replace(b":", b":\0")),
    ]
    name, way = rng.choice(ways)
    return name, way()


def json_mutant(rng: random.Random, content: Any) -> Damage:
    if rng.random() < 0.75:
        name, found = changed(rng, content)
        return name, json_text(found)
    text = json_text(content)
    first = next(iter(content)) if isinstance(content, dict) else "a"
    special = {
        "a list": b"[]",
        "a text": b'"x"',
        "null": b"null",
        "NaN": b"NaN",
        "deep lists": b"[" * 200_000,
        "deep mappings": b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
        "unclosed quotes": b'"' + b'\\"' * 500_000,
        "a key twice": text[:-1] + b', "%s": 1}' % str(first).encode(),
        "a million items": b"[" + b"{}," * 1_000_000 + b"0]",
        "a million digits": b"[" + b"9" * 1_000_000 + b"]",
        "single quotes": text.replace(b'"', b"'"),
        "a comma too many": text[:-1] + b",}",
    }
    if rng.random() < 0.5:
        name = rng.choice(list(special))
        return name, special[name]
    return damaged_bytes(rng, text)


def yaml_mutant(rng: random.Random, content: Any) -> Damage:
    if rng.random() < 0.65:
        name, found = changed(rng, content)
        return name, yaml_text(found)
    text = yaml_text(content)
    bomb = b"a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + b"".join(
        b"a%d: &a%d [%s]\n" % (n, n, b", ".join([b"*a%d" % (n - 1)] * 9)) for n in range(1, 10)
    )
    merges = b"a0: &a0 {x: 1}\n" + b"".join(
        b"a%d: &a%d {<<: [%s]}\n" % (n, n, b", ".join([b"*a%d" % (n - 1)] * 9)) for n in range(1, 9)
    )
    special = {
        "expanding aliases": bomb
        + text.replace(text[: text.index(b":") + 1], text[: text.index(b":") + 1] + b" *a9\nothers:", 1),
        "expanding merges": merges + text,
        "an alias of itself": b"&a [*a]",
        "deep lists": b"[" * 60_000,
        "deep mappings": b"{a: " * 20_000,
        "deep blocks": b"".join(b" " * n + b"-\n" for n in range(600)),
        "a tag that runs code": b'!!python/object/apply:os.system ["true"]',
        "a tag of another type": text.replace(b": ", b": !!timestamp ", 1),
        "a broken date": text + b"\nday: 2001-99-99\n",
        "a key twice": text + text,
        "a list as key": b"? [1, 2]\n: 3\n",
        "two documents": text + b"\n---\n" + text,
        "tabs": text.replace(b"  ", b"\t"),
        "a million digits": b"pads: " + b"9" * 60_000,
        "sixty": b"pads: " + b"1:" * 20_000 + b"1",
        "quotes open": text + b'\n"' + b"\\x" * 20_000,
    }
    if rng.random() < 0.6:
        name = rng.choice(list(special))
        return name, special[name]
    return damaged_bytes(rng, text)


def lines_mutant(rng: random.Random, rows: list[Any]) -> Damage:
    """JSON lines with one of them damaged."""
    lines = [json.dumps(row).encode() for row in rows]
    at = rng.randrange(len(lines))
    name, lines[at] = json_mutant(rng, rows[at])
    return f"line {at}: {name}", b"\n".join(lines)


def csv_mutant(rng: random.Random, text: str) -> Damage:
    rows = [line.split(",") for line in text.splitlines()]
    if rng.random() < 0.7:
        row = rng.choice(rows)
        name = rng.choice(list(JUNK))
        row[rng.randrange(len(row))] = str(JUNK[name])
        return name, "\n".join(map(",".join, rows)).encode("utf-8", "surrogatepass")
    special = {
        "quotes open": text.encode() + b'"' + b"x" * 1_000_000,
        "more cells": text.encode() + b"," * 1000,
        "fewer cells": text.encode() + b"1\n",
        "a name twice": text.replace("loss", "iteration").encode(),
    }
    if rng.random() < 0.4:
        name = rng.choice(list(special))
        return name, special[name]
    return damaged_bytes(rng, text.encode())


def npy_bytes(array: np.ndarray, pickled: bool = False) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, array, allow_pickle=pickled)
    return out.getvalue()


def lying_npy(shape: str, descr: str = "<f4", body: bytes = b"\0" * 64) -> bytes:
    """A .npy whose header claims what it likes."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + body


def _odd_array(rng: random.Random, array: np.ndarray) -> tuple[str, bytes]:
    kind = array.dtype.kind

    def put(value: Any, dtype: Any = None) -> np.ndarray:
        out = array.astype(dtype or array.dtype)
        if out.size:
            out.flat[rng.randrange(out.size)] = value
        return out

    floats = kind == "f"
    ways: dict[str, Callable[[], bytes]] = {
        "objects": lambda: npy_bytes(np.array([{"a": 1}, None], dtype=object), pickled=True),
        "texts": lambda: npy_bytes(array.astype(str)),
        "bytes": lambda: npy_bytes(array.astype("S8")),
        "structured": lambda: npy_bytes(np.zeros(array.shape, dtype=[("a", "f4"), ("b", "i4")])),
        "complex": lambda: npy_bytes(np.zeros(array.shape, complex)),
        "booleans": lambda: npy_bytes(np.ones(array.shape, bool)),
        "dates": lambda: npy_bytes(np.zeros(array.shape, "datetime64[s]")),
        "floats": lambda: npy_bytes(put(2.5, float) if kind != "U" else np.zeros(3)),
        "nan": lambda: npy_bytes(put(np.nan, float) if kind != "U" else np.zeros(0)),
        "infinite": lambda: npy_bytes(put(np.inf, float) if kind != "U" else np.zeros((0, 3))),
        "huge": lambda: npy_bytes(put(1e300, float) if floats else put(array.flat[0])),
        "huge counts": lambda: npy_bytes(np.array([2**62, 2**62, 2**62])),
        "unsigned": lambda: npy_bytes(np.zeros(array.shape, np.uint64) + np.uint64(2**63)),
        "negative": lambda: npy_bytes(put(-1, np.int64) if kind in "iu" else np.zeros(array.shape) - 1),
        "longer": lambda: npy_bytes(np.concatenate([array, array])),
        "shorter": lambda: npy_bytes(array[:-1]),
        "flat": lambda: npy_bytes(array.ravel()),
        "one more axis": lambda: npy_bytes(array[None]),
        "a number": lambda: npy_bytes(np.asarray(array.flat[0])),
        "empty": lambda: npy_bytes(array[:0]),
        "Fortran order": lambda: npy_bytes(np.asfortranarray(array)),
        "other byte order": lambda: npy_bytes(array.astype(array.dtype.newbyteorder(">"))),
        "half precision": lambda: npy_bytes(array.astype(np.float16) if floats else array),
        "petabytes": lambda: lying_npy("(1000000000000, 1000)"),
        "terabytes of nothing": lambda: lying_npy("(1000000000000, 0)"),
        "empty texts": lambda: lying_npy("(10000000000000,)", "<U0"),
        "more axes than there are": lambda: lying_npy("(" + "1," * 200 + ")"),
        "a shape beyond all numbers": lambda: lying_npy(f"({10**60},)"),
        "a negative shape": lambda: lying_npy("(-1, 16)"),
        "deep header": lambda: lying_npy("(" * 3000 + ")" * 3000),
        "code in the header": lambda: lying_npy("__import__('os').getpid()"),
        "noise": lambda: bytes(rng.randrange(256) for _ in range(200)),
        "cut": lambda: npy_bytes(array)[:-7],
        "version 9": lambda: npy_bytes(array).replace(b"NUMPY\x01", b"NUMPY\x09"),
    }
    name = rng.choice(list(ways))
    return name, ways[name]()


def npz_mutant(rng: random.Random, arrays: dict[str, np.ndarray]) -> Damage:
    members = {f"{name}.npy": npy_bytes(array) for name, array in arrays.items()}
    method, note = zipfile.ZIP_STORED, ""
    draw = rng.random()
    if draw < 0.7:
        name = rng.choice(list(arrays))
        what, members[f"{name}.npy"] = _odd_array(rng, arrays[name])
        note = f"{name}: {what}"
    elif draw < 0.85:
        name = rng.choice(list(members))
        note, method = rng.choice(
            [(f"{name} missing", 0), (f"{name} renamed", 0), ("zip bomb", zipfile.ZIP_DEFLATED), ("extra", 0)]
        )
        if "bomb" in note:
            members[name] = lying_npy("(500000000,)", body=b"\0" * 400_000_000)
        elif note == "extra":
            members["more.npy"] = npy_bytes(np.array([{}], dtype=object), pickled=True)
        else:
            data = members.pop(name)
            members |= {f"../{name}": data} if "renamed" in note else {}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method, compresslevel=1) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    data = out.getvalue()
    return (note, data) if note else damaged_bytes(rng, data)


def npy_mutant(rng: random.Random, array: np.ndarray) -> Damage:
    return _odd_array(rng, array) if rng.random() < 0.8 else damaged_bytes(rng, npy_bytes(array))


def table_mutant(rng: random.Random, table: pa.Table) -> Damage:
    """A Parquet file with a column changed, or broken as bytes."""
    if rng.random() < 0.3:
        return damaged_bytes(rng, parquet_bytes(table))
    name = rng.choice(table.column_names)
    at, rows, column = table.column_names.index(name), table.num_rows, table[name]

    def with_column(values: Any) -> bytes:
        return parquet_bytes(table.set_column(at, name, values))

    values = column.to_pylist()

    def put(value: Any) -> bytes:
        changed_values = copy.deepcopy(values)
        spot = rng.randrange(rows)
        if isinstance(changed_values[spot], list):
            inner = changed_values[spot]
            while isinstance(inner[0], list):
                inner = inner[0]
            inner[rng.randrange(len(inner))] = value
        else:
            changed_values[spot] = value
        return with_column(pa.array(changed_values))

    ways: dict[str, Callable[[], bytes]] = {
        "missing": lambda: parquet_bytes(table.drop_columns([name])),
        "twice": lambda: parquet_bytes(table.append_column(name, column)),
        "texts": lambda: with_column(pa.array(["x"] * rows)),
        "numbers as texts": lambda: with_column(pa.array(["1.5"] * rows)),
        "booleans": lambda: with_column(pa.array([True] * rows)),
        "bytes": lambda: with_column(pa.array([b"x"] * rows)),
        "structs": lambda: with_column(pa.array([{"a": 1}] * rows)),
        "lists of texts": lambda: with_column(pa.array([["a", "b"]] * rows)),
        "deep lists": lambda: with_column(pa.array([[[[1.0]]]] * rows)),
        "empty lists": lambda: with_column(pa.array([[]] * rows, pa.list_(pa.float64()))),
        "null": lambda: with_column(pa.nulls(rows)),
        "nulls": lambda: with_column(pa.array([None, *values[1:]], column.type)),
        "categories": lambda: with_column(pa.array(["a"] * rows).dictionary_encode()),
        "dates": lambda: with_column(pa.array([0] * rows, pa.timestamp("s"))),
        "large whole numbers": lambda: with_column(pa.array([2**62 + 1] * rows)),
        "numbers": lambda: with_column(pa.array([0.5] * rows)),
        "nan": lambda: put(float("nan")),
        "infinite": lambda: put(float("inf")),
        "huge": lambda: put(1e300),
        "negative": lambda: put(-1.0),
        "no rows": lambda: parquet_bytes(table.slice(0, 0)),
        "one row": lambda: parquet_bytes(table.slice(0, 1)),
        "rows reversed": lambda: parquet_bytes(table.take(list(range(rows))[::-1])),
        "half precision": lambda: with_column(pa.array(np.zeros(rows, np.float16))),
        "decimals": lambda: with_column(pa.array([1] * rows, pa.int64()).cast(pa.decimal128(30, 2))),
        "an odd name": lambda: parquet_bytes(table.rename_columns({name: "a\n\0\x1b"})),
        "a bomb": lambda: _bomb(tuple(table.column_names)),
    }
    way = rng.choice(list(ways))
    try:
        return f"{name}: {way}", ways[way]()
    except (pa.ArrowException, TypeError):  # this column cannot be damaged so
        return f"{name}: missing", ways["missing"]()


@lru_cache(maxsize=8)
def _bomb(names: tuple[str, ...]) -> bytes:
    """Many rows of zeros, which take few bytes."""
    zeros = pa.array(np.zeros(60_000_000 // len(names)))
    return parquet_bytes(pa.table(dict.fromkeys(names, zeros)))


def parquet_bytes(table: pa.Table) -> bytes:
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


def written(path: Path, damage: Damage) -> str:
    path.write_bytes(damage[1])
    return damage[0]
