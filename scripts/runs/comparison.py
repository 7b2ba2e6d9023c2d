"""Two ways beside each other over several seeds, in numbers and in words."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.cli.report.statistics import mean_interval, rate_interval, wilson_interval


def over_seeds(successes: Sequence[int], episodes: Sequence[int]) -> dict[str, Any]:
    """Mean success over seeds with its t-interval, within what a success can be, and each seed's: policies
    differ by more than chance in their episodes. Of one seed, Wilson's interval over these.
    """
    rates = [won / count for won, count in zip(successes, episodes, strict=True)]
    mean, *ends = rate_interval(rates)
    if len(rates) == 1:
        ends = wilson_interval(successes[0], episodes[0])
    ci95 = [round(end, 4) for end in ends]
    counts = {"success": sum(successes), "episodes": sum(episodes)}
    return counts | {"rate": round(mean, 4), "ci95": ci95, "per_seed": [round(rate, 4) for rate in rates]}


def difference(rows: dict[str, Any], one: str, two: str) -> dict[str, Any]:
    """Two minus one: mean over seeds with its t-interval, for fine-tuning's luck differs by seed."""
    change = np.subtract(rows[two]["per_seed"], rows[one]["per_seed"])
    mean, low, high = mean_interval(change.tolist())
    return {"mean": round(mean, 4), "ci95": [round(low, 4), round(high, 4)]}


def effect(mean: float, ci95: list[float]) -> str:
    """What the interval of a difference allows to say."""
    low, high = ci95
    return "pays" if low > 0 else "costs" if high < 0 else "makes no difference that these seeds can show"


def rate_text(row: dict) -> str:
    """Mean rate with its interval, and the seeds' rates."""
    seeds = ", ".join(f"{100 * rate:.0f}" for rate in row["per_seed"])
    return f"{interval_text(row['rate'], row['ci95'])} (seeds: {seeds})"


def interval_text(mean: float, ci95: list[float]) -> str:
    """For example ``36 % [29, 42]``; one seed has no interval."""
    if not all(map(math.isfinite, ci95)):
        return f"{100 * mean:.0f} % (one seed)"
    return f"{100 * mean:.0f} % [{100 * ci95[0]:.0f}, {100 * ci95[1]:.0f}]"


def save(folder: Path, comparison: dict[str, Any], text: str) -> None:
    """Keep a comparison as ``comparison.json`` and ``comparison.md``, and print it."""
    (folder / "comparison.json").write_text(json.dumps(comparison, indent=2) + "\n", encoding="utf-8")
    (folder / "comparison.md").write_text(text + "\n", encoding="utf-8")
    print(f"\n{text}")
