"""Readers and schema of files from outside: what they take, and the line in which they refuse the rest."""

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mutants import lying_npy, npy_bytes

from lerobot_vtrefine.files import (
    check_settings,
    decode,
    inside,
    limits,
    read_json,
    read_json_lines,
    read_number_rows,
    read_yaml,
)
from lerobot_vtrefine.files.arrays import NUMBERS, TEXTS, read_arrays
from lerobot_vtrefine.files.tables import read_table


@dataclass(frozen=True)
class Part:
    size_m: float = limits(above=0.0, maximum=1.0)
    count: int = limits(1, 9, default=1)


@dataclass(frozen=True)
class Whole:
    name: str
    kind: Literal["a", "b"] = "a"
    on: bool = False
    pair: tuple[float, float] = (0.0, 0.0)
    parts: tuple[Part, ...] = ()
    by_joint: dict[str, float] = field(default_factory=dict)
    level: float | tuple[float, ...] | None = limits(0.0, default=None)
    anything: Any = None


def test_a_dataclass_is_made_of_plain_data() -> None:
    data = {"name": "x", "pair": [1, 2.5], "parts": [{"size_m": 0.5, "count": 3.0}], "level": [1, 2]}
    made = decode(Whole, data, "file")
    assert made == Whole("x", pair=(1.0, 2.5), parts=(Part(0.5, 3),), level=(1.0, 2.0))
    assert isinstance(made.parts[0].count, int)
    assert decode(Whole, {"name": "x", "more": 1}, "file", others=True) == Whole("x")


