"""How ``compare_reality.py`` tells its results."""

from typing import Any

import numpy as np
from compare_touch import interval_text, rate_text

from lerobot_vtrefine.cli.report.statistics import mean_interval


def difference(row: dict[str, Any], one: str, two: str) -> dict[str, Any]:
    """Two minus one: mean over seeds with its t-interval, for fine-tuning's luck differs by seed."""
    change = np.subtract(row[two]["per_seed"], row[one]["per_seed"])
    mean, low, high = mean_interval(change.tolist())
    return {"mean": round(mean, 4), "ci95": [round(low, 4), round(high, 4)]}


def as_text(results: dict[str, Any]) -> str:
    """The comparison as a Markdown table, and a sentence per reality."""
    lines = [
        "| stand-in reality | trained in | success in reality | in its own simulator |",
        "|---|---|---|---|",
    ]
    words = []
    for name, row in results.items():
        for world in ("plain", "diagnosed"):
            real, own = (rate_text(row[f"{world} in {where}"]) for where in ("reality", "its own simulator"))
            lines.append(f"| {name} | the {world} simulator | {real} | {own} |")
        words.append(sentence(name, row))
    return "\n".join([*lines, "", *words])


def sentence(name: str, row: dict[str, Any]) -> str:
    """What the hidden physics costs a policy that does not know it, and what diagnosis brings back."""
    gap, gain = row["reality_minus_simulator"], row["diagnosed_minus_plain"]
    low, high = gain["ci95"]
    effect = "pays" if low > 0 else "costs" if high < 0 else "makes no difference that these seeds can show"
    found = ", ".join(row["verdict"]["causes"]) or "nothing"
    return (
        f"{name}: the plain simulator's policy changes by {interval_text(gap['mean'], gap['ci95'])} in the"
        f" stand-in reality; training in the diagnosed simulator ({row['verdict']['status']}: {found})"
        f" {effect}, {interval_text(gain['mean'], gain['ci95'])} over {len(row['seeds'])} seeds of"
        f" {row['plain in reality']['episodes'] // len(row['seeds'])} episodes."
    )
