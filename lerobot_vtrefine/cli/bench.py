"""``vtrefine-bench``: speed as ratios, each measured within one run so that the machine's load cancels."""

import importlib.util
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import draccus

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.stages import last_line, stop

# Every module offers run() -> [(what, ratio, explanation)].
PARTS = {
    "tactile": "lerobot_vtrefine.tactile.benchmark",
    "envs": "lerobot_vtrefine.envs.benchmark",
    "finetune": "lerobot_vtrefine.finetune.benchmark",
    "drivers": "lerobot_vtrefine.drivers.benchmark",
}

CHILD = """
import importlib, json, pathlib, sys
rows = [(name, float(ratio), text) for name, ratio, text in importlib.import_module(sys.argv[1]).run()]
pathlib.Path(sys.argv[2]).write_text(json.dumps(rows), encoding="utf-8")
"""


@dataclass(frozen=True)
class BenchConfig:
    """What to measure and where to write it."""

    parts: tuple[str, ...] = tuple(PARTS)
    """Parts to measure, of tactile, envs, finetune, drivers."""
    limit_s: float = 60.0
    """Seconds that a part may take; a slower one is left out."""
    json: Path | None = None
    """File for the rows as JSON, beside the table."""

    def __post_init__(self) -> None:
        unknown = sorted(set(self.parts) - set(PARTS))
        if unknown:
            raise ValueError(f"--parts: unknown {', '.join(unknown)}; choose from {', '.join(PARTS)}")
        if not self.limit_s > 0:
            raise ValueError(f"--limit_s must be above 0, got {self.limit_s}")


@dataclass(frozen=True)
class Row:
    """One measured ratio (no unit)."""

    part: str
    name: str
    ratio: float
    explanation: str


def measure(parts: Iterable[str], limit_s: float) -> list[Row]:
    """Measure the parts one after the other, each in a process of its own.

    A part without a benchmark, one that fails and one that takes longer than ``limit_s`` seconds are each
    named on one line; the others are measured all the same.
    """
    rows = []
    for part in parts:
        print(f"measuring {part} ...", file=sys.stderr, flush=True)
        try:
            rows += measure_part(part, limit_s)
        except (ChildProcessError, TimeoutError, ModuleNotFoundError) as error:
            print(f"{part}: {error}", file=sys.stderr, flush=True)
    return rows


def measure_part(part: str, limit_s: float) -> list[Row]:
    """The rows of one part.

    Raises:
        ModuleNotFoundError: it has no benchmark.
        TimeoutError: it took too long.
        ChildProcessError: it failed.
    """
    if importlib.util.find_spec(PARTS[part]) is None:
        raise ModuleNotFoundError("no benchmark, skipped")
    with tempfile.TemporaryDirectory() as folder:
        result, log = Path(folder) / "rows.json", Path(folder) / "log"
        with log.open("wb") as file:
            child = subprocess.Popen(
                [sys.executable, "-c", CHILD, PARTS[part], str(result)],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        try:
            status = child.wait(limit_s)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"not finished after {limit_s:g} s, skipped; --limit_s allows more") from None
        finally:
            if child.poll() is None:
                stop(child)
        if status:
            raise ChildProcessError(f"failed with status {status}: {last_line(log)}")
        return [Row(part, *row) for row in json.loads(result.read_text(encoding="utf-8"))]


def table(rows: Sequence[Row]) -> str:
    """The rows as aligned text."""
    width = max((len(row.name) for row in rows), default=0)
    return "\n".join(f"{row.name:<{width}}  {row.ratio:8.2f}  {row.explanation}" for row in rows)


@run_cli
def main() -> int:
    """Console entry point; the exit status is 1 when nothing could be measured."""
    config = draccus.parse(BenchConfig)
    rows = measure(config.parts, config.limit_s)
    print(table(rows))
    if config.json is not None:
        config.json.parent.mkdir(parents=True, exist_ok=True)
        config.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n", encoding="utf-8")
    return 0 if rows else 1
