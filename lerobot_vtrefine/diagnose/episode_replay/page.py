"""``report.html`` of a replay: one self-contained page."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.diagnose.episode_replay import figures
from lerobot_vtrefine.diagnose.episode_replay.compare import Comparison, EpisodePair
from lerobot_vtrefine.diagnose.episode_replay.touch import telling_frames
from lerobot_vtrefine.embodiments import pad_layout_of
from lerobot_vtrefine.pages.pads import colour_scale, encode, pad_film
from lerobot_vtrefine.pages.render import render
from lerobot_vtrefine.wording import plural

FRAMES_SHOWN = 4
LEAST_TOLD = 0.1
"""Errors of joints below this are not told in figures [mrad, mm]."""


def render_page(comparison: Comparison) -> str:
    """The page as HTML text; figures are embedded."""
    joints = [row.joint for row in comparison.tracking]
    worst, typical = _worst_and_typical(comparison)
    shown = {"typical": typical} if worst is typical else {"typical": typical, "worst": worst}
    pads_pair = _strongest_touch(comparison)
    return render(
        "lerobot_vtrefine.diagnose.episode_replay",
        "page.html",
        verdict=verdict(comparison),
        twin=_video(comparison.film, comparison.fps) if comparison.film else None,
        filmed=comparison.pairs[0].recorded.index,
        films=_films(pads_pair, comparison.fps) if pads_pair else [],
        comparison=comparison,
        episodes=len(comparison.pairs),
        frames=sum(len(pair.position) for pair in comparison.pairs),
        rows=[_tracking_row(row) for row in comparison.tracking],
        bars=figures.tracking_bars(comparison.tracking),
        traces=[
            (name, pair.recorded.index, figures.joint_traces(pair, joints, comparison.fps))
            for name, pair in shown.items()
        ],
        touch=comparison.touch,
        histograms=figures.histograms(comparison.touch),
        totals=figures.pad_totals(pads_pair, comparison.fps) if pads_pair else [],
        moments=_moments(pads_pair, comparison.fps) if pads_pair else [],
        touch_episode=pads_pair.recorded.index if pads_pair else None,
    )


def verdict(comparison: Comparison) -> str:
    """What the replay says, in a sentence or two."""
    if not comparison.tracking:
        return "No joint was compared."
    arms = [row for row in comparison.tracking if figures.unit_of(row.joint) == "mrad"]
    worst = max(arms or comparison.tracking, key=lambda row: row.rmse)
    if max(row.peak for row in comparison.tracking) == 0.0:
        said = "The twin repeats the recorded motion exactly."
    else:
        error, unit = 1e3 * worst.rmse, figures.unit_of(worst.joint)
        within, joint = f"{max(error, LEAST_TOLD):.1f} {unit} RMS", worst.joint.replace("_", " ")
        said = f"The twin follows the recorded arms to within {within}; the worst joint is {joint}."
    felt = [pad for pad in comparison.touch if pad.overlap is not None]
    if comparison.touch and all(pad.identical_frames == pad.frames for pad in comparison.touch):
        said += " All pads read the same in every frame."
    elif felt:
        least = min(felt, key=lambda pad: pad.overlap or 0.0)
        said += f" Pad readings overlap by {100 * (least.overlap or 0.0):.0f} % or more."
    ended = [pair.success for pair in comparison.pairs if pair.success is not None]
    if ended:
        episodes = plural(len(ended), "episode")
        said += f" In the twin {sum(ended)} of {episodes} ended with the plug seated and held."
    return said


def _video(frames: list[Array], fps: float) -> str:
    """Frames as an MP4 data URI."""
    from lerobot.utils.io_utils import write_video

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "twin.mp4"
        write_video(path, frames, round(fps))
        return encode(path.read_bytes(), "video/mp4")


def _films(pair: EpisodePair, fps: float) -> list[dict[str, str]]:
    """Every pad in motion, recorded beside the twin, on one scale."""
    sides = {}
    for pad in figures.shared_pads(pair):
        layout = pad_layout_of(pad)
        shape = (-1, layout.rows, layout.cols)
        sides[pad] = [side.reshape(shape) for side in figures.pads_above(pair, pad)]
    top = max(1.0, *(float(side.max()) for both in sides.values() for side in both))
    return [
        {
            "source": pad_film(both, top, 1.0 / fps),
            "caption": f"{pad.replace('_', ' ')}: recorded, and in the twin.",
            "scale": colour_scale(top, "counts above idle"),
        }
        for pad, both in sides.items()
    ]


def _tracking_row(row: Any) -> dict[str, str]:
    def number(value: float | None, digits: int = 1) -> str:
        if value is None:
            return "–"
        rounded = round(1e3 * value, digits) + 0.0  # no minus before a zero
        return f"{rounded:.{digits}f}".replace("-", "−")

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


def _moments(pair: EpisodePair, fps: float) -> list[tuple[str, list[dict[str, str]], str]]:
    """Time, pictures and colour scale of the frames that tell most."""
    above = np.concatenate([figures.pads_above(pair, pad)[0] for pad in figures.shared_pads(pair)], axis=1)
    shown = []
    for moment in telling_frames(above, FRAMES_SHOWN):
        pictures, top = figures.frames(pair, moment)
        shown.append((f"{moment / fps:.1f} s", pictures, colour_scale(top, "counts above idle")))
    return shown
