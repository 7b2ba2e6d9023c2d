"""Drawings of a replay: recorded dark, twin orange, commands pale."""

import numpy as np

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.diagnose.episode_replay.compare import EpisodePair
from lerobot_vtrefine.diagnose.episode_replay.touch import COUNT_BINS, READING_BINS, PadTouch, pressed
from lerobot_vtrefine.diagnose.episode_replay.tracking import JointTracking
from lerobot_vtrefine.embodiments import pad_layout_of
from lerobot_vtrefine.pages.charts import Panel, drawing, label, span
from lerobot_vtrefine.pages.pads import pad_image

RECORDED, TWIN, COMMAND = "m", "b", "d"
WIDTH, HEIGHT = 350.0, 190.0
LEFT, RIGHT, TOP, BOTTOM = 62.0, 14.0, 26.0, 44.0
NAMES_PX, BAR_PX, ROW_PX = 150.0, 11.0, 34.0
LEAST_SPAN = {"rad": 0.05, "mm": 2.0}
"""What an axis of positions shows at least, so that noise does not look like motion."""
LEAST_SHARE = 1e-4
"""Where the logarithmic axis of a histogram begins."""


def unit_of(joint: str) -> str:
    """Unit for people, a thousandth of the SI unit: mm for fingers, mrad for the rest."""
    return "mm" if joint.endswith("finger") else "mrad"


def _panel(x_range: tuple[float, float], y_range: tuple[float, float]) -> Panel:
    return Panel(LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, x_range, y_range)


def tracking_bars(tracking: list[JointTracking]) -> list[str]:
    """RMSE of every joint beside how far the recorded joint is from its command; a drawing per unit."""
    drawings = []
    for unit in ("mrad", "mm"):
        rows = [row for row in tracking if unit_of(row.joint) == unit]
        if rows:
            drawings.append(_tracking_bars(rows, unit))
    return drawings


def _tracking_bars(rows: list[JointTracking], unit: str) -> str:
    values = [1e3 * value for row in rows for value in (row.rmse, row.command_rmse, *(row.rmse_ci95 or ()))]
    width, height = 520.0, ROW_PX * len(rows)
    panel = Panel(NAMES_PX, 10, width - NAMES_PX - 24, height, (0.0, 1.05 * max(*values, 1e-6)), (0.0, 1.0))
    parts = [panel.frame(f"RMS [{unit}]", "", y_count=0)]
    for index, row in enumerate(rows):
        top = 10 + ROW_PX * (index + 0.15)
        parts.append(label(NAMES_PX - 8, top + BAR_PX + 5, row.joint.replace("_", " "), "end"))
        for place, value, style in ((top, row.command_rmse, COMMAND), (top + BAR_PX + 1, row.rmse, TWIN)):
            box = f'x="{NAMES_PX}" y="{place:.1f}" width="{panel.x(1e3 * value) - NAMES_PX:.1f}"'
            parts.append(f'<rect class="bar {style}" {box} height="{BAR_PX}"/>')
        if row.rmse_ci95 is not None:
            low, high = (panel.x(1e3 * value) for value in row.rmse_ci95)
            parts.append(f'<path class="whisker" d="M{low:.1f} {top + 1.5 * BAR_PX + 1:.1f}H{high:.1f}"/>')
    return drawing(width, height + 58, parts, f"RMS error of every joint in {unit}")


def joint_traces(pair: EpisodePair, joints: list[str], fps: float) -> list[str]:
    """Command, recorded and twin position of every joint of one episode."""
    time = np.arange(len(pair.position)) / fps
    drawings = []
    for j, joint in enumerate(joints):
        unit, scale = ("mm", 1e3) if unit_of(joint) == "mm" else ("rad", 1.0)
        command, recorded, twin = (
            scale * values[:, j] for values in (pair.recorded.action, pair.recorded.state, pair.position)
        )
        low, high = span(command, recorded, twin)
        middle, half = (low + high) / 2, max((high - low) / 2, LEAST_SPAN[unit] / 2)
        panel = _panel(span(time, margin=0.0), (middle - half, middle + half))
        parts = [
            panel.frame("time [s]", f"{joint.replace('_', ' ')} [{unit}]"),
            panel.steps(time, command, COMMAND),
            panel.line(time, twin, TWIN),
            panel.line(time, recorded, RECORDED),  # thin, so that both show where they are the same
        ]
        drawings.append(drawing(WIDTH, HEIGHT, parts, f"position of {joint.replace('_', ' ')} over time"))
    return drawings


def histograms(touch: list[PadTouch]) -> list[str]:
    """Distributions of touched taxels per pad: normalised readings (as the paper's Figure 4) and counts."""
    drawings = []
    for pad in touch:
        for bins, density, words in (
            (READING_BINS, pad.reading_density, "normalised reading"),
            (COUNT_BINS, pad.count_density, "counts above idle"),
        ):
            shares = np.maximum(np.asarray(density, float), LEAST_SHARE)
            sides = shares if words.startswith("norm") else np.log10(shares)
            panel = _panel((bins[0], bins[-1]), (sides.min(), sides.max() + 1e-9))
            log = "" if sides is shares else "log₁₀ of "
            parts = [
                panel.frame(words, f"{pad.pad.replace('_', ' ')}: {log}share of touched taxels"),
                panel.stairs(np.asarray(bins), sides[0], RECORDED, filled=True),
                panel.stairs(np.asarray(bins), sides[1], TWIN),
            ]
            drawings.append(drawing(WIDTH, HEIGHT, parts, f"{words} of {pad.pad.replace('_', ' ')}"))
    return drawings


def pad_totals(pair: EpisodePair, fps: float) -> list[str]:
    """Sum of counts above idle over one episode, per pad, on one scale."""
    sums = {pad: [side.sum(1) for side in pads_above(pair, pad)] for pad in shared_pads(pair)}
    highest = span(*(side for sides in sums.values() for side in sides), zero=True)
    drawings = []
    for pad, (recorded, twin) in sums.items():
        time, words = np.arange(len(recorded)) / fps, pad.replace("_", " ")
        panel = _panel(span(time, margin=0.0), highest)
        parts = [
            panel.frame("time [s]", f"{words}: sum of counts"),
            panel.line(time, twin, TWIN),
            panel.line(time, recorded, RECORDED),
        ]
        drawings.append(drawing(WIDTH, HEIGHT, parts, f"sum of the counts of {words} over time"))
    return drawings


def frames(pair: EpisodePair, moment: int) -> tuple[list[dict[str, str]], float]:
    """Recorded and twin pads at one frame as pictures on one scale, and its top [counts above idle]."""
    above = {pad: [side[moment] for side in pads_above(pair, pad)] for pad in shared_pads(pair)}
    highest = max(1.0, *(float(side.max()) for sides in above.values() for side in sides))
    pictures = []
    for side, name in enumerate(("recorded", "twin")):
        for pad, sides in above.items():
            layout = pad_layout_of(pad)
            picture = pad_image(sides[side].reshape(layout.rows, layout.cols), highest)
            pictures.append({"source": picture, "caption": f"{pad.replace('_', ' ')}, {name}"})
    return pictures, highest


def shared_pads(pair: EpisodePair) -> list[str]:
    """Pads that recording and twin both have."""
    return [pad for pad in pair.counts if pad in pair.recorded.counts]


def pads_above(pair: EpisodePair, pad: str) -> tuple[Array, Array]:
    """Counts above idle and noise floor of recorded and twin, (T, K) each."""
    recorded = pressed(pair.recorded.counts[pad], pair.recorded.baselines[pad])
    return recorded, pressed(pair.counts[pad], pair.baselines[pad])
