#!/usr/bin/env python
"""Does touch pay? Train visuo-tactile and visual-only policies the same way on several seeds and compare.

    .venv/bin/python scripts/compare_touch.py --seeds 0 1 2

Every run is one ``vtrefine-demo``; flags that this script does not know are passed on to it, for example
``--env='{pair: square, clearance_m: 0.001, start: grasped}'``. Interrupted and
started again, it continues. The comparison is printed and saved as ``comparison.json`` and ``comparison.md``.
"""

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy.stats import t as student_t

from lerobot_vtrefine.cli.report.statistics import proportion

MODALITIES = ("visuo_tactile", "visual")
POLICIES = {"pretrain": "imitation", "finetune": "after DPPO"}


def run_demo(output: Path, modalities: str, seed: int, extra: list[str]) -> dict:
    """One pipeline; finished stages are not repeated. Returns its results."""
    command = [
        shutil.which("vtrefine-demo", path=str(Path(sys.executable).parent)) or "vtrefine-demo",
        f"--modalities={modalities}",
        f"--seed={seed}",
        f"--output_dir={output}",
        *extra,
    ]
    print(f"\n== {modalities}, seed {seed}", flush=True)
    subprocess.run(command, check=True)
    return json.loads((output / "results.json").read_text(encoding="utf-8"))


def mean_interval(values: list[float]) -> tuple[float, float, float]:
    """Mean and Student-t 95 % interval over seeds; an infinite interval for a single seed."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, -float("inf"), float("inf")
    half = float(student_t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return mean, mean - half, mean + half


def compare(results: dict[str, dict[int, dict]]) -> dict:
    """Pooled success of each modality, and the difference that touch makes per seed, on the same episodes."""
    comparison = {}
    for policy in POLICIES:
        rows = {}
        for modality in MODALITIES:
            runs = [run[policy] for run in results[modality].values()]
            pooled = proportion(sum(run["success"] for run in runs), sum(run["episodes"] for run in runs))
            rows[modality] = pooled | {"per_seed": [run["rate"] for run in runs]}
        pairs = zip(*(rows[modality]["per_seed"] for modality in MODALITIES), strict=True)
        mean, low, high = mean_interval([touch - sight for touch, sight in pairs])
        rows["touch_minus_visual"] = {"mean": round(mean, 4), "ci95": [round(low, 4), round(high, 4)]}
        comparison[policy] = rows
    return comparison


def as_text(comparison: dict) -> str:
    """The comparison as a Markdown table and one sentence."""
    lines = ["| policy | visuo-tactile | visual only | difference (per seed) |", "|---|---|---|---|"]
    for policy, title in POLICIES.items():
        rows = comparison[policy]
        cells = [rate_text(rows[modality]) for modality in MODALITIES]
        gain = rows["touch_minus_visual"]
        lines.append(f"| {title} | {' | '.join(cells)} | {interval_text(gain['mean'], gain['ci95'])} |")
    low, high = comparison["finetune"]["touch_minus_visual"]["ci95"]
    words = "pays" if low > 0 else "costs" if high < 0 else "makes no difference that these seeds can show"
    return "\n".join([*lines, "", f"After DPPO, touch {words}."])


def rate_text(row: dict) -> str:
    """Pooled rate with its interval, and the seeds' rates."""
    seeds = ", ".join(f"{100 * rate:.0f}" for rate in row["per_seed"])
    return f"{interval_text(row['rate'], row['ci95'])} (seeds: {seeds})"


def interval_text(value: float, interval: list[float]) -> str:
    """For example ``36 % [29, 42]``."""
    return f"{100 * value:.0f} % [{100 * interval[0]:.0f}, {100 * interval[1]:.0f}]"


def main() -> None:
    """Parse, run every pipeline, compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/compare_touch"))
    options, extra = parser.parse_known_args()
    results = {
        modality: {
            seed: run_demo(options.output_dir / f"{modality}_{seed}", modality, seed, extra)
            for seed in options.seeds
        }
        for modality in MODALITIES
    }
    comparison = compare(results)
    text = as_text(comparison)
    (options.output_dir / "comparison.json").write_text(
        json.dumps(comparison, indent=2) + "\n", encoding="utf-8"
    )
    (options.output_dir / "comparison.md").write_text(text + "\n", encoding="utf-8")
    print(f"\n{text}")


if __name__ == "__main__":
    try:
        main()
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
    except KeyboardInterrupt:
        sys.exit(130)
