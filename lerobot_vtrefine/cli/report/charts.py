"""Small charts as inline SVG; the page's style sheet colours them, in light and dark mode."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 440, 260
LEFT, RIGHT, TOP, BOTTOM = 56, 14, 26, 46
LEAST_SCALE = 0.82
"""Text of 15 units stays above 12 pixels; narrower screens scroll."""
PER_BAR = 112
"""Width of a bar with its label; a chart of many bars is wider."""


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
    """Lines over a common x axis; y is a rate from 0 to 1. Empty text without any point."""
    xs = [x for line in series for x, _ in line.points]
    if not xs:
        return ""
    start, end = min(xs), max(max(xs), min(xs) + 1)

    def place(x: float) -> float:
        return LEFT + (x - start) / (end - start) * (WIDTH - LEFT - RIGHT)

    parts = [_grid()]
    for line in series:
        path = " ".join(f"{place(x):.1f},{_height(y):.1f}" for x, y in line.points)
        title = f"<title>{escape(line.label)}</title>"
        if line.markers:
            dots = ((place(x), _height(y)) for x, y in line.points)
            parts += [f'<circle class="dot {line.style}" cx="{x:.1f}" cy="{y:.1f}" r="5"/>' for x, y in dots]
            continue
        parts.append(f'<polyline class="line {line.style}" points="{path}">{title}</polyline>')
    parts += [_label(place(tick), HEIGHT - BOTTOM + 19, f"{tick:g}") for tick in _ticks(start, end)]
    parts.append(_label(WIDTH / 2, HEIGHT - 6, x_title))
    return _svg(parts, y_title)


def bar_chart(bars: Sequence[Bar], y_title: str) -> str:
    """Bars with interval whiskers, y from 0 to 1."""
    width = max(WIDTH, LEFT + RIGHT + PER_BAR * len(bars))
    step = (width - LEFT - RIGHT) / len(bars)
    parts = [_grid(width)]
    for index, bar in enumerate(bars):
        middle = LEFT + step * (index + 0.5)
        half = min(60.0, step * 0.32)
        top, low, high = _height(bar.rate), _height(bar.low), _height(bar.high)
        box = f'x="{middle - half:.1f}" y="{top:.1f}" width="{2 * half:.1f}" height="{_height(0) - top:.1f}"'
        caps = f"M{middle:.1f} {low:.1f}V{high:.1f}m-6 0h12M{middle - 6:.1f} {low:.1f}h12"
        parts += [
            f'<rect class="bar {bar.style}" {box} rx="3"/>',
            f'<path class="whisker" d="{caps}"/>',
            _label(middle, high - 6, f"{100 * bar.rate:.0f} %", "value"),
            _label(middle, HEIGHT - BOTTOM + 19, bar.label),
        ]
    return _svg(parts, y_title, width)


def _label(x: float, y: float, text: str, style: str = "tick") -> str:
    return f'<text class="{style}" x="{x:.1f}" y="{y:.1f}" text-anchor="middle">{escape(text)}</text>'


def _height(rate: float) -> float:
    return TOP + (1 - rate) * (HEIGHT - TOP - BOTTOM)


def _grid(width: int = WIDTH) -> str:
    lines = []
    for tick in (0.0, 0.25, 0.5, 0.75, 1.0):
        y = _height(tick)
        lines.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{width - RIGHT}"/>')
        lines.append(
            f'<text class="tick" x="{LEFT - 6}" y="{y + 5:.1f}" text-anchor="end">{100 * tick:.0f} %</text>'
        )
    return "".join(lines)


def _ticks(start: float, end: float, count: int = 6) -> list[int]:
    step = max(1, round((end - start) / count))
    return list(range(int(start), int(end) + 1, step))


def _svg(parts: Sequence[str], label: str, width: int = WIDTH) -> str:
    body = "".join(parts)
    size = f'viewBox="0 0 {width} {HEIGHT}" style="min-width: {LEAST_SCALE * width:.0f}px"'
    return f'<svg {size} role="img" aria-label="{escape(label)}">{body}</svg>'
