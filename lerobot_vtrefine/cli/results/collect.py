"""Makes rows and learning curves from the folders that runs leave, and from printed tables."""

import json
from dataclasses import replace as replace_fields
from pathlib import Path
from typing import Any

from lerobot_vtrefine.cli.pipeline.stages import trained_policy
from lerobot_vtrefine.cli.results.provenance import FILE_NAME
from lerobot_vtrefine.cli.results.rows import IMITATION, TUNED, Line, Progress, Row, Run
from lerobot_vtrefine.cli.results.tables import HANDLING, MEASURED, REACHED
from lerobot_vtrefine.finetune.logger import read_progress
from lerobot_vtrefine.finetune.pipeline import CONFIG_NAME

ORIGIN = ("commit", "command", "machine")


def read_json_or_none(path: Path) -> Any:
    """A JSON file's content; None without the file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def origin_of(folder: Path, **given: str | None) -> dict[str, str | None]:
    """``commit``, ``command`` and ``machine`` as the run recorded them, else as given."""
    recorded = read_json_or_none(folder / FILE_NAME) or {}
    return {name: recorded.get(name) or given.get(name) for name in ORIGIN}


def run_rows(
    folder: Path, common: dict[str, Any], origin: dict[str, str | None]
) -> list[tuple[Run, Progress]]:
    """The rows of one run's folder with their learning curves; the kind of run shows in what it left.

    ``common`` holds ``table`` and ``task``, perhaps ``policy`` and ``variant``.

    Raises:
        ValueError: the folder holds no run, or one that is not finished.
    """
    if (results := read_json_or_none(folder / "results.json")) is not None:
        return pipeline_rows(folder, results, common, origin)
    if (settings := read_json_or_none(folder / CONFIG_NAME)) is not None:
        final, progress = finetune_row(folder, settings, common, origin)
        return [*((row, []) for row in earlier_rows(final, progress)), (final, progress)]
    raise ValueError(
        f"{folder} holds neither results.json (vtrefine-demo) nor {CONFIG_NAME} (vtrefine-finetune)"
    )


def pipeline_rows(
    folder: Path, results: dict[str, Any], common: dict[str, Any], origin: dict[str, str | None]
) -> list[tuple[Run, Progress]]:
    """Rows of a ``vtrefine-demo``: imitation and fine-tuning, also without a sense where that was tried."""
    config, rows = results["config"], []
    common = dict(common)
    given = common.pop("variant", "")
    commits = {stage["name"]: stage.get("commit") for stage in results["stages"]}
    recorded = results.get("provenance", {})
    origin = {name: recorded.get(name) or origin[name] for name in ORIGIN}
    for stage, variant in (("pretrain", IMITATION), ("finetune", TUNED)):
        tuned = stage == "finetune"
        progress = read_progress(folder / "finetune") if tuned else []
        evaluations = {variant: results[stage]} | {
            f"{variant} without {sense}".strip(): found
            for sense, found in results["ablations"].get(stage, {}).items()
        }
        for name, found in evaluations.items():
            medians = found["metrics"]["successes"] if name == variant else {}
            row = Run(
                **{"policy": config["modalities"]} | common,
                variant=", ".join(filter(None, (given, name))),
                seed=config["seed"],
                success=found["success"] / found["episodes"],
                episodes=found["episodes"],
                iterations=config["finetune_iterations"] if tuned else 0,
                env_steps=last_steps(progress) if tuned else 0,
                extra={key: medians[key]["median"] for key, *_ in MEASURED if medians.get(key)},
                **origin | {"commit": commits.get(stage) or origin["commit"]},
            )
            rows.append((row, progress if name == variant else []))
    return rows


def finetune_row(
    folder: Path, settings: dict[str, Any], common: dict[str, Any], origin: dict[str, str | None]
) -> tuple[Run, Progress]:
    """The row of a ``vtrefine-finetune``: its last checkpoint, as ``lerobot-eval`` judged it in ``eval/``.

    Without such a folder, as the run itself did after its last iteration.
    """
    progress, planned = read_progress(folder), settings["dppo"]["iterations"]
    done = int(progress[-1]["iteration"]) if progress else 0
    if done < planned:
        raise ValueError(f"{folder} has {done} of {planned} iterations; finish it with --resume=true")
    if (info := read_json_or_none(folder / "eval" / "eval_info.json")) is not None:
        outcomes = info["per_task"][0]["metrics"]["successes"]
        success, episodes = sum(map(bool, outcomes)) / len(outcomes), len(outcomes)
    elif "eval_episodes" in progress[-1]:
        success, episodes = progress[-1]["eval_success"], int(progress[-1]["eval_episodes"])
    else:
        raise ValueError(f"{folder} was not evaluated; run lerobot-eval with --output_dir={folder / 'eval'}")
    saved = read_json_or_none(trained_policy(folder) / "config.json")
    if saved is None and "policy" not in common:
        raise ValueError(
            f"{folder} holds no checkpoint that tells the policy; add --policy=visuo_tactile or visual"
        )
    row = Run(
        **({"policy": saved["modalities"]} if saved else {}) | common,
        seed=settings["seed"],
        success=success,
        episodes=episodes,
        iterations=planned,
        env_steps=last_steps(progress),
        extra={
            "largest_fall": largest_fall(progress),
            "seconds": round(sum(row.get("seconds", 0.0) for row in progress), 1),
        }
        | handling(progress[-1]),
        **origin_of(folder, **origin),
    )
    return row, progress


def earlier_rows(final: Run, progress: Progress) -> list[Run]:
    """The same run before its first iteration, and at the evaluation nearest to its middle, where it has
    them.
    """
    evaluated = [row for row in progress[:-1] if "eval_episodes" in row]
    first = [row for row in evaluated if row["iteration"] == 0]
    middle = progress[-1]["iteration"] / 2
    between = sorted(
        (row for row in evaluated if row["iteration"] > 0), key=lambda row: abs(row["iteration"] - middle)
    )
    named = [(IMITATION, row) for row in first] + [("half-way", row) for row in between[:1]]
    return [
        replace_fields(
            final,
            variant=", ".join(filter(None, (final.variant, name))),
            success=row["eval_success"],
            episodes=int(row["eval_episodes"]),
            iterations=int(row["iteration"]),
            env_steps=int(row.get("env_steps", 0)),
            extra=handling(row),
        )
        for name, row in named
    ]


def handling(row: dict[str, float]) -> dict[str, float]:
    """What an evaluation of a run's own measured beside success: means over its episodes, in four digits."""
    names = {f"mean_{key}": f"eval_{key}" for key, *_ in HANDLING}
    return {name: float(f"{row[column]:.4g}") for name, column in names.items() if column in row}


