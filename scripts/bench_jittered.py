"""Diagnose pads of the third, jittered rig: bench_jittered.py --effects mullins,clean --gains .3 --seeds 0:3.

Seeds below 1000 are for tuning, from 1000 on for reporting. One line of JSON per set goes to --output.
"""

import argparse
import importlib
import json
import sys
import time
from pathlib import Path

from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.quality import check_quality

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "diagnose"))
jittered_rig = importlib.import_module("jittered_rig")


def run(name: str, gain: float, seed: int, rows: int, cols: int) -> dict:
    """One set's row."""
    rig = jittered_rig.Rig(seed, rows, cols)
    effect = jittered_rig.EFFECTS.get(name)
    effects = [(effect, rig.strength_for(effect, gain))] if effect else []
    recordings, issues = check_quality(rig.record(effects))
    begin = time.process_time()
    found = diagnose_pad(recordings)
    row = {"effect": name, "gain": gain, "seed": seed, "hz": rig.rate_hz, "status": found.verdict.status}
    row["cause"] = effect.cause if effect else None
    row["named"] = [cause.name for cause in found.verdict.causes]
    row["ambiguous"] = [list(group) for group in found.verdict.ambiguous_with]
    row["clue"] = found.verdict.unknown.clue
    row["achievable"] = rig.achievable(effects) if effects else 0.0
    row["heldout_gain"] = found.verdict.heldout.gain if found.verdict.heldout else None
    row["cpu_s"] = round(time.process_time() - begin, 1)
    row["issues"] = [issue.problem for issue in issues]
    row["minimum_detectable"] = dict(found.verdict.minimum_detectable)
    truth = {"k_d/k_n": rig.damping_s} | (
        {effect.parameter: effects[0][1]} if effect and effect.parameter else {}
    )
    params = {name: p for cause in found.verdict.causes for name, p in cause.params.items()}
    row["truth"] = truth
    row["params"] = {key: [params[key].value, params[key].ci95] for key in truth if key in params}
    return row


def main() -> None:
    """Run the sets and print one line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--effects", default="clean")
    parser.add_argument("--gains", default="0.3")
    parser.add_argument("--seeds", default="0:2")
    parser.add_argument("--pad", default="12x32", help="rows and columns (default %(default)s)")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    first, last = (int(part) for part in options.seeds.split(":"))
    rows, cols = (int(part) for part in options.pad.split("x"))
    for name in options.effects.split(","):
        for gain in (float(part) for part in options.gains.split(",")):
            for seed in range(first, last):
                row = run(name, gain, seed, rows, cols)
                line = json.dumps(row, default=lambda value: value.tolist())
                if options.output:
                    with options.output.open("a") as file:
                        file.write(line + "\n")
                short = {
                    key: row[key]
                    for key in ("effect", "gain", "seed", "hz", "status", "named", "clue", "cpu_s")
                }
                print(
                    json.dumps(short),
                    f"{row['heldout_gain']:.3f}/{row['achievable']:.3f}",
                    row["params"],
                    flush=True,
                )


if __name__ == "__main__":
    main()
