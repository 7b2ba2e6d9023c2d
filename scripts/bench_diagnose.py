"""How good is vtrefine-diagnose on recordings with known causes? Prints the table of metrics and bars.

The recordings come from tests/diagnose/hidden, which shares no code with the engine. Results are kept per set
in the output folder, so that an interrupted run goes on where it stopped; delete the folder after a change of
the engine. Seeds below 1000 are for tuning, reported figures come from 1000 and above.
"""

import argparse
import importlib
import json
import multiprocessing
import os
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")

import numpy as np
from tqdm import tqdm

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "diagnose"))
cases = importlib.import_module("hidden.cases")
table = importlib.import_module("hidden.table")
QUICK_DIVISOR = 5


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--groups", default=",".join(cases.GROUPS), help="comma-separated: %(default)s")
    parser.add_argument("--per_cell", type=int, help="sets per cell in place of each group's own count")
    parser.add_argument("--quick", action="store_true", help="about a fifth of the sets")
    parser.add_argument(
        "--first_seed", type=int, default=cases.REPORT_SEED, help="0 to tune; default %(default)s"
    )
    parser.add_argument(
        "--naive_every", type=int, default=12, help="run the naive analysts on every n-th set; 0: never"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--output_dir", type=Path, default=ROOT / "outputs" / "bench_diagnose")
    parser.add_argument("--only", help="run sets whose name contains this")
    parser.add_argument("--table", action="store_true", help="print what is there, run nothing")
    return parser.parse_args()


def chosen(args: argparse.Namespace) -> list[Any]:
    """The sets of this run."""
    found = []
    for name in args.groups.split(","):
        if name not in cases.GROUPS:
            sys.exit(f"--groups: unknown group {name!r}; valid: {', '.join(cases.GROUPS)}")
        make, count = cases.GROUPS[name]
        count = args.per_cell or (max(1, count // QUICK_DIVISOR) if args.quick else count)
        found += make(count, args.first_seed)
    found = [case for case in found if not args.only or args.only in case.name]
    # In a fixed random order, so that an interrupted run's table is a fair sample of the whole.
    return [found[i] for i in np.random.default_rng(0).permutation(len(found))]


def run(output_dir: Path, task: tuple[Any, bool]) -> dict[str, Any]:
    """One set, from the cache where it is there."""
    case, naive = task
    path = output_dir / f"{case.name}.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    row = importlib.import_module("hidden_engine").run_case(case, naive)
    scratch = path.with_suffix(".part")
    scratch.write_text(json.dumps(row), encoding="utf-8")
    scratch.replace(path)
    return row


def main() -> None:
    """Run what is missing and print the table."""
    args = arguments()
    args.output_dir.mkdir(parents=True, exist_ok=True)
    wanted = chosen(args)
    naive = [
        case.spec.rig == "4x4" and args.naive_every > 0 and i % args.naive_every == 0
        for i, case in enumerate(wanted)
    ]
    tasks = list(zip(wanted, naive, strict=True))
    if args.table:
        tasks = [task for task in tasks if (args.output_dir / f"{task[0].name}.json").exists()]
    with ExitStack() as stack:
        pool = None
        if args.jobs > 1 and not args.table:
            pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(args.jobs))
        results = (pool.imap_unordered if pool else map)(partial(run, args.output_dir), tasks)
        rows = list(tqdm(results, total=len(tasks), unit="set", disable=args.table))
    if not rows:
        sys.exit(f"{args.output_dir}: no results yet; run without --table")
    print(table.render(rows))
    (args.output_dir / "failures.txt").write_text("\n".join(table.failures(rows)) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
