"""``report.html``: one self-contained page about a pipeline's results."""

import json
import shlex
from pathlib import Path
from typing import Any

from matplotlib import colormaps
from matplotlib.colors import to_hex

from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.pipeline.progress import clock
from lerobot_vtrefine.cli.report.cloud import recorded_cloud
from lerobot_vtrefine.cli.report.media import data_uri, strongest_contact
from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.files import read_number_rows
from lerobot_vtrefine.pages.pads import COLOUR_MAP, colour_scale, pad_image
from lerobot_vtrefine.pages.rates import Bar, Series, bar_chart, line_chart
from lerobot_vtrefine.pages.render import render

NAMES = {"pretrain": "imitation", "finetune": "after DPPO"}
STYLES = {"pretrain": "a", "finetune": "b"}
# Name, unit and scale of what the page shows beside each success rate.
MEASUREMENTS = (
    ("in_hand_shift_m", "in-hand shift", "mm", 1e3),
    ("rim_slide_m", "sliding on the rim", "mm", 1e3),
    ("peak_force_n", "peak contact force", "N", 1.0),
    ("time_to_success_s", "time to success", "s", 1.0),
)
RARE = 0.05
"""A policy that may succeed less often than this tells nothing about its senses."""
VIDEOS_PER_POLICY = 2
"""Beside the pair that is shown first."""
# Columns of the fine-tuning log, with the style of their line.
CURVES = (("success", "rollouts", "a"), ("eval_success", "evaluations on the way", "b"))


def render_page(results: dict[str, Any], dataset_root: Path, curve_csv: Path) -> str:
    """The page as HTML text; videos and frames are embedded."""
    frames = strongest_contact(dataset_root)
    highest = max(float(frame.max()) for frame in frames.values())
    pair = video_pair(results)
    shown = {video["path"] for video in pair}
    more = [video for policy in NAMES for video in choose_videos(results, policy, shown)]
    return render(
        "lerobot_vtrefine.cli.report",
        "page.html",
        results=results,
        names=NAMES,
        success_chart=success_chart(results),
        curve_chart=curve_chart(read_curve(curve_csv)),
        measurements=measurement_rows(results),
        ablation_chart=ablation_chart(results),
        senses=senses(results),
        pair=[embedded(policy, video) for policy, video in zip(NAMES, pair, strict=False)],
        videos=more,
        pads=pad_pictures(frames, highest),
        pad_scale=colour_scale(highest, "counts"),
        cloud=recorded_cloud(dataset_root),
        cloud_scale=colour_scale(1.0, "reading, normalised"),
        ramp=json.dumps([to_hex(colormaps[COLOUR_MAP](k / 15)) for k in range(16)]),
        next_commands=next_commands(results),
        commands="\n\n".join(shell_line(stage["command"]) for stage in results["stages"]),
        stages=[stage | {"clock": clock(stage["seconds"])} for stage in results["stages"]],
        total=clock(results["seconds"]["total"]),
        config=json.dumps(results["config"], indent=2),
    )


def _bar(label: str, evaluation: dict[str, Any], style: str) -> Bar:
    return Bar(label, evaluation["rate"], *evaluation["ci95"], style)


def success_chart(results: dict[str, Any]) -> str:
    """The two headline success rates."""
    bars = [_bar(name, results[policy], STYLES[policy]) for policy, name in NAMES.items()]
    return bar_chart(bars, "success rate before and after DPPO")


def ablation_chart(results: dict[str, Any]) -> str:
    """Each policy intact and with one sense replaced by its mean; empty when no ablation ran."""
    if not results["ablations"]:
        return ""
    bars = []
    for policy, name in NAMES.items():
        bars.append(_bar(name, results[policy], STYLES[policy]))
        for modality, evaluation in results["ablations"].get(policy, {}).items():
            bars.append(_bar(f"without {modality}", evaluation, f"{STYLES[policy]} faded"))
    return bar_chart(bars, "success rate with one sense replaced by its mean")


def read_curve(path: Path) -> list[dict[str, float]]:
    """Rows of the fine-tuning log as numbers; empty when there is none."""
    if not path.is_file():
        return []
    return read_number_rows(path)


def curve_chart(rows: list[dict[str, float]]) -> str:
    """Success of DPPO's rollouts, and of its evaluations on the way, over its iterations."""
    lines = [
        Series(
            label,
            [(row["iteration"], row[column]) for row in rows if {"iteration", column} <= row.keys()],
            style,
            markers=column == "eval_success",
        )
        for column, label, style in CURVES
    ]
    return line_chart(lines, "DPPO iteration", "success while fine-tuning")


