"""What a comparison's evaluations say: its own numbers, and rows of the results file."""

import json
from pathlib import Path
from typing import Any

from runs.comparison import difference, over_seeds

from lerobot_vtrefine.cli.results.collect import last_steps, read_json_or_none
from lerobot_vtrefine.cli.results.rows import Progress, Run
from lerobot_vtrefine.finetune.logger import read_progress
from reality.budget import Budget, folder_name
from reality.hidden import REALITIES
from reality.lanes import cells
from reality.stages import evaluation_dir


def results_path(budget: Budget, trained: str, world: str, seed: int) -> Path:
    """What LeRobot's evaluation leaves."""
    return evaluation_dir(budget, trained, world, seed) / "eval_info.json"


def successes(budget: Budget, trained: str, world: str, seed: int) -> list[bool]:
    """Outcome of every evaluation episode."""
    info = json.loads(results_path(budget, trained, world, seed).read_text(encoding="utf-8"))
    return [bool(value) for value in info["per_task"][0]["metrics"]["successes"]]


def compare(budget: Budget) -> dict[str, Any]:
    """Every reality's comparison over the seeds whose evaluations are all there."""
    results = {}
    for name in budget.realities:
        pairs = cells(name).values()
        whole = [s for s in budget.seeds if all(results_path(budget, *pair, s).is_file() for pair in pairs)]
        if whole:
            results[name] = compare_one(budget, name, whole)
    return results


def compare_one(budget: Budget, name: str, seeds: list[int]) -> dict[str, Any]:
    """Success of every policy in every world over these seeds, and what the diagnosis said."""
    verdict = json.loads((budget.diagnosis(name) / "verdict.json").read_text(encoding="utf-8"))
    row: dict[str, Any] = {
        "verdict": {
            "status": verdict["status"],
            "causes": [cause["name"] for cause in verdict["causes"]],
            "heldout": verdict["heldout"],
        },
        "seeds": seeds,
    }
    for title, pair in cells(name).items():
        runs = [successes(budget, *pair, seed) for seed in seeds]
        row[title] = over_seeds([*map(sum, runs)], [*map(len, runs)])
    row["reality_minus_simulator"] = difference(row, "plain in its own simulator", "plain in reality")
    row["diagnosed_minus_plain"] = difference(row, "plain in reality", "diagnosed in reality")
    return row


def reality_rows(
    folder: Path, origin: dict[str, str | None], task: str | None = None
) -> list[tuple[Run, Progress]]:
    """Rows of the results file from a comparison's folder: every policy in every world, by seed.

    ``task``: what --task was, if anything.
    """
    rows = []
    for name in REALITIES:
        verdict = read_json_or_none(folder / folder_name(name) / "diagnosis" / "verdict.json")
        if verdict is None:  # this reality was not among --realities
            continue
        causes = ", ".join(cause["name"] for cause in verdict["causes"]) or "nothing"
        for title, (trained, world) in cells(name).items():
            prefix = folder_name("eval", trained, "in", world, "")
            for path in sorted(folder.glob(f"{prefix}[0-9]*/eval_info.json")):
                seed = path.parent.name.removeprefix(prefix)
                tuning = folder_name("finetune", trained, seed)
                progress = read_progress(folder / tuning)
                stamp = read_json_or_none(folder / "stages" / f"{tuning}.json")
                outcomes = read_json_or_none(path)["per_task"][0]["metrics"]["successes"]
                row = Run(
                    table="reality",
                    task=": ".join(filter(None, (task, name))),
                    policy="visuo_tactile",
                    variant=title,
                    seed=int(seed),
                    success=sum(map(bool, outcomes)) / len(outcomes),
                    episodes=len(outcomes),
                    iterations=int(progress[-1]["iteration"]) if progress else None,
                    env_steps=last_steps(progress),
                    extra={"diagnosis": causes},
                    **origin | {"commit": (stamp or {}).get("commit") or origin["commit"]},
                )
                rows.append((row, progress if title.endswith("simulator") else []))
    return rows
