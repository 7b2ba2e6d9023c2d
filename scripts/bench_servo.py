#!/usr/bin/env python
"""How well are runs at a gain predicted that was never fitted? Prints the table of results/servo.json.

Every setting (gain, supply, load) of a recording set of a servo is left out in turn: the diagnosis, and BAM's
friction models M1 to M6 (arXiv 2410.08650, see bam_ladder.py), are fitted to the other settings and judged on
it. What is done is kept in the output folder, so that an interrupted run goes on where it stopped:

    vtrefine-import --source=bam_xl330.npz --recording_dir=outputs/xl330
    python scripts/bench_servo.py --recording=outputs/xl330
    python scripts/collect_results.py servo outputs/bench_servo/servo.md --replace
"""

import json
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from bam_ladder import LADDER, errors, fit, gridded

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.diagnose.core.engine import infer
from lerobot_vtrefine.diagnose.core.resampling import gain_interval
from lerobot_vtrefine.diagnose.recordings import read_recording_set
from lerobot_vtrefine.diagnose.report.words import title
from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.problem import ServoProblem

ROOT = Path(__file__).parents[1]
Array = np.ndarray


def kept(path: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a file holds; it is made where it is not there."""
    if not path.is_file():
        found = make()
        part = path.with_suffix(".part")
        part.write_text(json.dumps(found), encoding="utf-8")
        part.replace(path)
    return json.loads(path.read_text(encoding="utf-8"))


def diagnosed(whole: ServoProblem, fitted: Array, held: Array, seed: int) -> dict[str, Any]:
    """Names found on some trials, and errors on the others."""
    found = infer(whole.subset(fitted), seed, locking=False)
    part = whole.subset(held)
    test = part.finer() or part
    fits = {"baseline": found.selection.baseline, "engine": found.selection.fit}
    squared = {name: test.errors(item)[:, 0].tolist() for name, item in fits.items()}
    ties = sorted({item.name for item in found.rivals})
    return squared | {"causes": list(found.selection.causes()), "ties": ties}


def ladder(bench: Bench, fitted: Array, held: Array, rung: str, lower: dict[str, Any]) -> dict[str, Any]:
    """One of BAM's models, refitted."""
    logs = gridded(bench)
    theta = fit(logs.of(fitted), rung, {name: np.array(item["theta"]) for name, item in lower.items()})
    return {"theta": theta.tolist(), "errors": errors(logs.of(held), rung, theta).tolist()}


def milliradians(squared: Array) -> str:
    """Root of a mean squared error."""
    return f"{1e3 * float(np.sqrt(np.mean(squared))):.1f}"


def render(found: list[dict[str, Any]], labels: list[str], seed: int) -> str:
    """The table: errors at every setting left out, and the gain over all."""
    base = [np.array(item["diagnosis"]["baseline"]) for item in found]
    rows = [("simulated servo: Coulomb and viscous friction", base)]
    rows.append(("vtrefine-diagnose", [np.array(item["diagnosis"]["engine"]) for item in found]))
    rows += [(f"BAM's {rung}", [np.array(item[rung]["errors"]) for item in found]) for rung in LADDER]
    lines = ["| | " + " | ".join([*labels, "squared error gone"]) + " |", "|---" * (len(labels) + 2) + "|"]
    before = np.concatenate(base)
    for name, squared in rows:
        after = np.concatenate(squared)
        low, high = gain_interval(before, after, seed)
        gone = "-" if squared is base else f"{1 - after.sum() / before.sum():.2f} [{low:.2f}, {high:.2f}]"
        cells = [
            milliradians(own) + ("" if squared is base else f" ({1 - own.mean() / first.mean():.2f})")
            for own, first in zip(squared, base, strict=True)
        ]
        lines.append(f"| {name} | " + " | ".join([*cells, gone]) + " |")
    return "\n".join(lines)


@run_cli
def main() -> None:
    """Do what is missing and print the table."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--recording", type=Path, required=True, help="folder with recording.json")
    parser.add_argument("--output_dir", type=Path, default=ROOT / "outputs" / "bench_servo")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.output_dir.mkdir(parents=True, exist_ok=True)
    bench = Bench.of(read_recording_set(options.recording))
    whole = ServoProblem.of(bench)
    settings = np.array(bench.settings)
    found, labels, said = [], [], []
    for number, name in enumerate(dict.fromkeys(bench.settings)):
        held, fitted = np.flatnonzero(settings == name), np.flatnonzero(settings != name)
        own: dict[str, Any] = {}
        for rung in LADDER:
            path = options.output_dir / f"{number}_{rung}.json"
            own[rung] = kept(path, partial(ladder, bench, fitted, held, rung, own))
        path = options.output_dir / f"{number}_diagnosis.json"
        own["diagnosis"] = kept(path, partial(diagnosed, whole, fitted, held, options.seed))
        duty = bench.duty_per_rad[held[0]]
        labels.append(f"{duty:.2f}/rad left out [mrad]")
        names = ", ".join(title(item) for item in own["diagnosis"]["causes"]) or "nothing"
        ties = ", ".join(title(item) for item in own["diagnosis"]["ties"])
        said.append(f"without {duty:.2f}/rad: {names}" + (f"; ties with {ties}" if ties else ""))
        found.append(own)
    text = render(found, labels, options.seed)
    (options.output_dir / "servo.md").write_text(text + "\n", encoding="utf-8")
    print(text, *said, sep="\n")


if __name__ == "__main__":
    sys.exit(main())