def measurement_rows(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Median and 90th percentile of each measurement, in each policy's successes and in all episodes."""
    rows = []
    for key, title, unit, scale in MEASUREMENTS:
        cells = []
        for policy in NAMES:
            metrics = results[policy]["metrics"]
            cells += [cell(metrics[group].get(key), scale) for group in ("successes", "all")]
        rows.append({"title": f"{title} [{unit}]", "cells": cells})
    return rows


def cell(value: dict[str, float] | None, scale: float) -> str:
    """For example ``2.5 (4.1)``; a dash where nothing was measured."""
    return "–" if value is None else f"{scale * value['median']:.1f} ({scale * value['p90']:.1f})"


def senses(results: dict[str, Any]) -> str:
    """Which senses the fine-tuned policy needs, in a sentence; empty when no ablation ran."""
    taken = results["ablations"].get("finetune", {})
    if not taken:
        return ""
    intact = results["finetune"]
    if intact["ci95"][0] < RARE:
        return "The policy succeeds too rarely to tell which senses it needs."
    needed = [name for name, evaluation in taken.items() if evaluation["ci95"][1] < intact["ci95"][0]]
    rates = ", ".join(f"{100 * e['rate']:.0f} % without {name}" for name, e in taken.items())
    rates = f"{100 * intact['rate']:.0f} % intact, {rates}"
    if needed:
        return f"After DPPO the policy needs {' and '.join(needed)}: {rates}."
    missing = "neither sense" if len(taken) > 1 else f"no {next(iter(taken))}"
    return f"After DPPO the policy needs {missing} to succeed about as often: {rates}."


def video_pair(results: dict[str, Any]) -> list[dict[str, Any]]:
    """The videos of one episode before and after: best one that was failed before and done after."""
    before, after = (
        {v["seed"]: v for v in results[policy]["videos"] if Path(v["path"]).is_file()} for policy in NAMES
    )
    both = sorted(
        before.keys() & after.keys(), key=lambda s: (before[s]["success"], not after[s]["success"], s)
    )
    return [before[both[0]], after[both[0]]] if both else []


def embedded(policy: str, video: dict[str, Any]) -> dict[str, Any]:
    """A video with its source and caption."""
    return {"source": data_uri(Path(video["path"])), "caption": caption(policy, video)}


def next_commands(results: dict[str, Any]) -> str:
    """What somebody types next, with this run's folders and task."""
    config = results["config"]
    root = config["output_dir"]
    checkpoint = f"{root}/finetune/checkpoints/last/pretrained_model"
    task = shlex.join(["--env.type=vtrefine", *flags("env", config["env"])])
    lines = (
        f"lerobot-eval --policy.path={checkpoint} --policy.device=cpu {task} --eval.n_episodes=200"
        f" --eval.batch_size=50 --seed=9000000 --output_dir={root}/again"
        f" --env.metrics_path={root}/again/episodes.jsonl",
        f"vtrefine-view-data --dataset.root={root}/dataset",
        f"vtrefine-share {checkpoint} --repo_id=USER/insertion --evaluation={root}/again",
    )
    return "\n\n".join(shell_line(line) for line in lines)


def shell_line(command: str) -> str:
    """A command over several lines that a shell takes as one."""
    return command.replace(" --", " \\\n    --")


def choose_videos(results: dict[str, Any], policy: str, shown: set[str]) -> list[dict[str, Any]]:
    """More videos of a policy, successes and failures both if there are both, with embedded sources."""
    videos = [v for v in results[policy]["videos"] if Path(v["path"]).is_file() and v["path"] not in shown]
    good = [video for video in videos if video["success"]]
    bad = [video for video in videos if not video["success"]]
    first, second = (bad, good) if results[policy]["rate"] < 0.5 else (good, bad)
    chosen = (first[: VIDEOS_PER_POLICY - 1] + second + first[VIDEOS_PER_POLICY - 1 :])[:VIDEOS_PER_POLICY]
    return [embedded(policy, video) for video in chosen]


def caption(policy: str, video: dict[str, Any]) -> str:
    """For example ``after DPPO, failure (contact force), seed 9000003``."""
    outcome = "success" if video["success"] else f"failure ({video['failure']})"
    return f"{NAMES[policy]}, {outcome}, seed {video['seed']}"


def pad_pictures(frames: dict[str, Array], highest: float) -> list[dict[str, str]]:
    """The pads' frames on one colour scale."""
    return [
        {
            "title": pad.replace("_", " "),
            "source": pad_image(frames[pad], highest),
            "maximum": f"{frames[pad].max():.0f}",
        }
        for pad in frames
    ]
