"""Charts of success rates: as bars with intervals, and over iterations."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.pages.charts import Panel, drawing, label, percent_tick

WIDTH, HEIGHT = 340, 260
LEFT, RIGHT, TOP, BOTTOM = 56, 14, 26, 46
PER_BAR = 112
"""Width of a bar with its label; a chart of many bars is wider."""
WIDEST_BAR = 120.0


@dataclass(frozen=True)
class Series:
    """A line through points (x, y); ``style`` is a CSS class of the page."""

    label: str
    points: Sequence[tuple[float, float]]
    style: str = "a"
    markers: bool = False
    """Points alone, for few of them."""


@dataclass(frozen=True)
class Bar:
    """A rate in 0..1 with its interval."""

    label: str
    rate: float
    low: float
    high: float
    style: str = "a"


def line_chart(series: Sequence[Series], x_title: str, y_title: str) -> str:
    """Lines over whole numbers, such as iterations; y is a rate from 0 to 1. Empty text without any point."""
    xs = [x for line in series for x, _ in line.points]
    if not xs:
        return ""
    panel = _panel(WIDTH, (min(xs), max(max(xs), min(xs) + 1)))
    parts = [panel.frame(x_title, "", x_least=1.0, y_count=5, y_text=percent_tick)]
    for line in series:
        points = np.array(line.points, float).reshape(-1, 2)
        draw = panel.dots if line.markers else panel.line
        parts.append(draw(points[:, 0], points[:, 1], line.style))
    return drawing(WIDTH, HEIGHT, parts, y_title)


def bar_chart(bars: Sequence[Bar], y_title: str) -> str:
    """Bars with interval whiskers, y from 0 to 1."""
    width = max(WIDTH, LEFT + RIGHT + PER_BAR * len(bars))
    panel = _panel(width, (0.0, float(len(bars))))
    half = min(WIDEST_BAR / 2, 0.32 * panel.width / len(bars))
    parts = [panel.frame("", "", x_ticks=False, y_count=5, y_text=percent_tick)]
    for index, bar in enumerate(bars):
        middle, top = panel.x(index + 0.5), panel.y(bar.rate)
        box = f'x="{middle - half:.1f}" y="{top:.1f}" width="{2 * half:.1f}" height="{panel.y(0) - top:.1f}"'
        parts += [
            f'<rect class="bar {bar.style}" {box} rx="3"/>',
            panel.whiskers(*np.array([[index + 0.5], [bar.low], [bar.high]])),
            label(middle, panel.y(bar.high) - 6, percent_tick(bar.rate), "middle", "value"),
            label(middle, HEIGHT - BOTTOM + 19, bar.label, "middle"),
        ]
    return drawing(width, HEIGHT, parts, y_title)


def _panel(width: float, x_range: tuple[float, float]) -> Panel:
    return Panel(LEFT, TOP, width - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, x_range, (0.0, 1.0))
