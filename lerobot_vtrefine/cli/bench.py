"""``vtrefine-bench``: measure speed, as ratios within one run so that the machine's load cancels.

examples:
  vtrefine-bench
  vtrefine-bench --plot                        # pressure images of the contact models, and their errors
  vtrefine-bench --device=cuda                 # many worlds on a GPU
  vtrefine-bench --device=cuda --solver='[own, stock]'      # beside mujoco_warp's own step
"""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import draccus

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import OVERWRITE, check_new_file
from lerobot_vtrefine.cli.pipeline.stages import end, last_line, own_sessions
from lerobot_vtrefine.extras import SIMULATOR, require
from lerobot_vtrefine.sim.config import WARP_SOLVERS, WarpConfig
from lerobot_vtrefine.whole_files import write_text
from lerobot_vtrefine.wording import plural

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.benchmark import WorldsRow

# Every module offers run() -> [(what, ratio, explanation)].
PARTS = {
    "tactile": "lerobot_vtrefine.tactile.benchmark",
    "envs": "lerobot_vtrefine.envs.benchmark",
    "dataset": "lerobot_vtrefine.lerobot_compat.benchmark",
    "diagnose": "lerobot_vtrefine.diagnose.pad.benchmark",
    "finetune": "lerobot_vtrefine.finetune.benchmark",
    "drivers": "lerobot_vtrefine.drivers.benchmark",
    "busy": "lerobot_vtrefine.finetune.benchmark_busy",
}

SIMULATED = ("tactile", "envs")
"""Parts that need the simulator."""

SHORTENED: dict[str, dict[str, float]] = {"drivers": {"seconds": 2.0}}
"""Arguments of run() that keep a part within the limit; with --full it gets its own defaults."""

ONE_THREAD = {"diagnose": {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}}
"""Variables of parts that count processor time, to which threads that wait for one another would add."""

CHILD = """
import importlib, json, pathlib, sys
found = importlib.import_module(sys.argv[1]).run(**json.loads(sys.argv[3]))
rows = [(name, float(ratio), text) for name, ratio, text in found]
pathlib.Path(sys.argv[2]).write_text(json.dumps(rows), encoding="utf-8")
"""

PLOT_DIR = Path("outputs/bench")
SWITCHES = ("--full", "--plot")


@dataclass(frozen=True)
class BenchConfig:
    """What to measure and where to write it."""

    parts: tuple[str, ...] = tuple(PARTS)
    """Parts to measure, e.g. '[envs, drivers]'; all by default."""
    limit_s: float = 60.0
    """Seconds that a part may take; a slower one is left out. No limit with --full."""
    full: bool = False
    """Measure at full length what is otherwise shortened to stay within the limit."""
    plot: bool = False
    """Instead, draw the contact models' pressure images beside the exact ones, and a table of errors and
    speeds, into outputs/bench."""
    device: str | None = None
    """Instead, measure worlds of the warp backend on cuda or cpu; on cuda the contact models, too."""
    worlds: tuple[int, ...] = (1, 64, 1024, 4096)
    """Numbers of worlds for --device."""
    solver: tuple[str, ...] = ("own",)
    """Of these worlds: '[own]', '[stock]' (mujoco_warp's own step), or '[own, stock]' to compare the two."""
    steps: int = 40
    """Control steps measured for each number of worlds."""
    json: Path | None = None
    """File for the rows as JSON, beside the table."""
    overwrite: bool = False
    """Replace a file of --json that is there already."""

    def __post_init__(self) -> None:
        unknown = sorted(set(self.parts) - set(PARTS))
        if unknown:
            raise ValueError(f"--parts: unknown {', '.join(unknown)}; choose from {', '.join(PARTS)}")
        for name in ("parts", "solver"):
            if not getattr(self, name):
                raise ValueError(f"--{name} is empty; leave it out for its default")
        if not self.limit_s > 0:
            raise ValueError(f"--limit_s must be above 0, got {self.limit_s}")
        if self.plot and self.device is not None:
            raise ValueError("--plot and --device are two different things to do; give one")
        if self.plot and self.json is not None:
            raise ValueError("--plot has no rows for --json; leave out one of them")
        for solver in self.solver:
            check_choice("--solver", solver, WARP_SOLVERS)
        if min(self.worlds, default=0) < 1:
            raise ValueError(
                f"--worlds must be numbers from 1 on, such as '[1, 64]', got {list(self.worlds)}"
            )


@dataclass(frozen=True)
class Row:
    """One measured ratio (no unit)."""

    part: str
    name: str
    ratio: float
    explanation: str


def measure(parts: Iterable[str], limit_s: float, full: bool = False) -> list[Row]:
    """Measure the parts one after the other, each in a process of its own.

    With ``full`` there is no limit, and parts are as long as they are meant to be. A part without a
    benchmark, one that fails and one that takes longer than ``limit_s`` seconds are each named on one line;
    the others are measured all the same.
    """
    rows = []
    for part in parts:
        print(f"measuring {part} ...", file=sys.stderr, flush=True)
        try:
            rows += measure_part(part, None if full else limit_s, {} if full else SHORTENED.get(part, {}))
        except (ChildProcessError, TimeoutError, ImportError) as error:
            print(f"{part}: {error}", file=sys.stderr, flush=True)
    return rows


