"""Damage to recording sets on disk: what loggers, cables and disks do."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

VICTIM = "trial_0003.parquet"


def change(path: Path, edit: Callable[[dict[str, np.ndarray]], None], name: str = VICTIM) -> None:
    """Rewrite one trial; `edit` changes its columns, raw as an (F, N) array, in place."""
    table = pq.read_table(path / name)
    data = {c: np.array(table[c].to_pylist(), dtype=float) for c in table.column_names}
    edit(data)
    arrays = {c: pa.array(list(v) if v.ndim > 1 else v) for c, v in data.items()}
    pq.write_table(pa.table(arrays), path / name)


def shape_of(path: Path) -> tuple[int, int]:
    pad = json.loads((path / "recording.json").read_text(encoding="utf-8"))["pad"]
    return pad["rows"], pad["cols"]


def starts_loaded(path: Path) -> None:
    """The operator pressed record too late: the trial begins in the middle of its first press."""

    def edit(data: dict[str, np.ndarray]) -> None:
        load = data["depth_m"] if "depth_m" in data else data["force_n"] - 1e-9
        first = int(np.flatnonzero(load > 0.6 * load.max())[0])
        for column in data:
            data[column] = data[column][first:]
        data["time_s"] = data["time_s"] - data["time_s"][0]

    change(path, edit)


def duplicated_frames(path: Path) -> None:
    """The logger wrote every third frame twice, time included."""

    def edit(data: dict[str, np.ndarray]) -> None:
        frames = np.arange(len(data["time_s"]))
        repeat = np.sort(np.concatenate([frames, frames[::3]]))
        for column in data:
            data[column] = data[column][repeat]

    change(path, edit)


def clock_back(path: Path) -> None:
    """The host's clock was set back by two seconds in the middle."""

    def edit(data: dict[str, np.ndarray]) -> None:
        data["time_s"][len(data["time_s"]) // 2 :] -= 2.0

    change(path, edit)


def clock_forward(path: Path) -> None:
    """The clock jumped ahead by four seconds while the indenter went on."""

    def edit(data: dict[str, np.ndarray]) -> None:
        data["time_s"][len(data["time_s"]) // 2 :] += 4.0

    change(path, edit)


def missing_frames(path: Path) -> None:
    """Two seconds of frames were lost; the clock went on."""

    def edit(data: dict[str, np.ndarray]) -> None:
        count = len(data["time_s"])
        for column in data:
            data[column] = np.delete(data[column], slice(count // 3, count // 3 + count // 5), axis=0)

    change(path, edit)


def swapped_rows(path: Path) -> None:
    """Two rows of the pad came out of the cable exchanged in one trial."""
    rows, cols = shape_of(path)

    def edit(data: dict[str, np.ndarray]) -> None:
        image = data["raw"].reshape(-1, rows, cols)
        image[:, [rows // 2 - 1, rows // 2]] = image[:, [rows // 2, rows // 2 - 1]]

    change(path, edit)


def mirrored_rows(path: Path) -> None:
    """The cable was plugged in the other way round for one trial."""
    rows, cols = shape_of(path)

    def edit(data: dict[str, np.ndarray]) -> None:
        data["raw"] = data["raw"].reshape(-1, rows, cols)[:, ::-1].reshape(len(data["raw"]), -1)

    change(path, edit)


def not_a_number(path: Path) -> None:
    def edit(data: dict[str, np.ndarray]) -> None:
        data["raw"][40:45, data["raw"].shape[1] // 3] = np.nan

    change(path, edit)


def depth_not_a_number(path: Path) -> None:
    def edit(data: dict[str, np.ndarray]) -> None:
        data["x_m"][30] = np.nan

    change(path, edit)


def saturated_channel(path: Path) -> None:
    """One channel is stuck at full scale in every trial."""
    full = json.loads((path / "recording.json").read_text(encoding="utf-8"))["reading"]["full_scale"]
    rows, cols = shape_of(path)

    def edit(data: dict[str, np.ndarray]) -> None:
        data["raw"][:, (rows // 2) * cols + cols // 2] = full

    for file in sorted(path.glob("trial_*.parquet")):
        change(path, edit, file.name)


def unplugged(path: Path) -> None:
    """All readings of one trial are zero."""

    def edit(data: dict[str, np.ndarray]) -> None:
        data["raw"][:] = 0.0

    change(path, edit)


def missing_column(path: Path) -> None:
    pq.write_table(pq.read_table(path / VICTIM).drop_columns(["x_m"]), path / VICTIM)


def short_rows(path: Path) -> None:
    """Readings of a smaller pad."""

    def edit(data: dict[str, np.ndarray]) -> None:
        data["raw"] = data["raw"][:, :-1]

    change(path, edit)


def ragged_rows(path: Path) -> None:
    table = pq.read_table(path / VICTIM)
    rows = table["raw"].to_pylist()
    rows[17] = rows[17][:-2]
    pq.write_table(table.set_column(table.column_names.index("raw"), "raw", pa.array(rows)), path / VICTIM)


def truncated_file(path: Path) -> None:
    data = (path / VICTIM).read_bytes()
    (path / VICTIM).write_bytes(data[: len(data) // 2])


def empty_trial(path: Path) -> None:
    pq.write_table(pq.read_table(path / VICTIM).slice(0, 0), path / VICTIM)


def missing_file(path: Path) -> None:
    (path / VICTIM).unlink()


def broken_json(path: Path) -> None:
    text = (path / "recording.json").read_text(encoding="utf-8")
    (path / "recording.json").write_text(text[: len(text) // 2], encoding="utf-8")


def wrong_schema(path: Path) -> None:
    text = (path / "recording.json").read_text(encoding="utf-8")
    (path / "recording.json").write_text(text.replace("recording-set@1", "recording-set@9"), encoding="utf-8")


REPORTED = {
    "starts_loaded": starts_loaded,
    "duplicated_frames": duplicated_frames,
    "clock_back": clock_back,
    "clock_forward": clock_forward,
    "missing_frames": missing_frames,
    "swapped_rows": swapped_rows,
    "mirrored_rows": mirrored_rows,
    "not_a_number": not_a_number,
    "depth_not_a_number": depth_not_a_number,
    "unplugged": unplugged,
    "saturated_channel": saturated_channel,
}
"""Damage that a verdict lists in `data_issues`, naming VICTIM (the channel in every trial apart)."""

REFUSED = {
    "missing_column": missing_column,
    "short_rows": short_rows,
    "ragged_rows": ragged_rows,
    "truncated_file": truncated_file,
    "missing_file": missing_file,
    "broken_json": broken_json,
    "wrong_schema": wrong_schema,
}
"""Damage that ends the command with status 2 and a line that names the file."""

EITHER = {"empty_trial": empty_trial}
"""Refused or set aside: the contract leaves it open."""

CORRUPTIONS = {**REPORTED, **REFUSED, **EITHER}
