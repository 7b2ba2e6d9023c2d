"""Learning curves on Hopper: kept line by line, then laid beside each other as rows of a table."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.cli.report.statistics import mean_interval
from lerobot_vtrefine.cli.results.rows import Line

NAMES = {
    "reference": "the reference implementation",
    "paper": "`--dppo.type=paper`",
    "trust_region": "`--dppo.type=trust_region`",
}
TABLE = "reference_hopper"


class Curve:
    """A learning curve, on disk after every line: JSON, one object each."""

    def __init__(self, path: Path, **named: Any) -> None:
        self.path, self.named, self.began = path, named, time.perf_counter()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)

    def add(self, iteration: int, env_steps: int, **numbers: float) -> None:
        """A line after so many iterations of training and so many environment steps."""
        line: dict[str, float] = {"iteration": iteration, "env_steps": env_steps}
        line |= {name: float(f"{value:.5g}") for name, value in numbers.items()}
        line["seconds"] = round(time.perf_counter() - self.began, 1)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(self.named | line) + "\n")
        print(json.dumps(line), flush=True)


Evaluations = dict[int, list[tuple[float, float]]]
"""By seed: environment steps and held-out return, in order."""


def read_curves(folder: Path) -> dict[str, Evaluations]:
    """The evaluations of every curve in a folder, by who trained."""
    found: dict[str, Evaluations] = {name: {} for name in NAMES}
    for path in sorted(folder.glob("*.jsonl")):
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        points = [(line["env_steps"], line["eval_return"]) for line in lines if "eval_return" in line]
        if points:
            found[lines[0]["by"]][lines[0]["seed"]] = points
    return {name: runs for name, runs in found.items() if runs}


def returns_at(points: Sequence[tuple[float, float]], budgets: Sequence[float]) -> list[float]:
    """Returns after these environment steps, between evaluations in a straight line."""
    steps, returns = zip(*points, strict=True)
    return [float(value) for value in np.interp(budgets, steps, returns)]


def lines_of(curves: dict[str, Evaluations], budgets: Sequence[float], **origin: Any) -> list[Line]:
    """A row for each who trained, and one for each of ours minus the reference, seed by seed."""
    at = {
        name: {seed: returns_at(points, budgets) for seed, points in runs.items()}
        for name, runs in curves.items()
    }
    rows = [(NAMES[name], at[name], "") for name in at]
    for name in at.keys() - {"reference"}:
        both = sorted(at[name].keys() & at.get("reference", {}).keys())
        changes = {seed: list(np.subtract(at[name][seed], at["reference"][seed])) for seed in both}
        if both:
            rows.append((f"{NAMES[name]} minus the reference", changes, "+"))
    heads = [f"after {budget / 1e6:.2f} M steps" if budget else "before" for budget in budgets]
    return [
        Line(
            table=TABLE,
            cells={"fine-tuned by": words, "seeds": str(len(found))}
            | {head: cell([values[i] for values in found.values()], sign) for i, head in enumerate(heads)},
            **origin,
        )
        for words, found, sign in rows
    ]


def cell(returns: Sequence[float], sign: str) -> str:
    """Mean over seeds, Student's 95 % interval, each."""
    if len(returns) == 1:
        return f"{returns[0]:{sign}.0f}"
    mean, low, high = mean_interval(returns)
    each = ", ".join(f"{value:{sign}.0f}" for value in returns)
    return f"{mean:{sign}.0f} [{low:.0f}, {high:.0f}] ({each})"
