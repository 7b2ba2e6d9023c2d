"""Puts rows into a results file, and their learning curves beside it; removes what no row names any more."""

import csv
import fcntl
import os
import re
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace as replace_fields
from pathlib import Path

from lerobot_vtrefine.cli.outputs import check_file
from lerobot_vtrefine.cli.results.rows import Progress, Row, Run, merge, read_rows, write_rows

CURVE_COLUMNS = ("iteration", "env_steps", "success", "eval_success", "seconds", "actor_lr", "decision_kl")


def save(path: Path, found: list[tuple[Row, Progress]], *, replace: bool) -> None:
    """Put rows and curves into a results file; ``replace`` drops their groups' earlier rows, of all seeds.

    Curves carry the file's name and lie beside it in ``curves/``; those that no row names any more are
    removed. Processes that end at the same time wait for each other.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with only_one_in(path.parent):
        _save(path, found, replace)


def check_results(flag: str, path: Path) -> None:
    """Raise, before hours of work for a row of it, where `save` could not put one into this file.

    Raises:
        OSError: it cannot be written. ValueError: it holds no rows; names it.
    """
    check_file(flag, path)
    if path.is_file():
        read_rows(path)


@contextmanager
def only_one_in(folder: Path) -> Generator[None]:
    """Wait until no other process is in here for this folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _save(path: Path, found: list[tuple[Row, Progress]], replace: bool) -> None:
    old = read_rows(path) if path.is_file() else []
    rows = []
    for row, progress in found:
        if isinstance(row, Run) and progress:
            label = re.sub(
                r"[^\w.]+", "_", "_".join(filter(None, (row.task, row.policy, row.variant, str(row.seed))))
            )
            row = replace_fields(row, curve=f"curves/{path.stem}-{label}.csv")
            write_curve(path.parent / str(row.curve), progress)
        rows.append(row)
    groups = {row.key[:-1] for row in rows} if replace else set()
    rows = merge([row for row in old if row.key[:-1] not in groups], rows)
    write_rows(path, rows)
    for curve in _curves(path, old) - _curves(path, rows):
        curve.unlink(missing_ok=True)


def _curves(path: Path, rows: list[Row]) -> set[Path]:
    """Curves of a results file's own that rows of it name: those of a copied row stay the other file's."""
    named = {path.parent / row.curve for row in rows if isinstance(row, Run) and row.curve}
    return {curve for curve in named if curve.name.startswith(f"{path.stem}-")}


def write_curve(path: Path, progress: Progress) -> None:
    """The columns of ``progress.csv`` that matter, in four digits."""
    columns = [name for name in CURVE_COLUMNS if any(name in row for row in progress)]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in progress:
            numbers = [row.get(name) for name in columns]
            writer.writerow("" if n is None else str(int(n)) if n == int(n) else f"{n:.4g}" for n in numbers)
