"""A third rig, of its own conventions: few conditions, clocks that jitter, laws in several forms.

Laws act in continuous time on a fine grid, taxel by taxel, and every taxel is read at its own instant. It
shares no code with the library or the other generators. Effects are scaled to an achievable gain: the part of
the squared error of the best-fitting spring and damper that the true law takes away.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.special import erf

from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial

PITCH_M, FULL_SCALE, STEP_S = 0.002, 255.0, 2e-3
CONDITIONS, REPLICATES = 8, 2
Law = Callable[["Press", np.ndarray, float], np.ndarray]


@dataclass
class Press:
    """One press on the fine grid: heights above the face (T, n) [m] of the taxels that it touches."""

    time_s: np.ndarray
    x_m: np.ndarray
    y_m: np.ndarray
    depth_m: np.ndarray
    condition: int
    taxels: np.ndarray
    heights: np.ndarray
    rows: int
    cols: int
    rng: np.random.Generator
    frames_s: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def row(self) -> np.ndarray:
        return self.taxels // self.cols

    @property
    def col(self) -> np.ndarray:
        return self.taxels % self.cols

    @property
    def top(self) -> float:
        return 1.2e-3


@dataclass(frozen=True)
class Effect:
    """Its cause (empty: no catalogue lists it), where it acts, its law, and the cause's parameter.

    It acts on "height", "depth", "reading", "delay" or "frames".
    `law(press, x, strength)` gives the changed x; a delay's law gives seconds per taxel (n,).
    """

    cause: str
    where: str
    law: Law
    unit_strength: float
    parameter: str | None = None


def _largest(x: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(x, axis=0)


def _recovering(press: Press, x: np.ndarray, tau_s: float) -> np.ndarray:
    memory, out = np.zeros(x.shape[1]), np.empty_like(x)
    for k, value in enumerate(x):
        memory = np.maximum(value, memory * np.exp(-STEP_S / tau_s))
        out[k] = memory
    return out


def _mullins(press: Press, x: np.ndarray, a: float) -> np.ndarray:
    top = _largest(x)
    return x * (1 - a * (1 - x / np.maximum(top, 1e-12)))


def _ogden(press: Press, x: np.ndarray, a: float) -> np.ndarray:
    return x * (1 - a * erf((_largest(x) - x) / (0.4 * press.top)))


def _damage(press: Press, x: np.ndarray, a: float) -> np.ndarray:
    top = _largest(x)
    return np.where(x < 0.999 * top, x * (1 - a * np.tanh(top / (0.5 * press.top))), x)


def _healing(press: Press, x: np.ndarray, a: float) -> np.ndarray:
    top = _recovering(press, x, 4.0)
    return x * (1 - a * (1 - x / np.maximum(top, 1e-12)))


def _line_load(line: np.ndarray, x: np.ndarray, own: float) -> np.ndarray:
    """Load of every taxel's row or column, by the numbers of these (n,); `own` is the taxel's own weight."""
    total = np.zeros_like(x)
    for number in np.unique(line):
        mine = line == number
        total[:, mine] = x[:, mine].sum(axis=1, keepdims=True) - (1 - own) * x[:, mine]
    return total


def _toe(press: Press, x: np.ndarray, d0: float) -> np.ndarray:
    d = np.maximum(x, 0)
    return np.where(d < d0, d**2 / (2 * d0), d - d0 / 2)


def _relaxed(press: Press, x: np.ndarray, a: float) -> np.ndarray:
    slow, out = np.zeros(x.shape[1]), np.empty_like(x)
    for k, value in enumerate(x):
        slow += (value - slow) * (1 - np.exp(-STEP_S / 1.2))
        out[k] = value - a * slow
    return out


def _play(press: Press, x: np.ndarray, a: float) -> np.ndarray:
    half, follow, out = 0.15e-3, np.zeros(x.shape[1]), np.empty_like(x)
    for k, value in enumerate(x):
        follow = np.clip(follow, value - half, value + half) * (value > 0)
        out[k] = (1 - a) * value + a * np.maximum(follow, 0)
    return out


_LAWS: dict[str, tuple[str, str, Law, float, str | None]] = {
    "mullins": ("first_load_softening", "depth", _mullins, 0.3, None),
    "mullins_ogden": ("first_load_softening", "depth", _ogden, 0.3, None),
    "mullins_damage": ("first_load_softening", "depth", _damage, 0.2, None),
    "mullins_healing": ("first_load_softening", "depth", _healing, 0.3, None),
    "row_all": (
        "row_sharing", "reading", lambda p, x, c: x / (1 + c * _line_load(p.row, x, 1.0)), 1e-3,
        "conductance_per_count",
    ),
    "row_others": (
        "row_sharing", "reading", lambda p, x, c: x / (1 + c * _line_load(p.row, x, 0.0)), 1e-3,
        "conductance_per_count",
    ),
    "skew_rows": (
        "scan_skew", "delay", lambda p, x, s: s * p.row / (p.rows - 1), 0.02, "skew_s"
    ),
    "skew_cols": ("scan_skew", "delay", lambda p, x, s: s * p.col / (p.cols - 1), 0.02, None),
    "skew_raster": (
        "scan_skew", "delay", lambda p, x, s: s * p.taxels / (p.rows * p.cols - 1), 0.02, None
    ),
    "skew_raster_cols": (
        "scan_skew", "delay", lambda p, x, s: s * (p.col * p.rows + p.row) / (p.rows * p.cols - 1), 0.02,
        None,
    ),
    "offset_late": ("contact_offset", "height", lambda p, x, d: x - d, 5e-5, "offset_m"),
    "offset_early": ("contact_offset", "height", lambda p, x, d: x + d, 5e-5, None),
    "offset_toe": ("contact_offset", "depth", _toe, 2e-4, None),
    "drop_outs": ("sample_and_hold", "frames", lambda p, x, q: x, 0.2, None),
    "latency": ("latency", "delay", lambda p, x, s: np.full(len(p.taxels), s), 0.02, "tau_s"),
    "relaxation": ("viscoelastic_relaxation", "depth", _relaxed, 0.15, "fraction"),
    "hysteresis": ("hysteresis", "depth", _play, 0.2, "fraction"),
    "saturation": ("saturation", "reading", lambda p, x, c: x / (1 + c * x), 1e-3, None),
    "stiffening": (
        "nonlinear_stiffness", "depth",
        lambda p, x, e: 1e-3 * (np.maximum(x, 0) / 1e-3) ** (1 + e), 0.2, None,
    ),
    "gains": (
        "taxel_gain_spread", "reading",
        lambda p, x, s: x * np.exp(s * _SPECIMEN[p.taxels]), 0.1, "sigma",
    ),
    "hum": (
        "", "reading", lambda p, x, a: x + a * (x > 0) * np.sin(39.6 * p.time_s)[:, None], 5.0, None
    ),
    "breathing": (
        "", "reading", lambda p, x, a: x * (1 + a * np.sin(2.2 * p.time_s))[:, None], 0.1, None
    ),
    "supply": (
        "supply_droop", "reading", lambda p, x, c: x / (1 + c * x.sum(axis=1, keepdims=True)), 1e-4,
        "droop_per_count",
    ),
    "columns": ("", "reading", lambda p, x, c: x / (1 + c * _line_load(p.col, x, 1.0)), 1e-3, None),
}  # fmt: skip
_SPECIMEN = np.random.default_rng(77).standard_normal(4096)
EFFECTS = {name: Effect(*entry) for name, entry in _LAWS.items()}


def _courses(rng: np.random.Generator, rows: int, cols: int, number: int) -> tuple[np.ndarray, ...]:
    """Time, x, y and depth of one condition on the fine grid."""
    span = rng.uniform(5.0, 10.0)
    time = np.arange(0, span, STEP_S)
    peak, share = rng.uniform(0.6e-3, 1.2e-3), rng.uniform(0.3, 0.7)
    knots = np.cumsum(rng.uniform(0.4, 1.6, 9))
    knots *= 0.97 * span / knots[-1]
    levels = np.array(
        [-3e-4, share * peak, share * peak, 0.1 * peak, peak, peak, 0.45 * peak, 0.8 * peak, -3e-4]
    )
    depth = np.interp(time, knots, levels)
    if number % 4 == 1:  # a swing on top
        depth = depth + 0.12 * peak * np.sin(2 * np.pi * rng.uniform(0.5, 2.0) * time) * (depth > 0)
    if number % 4 == 2:  # let go in between
        depth = np.interp(time, knots, np.where(np.arange(9) == 3, -3e-4, levels))
    width = max(int(0.01 / STEP_S), 1)
    depth = np.convolve(np.pad(depth, width, mode="edge"), np.ones(width) / width, mode="same")[width:-width]
    x0 = rng.uniform(-0.35, 0.35) * (cols - 1) * PITCH_M
    y0 = rng.uniform(-0.3, 0.3) * (rows - 1) * PITCH_M
    slide = (
        rng.uniform(0.003, 0.008) * np.interp(time, [0.3 * span, 0.8 * span], [0.0, 1.0]) * (number % 4 == 3)
    )
    return time, x0 + slide, np.full(len(time), y0), depth


@dataclass
class Rig:
    """A specimen, its rig and its session; everything follows from the seed and the session's number."""

    seed: int
    rows: int = 12
    cols: int = 32
    session: int = 0

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 31])
        self.shape = {"shape": "sphere", "radius_m": float(rng.uniform(0.007, 0.013))}
        self.gain = float(rng.uniform(0.6, 0.9) * FULL_SCALE / 1.2e-3)
        self.damping_s = float(rng.uniform(0.5e-3, 5e-3))
        self.rate_hz = float(rng.choice([30.0, 100.0]))
        self.white = float(rng.uniform(0.0035, 0.007) * FULL_SCALE)
        self.slow = float(rng.uniform(0.0025, 0.006) * FULL_SCALE)
        self.rho = float(rng.uniform(0.8, 0.95))
        self.idle = rng.uniform(8, 30, self.rows * self.cols)
        courses = [_courses(rng, self.rows, self.cols, k) for k in range(CONDITIONS)]
        if self.session:  # other presses of the same specimen, at the same places
            rng = np.random.default_rng([self.seed, 35, self.session])
            sites = [(x[0], y[0]) for _, x, y, _ in courses]
            courses = [_courses(rng, self.rows, self.cols, k) for k in range(CONDITIONS)]
            courses = [
                (time, x - x[0] + site[0], y - y[0] + site[1], depth)
                for (time, x, y, depth), site in zip(courses, sites, strict=True)
            ]
        order = rng.permutation(CONDITIONS * REPLICATES)
        self.presses = [self._press(*courses[k // REPLICATES], k // REPLICATES, int(k)) for k in order]

    def _press(self, time, x, y, depth, condition, number) -> Press:
        rng = np.random.default_rng([self.seed, 32, number + 1000 * self.session])
        east = (np.arange(self.cols) - (self.cols - 1) / 2) * PITCH_M
        north = (np.arange(self.rows) - (self.rows - 1) / 2) * PITCH_M
        grid_x, grid_y = (axis.ravel() for axis in np.meshgrid(east, north))
        radius = self.shape["radius_m"]
        away2 = (grid_x - x[:, None]) ** 2 + (grid_y - y[:, None]) ** 2
        bottom = np.where(away2 < radius**2, radius - np.sqrt(np.maximum(radius**2 - away2, 0)), 1.0)
        heights = depth[:, None] - bottom
        taxels = np.flatnonzero((heights > -5e-5).any(axis=0))
        press = Press(time, x, y, depth, condition, taxels, heights[:, taxels], self.rows, self.cols, rng)
        count = int(time[-1] * self.rate_hz)
        press.frames_s = (np.arange(count) + 0.5 + rng.normal(0, 0.12, count).clip(-0.4, 0.4)) / self.rate_hz
        return press

    def readings(self, press: Press, effects, deviate: bool) -> np.ndarray:
        """Readings above idle without noise at the frames (F, n) [counts]."""
        rng = np.random.default_rng([self.seed, 33, *np.ravel(press.frames_s[:2] * 1e6).astype(int)])
        own_gain, own_offset = (
            (1 + 0.01 * rng.standard_normal(), 1e-5 * rng.standard_normal()) if deviate else (1, 0)
        )
        x = press.heights - own_offset
        for effect, strength in effects:
            x = effect.law(press, x, strength) if effect.where == "height" else x
        rate = np.gradient(press.depth_m, STEP_S)[:, None] + np.gradient(
            press.heights - press.depth_m[:, None], STEP_S, axis=0
        )
        touch, x = x > 0, np.maximum(x, 0)
        for effect, strength in effects:
            x = effect.law(press, x, strength) if effect.where == "depth" else x
        x = own_gain * self.gain * np.maximum(x + self.damping_s * rate, 0) * touch
        for effect, strength in effects:
            x = effect.law(press, x, strength) if effect.where == "reading" else x
        x = np.minimum(x, FULL_SCALE)
        delay = sum(
            (e.law(press, x, s) for e, s in effects if e.where == "delay"), np.zeros(len(press.taxels))
        )
        taken = press.frames_s.copy()
        for effect, strength in effects:
            if effect.where == "frames":
                held = rng.uniform(size=len(taken)) < strength
                held[0] = False
                taken = taken[np.maximum.accumulate(np.where(held, 0, np.arange(len(taken))))]
        out = np.empty((len(taken), len(press.taxels)))
        for j, late in enumerate(delay):
            out[:, j] = np.interp(taken - late, press.time_s, x[:, j])
        press.__dict__["taken"] = taken
        return out

    def expected(self, press: Press, effects) -> np.ndarray:
        """Mean readings (F, n) [counts] over what nobody knows of a press before it is recorded: how its gain
        and touch deviate, and which of its frames drop out."""
        mean = self.readings(press, [item for item in effects if item[0].where != "frames"], False)
        for chance in [strength for effect, strength in effects if effect.where == "frames"]:
            for k in range(1, len(mean)):
                mean[k] = chance * mean[k - 1] + (1 - chance) * mean[k]
        return mean

    def achievable(self, effects) -> float:
        """Part of the squared error of the best spring and damper that the true law takes away.

        Both are judged on recordings with deviations and noise of their own, which neither knows. Frames that
        drop out are the recording's own, but for a shift by two frames: for them it is a scale, and no model
        can reach it.
        """
        gram, along, power, left, count = np.zeros((2, 2)), np.zeros(2), 0.0, 0.0, 0
        for press in self.presses:
            truth, measured = (self.readings(press, effects, deviate) for deviate in (False, True))
            at = np.searchsorted(press.time_s, press.frames_s).clip(max=len(press.time_s) - 1)
            touch = press.heights[at] > 0
            rate = np.gradient(press.heights, STEP_S, axis=0)[at]
            columns = np.stack([(press.heights[at] * touch).ravel(), (rate * touch).ravel()])
            gram, along = gram + columns @ columns.T, along + columns @ measured.ravel()
            power, count = power + float((measured**2).sum()), count + truth.size
            left += float(((measured - truth) ** 2).sum())
        noise = count * (self.white**2 + self.slow**2 + 1 / 12)
        return 1.0 - (left + noise) / (power - along @ np.linalg.solve(gram, along) + noise)

    def strength_for(self, effect: Effect, gain: float) -> float:
        """Strength at which the effect has that achievable gain, by bisection of its logarithm."""
        low, high = np.log(effect.unit_strength) - 5, np.log(effect.unit_strength) + 3
        if effect.where in ("frames",):
            high = np.log(0.85)
        for _ in range(9):
            middle = 0.5 * (low + high)
            low, high = (
                (middle, high) if self.achievable([(effect, np.exp(middle))]) < gain else (low, middle)
            )
        return float(np.exp(0.5 * (low + high)))

    def record(self, effects=()) -> RecordingSet:
        """The session as `read_recording_set` would give it."""
        trials, start_s = [], 0.0
        for order, press in enumerate(self.presses):
            signal = self.readings(press, effects, True)
            taken, frames = press.__dict__["taken"], len(press.frames_s)
            rng = np.random.default_rng([self.seed, 34, order + 1000 * self.session])
            slow = rng.standard_normal((frames, self.rows * self.cols))
            for k in range(1, frames):
                slow[k] = self.rho * slow[k - 1] + np.sqrt(1 - self.rho**2) * slow[k]
            raw = self.idle + self.white * rng.standard_normal(slow.shape) + self.slow * slow
            raw[:, press.taxels] += signal
            raw = np.clip(np.round(raw), 0, FULL_SCALE)
            same = np.flatnonzero(np.diff(taken, prepend=-1) == 0)
            for k in same:
                raw[k] = raw[k - 1]
            at = press.frames_s
            zeros = np.zeros(frames)
            column = [np.interp(at, press.time_s, values) for values in (press.x_m, press.y_m, press.depth_m)]
            trials.append(
                Trial(
                    f"p{order:02d}.parquet", f"c{press.condition}", order, start_s, self.shape, at,
                    *column, zeros, zeros, None, None, raw,
                )
            )  # fmt: skip
            start_s += float(at[-1]) + 8.0
        return RecordingSet(Path(), "pad", self.rows, self.cols, PITCH_M, FULL_SCALE, (), tuple(trials))
