"""``vtrefine-bench``: speed as ratios, each measured within one run so that the machine's load cancels."""

import importlib
import importlib.util
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import draccus

from lerobot_vtrefine.cli.errors import run_cli

# Every module offers run() -> [(what, ratio, explanation)].
PARTS = {
    "tactile": "lerobot_vtrefine.tactile.benchmark",
    "envs": "lerobot_vtrefine.envs.benchmark",
    "finetune": "lerobot_vtrefine.finetune.benchmark",
    "drivers": "lerobot_vtrefine.drivers.benchmark",
}


@dataclass(frozen=True)
class BenchConfig:
    """What to measure and where to write it."""

    parts: tuple[str, ...] = tuple(PARTS)
    """Parts to measure, of tactile, envs, finetune, drivers."""
    json: Path | None = None
    """File for the rows as JSON, beside the table."""

    def __post_init__(self) -> None:
        unknown = sorted(set(self.parts) - set(PARTS))
        if unknown:
            raise ValueError(f"--parts: unknown {', '.join(unknown)}; choose from {', '.join(PARTS)}")


@dataclass(frozen=True)
class Row:
    """One measured ratio (no unit)."""

    part: str
    name: str
    ratio: float
    explanation: str


def load_benchmark(part: str) -> Callable[[], Iterable[Sequence]] | None:
    """The ``run`` function of a part; None while the part has no benchmark."""
    module = PARTS[part]
    if importlib.util.find_spec(module) is None:
        return None
    return importlib.import_module(module).run


def measure(parts: Iterable[str]) -> list[Row]:
    """Measure the parts one after the other; a part without a benchmark is named and skipped."""
    rows = []
    for part in parts:
        benchmark = load_benchmark(part)
        if benchmark is None:
            print(f"{part}: no benchmark, skipped", file=sys.stderr)
            continue
        print(f"measuring {part} ...", file=sys.stderr, flush=True)
        rows += [Row(part, name, float(ratio), explanation) for name, ratio, explanation in benchmark()]
    return rows


def table(rows: Sequence[Row]) -> str:
    """The rows as aligned text."""
    width = max((len(row.name) for row in rows), default=0)
    return "\n".join(f"{row.name:<{width}}  {row.ratio:8.2f}  {row.explanation}" for row in rows)


@run_cli
def main() -> None:
    """Console entry point."""
    config = draccus.parse(BenchConfig)
    rows = measure(config.parts)
    print(table(rows))
    if config.json is not None:
        config.json.parent.mkdir(parents=True, exist_ok=True)
        config.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")
