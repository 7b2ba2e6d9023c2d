"""Rows of ``results/*.json``: what a row holds, checked where it is read and where it is made.

A file is ``{"rows": [...]}``. A row of a table of runs is a `Run`; one of a benchmark's table, a `Line`.
"""

import json
import re
from collections.abc import Iterable
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, get_type_hints

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.whole_files import write_text

COMMIT = re.compile(r"[0-9a-f]{7,40}\+?")
IMITATION, SCRATCH, TUNED = "imitation", "without pre-training", ""
"""Variants of a run: not fine-tuned, fine-tuned from random weights, fine-tuned from imitation."""

Progress = list[dict[str, float]]
"""A run's learning curve: what each iteration logged."""


@dataclass(frozen=True)
class Row:
    """What every row holds. What was not recorded is None (null in the file), never a guess."""

    TABLES: ClassVar[tuple[str, ...]] = ()

    table: str
    commit: str | None
    """Of the code that was run; ``+`` where files differed from it."""
    command: str | None
    machine: str | None
    """Cores and GPUs, for example ``16 cores, 1 x NVIDIA H200``."""

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self)).items():
            if name in ("TABLES", "extra", "cells"):
                continue
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, kind | int if kind is float else kind):
                raise ValueError(f"{name} must be {_words(kind)}, got {value!r}")
        check_choice("table", self.table, self.TABLES)
        if self.commit is not None and not COMMIT.fullmatch(self.commit):
            raise ValueError(f"commit must be a hash, got {self.commit!r}")

    @property
    def key(self) -> tuple[Any, ...]:
        """What a later row replaces."""
        raise NotImplementedError


def _words(kind: Any) -> str:
    """A type in plain words."""
    words = {str: "text", int: "a whole number", float: "a number", type(None): "null"}
    return " or ".join(words[part] for part in getattr(kind, "__args__", (kind,)))


@dataclass(frozen=True, kw_only=True)
class Run(Row):
    """One policy's evaluation."""

    TABLES = (
        "converges",
        "demo",
        "touch",
        "paper",
        "paper_pads",
        "demonstrations",
        "demonstrations_pads",
        "policies",
        "reality",
        "expert",
        "reference",
        "tried",
    )

    task: str
    policy: str
    """``visuo_tactile``, ``visual``, ..."""
    variant: str = TUNED
    """What else tells it from other rows of its task, policy and seed."""
    seed: int | None
    """None: several seeds pooled, whose own figures were not recorded."""
    success: float
    """Share of the episodes."""
    episodes: int
    iterations: int | None
    """Of DPPO; 0: imitation alone."""
    env_steps: int | None
    """That DPPO took."""
    curve: str | None = None
    """Learning curve, a CSV file; relative to the rows' file."""
    extra: dict[str, float | str] = field(default_factory=dict)
    """More that the table shows: numbers (with a point) in SI units, or words."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.success <= 1:
            raise ValueError(f"success must lie in 0..1, got {self.success}")
        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}")
        for name in ("seed", "iterations", "env_steps"):
            if (getattr(self, name) or 0) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        _check_mapping("extra", self.extra, float | str)

    @property
    def key(self) -> tuple[Any, ...]:
        """Table, task, policy, variant, seed."""
        return (self.table, self.task, self.policy, self.variant, self.seed)

    @property
    def successes(self) -> int:
        """Episodes that succeeded."""
        return round(self.success * self.episodes)


@dataclass(frozen=True, kw_only=True)
class Line(Row):
    """One line of a benchmark's table, as the benchmark printed it."""

    TABLES = (
        "diagnosis",
        "information",
        "ingredients",
        "jittered",
        "outsider",
        "reference_hopper",
        "servo",
        "step_mm",
        "step_size",
        "sysid",
        "tactile",
        "timestep",
        "tolerance",
        "touch_inputs",
        "touch_tasks",
        "worlds",
    )

    cells: dict[str, str]
    """Text by column; the first one names the line."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_mapping("cells", self.cells, str)
        if not self.cells:
            raise ValueError("cells must not be empty")

    @property
    def key(self) -> tuple[Any, ...]:
        """Table and the first cell."""
        return (self.table, next(iter(self.cells.values())))


def _check_mapping(name: str, value: Any, kind: Any) -> None:
    if not isinstance(value, dict) or not all(isinstance(item, kind) for item in value.values()):
        raise ValueError(f"{name} must map names to {_words(kind)}, got {value!r}")


def read_rows(path: Path) -> list[Row]:
    """The rows of one file.

    Raises:
        ValueError: something in it is wrong; the message names file, row and field.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: no JSON: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("rows"), list):
        raise ValueError(f'{path}: must be {{"rows": [...]}}')
    rows: dict[tuple[Any, ...], Row] = {}
    curves: set[str] = set()
    for number, data in enumerate(content["rows"], 1):
        try:
            row = _row(data)
            if row.key in rows:
                raise ValueError(f"stands for the same as an earlier one: {row.key}")
            if isinstance(row, Run) and row.curve and not (path.parent / row.curve).is_file():
                raise ValueError(f"curve {row.curve} is not a file")
            if isinstance(row, Run) and row.curve and row.curve in curves:
                raise ValueError(f"curve {row.curve} is an earlier row's")
        except ValueError as error:
            raise ValueError(f"{path}: row {number}: {error}") from error
        rows[row.key] = row
        curves |= {row.curve} if isinstance(row, Run) and row.curve else set()
    return list(rows.values())


def _row(data: Any) -> Row:
    if not isinstance(data, dict):
        raise ValueError(f"must be an object, got {data!r}")
    kind = Line if "cells" in data else Run
    needed = {f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING}
    for words, names in (
        ("lacks", needed - data.keys()),
        ("has unknown", data.keys() - {f.name for f in fields(kind)}),
    ):
        if names:
            raise ValueError(f"{words} {', '.join(sorted(names))}")
    return kind(**data)


def read_all(folder: Path) -> list[Row]:
    """The rows of all files in a folder, each table in one file alone."""
    rows: list[Row] = []
    for path in sorted(folder.glob("*.json")):
        more = read_rows(path)
        twice = {row.table for row in rows} & {row.table for row in more}
        if twice:
            raise ValueError(f"{path}: table {min(twice)} is in another file too")
        rows += more
    return rows


def merge(old: Iterable[Row], new: Iterable[Row]) -> list[Row]:
    """Old rows with new ones in place of those that stand for the same.

    A seed of its own takes the place of a row that pools several.
    """
    fresh = {row.key: row for row in new}
    pooled = {(*row.key[:-1], None) for row in fresh.values() if isinstance(row, Run)}
    kept = {row.key: row for row in old if row.key not in pooled or row.key in fresh}
    return list((kept | fresh).values())


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write a file, one row a line; whole or not at all."""
    lines = []
    for row in rows:
        unset = {f.name: f.default for f in fields(row)} | {"extra": {}}
        shown = {name: value for name, value in asdict(row).items() if value != unset[name]}
        origin = {name: shown.pop(name) for name in ("commit", "command", "machine")}
        lines.append(json.dumps(shown | origin, ensure_ascii=False))
    write_text(path, '{"rows": [\n' + ",\n".join(lines) + "\n]}\n")
