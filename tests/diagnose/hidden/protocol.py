"""Motions of the indenter: what a careful, a hasty and a minimal operator would record."""

from dataclasses import dataclass

import numpy as np

from hidden.rig import Rig

CLEAR_M = -0.0004
"""Height of the indenter between presses, as a depth."""
IDLE_S = 0.7
SMOOTHING_S = 0.04
"""Length of the box that rounds the corners of the motion."""


@dataclass(frozen=True)
class Motion:
    """Key points of one condition, joined by straight lines: times (K,) [s] and x, y, depth (K, 3) [m]."""

    kind: str
    indenter: int
    times_s: np.ndarray
    points_m: np.ndarray

    def sample(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (T, 3) at times (T,), corners rounded by a moving average."""
        grid = np.arange(-0.5, self.times_s[-1] + 0.5, 1e-3)
        lines = np.stack([np.interp(grid, self.times_s, p) for p in self.points_m.T], axis=1)
        total = np.vstack([np.zeros(3), np.cumsum(lines, axis=0)])
        half = round(SMOOTHING_S / 2e-3)
        index = np.arange(len(grid))
        low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(grid))
        smooth = (total[high] - total[low]) / (high - low)[:, None]
        speed = np.gradient(smooth, grid, axis=0)
        return tuple(np.stack([np.interp(time_s, grid, c) for c in v.T], axis=1) for v in (smooth, speed))


class Pen:
    """Draws a motion: lift, travel, press, hold; no move is shorter than two frames and a half."""

    def __init__(self, x_m: float, y_m: float, rate_hz: float) -> None:
        self.shortest_s = 2.5 / rate_hz
        self.now = [x_m, y_m, CLEAR_M]
        self.times, self.points = [0.0, IDLE_S], [list(self.now), list(self.now)]

    def go(self, seconds: float, depth: float | None = None, xy: tuple[float, float] | None = None) -> None:
        self.now = [*(xy or self.now[:2]), self.now[2] if depth is None else depth]
        self.times.append(self.times[-1] + max(seconds, self.shortest_s))
        self.points.append(list(self.now))

    def motion(self, kind: str, indenter: int) -> Motion:
        return Motion(kind, indenter, np.array(self.times), np.array(self.points))


def site(rig: Rig, rng: np.random.Generator) -> tuple[float, float]:
    """A place on the pad, within the taxels' field."""
    half = np.array([rig.cols - 1, rig.rows - 1]) * rig.pitch_m / 2
    return tuple(rng.uniform(-half, half))


def press(pen: Pen, depth: float, ramp_s: float, hold_s: float, speed_back: float = 1.0) -> None:
    pen.go(ramp_s, depth)
    pen.go(hold_s)
    pen.go(ramp_s * speed_back, CLEAR_M)


def draw(kind: str, rig: Rig, rng: np.random.Generator) -> Motion:
    """One condition of a kind, filling the rig's duration."""
    pen = Pen(*site(rig, rng), rig.rate_hz)
    depth = rig.reach_m * rng.uniform(0.45, 1.0)
    ramp = float(np.exp(rng.uniform(np.log(0.12), np.log(1.6))))
    end = rig.duration_s - 0.6
    if kind == "hold":
        press(pen, depth, ramp, max(0.5, rng.uniform(0.45, 0.6) * end - ramp))
    while pen.times[-1] + 2 * ramp + 0.8 < end:
        scale = rng.uniform(0.5, 1.0)
        if kind in ("cycles", "hold"):
            press(pen, depth * scale, ramp, rng.uniform(0.1, 0.6))
        elif kind == "unloads":
            unloads(pen, depth, ramp, rng, end)
        elif kind == "slide" and rig.rows * rig.cols > 1:
            pen.go(ramp, depth * scale)
            pen.go(rng.uniform(0.7, 2.0), xy=site(rig, rng))
            pen.go(ramp, CLEAR_M)
        elif kind == "sites":
            press(pen, depth * scale, ramp, rng.uniform(0.2, 0.6))
            pen.go(0.4, xy=site(rig, rng))
        else:
            stairs(pen, depth, ramp, rng)
        pen.go(rng.uniform(0.15, 0.5))
    pen.go(0.1)
    return pen.motion(kind, int(rng.integers(len(rig.indenters))))


def unloads(pen: Pen, depth: float, ramp: float, rng: np.random.Generator, end: float) -> None:
    """Load, then go part of the way back and forth before leaving."""
    pen.go(ramp, depth)
    for _ in range(3):
        if pen.times[-1] + 2 * ramp > end:
            break
        low = depth * rng.uniform(0.2, 0.7)
        pen.go(ramp * (depth - low) / depth, low)
        pen.go(rng.uniform(0.05, 0.3))
        pen.go(ramp * (depth - low) / depth, depth * rng.uniform(low / depth, 1.0))
    pen.go(ramp, CLEAR_M)


def stairs(pen: Pen, depth: float, ramp: float, rng: np.random.Generator) -> None:
    for level in (0.35, 0.7, 1.0):
        pen.go(ramp / 3, depth * level)
        pen.go(rng.uniform(0.2, 0.5))
    pen.go(ramp, CLEAR_M)


KINDS = ("cycles", "hold", "unloads", "sites", "slide", "stairs")


def standard(rig: Rig, rng: np.random.Generator, conditions: int | None = None) -> list[Motion]:
    """Ramps of several speeds, holds, partial unloads, slides and several sites."""
    count = conditions or rig.conditions
    motions = [draw(KINDS[i % len(KINDS)], rig, rng) for i in range(count)]
    return [motions[i] for i in rng.permutation(count)]


def monotone(rig: Rig, rng: np.random.Generator) -> list[Motion]:
    """The same press, one speed, one depth, one site, in every recording."""
    pen = Pen(*(0.25 * np.array(site(rig, rng))), rig.rate_hz)
    while pen.times[-1] + 2.2 < rig.duration_s:
        press(pen, 0.8 * rig.reach_m, 0.6, 0.3)
        pen.go(0.4)
    return [pen.motion("monotone", 0)] * rig.conditions


def monotone_and_more(rig: Rig, rng: np.random.Generator) -> list[Motion]:
    """The same press again and again, then a long hold, new speeds, depths and sites."""
    return [*monotone(rig, rng), *(draw(kind, rig, rng) for kind in ("hold", "sites", "unloads", "slide"))]


PROTOCOLS = {"standard": standard, "monotone": monotone, "monotone_and_more": monotone_and_more}
