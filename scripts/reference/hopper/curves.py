"""Learning curves on Hopper: kept line by line, then laid beside each other as rows of a table."""

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lerobot_vtrefine.cli.report.statistics import mean_interval
from lerobot_vtrefine.cli.results.rows import Line

NAMES = {
    "reference": "the reference implementation",
    "reference_quiet": "the reference, untuned steps without noise",
    "reference_critic": "the reference, its critic's input standardised",
    "reference_quiet_critic": "the reference with both",
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
        # Also while what the reference prints is dropped.
        print(json.dumps(line), file=sys.__stdout__, flush=True)


class Points(NamedTuple):
    """One run: environment steps and mean return, in order."""

    held_out: list[tuple[float, float]]
    """Of evaluations."""
    exploring: list[tuple[float, float]]
    """Of an iteration's own episodes; the steps are those after it."""


Runs = dict[str, dict[int, Points]]
"""By who trained and by seed."""


def read_curves(folder: Path) -> Runs:
    """The curves of a folder that have begun."""
    found: Runs = {name: {} for name in NAMES}
    for path in sorted(folder.glob("*.jsonl")):
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        points = Points(
            *(
                [(line["env_steps"], line[key]) for line in lines if key in line]
                for key in ("eval_return", "return")
            )
        )
        if points.held_out:
            found[lines[0]["by"]][lines[0]["seed"]] = points
    return {name: runs for name, runs in found.items() if runs}


def summary(points: Points, step: float, rounds: int) -> dict[str, float]:
    """Held-out returns after every ``step`` environment steps, between evaluations in a straight line; those
    while exploring, of the iterations of the first and of the last such round.
    """
    budgets = [i * step for i in range(rounds + 1)]
    steps, found_there = np.array(points.held_out).T
    returns = np.interp(budgets, steps, found_there)
    heads = ["before", *(f"after {budget / 1e6:.2f} M steps" for budget in budgets[1:])]
    found = dict(zip(heads, map(float, returns), strict=True))
    for words, last in (("first", 1), ("last", rounds)):
        # With some slack: iterations of ours do not end at round numbers.
        inside = [value for at, value in points.exploring if (last - 1) * step < at <= (last + 0.05) * step]
        found[f"exploring, {words} {step / 1e6:.2f} M"] = float(np.mean(inside or [np.nan]))
    return found


def lines_of(runs: Runs, step: float, start: str, **origin: Any) -> list[Line]:
    """A row for each who trained, and one for each of the others minus the reference, seed by seed.

    ``start`` names the imitation in every row. There are as many rounds of ``step`` environment steps as all
    runs have made, give or take a tenth of one.
    """
    reached = min(points.held_out[-1][0] for seeds in runs.values() for points in seeds.values())
    rounds = int(reached / step + 0.1)
    at = {
        name: {seed: summary(points, step, rounds) for seed, points in seeds.items()}
        for name, seeds in runs.items()
    }
    rows = [(NAMES[name], at[name], "") for name in at]
    theirs = at.get("reference", {})
    for name in [name for name in at if name != "reference"]:
        changes = {
            seed: {head: value - theirs[seed][head] for head, value in found.items()}
            for seed, found in at[name].items()
            if seed in theirs
        }
        if changes:
            rows.append((f"{NAMES[name]} minus the reference", changes, "+"))
    return [
        Line(
            table=TABLE,
            cells={"imitation, fine-tuned by": f"{start}: {words}", "seeds": str(len(found))}
            | {
                head: cell([one[head] for one in found.values()], sign) for head in next(iter(found.values()))
            },
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
