"""``report.html``: one self-contained page about a pipeline's results."""

import json
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from lerobot_vtrefine.cli.pipeline.progress import clock
from lerobot_vtrefine.cli.report.charts import Bar, Series, bar_chart, line_chart
from lerobot_vtrefine.cli.report.media import data_uri, heat_map, strongest_contact
from lerobot_vtrefine.files import read_number_rows

NAMES = {"pretrain": "imitation", "finetune": "after DPPO"}
STYLES = {"pretrain": "a", "finetune": "b"}
# Name, unit and scale of what the page shows beside each success rate.
MEASUREMENTS = (
    ("in_hand_shift_m", "in-hand shift", "mm", 1e3),
    ("rim_slide_m", "sliding on the rim", "mm", 1e3),
    ("peak_force_n", "peak contact force", "N", 1.0),
    ("time_to_success_s", "time to success", "s", 1.0),
)
VIDEOS_PER_POLICY = 3
# Columns of the fine-tuning log, with the style of their line.
CURVES = (("success", "rollouts", "a"), ("eval_success", "evaluations on the way", "b"))


def render_page(results: dict[str, Any], dataset_root: Path, curve_csv: Path) -> str:
    """The page as HTML text; videos and frames are embedded."""
    environment = Environment(
        loader=PackageLoader("lerobot_vtrefine.cli.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        results=results,
        names=NAMES,
        success_chart=success_chart(results),
        curve_chart=curve_chart(read_curve(curve_csv)),
        measurements=measurement_rows(results),
        ablation_chart=ablation_chart(results),
        videos=[video for policy in NAMES for video in choose_videos(results, policy)],
        pads=pad_pictures(dataset_root),
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


def choose_videos(results: dict[str, Any], policy: str) -> list[dict[str, Any]]:
    """Videos of a policy, successes and failures both if there are both, with embedded sources."""
    videos = [video for video in results[policy]["videos"] if Path(video["path"]).is_file()]
    good = [video for video in videos if video["success"]]
    bad = [video for video in videos if not video["success"]]
    first, second = (bad, good) if results[policy]["rate"] < 0.5 else (good, bad)
    chosen = (first[: VIDEOS_PER_POLICY - 1] + second + first[VIDEOS_PER_POLICY - 1 :])[:VIDEOS_PER_POLICY]
    return [{"source": data_uri(Path(video["path"])), "caption": caption(policy, video)} for video in chosen]


def caption(policy: str, video: dict[str, Any]) -> str:
    """For example ``after DPPO, failure (contact force), seed 9000003``."""
    outcome = "success" if video["success"] else f"failure ({video['failure']})"
    return f"{NAMES[policy]}, {outcome}, seed {video['seed']}"


def pad_pictures(dataset_root: Path) -> list[dict[str, str]]:
    """The pads' frames at the strongest contact of a demonstration, on one colour scale."""
    frames = strongest_contact(dataset_root)
    maximum = max(float(frame.max()) for frame in frames.values())
    return [
        {
            "title": pad.replace("_", " "),
            "source": heat_map(frames[pad], maximum),
            "maximum": f"{frames[pad].max():.0f}",
        }
        for pad in frames
    ]