def measure_part(part: str, limit_s: float | None, arguments: dict[str, float]) -> list[Row]:
    """The rows of one part, whose run() gets `arguments`.

    Raises:
        ModuleNotFoundError: it has no benchmark.
        MissingExtraError: it needs the simulator, which is not installed.
        TimeoutError: it took too long.
        ChildProcessError: it failed.
    """
    if importlib.util.find_spec(PARTS[part]) is None:
        raise ModuleNotFoundError("no benchmark, skipped")
    if part in SIMULATED:
        require("it", SIMULATOR)
    with tempfile.TemporaryDirectory() as folder:
        result, log = Path(folder) / "rows.json", Path(folder) / "log"
        with log.open("wb") as file, own_sessions(end) as start:
            child = start(
                # Unbuffered, or what it printed before it failed would follow its last words in the log.
                [sys.executable, "-u", "-c", CHILD, PARTS[part], str(result), json.dumps(arguments)],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | ONE_THREAD.get(part, {}),
            )
            try:
                status = child.wait(limit_s)
            except subprocess.TimeoutExpired:
                message = f"not finished after {limit_s:g} s, skipped; --limit_s allows more"
                raise TimeoutError(message) from None
        if status:
            raise ChildProcessError(f"failed with status {status}: {last_line(log)}")
        return [Row(part, *row) for row in json.loads(result.read_text(encoding="utf-8"))]


def table(rows: Sequence[Row]) -> str:
    """The rows as aligned text."""
    width = max((len(row.name) for row in rows), default=0)
    return "\n".join(f"{row.name:<{width}}  {row.ratio:8.2f}  {row.explanation}" for row in rows)


def measure_device(config: BenchConfig, device: str) -> list[Row]:
    """Print a table of the warp backend's worlds for each solver; return the solvers' ratios, and the
    contact models' rows, which need CUDA.
    """
    from lerobot_vtrefine.sim.benchmark import WorldsRow, measure_worlds
    from lerobot_vtrefine.sim.benchmark import table as worlds_table
    from lerobot_vtrefine.tactile.benchmark import run_cuda

    found: dict[str, list[WorldsRow]] = {}
    for solver in config.solver:
        found[solver] = []
        for row in measure_worlds(WarpConfig(device=device, solver=solver), config.worlds, config.steps):
            print(
                f"{plural(row.worlds, 'world')}: {row.worlds / row.mean_s:.4g} steps/s",
                file=sys.stderr,
                flush=True,
            )
            found[solver].append(row)
        print(f"solver {solver}:\n{worlds_table(found[solver])}")
    both = zip(found["own"], found["stock"], strict=True) if len(found) == 2 else ()
    rows = [row for own, stock in both for row in _solver_rows(own, stock)]
    return rows + ([Row("tactile", *row) for row in run_cuda()] if device.startswith("cuda") else [])


def _solver_rows(own: "WorldsRow", stock: "WorldsRow") -> list[Row]:
    """How many times as fast this package's step is as mujoco_warp's: control steps, and physics alone."""
    return [
        Row(
            "solver",
            f"{what} of {plural(own.worlds, 'world')}, stock / own",
            theirs / ours,
            f"{1e3 * ours:.1f} ms against {1e3 * theirs:.1f} ms",
        )
        for what, ours, theirs in (
            ("control step", own.mean_s, stock.mean_s),
            ("physics", own.physics_s, stock.physics_s),
        )
    ]


def plot(folder: Path) -> str:
    """Draw `tactile.png` in the folder; return the table beside it as Markdown, also written there."""
    from lerobot_vtrefine.cli.bench_picture import draw, measure_cases
    from lerobot_vtrefine.cli.bench_picture import table as models_table
    from lerobot_vtrefine.tactile.benchmark import measure_rates

    cases = measure_cases()
    draw(cases, folder / "tactile.png")
    text = models_table(cases, measure_rates())
    (folder / "tactile.md").write_text(text + "\n", encoding="utf-8")
    print(f"{folder / 'tactile.png'} and {folder / 'tactile.md'} written", file=sys.stderr, flush=True)
    return text


@run_cli
def main() -> int:
    """Console entry point; the exit status is 1 when nothing could be measured."""
    arguments = [f"{item}=true" if item in SWITCHES else item for item in sys.argv[1:]]
    config = draccus.parse(BenchConfig, args=arguments)
    if config.json is not None:
        check_new_file("--json", config.json, overwrite=config.overwrite, how=OVERWRITE)
    if config.plot:
        print(plot(PLOT_DIR))
        return 0
    if config.device is not None:
        rows = measure_device(config, config.device)
        print(table(rows))
        found = True
    else:
        rows = measure(config.parts, config.limit_s, config.full)
        print(table(rows))
        found = bool(rows)
    if config.json is not None:
        write_text(config.json, json.dumps([asdict(row) for row in rows], indent=2) + "\n")
    return 0 if found else 1


if __name__ == "__main__":
    raise SystemExit(main())
