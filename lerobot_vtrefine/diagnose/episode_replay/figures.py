"""Figures of a replay as PNG data URIs."""

import base64
import io

import numpy as np
from matplotlib.figure import Figure

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.diagnose.episode_replay.compare import EpisodePair
from lerobot_vtrefine.diagnose.episode_replay.touch import COUNT_BINS, READING_BINS, PadTouch, pressed
from lerobot_vtrefine.diagnose.episode_replay.tracking import JointTracking
from lerobot_vtrefine.embodiments import pad_layout_of

RECORDED, TWIN, COMMAND = "#1f6fb4", "#d1601f", "#9a9a9a"
DPI = 95
LEAST_SPAN = {"rad": 0.05, "mm": 2.0}
"""What an axis of positions shows at least, so that noise does not look like motion."""


def data_uri(figure: Figure) -> str:
    """The figure as a PNG in a ``data:`` URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def unit_of(joint: str) -> str:
    """Unit for people, a thousandth of the SI unit: mm for fingers, mrad for the rest."""
    return "mm" if joint.endswith("finger") else "mrad"


def tracking_bars(tracking: list[JointTracking]) -> Figure:
    """RMSE of every joint beside how far the recorded joint is from its command."""
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, width_ratios=[3, 1])
    for axis, unit in zip(axes, ("mrad", "mm"), strict=True):
        rows = [row for row in tracking if unit_of(row.joint) == unit]
        place = np.arange(len(rows))
        reference = [1e3 * row.command_rmse for row in rows]
        axis.bar(place - 0.2, reference, 0.4, color=COMMAND, label="recorded − command")
        axis.bar(place + 0.2, [1e3 * row.rmse for row in rows], 0.4, color=TWIN, label="twin − recorded")
        for x, row in zip(place, rows, strict=True):
            if row.rmse_ci95 is not None:
                axis.plot([x + 0.2] * 2, [1e3 * value for value in row.rmse_ci95], color="black", lw=1)
        names = [row.joint.replace("_", " ", 1).replace("_", " ") for row in rows]
        axis.set_xticks(place, names, rotation=35, ha="right", fontsize=10)
        axis.set_ylabel(f"RMS [{unit}]")
    axes[0].legend(fontsize=10, frameon=False)
    return figure


def joint_traces(pair: EpisodePair, joints: list[str], fps: float) -> Figure:
    """Command, recorded and twin position of every joint of one episode."""
    columns = 4
    rows = -(-len(joints) // columns)
    figure = Figure(figsize=(12, 1.9 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    time = np.arange(len(pair.position)) / fps
    for j, (axis, joint) in enumerate(zip(axes, joints, strict=False)):
        unit, scale = ("mm", 1e3) if unit_of(joint) == "mm" else ("rad", 1.0)
        axis.step(time, scale * pair.recorded.action[:, j], where="post", color=COMMAND, lw=1)
        axis.plot(time, scale * pair.recorded.state[:, j], color=RECORDED, lw=1.4)
        axis.plot(time, scale * pair.position[:, j], color=TWIN, lw=1.2)
        low, high = axis.get_ylim()
        middle, half = (low + high) / 2, max((high - low) / 2, LEAST_SPAN[unit] / 2)
        axis.set_ylim(middle - half, middle + half)
        axis.set_title(f"{joint.replace('_', ' ')} [{unit}]", fontsize=10)
        axis.tick_params(labelsize=10)
    axes[0].legend(["command", "recorded", "twin"], fontsize=10, frameon=False)
    return figure


def histograms(touch: list[PadTouch]) -> Figure:
    """Distributions of touched taxels per pad: normalised readings (as the paper's Figure 4) and counts."""
    figure = Figure(figsize=(3.1 * len(touch), 4.8), layout="constrained")
    axes = figure.subplots(2, len(touch), squeeze=False)
    for column, pad in enumerate(touch):
        for row, (bins, density) in enumerate(
            ((READING_BINS, pad.reading_density), (COUNT_BINS, pad.count_density))
        ):
            axis = axes[row, column]
            axis.stairs(density[0], bins, fill=True, color=RECORDED, alpha=0.45)
            axis.stairs(density[1], bins, color=TWIN, lw=1.6)
            axis.tick_params(labelsize=10)
            axis.set_xlabel(("normalised reading", "counts above idle")[row], fontsize=10)
            if row:
                axis.set_yscale("log")
        axes[0, column].set_title(pad.pad.replace("_", " "), fontsize=10)
    axes[0, 0].set_ylabel("share of touched taxels", fontsize=10)
    axes[0, 0].legend(["recorded", "twin"], fontsize=10, frameon=False)
    return figure


def pad_totals(pair: EpisodePair, fps: float) -> Figure:
    """Sum of counts above idle over one episode, per pad."""
    pads = [pad for pad in pair.counts if pad in pair.recorded.counts]
    figure = Figure(figsize=(12, 2.4), layout="constrained")
    axes = figure.subplots(1, len(pads), squeeze=False, sharex=True)[0]
    for axis, pad in zip(axes, pads, strict=True):
        recorded, twin = pads_above(pair, pad)
        time = np.arange(len(recorded)) / fps
        axis.plot(time, recorded.sum(1), color=RECORDED, lw=1.4)
        axis.plot(time, twin.sum(1), color=TWIN, lw=1.2)
        axis.set_title(pad.replace("_", " "), fontsize=10)
        axis.set_xlabel("time [s]", fontsize=10)
        axis.tick_params(labelsize=10)
    axes[0].set_ylabel("sum of counts", fontsize=10)
    axes[0].legend(["recorded", "twin"], fontsize=10, frameon=False)
    return figure


def frames(pair: EpisodePair, moment: int) -> Figure:
    """Recorded above twin, all pads at one frame on one colour scale (counts above idle)."""
    pads = [pad for pad in pair.counts if pad in pair.recorded.counts]
    above = {pad: [side[moment] for side in pads_above(pair, pad)] for pad in pads}
    highest = max(1.0, *(float(side.max()) for sides in above.values() for side in sides))
    figure = Figure(figsize=(3.1 * len(pads), 2.7), layout="constrained")
    axes = figure.subplots(2, len(pads), squeeze=False)
    for column, pad in enumerate(pads):
        layout = pad_layout_of(pad)
        for row, name in enumerate(("recorded", "twin")):
            axis = axes[row, column]
            picture = above[pad][row].reshape(layout.rows, layout.cols)
            image = axis.imshow(picture, vmin=0, vmax=highest, cmap="viridis")
            axis.set_xticks([])
            axis.set_yticks([])
            if column == 0:
                axis.set_ylabel(name, fontsize=10)
        axes[0, column].set_title(pad.replace("_", " "), fontsize=10)
    figure.colorbar(image, ax=axes, shrink=0.8, label="counts")
    return figure


def pads_above(pair: EpisodePair, pad: str) -> tuple[Array, Array]:
    """Counts above idle and noise floor of recorded and twin, (T, K) each."""
    recorded = pressed(pair.recorded.counts[pad], pair.recorded.baselines[pad])
    return recorded, pressed(pair.counts[pad], pair.baselines[pad])
