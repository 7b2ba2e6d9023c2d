"""Charts of all report pages as inline SVG: the page's style sheet colours them, in light and dark mode.

Styles are its classes: ``m`` measured or recorded, ``a`` before or simulated, ``b`` after, extended or the
twin, ``d`` what drove it. Text is 15 units high; drawings scroll rather than shrink it below 12 pixels.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

LEAST_SCALE = 0.82
"""How far a drawing shrinks on a narrow screen: 15 units then are 12.3 pixels."""
MOST_SCALE = 1.2
"""How far one grows on a wide one."""
MAX_POINTS = 400
"""Lines are thinned to this many points, which is more than pixels show."""


def digits(value: float) -> str:
    """Three significant digits without needless zeros or exponents."""
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e5:
        return f"{value:.2e}".replace("e-0", "e-").replace("e+0", "e")
    text = f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}"
    return text.replace("-", "−")


def percent_tick(value: float) -> str:
    """A rate from 0 to 1 on an axis."""
    return f"{100 * value:.0f} %"


@dataclass(frozen=True)
class Panel:
    """A rectangle of a drawing [px] with the data range that it shows."""

    left: float
    top: float
    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def x(self, value: float) -> float:
        """Horizontal place of a value."""
        low, high = self.x_range
        return self.left + (value - low) / (high - low) * self.width

    def y(self, value: float) -> float:
        """Vertical place of a value."""
        low, high = self.y_range
        return self.top + (high - value) / (high - low) * self.height

    def line(self, xs: np.ndarray, ys: np.ndarray, style: str) -> str:
        """A polyline through finite points."""
        return f'<polyline class="line {style}" points="{self._points(xs, ys)}"/>'

    def band(self, xs: np.ndarray, low: np.ndarray, high: np.ndarray, style: str) -> str:
        """The area between two curves."""
        points = self._points(np.concatenate([xs, xs[::-1]]), np.concatenate([low, high[::-1]]))
        return f'<polygon class="band {style}" points="{points}"/>'

    def steps(self, xs: np.ndarray, ys: np.ndarray, style: str) -> str:
        """A line that holds each value until the next one."""
        return self.line(np.repeat(xs, 2)[1:], np.repeat(ys, 2)[:-1], style)

    def dots(self, xs: np.ndarray, ys: np.ndarray, style: str, radius: float = 5.0) -> str:
        """A dot at every finite point."""
        return "".join(
            f'<circle class="dot {style}" cx="{self.x(x):.1f}" cy="{self.y(y):.1f}" r="{radius:g}"/>'
            for x, y in zip(xs, ys, strict=True)
            if np.isfinite(x) and np.isfinite(y)
        )

    def whiskers(self, xs: np.ndarray, low: np.ndarray, high: np.ndarray) -> str:
        """Upright intervals."""
        spans = zip(xs, low, high, strict=True)
        return "".join(
            f'<path class="whisker" d="M{self.x(x):.1f} {self.y(a):.1f}V{self.y(b):.1f}"/>'
            for x, a, b in spans
        )

    def stairs(self, edges: np.ndarray, heights: np.ndarray, style: str, *, filled: bool = False) -> str:
        """A histogram's outline, or its area."""
        xs, ys = np.repeat(edges, 2)[1:-1], np.repeat(heights, 2)
        return (
            self.band(xs, np.full(len(ys), self.y_range[0]), ys, style)
            if filled
            else self.line(xs, ys, style)
        )

    def rule(self, x: float, style: str) -> str:
        """An upright line through the panel."""
        return f'<path class="line {style}" d="M{self.x(x):.1f} {self.top:.1f}v{self.height:.1f}"/>'

    def _points(self, xs: np.ndarray, ys: np.ndarray) -> str:
        keep = np.flatnonzero(np.isfinite(xs) & np.isfinite(ys))
        if len(keep) > MAX_POINTS:
            keep = keep[np.linspace(0, len(keep) - 1, MAX_POINTS).astype(int)]
        return " ".join(f"{self.x(xs[k]):.1f},{self.y(ys[k]):.1f}" for k in keep)

    def frame(
        self,
        x_title: str,
        y_title: str,
        *,
        x_ticks: bool = True,
        x_least: float = 0.0,
        y_count: int = 4,
        y_text: Callable[[float], str] = digits,
    ) -> str:
        """Grid lines with numbers, and titles of both axes.

        Args:
            x_least: smallest distance of ticks.
            y_count: number of ticks; 0 draws no grid.
        """
        right, bottom = self.left + self.width, self.top + self.height
        parts = []
        for tick in ticks(*self.y_range, y_count) if y_count else ():
            place = self.y(tick)
            style = "zero" if tick == 0 else "grid"
            parts.append(f'<path class="{style}" d="M{self.left:.1f} {place:.1f}H{right:.1f}"/>')
            parts.append(label(self.left - 6, place + 5, y_text(tick), "end"))
        if x_ticks:
            for tick in ticks(*self.x_range, 6, x_least):
                place = self.x(tick)
                parts.append(f'<path class="grid" d="M{place:.1f} {bottom:.1f}v4"/>')
                parts.append(label(place, bottom + 19, digits(tick), "middle"))
            parts.append(label(self.left + self.width / 2, bottom + 38, x_title, "middle"))
        parts.append(f'<path class="axis" d="M{self.left:.1f} {self.top:.1f}V{bottom:.1f}H{right:.1f}"/>')
        parts.append(label(self.left, self.top - 7, y_title, "start"))
        return "".join(parts)


def span(*arrays: np.ndarray, margin: float = 0.05, zero: bool = False) -> tuple[float, float]:
    """Range of all finite values with a margin, never empty; with `zero` it contains zero."""
    values = np.concatenate([np.ravel(array) for array in arrays])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if zero:
        low, high = min(low, 0.0), max(high, 0.0)
    pad = margin * (high - low) if high > low else max(abs(high), 1e-6) * 0.5
    return low - pad, high + pad


def ticks(low: float, high: float, count: int, least: float = 0.0) -> list[float]:
    """Round numbers within a range, about `count` of them and at least `least` apart."""
    raw = max((high - low) / max(count, 1), least)
    size = 10.0 ** math.floor(math.log10(raw))
    step = next(size * factor for factor in (1, 2, 5, 10) if size * factor >= raw)
    first = math.ceil(low / step)
    return [round(k * step, 12) + 0.0 for k in range(first, math.floor(high / step) + 1)]


def label(x: float, y: float, text: str, anchor: str, style: str = "tick") -> str:
    """A text at a place; anchor start, middle or end."""
    return f'<text class="{style}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def drawing(width: float, height: float, parts: Sequence[str], title: str) -> str:
    """The parts as one picture, with a title for those who cannot see it."""
    body = "".join(parts)
    least, most = f"min-width: {LEAST_SCALE * width:.0f}px", f"max-width: {MOST_SCALE * width:.0f}px"
    size = f'viewBox="0 0 {width:.0f} {height:.0f}" style="{least}; {most}"'
    return f'<svg {size} role="img" aria-label="{escape(title, quote=True)}">{body}</svg>'
