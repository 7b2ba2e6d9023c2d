"""How good is vtrefine-diagnose on the third rig? 12 x 32 taxels, 16 presses, jittered clocks.

The recordings come from tests/diagnose/jittered_rig.py: laws in several forms, scaled to an achievable gain.
An interrupted run goes on where it stopped; delete its folder after a change of the engine. It needs the
installed package, this folder and tests/diagnose beside it. Seeds up to those that results/jittered.json
names have been looked at. The 50 sets of a seed have a specimen, a rig and a session each, so that tables may
count them one by one; they take about 1400 s of one core:

    python scripts/bench_jittered.py --seeds=9510:9517 --jobs=16
    python scripts/collect_results.py jittered outputs/bench_jittered/table.md --replace
    make tables
"""

import argparse
import importlib
import re
import sys
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from runs.sets import Row, add_arguments, run_sets, shuffled

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "diagnose"))
jittered_rig = importlib.import_module("jittered_rig")
grading = importlib.import_module("jittered_grading")
CLEAN = "clean"
CLEAN_PER_LAW = 2


def run(task: tuple[str, float, int, int, int]) -> Row:
    """One set's row."""
    from lerobot_vtrefine.diagnose.api import diagnose

    name, gain, seed, rows, cols = task
    rig = jittered_rig.Rig(specimen(name, gain, seed), rows, cols)
    effect = jittered_rig.EFFECTS.get(name)
    effects = [(effect, rig.strength_for(effect, gain))] if effect else []
    recordings = rig.record(effects)
    row: Row = {"law": name, "gain_wanted": gain, "seed": seed, "hz": rig.rate_hz}
    begin = time.process_time()
    try:
        found = diagnose(recordings)
    except Exception as error:
        return row | {"kind": "error", "error": f"{type(error).__name__}: {error}"}
    row["cpu_s"] = round(time.process_time() - begin, 1)
    return row | grading.graded(rig, effects, found)


def specimen(law: str, gain: float, seed: int) -> int:
    """The rig's own seed.

    With one rig for all laws of a seed, gains that by chance followed its session decided about fifty sets.
    """
    place = [CLEAN, *jittered_rig.EFFECTS].index(law)
    return int(np.random.SeedSequence([seed, place, round(100 * gain)]).generate_state(1)[0])


def seed_range(text: str) -> tuple[int, int]:
    """The first seed, and the last one + 1."""
    found = re.fullmatch(r"(\d+):(\d+)", text)
    if not found or int(found[1]) >= int(found[2]):
        raise argparse.ArgumentTypeError(f"give the first and the last + 1, such as 0:2, got {text!r}")
    return int(found[1]), int(found[2])


def pad_size(text: str) -> tuple[int, int]:
    """Rows and columns."""
    found = re.fullmatch(r"([1-9]\d?)x([1-9]\d?)", text)
    if not found:
        raise argparse.ArgumentTypeError(f"give rows and columns, such as 12x32, got {text!r}")
    return int(found[1]), int(found[2])


def gain_list(text: str) -> list[float]:
    """Achievable gains, which are shares."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or not all(0 < gain < 1 for gain in found):
        raise argparse.ArgumentTypeError(f"give numbers between 0 and 1, such as 0.2,0.4, got {text!r}")
    return found


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = CommandParser(description=__doc__)
    laws = [CLEAN, *jittered_rig.EFFECTS]
    parser.add_argument("--laws", default=",".join(laws), help="comma-separated: %(default)s")
    parser.add_argument(
        "--gains", type=gain_list, default="0.2,0.4", help="achievable gains (default %(default)s)"
    )
    parser.add_argument(
        "--seeds", type=seed_range, default="0:2", help="first and last + 1 (default %(default)s, for tuning)"
    )
    parser.add_argument(
        "--pad", type=pad_size, default="12x32", help="rows and columns (default %(default)s)"
    )
    add_arguments(parser, ROOT / "outputs" / "bench_jittered")
    return parser.parse_args()


def chosen(args: argparse.Namespace) -> dict[str, Any]:
    """The sets of this run by their names; clean ones have no gain, and more seeds."""
    first, last = args.seeds
    rows, cols = args.pad
    sets = []
    for law in args.laws.split(","):
        if law != CLEAN and law not in jittered_rig.EFFECTS:
            raise ValueError(f"--laws: unknown {law!r}; valid: {CLEAN}, {', '.join(jittered_rig.EFFECTS)}")
        clean = law == CLEAN
        seeds = range(first, last + (CLEAN_PER_LAW - 1) * (last - first) * clean)
        gains = [0.0] if clean else args.gains
        sets += [(law, gain, seed, rows, cols) for gain, seed in product(gains, seeds)]
    return {
        f"{law}-{gain}-{seed}-{rows}x{cols}": (law, gain, seed, *size)
        for law, gain, seed, *size in shuffled(sets)
    }


@run_cli
def main() -> None:
    """Run what is missing and print the table."""
    args = arguments()
    sets = chosen(args)
    rows = run_sets(run, sets, args)
    if not rows:
        raise ValueError(f"{args.output_dir}: no results yet; run without --table")
    text = grading.document(rows)
    (args.output_dir / "table.md").write_text(text + "\n", encoding="utf-8")
    print(grading.by_law(rows), *grading.failures(rows), "", text, sep="\n")
    print(f"{len(rows)} of {len(sets)} sets, {sum(row['total_cpu_s'] for row in rows):.0f} s of one core")


if __name__ == "__main__":
    raise SystemExit(main())
