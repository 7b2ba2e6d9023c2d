"""A plain x-y plot as inline SVG; the page's style sheet colours it, in light and dark mode."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from lerobot_vtrefine.diagnose.report.numbers import digits

NARROW = 400.0
"""Drawings up to this width [px] are shown smaller on narrow screens."""
MAX_POINTS = 400
"""Lines are thinned to this many points, which is more than pixels show."""


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

    def _points(self, xs: np.ndarray, ys: np.ndarray) -> str:
        keep = np.flatnonzero(np.isfinite(xs) & np.isfinite(ys))
        if len(keep) > MAX_POINTS:
            keep = keep[np.linspace(0, len(keep) - 1, MAX_POINTS).astype(int)]
        return " ".join(f"{self.x(xs[k]):.1f},{self.y(ys[k]):.1f}" for k in keep)

    def frame(self, x_title: str, y_title: str, *, x_ticks: bool = True, y_count: int = 4) -> str:
        """Grid lines with numbers, and titles of both axes; no grid for ``y_count`` 0."""
        right, bottom = self.left + self.width, self.top + self.height
        parts = []
        for tick in ticks(*self.y_range, y_count) if y_count else ():
            place = self.y(tick)
            style = "zero" if tick == 0 else "grid"
            parts.append(f'<path class="{style}" d="M{self.left:.1f} {place:.1f}H{right:.1f}"/>')
            parts.append(label(self.left - 6, place + 4, digits(tick), "end"))
        if x_ticks:
            for tick in ticks(*self.x_range, 6):
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


def ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers within a range, about `count` of them."""
    raw = (high - low) / max(count, 1)
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
    style = "wide" if width > NARROW else "narrow"
    size = f'class="{style}" viewBox="0 0 {width:.0f} {height:.0f}"'
    return f'<svg {size} role="img" aria-label="{escape(title, quote=True)}">{body}</svg>'
