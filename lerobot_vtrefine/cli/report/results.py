"""``results.json``: what the evaluations of a pipeline measured, with intervals, seeds and seconds."""

import json
import platform
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lerobot_vtrefine.cli.pipeline.demo_config import DemoConfig
from lerobot_vtrefine.cli.pipeline.stages import StageRecord
from lerobot_vtrefine.cli.report.statistics import proportion, quantiles
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cores import usable_cores
from lerobot_vtrefine.envs.episode_log import read_episode_log
from lerobot_vtrefine.files import decode, limits, read_json

# Measurements of every episode, and those that only a success has.
METRICS = ("in_hand_shift_m", "rim_slide_m", "peak_force_n")
SUCCESS_METRICS = ("time_to_success_s", *METRICS)
CLEAR_LIFT = 0.2
FEW_EPISODES = 50
"""Below this many, an interval spans a quarter of the scale and a comparison means nothing."""


@dataclass(frozen=True)
class _Overall:
    eval_s: float = limits(0.0, 1e9)


@dataclass(frozen=True)
class _TaskMetrics:
    successes: tuple[bool, ...]
    video_paths: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Task:
    metrics: _TaskMetrics


@dataclass(frozen=True)
class _EvalInfo:
    """What is read of lerobot-eval's eval_info.json, whose other fields are LeRobot's."""

    per_task: tuple[_Task, ...]
    overall: _Overall


def load_evaluation(directory: Path, first_seed: int) -> dict[str, Any]:
    """One evaluation as ``lerobot-eval`` and the environment's episode log left it.

    Returns:
        ``success``, ``episodes``, ``rate``, ``ci95``, ``eval_seconds``, ``seeds``, ``metrics`` (quantiles
        over all episodes and over successes; SI units), ``failures`` (count by reason), ``picked_up`` (share
        of episodes in which the hands had all their parts at once; None where the log does not say) and
        ``videos`` (``[{"path", "seed", "success", "failure"}]``).
    """
    path = directory / "eval_info.json"
    try:
        info = decode(_EvalInfo, read_json(path), "the evaluation", others=True)
        if len(info.per_task) != 1:
            raise ValueError(f"per_task must hold one task, got {len(info.per_task)}")
    except ValueError as error:
        raise ValueError(f"{path} is not a result of lerobot-eval: {error}") from error
    task = info.per_task[0].metrics
    successes = list(task.successes)
    rows = read_episode_log(directory / "episodes.jsonl", first_seed, len(successes))
    reasons = {row["seed"]: failure_name(row) for row in rows if not row["success"]}
    videos = [
        {"path": path, "seed": seed, "success": successes[seed - first_seed], "failure": reasons.get(seed)}
        for seed, path in enumerate(task.video_paths, first_seed)
    ]
    return proportion(sum(successes), len(successes)) | {
        "eval_seconds": round(info.overall.eval_s, 1),
        "seeds": [first_seed + index for index in range(len(successes))],
        "metrics": summarise(rows),
        "failures": dict(Counter(reasons.values()).most_common()),
        "picked_up": picked_up(rows),
        "videos": videos,
    }


def failure_name(row: dict[str, Any]) -> str:
    """Why an episode failed; the simulation names no reason when the time ran out."""
    name = row.get("failure")
    return "time-out" if name in (None, "", "none") else name.replace("in_hand", "in-hand").replace("_", " ")


def picked_up(rows: Sequence[dict[str, Any]]) -> float | None:
    """Share of episodes in which the hands had all their parts at once, where rows say so."""
    told = [bool(row["picked_up"]) for row in rows if "picked_up" in row]
    return sum(told) / len(told) if told else None


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Quantiles of every measurement over all episodes and over the successful ones."""
    good = [row for row in rows if row["success"]]
    return {
        "all": {name: quantiles([row.get(name) for row in rows]) for name in METRICS},
        "successes": {name: quantiles([row.get(name) for row in good]) for name in SUCCESS_METRICS},
    }


def collect_results(config: DemoConfig, records: Sequence[StageRecord]) -> dict[str, Any]:
    """Everything of ``results.json``; ``pretrain`` and ``finetune`` first."""
    seconds = {record.name: record.seconds for record in records}
    policies = {
        policy: load_evaluation(config.evaluation_dir(policy), config.eval_seed)
        | {"seconds": seconds[policy], "modalities": config.modalities}
        for policy in ("pretrain", "finetune")
    }
    ablations: dict[str, dict[str, Any]] = {}
    for policy, modality in config.ablations():
        evaluation = load_evaluation(config.evaluation_dir(policy, modality), config.eval_seed)
        evaluation.pop("videos")
        ablations.setdefault(policy, {})[modality] = evaluation
    return {
        "summary": verdict(policies["pretrain"], policies["finetune"]),
        **policies,
        "ablations": ablations,
        "seconds": seconds | {"total": round(sum(seconds.values()), 1)},
        "stages": [asdict(record) for record in records],
        "config": json.loads(json.dumps(asdict(config), default=str)),
        "machine": machine(),
        "provenance": provenance(),
    }


def verdict(before: dict[str, Any], after: dict[str, Any]) -> str:
    """What was achieved, in plain words, also when it is little."""
    change = after["rate"] - before["rate"]
    if after["ci95"][0] > before["ci95"][1]:
        words = "DPPO clearly improved" if change >= CLEAR_LIFT else "DPPO improved"
        overlap = "the 95 % intervals do not overlap"
    elif after["ci95"][1] < before["ci95"][0]:
        words, overlap = "DPPO made worse", "the 95 % intervals do not overlap"
    else:
        words, overlap = "DPPO did not clearly change", "the 95 % intervals overlap"
    rates = f"success went from {percent(before)} to {percent(after)}"
    said = f"{words} the policy it began with: {rates}; {overlap}."
    few = min(before["episodes"], after["episodes"]) < FEW_EPISODES
    return f"{said} With so few episodes this shows that everything works, and no more." if few else said


def percent(evaluation: dict[str, Any]) -> str:
    """For example ``36 % [29, 42] (71 of 200 episodes)``."""
    low, high = evaluation["ci95"]
    counts = f"{evaluation['success']} of {evaluation['episodes']} episodes"
    return f"{100 * evaluation['rate']:.0f} % [{100 * low:.0f}, {100 * high:.0f}] ({counts})"


def machine() -> dict[str, Any]:
    """Where the numbers were measured."""
    packages = ("lerobot_policy_vtrefine", "lerobot", "torch", "mujoco", "warp-lang")
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "cores": usable_cores(),
        "packages": {name: version(name) for name in packages},
    }