def last_steps(progress: Progress) -> int | None:
    """Environment steps of a run; None where it did not record them."""
    return int(progress[-1]["env_steps"]) if progress and "env_steps" in progress[-1] else None


def largest_fall(progress: Progress) -> float:
    """How far below the best so far training success fell in the last half of the iterations."""
    best, falls = 0.0, [0.0]
    for row in progress:
        success = row.get("success", best)
        best = max(best, success)
        if 2 * row["iteration"] > progress[-1]["iteration"]:
            falls.append(best - success)
    return round(max(falls), 4)


def steps_to(progress: Progress) -> dict[str, float]:
    """Environment steps at the first evaluation that found at least these successes, by ``steps_to_RATE``."""
    found = {}
    for rate in REACHED:
        steps = [row["env_steps"] for row in progress if row.get("eval_success", -1.0) >= rate]
        found |= {f"steps_to_{rate}": float(steps[0])} if steps else {}
    return found


def printed_lines(path: Path, name: str, origin: dict[str, str | None]) -> list[Row]:
    """Rows of a benchmark from the Markdown table in what it printed.

    Raises:
        ValueError: there is no table.
    """
    text = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in text if line.startswith("|")]
    if len(cells) < 3:
        raise ValueError(f"{path} holds no Markdown table")
    return [Line(table=name, cells=dict(zip(cells[0], row, strict=True)), **origin) for row in cells[2:]]
