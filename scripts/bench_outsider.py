"""How good is vtrefine-diagnose on recordings by an author who has not seen it?

The recordings come from tests/diagnose/outsider: presses of a pad, written from the file formats and the
physics alone. 27 % have one cause in its plain form, 27 % one in another form, 12 % two causes, 18 % an
effect outside the catalogue, 16 % nothing (half of these with nasty noise). Seeds up to those that
results/outsider.json names have been looked at. It needs the installed package, this folder and
tests/diagnose beside it; an interrupted run goes on where it stopped, and a change of the engine needs
another folder. 300 sets take about 9000 s of one core:

    python scripts/bench_outsider.py --first_seed=11500 --sets=300
    python scripts/collect_results.py outsider outputs/bench_outsider/table.md --replace
    make tables
"""

import argparse
import importlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from runs.sets import Row, add_arguments, run_sets

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "diagnose"))
CLEAR, FAINT = 0.15, 0.05
"""Achievable gains from which on a hidden effect counts as clear, and as faint; below, it is not there."""
Says = Callable[[Row], bool]


def run(plan: dict[str, Any]) -> Row:
    """One set's row."""
    from lerobot_vtrefine.diagnose.api import diagnose

    effect = plan["effect"]
    effect = tuple(effect) if isinstance(effect, list) else effect
    with tempfile.TemporaryDirectory() as folder:
        make = importlib.import_module("outsider.gen").make
        truth = make(plan["seed"], plan["kind"], effect, plan["gain"], Path(folder) / plan["name"])
        begin = time.process_time()
        verdict = diagnose(Path(folder) / plan["name"]).verdict
    row: Row = {**plan, "form": truth["form"], "achievable": truth["gain"], "truth": truth["params"]}
    row["note"] = truth["note"]
    row |= {"status": verdict.status, "named": [cause.name for cause in verdict.causes]}
    row |= {"ambiguous": verdict.ambiguous_with, "clue": verdict.unknown.clue}
    row["gain_locked"] = verdict.heldout.gain if verdict.heldout else 0.0
    row["params"] = {
        f"{cause.name}.{name}": [value.value, value.ci95]
        for cause in verdict.causes
        for name, value in cause.params.items()
    }
    return row | {"cpu_s": round(time.process_time() - begin, 1)}


def hidden(row: Row) -> set[str]:
    """What acts."""
    effect = row["effect"]
    return set() if effect is None else {effect} if isinstance(effect, str) else set(effect)


def exact(row: Row) -> bool:
    """Whether the verdict is what its author would say."""
    if row["kind"] == "outside":
        return row["status"] == "unexplained"
    if not hidden(row):
        return row["status"] == "adequate"
    return row["status"] == "explained" and set(row["named"]) == hidden(row)


def first_right(row: Row) -> bool:
    """Whether the name that takes away most is one that acts."""
    return bool(row["named"]) and row["named"][0] in hidden(row)


def wrong(row: Row) -> bool:
    """Whether a name that does not act was told first, with confidence: without saying that one that does may
    stand in its place."""
    said = (
        {row["named"][0], *(name for group in row["ambiguous"] for name in group)} if row["named"] else set()
    )
    return row["status"] in ("explained", "ambiguous") and bool(said) and not said & hidden(row)


def document(rows: list[Row]) -> str:
    """The documents' table in Markdown."""
    share = importlib.import_module("hidden.table").share

    def of(*kinds: str, least: float = CLEAR, most: float = 1.0) -> list[Row]:
        return [row for row in rows if row["kind"] in kinds and least <= row["achievable"] < most]

    def line(words: str, bar: str, some: list[Row], says: Says) -> list[str]:
        count, text = share(some, says)
        return [words, str(count), text, bar]

    # Of two causes the generator notes where one is worth less than .03: then either answer is right.
    pairs = [row for row in of("pair") if "hardly matters" not in row.get("note", "")]
    sound = [row for row in rows if row["kind"] in ("clean", "nasty")]
    body = [
        ["", "sets", "engine", "bar"],
        line("one cause in its plain form: exact verdict", ".95", of("single"), exact),
        line("the same, achievable gain .05 to .15", "", of("single", least=FAINT, most=CLEAR), exact),
        line("one cause in another form: exact verdict", "", of("other"), exact),
        line("one cause in another form: right name first", ".97", of("other"), first_right),
        line("one cause: wrong name first", ".02", of("single", "other"), wrong),
        line("two causes that matter: exact verdict", ".90", pairs, exact),
        line("an effect outside the catalogue: said to be unknown", ".95", of("outside"), exact),
        line("an effect outside the catalogue: misnamed", ".02", of("outside"), wrong),
        line("nothing wrong: false alarm or name", ".03", sound, lambda row: not exact(row)),
        line("more than 60 s of one core", ".01", rows, lambda row: row["cpu_s"] > 60),
    ]
    text = ["| " + " | ".join(cells) + " |" for cells in body]
    return "\n".join([text[0], "|---" * 4 + "|", *text[1:]])


def failures(rows: list[Row]) -> list[str]:
    """One line for every set that was not answered exactly."""
    lines = []
    for row in sorted(rows, key=lambda row: (row["kind"], str(row["effect"]))):
        if not exact(row):
            said = ", ".join(row["named"]) or row["status"]
            said += "".join(f" or {' or '.join(group)}" for group in row["ambiguous"])
            clue = f" ({row['clue']})" if row["clue"] else ""
            form = f"{row['effect']}: {row['form']}, achievable {row['achievable']:.2f}"
            lines.append(f"{row['seed']} {row['kind']} {form} -> {row['status']}: {said}{clue}")
    return lines


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument(
        "--first_seed", type=at_least(0), default=1000, help="default %(default)s, for tuning"
    )
    parser.add_argument("--sets", type=at_least(1), default=60, help="default %(default)s")
    add_arguments(parser, ROOT / "outputs" / "bench_outsider")
    return parser.parse_args()


@run_cli
def main() -> None:
    """Run what is missing and print the table."""
    args = arguments()
    planned = importlib.import_module("outsider.gen").plan(args.first_seed, args.sets)
    rows = run_sets(run, {item["name"]: item for item in planned}, args)
    if not rows:
        raise ValueError(f"{args.output_dir}: no results yet; run without --table")
    text = document(rows)
    (args.output_dir / "table.md").write_text(text + "\n", encoding="utf-8")
    print(*failures(rows), "", text, sep="\n")
    print(f"{len(rows)} of {len(planned)} sets, {sum(row['total_cpu_s'] for row in rows):.0f} s of one core")


if __name__ == "__main__":
    raise SystemExit(main())
