"""``report.html`` of a replay: one self-contained page."""

from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from lerobot_vtrefine.diagnose.episode_replay import figures
from lerobot_vtrefine.diagnose.episode_replay.compare import Comparison, EpisodePair
from lerobot_vtrefine.diagnose.episode_replay.touch import telling_frames

FRAMES_SHOWN = 4


def render_page(comparison: Comparison) -> str:
    """The page as HTML text; figures are embedded."""
    environment = Environment(
        loader=PackageLoader("lerobot_vtrefine.diagnose.episode_replay", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    joints = [row.joint for row in comparison.tracking]
    worst, typical = _worst_and_typical(comparison)
    shown = {"typical": typical} if worst is typical else {"typical": typical, "worst": worst}
    pads_pair = _strongest_touch(comparison)
    return environment.get_template("page.html").render(
        comparison=comparison,
        episodes=len(comparison.pairs),
        frames=sum(len(pair.position) for pair in comparison.pairs),
        successes=[pair.success for pair in comparison.pairs if pair.success is not None],
        rows=[_tracking_row(row) for row in comparison.tracking],
        bars=figures.data_uri(figures.tracking_bars(comparison.tracking)),
        traces=[
            (name, pair.recorded.index, figures.data_uri(figures.joint_traces(pair, joints, comparison.fps)))
            for name, pair in shown.items()
        ],
        touch=comparison.touch,
        histograms=figures.data_uri(figures.histograms(comparison.touch)) if comparison.touch else None,
        totals=figures.data_uri(figures.pad_totals(pads_pair, comparison.fps)) if pads_pair else None,
        moments=_moments(pads_pair, comparison.fps) if pads_pair else [],
        touch_episode=pads_pair.recorded.index if pads_pair else None,
    )


def _tracking_row(row: Any) -> dict[str, str]:
    def number(value: float | None, digits: int = 1) -> str:
        return "–" if value is None else f"{1e3 * value:.{digits}f}"

    interval = "" if row.rmse_ci95 is None else f" [{number(row.rmse_ci95[0])}, {number(row.rmse_ci95[1])}]"
    return {
        "joint": row.joint.replace("_", " "),
        "unit": figures.unit_of(row.joint),
        "rmse": number(row.rmse) + interval,
        "bias": number(row.bias),
        "peak": number(row.peak),
        "command": number(row.command_rmse),
        "explained": "–" if row.explained is None else f"{100 * row.explained:.0f} %",
        "lags": f"{number(row.recorded_lag_s, 0)} / {number(row.twin_lag_s, 0)}",
    }


def _worst_and_typical(comparison: Comparison) -> tuple[EpisodePair, EpisodePair]:
    """Episodes by their error, each joint in units of its error over all episodes."""
    scale = np.array([max(row.rmse, 1e-9) for row in comparison.tracking])
    errors = [
        float((((pair.position - pair.recorded.state) / scale) ** 2).mean()) for pair in comparison.pairs
    ]
    order = np.argsort(errors)
    return comparison.pairs[int(order[-1])], comparison.pairs[int(order[(len(order) - 1) // 2])]


def _strongest_touch(comparison: Comparison) -> EpisodePair | None:
    """The episode whose recorded pads felt most."""
    compared = [pad.pad for pad in comparison.touch]
    pairs = [pair for pair in comparison.pairs if set(compared) <= set(pair.recorded.counts)]
    if not compared or not pairs:
        return None
    return max(pairs, key=lambda pair: sum(figures.pads_above(pair, pad)[0].sum() for pad in compared))


def _moments(pair: EpisodePair, fps: float) -> list[tuple[str, str]]:
    pads = [pad for pad in pair.counts if pad in pair.recorded.counts]
    above = np.concatenate([figures.pads_above(pair, pad)[0] for pad in pads], axis=1)
    return [
        (f"{moment / fps:.1f} s", figures.data_uri(figures.frames(pair, moment)))
        for moment in telling_frames(above, FRAMES_SHOWN)
    ]
