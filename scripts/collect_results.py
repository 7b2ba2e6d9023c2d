"""Turn what runs left into rows of results/*.json, from which ``make tables`` makes the README's tables.

One command replaces a table: --replace drops the earlier rows, of all seeds, of the tasks, policies and
variants that come; without it only rows of the same seed give way:

    python scripts/collect_results.py demo outputs/demo --task=demo --replace
    python scripts/collect_results.py touch outputs/compare_touch/*/*/ --replace
    python scripts/collect_results.py reality outputs/compare_reality --replace
    python scripts/collect_results.py converges outputs/square/*/ --task=square_1mm --replace
    python scripts/collect_results.py tactile outputs/bench/tactile.md --replace
    python scripts/collect_results.py diagnosis outputs/bench_diagnose/table.md --replace
    make tables

A source is the folder of a vtrefine-demo or of a vtrefine-finetune (judged by a lerobot-eval whose
--output_dir was its folder eval/, else by its own last evaluation), that of scripts/compare_reality.py, or,
for tables of benchmarks, a file with the table that was printed. Learning curves come to results/curves/.
Commit, command and machine are those that the run recorded; --commit, --command and --machine say them of
runs that could not (on a machine without git, say). What nobody says is null.
"""

from pathlib import Path

from reality.outcome import reality_rows

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.collect import ORIGIN, origin_of, printed_lines, run_rows
from lerobot_vtrefine.cli.results.rows import Line, Run
from lerobot_vtrefine.cli.results.store import save

RESULTS = Path(__file__).parents[1] / "results"


@run_cli
def main() -> None:
    """Collect every source, then write."""
    parser = CommandParser(description=__doc__)
    tables = [*Run.TABLES, *Line.TABLES]
    parser.add_argument("table", choices=tables, metavar="TABLE", help=f"of {', '.join(tables)}")
    parser.add_argument("sources", type=Path, nargs="+", help="folders of runs, or files with printed tables")
    parser.add_argument("--results", type=Path, help="file (default results/TABLE.json)")
    parser.add_argument(
        "--replace", action="store_true", help="drop earlier rows of these tasks, policies and variants"
    )
    parser.add_argument("--task", help="default: the name of the folder that holds the run's")
    parser.add_argument("--policy", help="visuo_tactile, visual, ...; default: what the run recorded")
    parser.add_argument("--variant", help="what else sets the runs apart, for example '10 demonstrations'")
    for name in ORIGIN:
        parser.add_argument(f"--{name}", help="of runs that did not record it")
    options = parser.parse_args()
    origin = {name: getattr(options, name) for name in ORIGIN}
    given = {name: getattr(options, name) for name in ("policy", "variant") if getattr(options, name)}
    found = []
    for source in options.sources:
        if options.table in Line.TABLES:
            recorded = origin_of(source.parent, **origin)
            found += [(row, []) for row in printed_lines(source, options.table, recorded)]
        elif options.table == "reality":
            found += reality_rows(source, origin_of(source, **origin), options.task)
        else:
            task = options.task or source.resolve().parent.name
            found += run_rows(source, {"table": options.table, "task": task} | given, origin)
    if not found:
        raise ValueError(f"no rows for {options.table} in {', '.join(map(str, options.sources))}")
    path = options.results or RESULTS / f"{options.table}.json"
    save(path, found, replace=options.replace)
    unknown = sum(row.commit is None for row, _ in found)
    print(f"{len(found)} rows in {path}" + (f"; {unknown} without a commit: add --commit" if unknown else ""))


if __name__ == "__main__":
    raise SystemExit(main())