def test_notes_of_others_pass_and_slips_of_the_pen_do_not() -> None:
    noted = {"name": "x", "parts": [{"size_m": 1, "maker": "me"}], "rig": {"bench": 3}}
    assert decode(Whole, noted, "file", others=True).parts == (Part(1.0),)
    with pytest.raises(ValueError, match="file has no 'by_joints'; is 'by_joint' meant"):
        decode(Whole, {"name": "x", "by_joints": {}}, "file", others=True)
    both = {"name": "x", "by_joint": {"elbow": 1}, "by_joints": 3}
    assert decode(Whole, both, "file", others=True).by_joint == {"elbow": 1.0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nme": 1}, "file has no 'nme'; valid: name, kind, on"),
        ({"name": 3}, "name must be a text, got 3"),
        ({"kind": "c"}, "kind must be one of a, b, got 'c'"),
        ({"on": 1}, "on must be true or false, got 1"),
        ({"pair": [1]}, "pair must hold 2 values, got 1"),
        ({"pair": [1, float("nan")]}, r"pair\[1\] must be a finite number, got nan"),
        ({"pair": [1, True]}, r"pair\[1\] must be a number, got True"),
        ({"pair": [1, 10**400]}, r"pair\[1\] must be at most 1e\+15, got 1000"),
        ({"parts": [{"count": 1}]}, r"parts\[0\] lacks 'size_m'"),
        ({"parts": [{"size_m": 0}]}, r"parts\[0\].size_m must be above 0, got 0"),
        ({"parts": [{"size_m": 1, "count": 2.5}]}, r"parts\[0\].count must be a whole number, got 2.5"),
        ({"parts": [{"size_m": 1, "count": 10}]}, r"parts\[0\].count must be at most 9, got 10"),
        ({"by_joint": {"elbow": "0.1"}}, "by_joint.elbow must be a number, got '0.1'"),
        ({"level": {}}, "level must be a number or a list or null, got a dict"),
        ({"level": [1, -1]}, r"level\[1\] must not be negative, got -1"),
        ({"name": "x" * 10**6}, "name must not have more than 4096 characters"),
    ],
)
def test_what_is_wrong_is_named(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        decode(Whole, {"name": "x", **change}, "file")
    assert len(str(refused.value)) < 200


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"{", "not valid JSON"),
        (b"\xff\xfe{", "not UTF-8"),
        (b"[" * 10**6, "nested more than 32 levels deep"),
        (b'"' + b'\\"' * 10**6, "not valid JSON"),
        (b'{"a": 1, "a": 2}', "'a' is given twice"),
        (b'{"a": NaN}', "NaN is not a finite number"),
        (b'{"a": 1e999}', "1e999 is not a finite number"),
        (b"9" * 1000, "too large a number"),
        (b" " * (9 << 20), "larger than the 8,388,608 bytes"),
    ],
)
def test_json_has_bounds(tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(text)
    with pytest.raises(ValueError, match=message) as refused:
        read_json(path)
    assert str(refused.value).startswith(str(path))


def test_a_byte_order_mark_is_no_fault_and_a_device_is(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_bytes(b"\xef\xbb\xbf" + json.dumps({"a": ["}", '"']}).encode())
    assert read_json(tmp_path / "x.json") == {"a": ["}", '"']}
    with pytest.raises(ValueError, match="not a regular file"):
        read_json("/dev/zero")
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "nowhere.json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &x [1, 2]\nb: *x", "aliases"),
        ("a: !!python/object/apply:os.system [true]", "tags"),
        ("a: 1\na: 2", "'a' is given twice"),
        ("[" * 60_000, "nested more than 32 levels deep"),
        ("a: 2001-99-99", "month must be in 1..12"),
        ("? [1]\n: 2", "a key must be a word"),
        ("a: [", "in line 1"),
        ("a" * 70_000, "larger than the 65,536 bytes"),
    ],
)
def test_yaml_is_plain(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as refused:
        read_yaml(path)
    assert "\n" not in str(refused.value)


def test_settings_may_share_values_but_not_explode(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("a: &x {b: 1}\nc: *x\nd: !include other.yaml\n")
    check_settings(path)
    for text, message in (
        ("a: &x [1]\nb: &y [*x, *x]\nc: [*y, *y]", "within the value of another"),
        ("- 1", "must hold settings by name"),
        ("a: {" * 100, "nested more than 32"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            check_settings(path)


def test_lines_are_named(tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    path.write_text('{"a": 1}\n\n{"a": 2')
    with pytest.raises(ValueError, match=r"x\.jsonl, line 3: not valid JSON"):
        read_json_lines(path)
    path.write_text("a,b\n1,\n2,x\n")
    with pytest.raises(ValueError, match=r"x\.jsonl, line 3: could not convert"):
        read_number_rows(path)
    path.write_text("a,b\n1,\n2,3\n")
    assert read_number_rows(path) == [{"a": 1.0}, {"a": 2.0, "b": 3.0}]


def test_names_stay_in_their_folder(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (tmp_path / "outside").write_text("x")
    (folder / "link").symlink_to(tmp_path / "outside")
    assert inside(folder, "a/b.parquet") == folder / "a" / "b.parquet"
    for name in ("../outside", "/etc/passwd", "link", "a/../../outside"):
        with pytest.raises(ValueError, match="lies outside of the folder"):
            inside(folder, name)
    for name in ("", "a\0b"):
        with pytest.raises(ValueError, match="is not a file's name"):
            inside(folder, name)


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<i2", "|u1", "<f2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_come_as_numpy_wrote_them(tmp_path: Path, dtype: str, order: Literal["C", "F"]) -> None:
    values = np.arange(24).reshape(2, 3, 4).astype(dtype, order=order)
    np.savez_compressed(
        tmp_path / "x.npz", a=values, scalar=np.float32(3), none=values[:0], t=np.array(["ab"])
    )
    found = read_arrays(tmp_path / "x.npz", NUMBERS + TEXTS)
    np.testing.assert_array_equal(found["a"], values)
    assert found["scalar"].shape == ()
    assert found["none"].shape == (0, 3, 4)
    assert found["t"].tolist() == ["ab"]
    np.save(tmp_path / "y.npy", values)
    np.testing.assert_array_equal(read_arrays(tmp_path / "y.npy", NUMBERS)["array"], values)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (npy_bytes(np.array([{}], dtype=object), pickled=True), "no plain numbers or texts"),
        (npy_bytes(np.zeros(2, dtype=[("a", "f4")])), "no plain numbers or texts"),
        (npy_bytes(np.array(["x"])), "holds str32, not numbers"),
        (npy_bytes(np.zeros(2, complex)), "holds complex128, not numbers"),
        (lying_npy("(1000000000000, 1000)"), r"should be \(1000000000000, 1000\) float32, but has 64 bytes"),
        (lying_npy(f"({10**60}, 0)", body=b""), "Maximum allowed dimension|array is too big|too large"),
        (b"x" * 100, "is no .npy"),
    ],
)
def test_arrays_that_lie_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("a.npy", data)
    with pytest.raises(ValueError, match=message) as refused:
        read_arrays(tmp_path / "x.npz", {"a": NUMBERS})
    assert str(refused.value).startswith(str(tmp_path / "x.npz"))


def test_tables_that_explode_are_refused(tmp_path: Path) -> None:
    zeros = pa.array(np.zeros(30_000_000))
    pq.write_table(pa.table({"a": zeros, "observation.tactile.b": zeros}), tmp_path / "x.parquet")
    assert (tmp_path / "x.parquet").stat().st_size < 2_000_000
    with pytest.raises(ValueError, match="30,000,000 rows"):
        read_table(tmp_path / "x.parquet")
    assert read_table(tmp_path / "x.parquet", ["a"]).num_rows == 30_000_000


LONG = b"x" * 200_000


@pytest.mark.parametrize(
    "value", [LONG, {"bytes": LONG, "path": "a"}, [LONG, None]], ids=["text", "image", "texts"]
)
def test_a_long_text_that_a_dictionary_repeats_counts_as_often(value: object, tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    with pq.ParquetWriter(path, pa.table({"observation.task": [value]}).schema) as writer:
        for _ in range(5):
            writer.write_table(pa.table({"observation.task": [value] * 500}))
    assert path.stat().st_size < 200_000
    with pytest.raises(ValueError, match=r"2,500 rows of 500,[0-9,]+ bytes or more are too many"):
        read_table(path)


def test_many_texts_of_which_a_few_repeat_are_read(tmp_path: Path) -> None:
    texts = [f"{number % 5_000:0100d}" for number in range(10_000)]
    pq.write_table(pa.table({"observation.task": texts}), tmp_path / "x.parquet")
    assert read_table(tmp_path / "x.parquet")["observation.task"].to_pylist() == texts


def test_lists_of_fixed_length_take_room_where_they_are_null(tmp_path: Path) -> None:
    nothing = pa.nulls(100, pa.list_(pa.uint8(), 5_000_000))
    pq.write_table(pa.table({"observation.tactile.left": nothing}), tmp_path / "x.parquet")
    with pytest.raises(ValueError, match="100 rows of 500,000,000 bytes"):
        read_table(tmp_path / "x.parquet")


def test_quiet_pads_of_a_long_recording_are_read(tmp_path: Path) -> None:
    """Eight columns of counts: at eight bytes a value they would be 418 MB, more than the bound."""
    path = tmp_path / "x.parquet"
    quiet = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(17_000 * 384, np.uint8)), 384)
    names = [
        f"observation.{kind}.{pad}"
        for kind in ("tactile", "tactile_baseline")
        for pad in ("a", "b", "c", "d")
    ]
    pq.write_table(pa.table(dict.fromkeys(names, quiet)), path)
    assert path.stat().st_size < 1_000_000
    assert read_table(path).column_names == names
