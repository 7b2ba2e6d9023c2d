"""How good is vtrefine-diagnose on recordings with known causes? Prints the table of metrics and bars.

The recordings come from tests/diagnose/hidden, which shares no code with the engine. An interrupted run goes
on where it stopped; delete its folder after a change of the engine. Seeds below 1000 are for tuning, reported
figures come from 1000 and above. All sets take about 6600 s of one core:

    python scripts/bench_diagnose.py --first_seed=20000 --naive_every=60 --jobs=22 --minutes=12 \\
        --before=results/diagnosis.json
    python scripts/collect_results.py diagnosis outputs/bench_diagnose/table.md --replace
    make tables
"""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

from runs.sets import add_arguments, run_sets, shuffled

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results import rows as results

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "diagnose"))
cases = importlib.import_module("hidden.cases")
table = importlib.import_module("hidden.table")
QUICK_DIVISOR = 5


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--groups", default=",".join(cases.GROUPS), help="comma-separated: %(default)s")
    parser.add_argument(
        "--per_cell", type=at_least(1), help="sets per cell in place of each group's own count"
    )
    parser.add_argument("--quick", action="store_true", help="about a fifth of the sets")
    parser.add_argument(
        "--first_seed", type=at_least(0), default=cases.REPORT_SEED, help="0 to tune; default %(default)s"
    )
    parser.add_argument(
        "--naive_every",
        type=at_least(0),
        default=12,
        help="run the naive analysts on every n-th set; 0: never",
    )
    parser.add_argument("--only", help="run sets whose name contains this")
    parser.add_argument("--before", type=Path, help="earlier results/diagnosis.json, as a column of table.md")
    add_arguments(parser, ROOT / "outputs" / "bench_diagnose")
    return parser.parse_args()


def chosen(args: argparse.Namespace) -> list[Any]:
    """The sets of this run."""
    found = []
    for name in args.groups.split(","):
        if name not in cases.GROUPS:
            raise ValueError(f"--groups: unknown group {name!r}; valid: {', '.join(cases.GROUPS)}")
        make, count = cases.GROUPS[name]
        count = args.per_cell or (max(1, count // QUICK_DIVISOR) if args.quick else count)
        found += make(count, args.first_seed)
    return shuffled([case for case in found if not args.only or args.only in case.name])


def run(task: tuple[Any, bool]) -> dict[str, Any]:
    """One set."""
    return importlib.import_module("hidden_engine").run_case(*task)


def earlier(path: Path | None) -> dict[str, dict[str, str]]:
    """Commit -> (line -> figures) of an earlier table."""
    found: dict[str, dict[str, str]] = {}
    for row in results.read_rows(path) if path else []:
        if isinstance(row, results.Line):
            found.setdefault(f"at {row.commit}", {})[row.cells[""]] = row.cells["engine"]
    return found


@run_cli
def main() -> None:
    """Run what is missing and print the table."""
    args = arguments()
    wanted, before = chosen(args), earlier(args.before)
    tasks = {
        case.name: (case, case.spec.rig == "4x4" and args.naive_every > 0 and i % args.naive_every == 0)
        for i, case in enumerate(wanted)
    }
    rows = run_sets(run, tasks, args)
    if not rows:
        raise ValueError(f"{args.output_dir}: no results yet; run without --table")
    document = table.document(rows, before)
    (args.output_dir / "table.md").write_text(document + "\n", encoding="utf-8")
    print(table.render(rows), *table.failures(rows), document, sep="\n\n")
    print(f"{len(rows)} of {len(tasks)} sets, {sum(row['total_cpu_s'] for row in rows):.0f} s of one core")


if __name__ == "__main__":
    raise SystemExit(main())
