"""A kind of file or flags that commands take from outside, and ways to damage a sound one."""

import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mutants
import pyarrow.parquet as pq


@dataclass(frozen=True)
class Kind:
    """One kind of input.

    `sound` fills a folder; `mutate` damages it, or makes a damaged file from nothing, and says how; `command`
    runs on it and returns a status.
    """

    name: str
    sound: Callable[[Path], None] | None
    mutate: Callable[[Path, random.Random], str]
    command: Callable[[Path], int | None]
    share: int = 1
    """How many mutants in comparison to other kinds."""
    prepare: Callable[[], None] | None = None
    """Imports what the command imports on its way, once and before children are forked."""


def of_json(file: str) -> Callable[[Path, random.Random], str]:
    def mutate(folder: Path, rng: random.Random) -> str:
        content = json.loads((folder / file).read_text())
        return mutants.written(folder / file, mutants.json_mutant(rng, content))

    return mutate


def of_table(*files: str) -> Callable[[Path, random.Random], str]:
    def mutate(folder: Path, rng: random.Random) -> str:
        path = folder / rng.choice(files)
        return f"{path.name}: {mutants.written(path, mutants.table_mutant(rng, pq.read_table(path)))}"

    return mutate


def either(*ways: Callable[[Path, random.Random], str]) -> Callable[[Path, random.Random], str]:
    return lambda folder, rng: rng.choice(ways)(folder, rng)


def dump(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
