"""The joints' servo model: second-order response to zero-order-held commands, and what real joints add to it.

A joint's target r is its command, late by tau, through play of full width `play`, plus `push` (gravity's sag,
what a load bends), and may pass a low-pass of the first order. The servo follows:

    q'' = omega^2 (r - friction sign(q') - q) - 2 zeta omega q'          (friction as servo error, [rad])

and the encoder reads q + offset, possibly through play of its own (`loose`). A joint at rest may need more
than its friction to break away (`stick`), and play may be taken up little by little (`rounding`): several
plays side by side, whose widths spread evenly about their mean (Prandtl-Ishlinskii). Without friction every
step is exact, whatever the frames' spacing and the delay; with friction, so are the stops between them.

Shapes: N frames, T trials, C columns. A column is one joint under one set of parameters: columns repeat
joints when several sets are tried at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.joints.batch import Batch
from lerobot_vtrefine.diagnose.joints.stages import applied

Array = np.ndarray

MAX_PARTS = 4
_TURN_RAD = 1.5
"""A joint with friction is followed in steps of at most this phase, so that it stops at most once in each."""
_CRITICAL = 1e-6
_SPREAD = (-0.8, -0.4, 0.0, 0.4, 0.8)
"""Middles of five equal parts of a spread of widths."""
_DT_DIGITS = 6
_LEAST_MEAN_S = 1e-4
_SHORTEST_S = 1e-6
"""A low-pass that is faster passes everything."""


@dataclass(frozen=True)
class Columns:
    """What to simulate: C columns of joints with their parameters (C,), SI units."""

    joint: Array
    omega: Array
    """Natural frequency [rad/s]."""
    zeta: Array
    """Damping ratio."""
    offset: Array
    """Reading minus true position."""
    play: Array
    """Full width of the play between command and servo."""
    loose: Array
    """Full width of the play between servo and encoder."""
    friction: Array
    """Dry friction, divided by the servo's stiffness."""
    stop: Array | None = None
    """Distance from zero at which the joint meets what its gripper holds; zero where it meets nothing."""
    give: Array | None = None
    """How far a stopped joint still follows its target, as a part of the way."""
    rounding: Array | None = None
    """Half the spread of the widths that make up a play, as a part of their mean; zero is one sharp play."""
    stick: Array | None = None
    """By what part breaking away takes more than friction in motion."""
    tau_s: float = 0.0
    """Every command acts this late."""
    late: Array | None = None
    """By how much more the commands of one joint do [s]."""
    filtered: Array | None = None
    """Time constant of the low-pass before the servo [s]."""
    push: Array | None = None
    """(N, T, C) added to the target."""
    stages: Mapping[str, Array] | None = None
    """Values (C,) of `stages.parameters`."""

    def only(self, kind: Array, tau_s: float) -> "Columns":
        """The servo's parameters of some columns, whose commands act that late."""
        names = ("joint", "omega", "zeta", "offset", "play", "loose", "friction", "stick", "filtered")
        own = {name: None if (all_ := getattr(self, name)) is None else all_[kind] for name in names}
        none = dict.fromkeys(("stop", "give", "push", "stages", "rounding", "late"))
        return replace(self, **own, **none, tau_s=tau_s)


def two_delays(mean_s: float, spread_s: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two delays [s] and their parts, with the mean, deviation and skewness of a gamma distribution, so that
    none is negative (Gauss's quadrature, generalised Laguerre)."""
    scale_s = spread_s**2 / max(mean_s, _LEAST_MEAN_S)
    shape = max(mean_s, _LEAST_MEAN_S) / scale_s
    early_s, late_s = (scale_s * (shape + 1 + way * np.sqrt(shape + 1)) for way in (-1, 1))
    part = (late_s - mean_s) / (late_s - early_s)
    return (early_s, part), (late_s, 1 - part)


def simulate(batch: Batch, columns: Columns) -> Array:
    """Encoder readings (N, T, C) that follow from the commands and the first position alone."""
    load = None if batch.load is None else batch.load[:, :, columns.joint]
    first = _true_first(batch.first_position[:, columns.joint] - columns.offset, columns, load)
    target = _play(batch.command[:, :, columns.joint], columns, first)
    if columns.stop is not None and columns.give is not None and (columns.stop > 0).any():
        target = blocked(target, columns.stop, columns.give)
    if columns.stages is not None:
        target = applied("target", target, columns.stages, load)
    start = np.clip(target[0], first - columns.loose / 2, first + columns.loose / 2)
    dry = columns.friction > 0
    delay = np.full(dry.shape, columns.tau_s) if columns.late is None else columns.tau_s + columns.late
    q = np.empty_like(target)
    for tau_s, rubs in sorted(set(zip(delay.tolist(), dry.tolist(), strict=True))):
        kind, follow = (delay == tau_s) & (dry == rubs), _with_friction if rubs else _linear
        q[..., kind] = follow(batch.time_s, target[..., kind], start[:, kind], columns.only(kind, tau_s))
    if (columns.loose > 0).any():
        q = _worn(q, columns.loose, columns.rounding, first)
    if columns.stages is not None:
        q = applied("reading", q, columns.stages, load)
    return q + columns.offset


def _true_first(read: Array, columns: Columns, load: Array | None) -> Array:
    """Where joints (T, C) are that are read there: without what stages add to a reading, to first order."""
    if columns.stages is None:
        return read
    added = applied("reading", read[None], columns.stages, None if load is None else load[:1]) - read
    return read - added[0]


def blocked(target: Array, stop: Array, give: Array) -> Array:
    """Targets (N, T, C) of joints that close towards zero and meet something at `stop` (C,)."""
    side = np.sign(target.mean((0, 1)))
    way = side * target
    met = (way < stop) & (stop > 0)
    return np.where(met, side * (stop + give * (way - stop)), target)


def _play(command: Array, columns: Columns, start: Array) -> Array:
    """Target after play; at the beginning the joint rests where the play lets it."""
    push = columns.push
    rest = start if push is None else start - push[0]
    target = command
    if (columns.play > 0).any():
        target = _worn(command, columns.play, columns.rounding, rest)
    return target if push is None else target + push


def _worn(x: Array, width: Array, rounding: Array | None, first: Array) -> Array:
    """Play of mean full width `width` (C,), sharp or rounded."""
    sharp = play_operator(x, width, first)
    if rounding is None or not (rounding > 0).any():
        return sharp
    out, some = sharp.copy(), rounding > 0
    part = [
        play_operator(x[..., some], width[some] * (1 + rounding[some] * at), first[..., some])
        for at in _SPREAD
    ]
    out[..., some] = np.mean(part, 0)
    return out


def play_operator(x: Array, width: Array | float, first: Array) -> Array:
    """The play operator along frames: outputs (N, ...) start from `first` (...) and move only when inputs
    leave a window of full width `width` (...) around them."""
    if not np.any(width):
        return x.copy()
    half = width / 2
    out, low, high = np.empty_like(x), x - half, x + half
    state = first
    for k in range(len(x)):
        np.maximum(state, low[k], out=out[k])
        state = np.minimum(out[k], high[k], out=out[k])
    return out


def transition(h: Array, omega: Array, zeta: Array) -> tuple[Array, Array, Array, Array]:
    """Exact state transition of (q - r, q') over time h: entries 11, 12, 21, 22, shapes broadcast."""
    decay = zeta * omega
    beat = omega**2 * (1 - zeta**2)
    root = np.sqrt(np.abs(beat))
    root = np.where(root < _CRITICAL * omega, _CRITICAL * omega, root)
    x = root * h
    swing = beat > 0
    slow, fast = np.exp(-(decay - root) * h), np.exp(-(decay + root) * h)
    envelope = np.exp(-decay * h)
    cosine = np.where(swing, envelope * np.cos(x), 0.5 * (slow + fast))
    sine = np.where(swing, envelope * np.sin(x), 0.5 * (slow - fast)) / root
    return cosine + decay * sine, sine, -(omega**2) * sine, cosine - decay * sine


def _linear(time_s: Array, target: Array, start: Array, columns: Columns) -> Array:
    dt = np.diff(time_s, axis=0)
    unique, inverse = np.unique(dt.round(_DT_DIGITS), return_inverse=True)
    inverse = inverse.reshape(dt.shape)
    alike = (inverse[1:] == inverse[:-1]).all(axis=1)
    # Factors of a step stand together, as position and speed do (2, T, C): operations on so few numbers
    # cost more to begin than to do.
    factors = np.stack(transition(unique[:, None], columns.omega, columns.zeta))
    factors = factors.reshape(2, 2, *factors.shape[1:])
    low_pass = _low_pass(unique[:, None], columns)
    fading = None if low_pass is None else np.stack(low_pass)
    held, extra = _arrivals(time_s, target, columns)
    out = np.empty_like(target)
    state, smooth = np.stack([start, np.zeros_like(start)]), target[0]
    out[0] = start
    for k in range(len(dt)):
        if k == 0 or not alike[k - 1]:
            factor = factors.take(inverse[k], axis=2)
            fade = None if fading is None else fading.take(inverse[k], axis=1)
        now = held[k]
        state[0] -= now
        parts = factor * state
        parts[0, 0] += now
        state = parts[:, 0] + parts[:, 1]
        if fade is not None:
            gone = fade * (smooth - now)
            state += gone[:2]
            smooth = now + gone[2]
        if extra is not None:
            state += extra[:2, k]
            smooth = smooth if fade is None else smooth + extra[2, k]
        out[k + 1] = state[0]
    return out


def _low_pass(h: Array, columns: Columns) -> tuple[Array, Array, Array] | None:
    """What is left of a low-pass's distance from its target after time h: in q, in q', and of itself."""
    if columns.filtered is None or not columns.filtered.any():
        return None
    omega, zeta = columns.omega, columns.zeta
    rate = -1 / np.maximum(columns.filtered, _SHORTEST_S)
    # A servo that fades exactly as its low-pass does is told by one that nearly does.
    close = np.abs(rate**2 + 2 * zeta * omega * rate + omega**2) < _CRITICAL * omega**2
    rate = np.where(close, (1 + _CRITICAL**0.5) * rate, rate)
    a11, a12, a21, a22 = transition(h, omega, zeta)
    fade, part = np.exp(rate * h), omega**2 / (rate**2 + 2 * zeta * omega * rate + omega**2)
    return part * (fade - a11 - rate * a12), part * (rate * (fade - a22) - a21), fade


def _arrivals(time_s: Array, target: Array, columns: Columns) -> tuple[Array, Array | None]:
    """Target in force at the start of every interval (N-1, T, C), and what later arrivals add by its end to
    the position, the speed and the low-pass, if there is one (2 or 3, N-1, T, C)."""
    if columns.tau_s <= 0:
        return target[:-1], None
    count, trials = time_s.shape
    arrival = time_s + columns.tau_s
    # Trials one after the other on one time axis, so that one search serves all.
    lane = np.arange(trials) * (time_s.max() + columns.tau_s + 1.0)
    lanes = (time_s + lane).T.ravel()
    first = np.arange(trials) * count
    interval = (
        np.searchsorted(lanes, (arrival[1:] + lane).ravel(), side="left").reshape(-1, trials) - first - 1
    )
    inside = (interval >= 0) & (interval < count - 1)
    where, trial = np.nonzero(inside)
    row = interval[inside]
    rest = time_s[row + 1, trial] - arrival[where + 1, trial]
    unique, inverse = np.unique(rest.round(_DT_DIGITS), return_inverse=True)
    b11, _, b21, _ = transition(unique[:, None], columns.omega, columns.zeta)
    b13, b23, fade = _low_pass(unique[:, None], columns) or (0.0, 0.0, None)
    change = target[where + 1, trial] - target[where, trial]
    changes = (1 - b11 - b13, -b21 - b23, *(() if fade is None else (1 - fade,)))
    extra = np.zeros((len(changes), count - 1, *target.shape[1:]))
    for place, added in enumerate(changes):
        _add(extra[place], row, trial, added[inverse] * change)
    arrived = (arrival[1:] + lane).T.ravel()
    # Arrivals up to and at the interval's start are in force there.
    held = np.searchsorted(arrived, (time_s + lane).ravel(), side="right").reshape(count, trials)
    held = (held - np.arange(trials) * (count - 1)).clip(0, count - 1)
    return np.take_along_axis(target, held[..., None], 0)[:-1], extra


def _add(out: Array, row: Array, trial: Array, values: Array) -> None:
    """Sum values into out[row, trial]; almost always each place gets one."""
    place = row * out.shape[1] + trial
    _, once, count = np.unique(place, return_index=True, return_counts=True)
    out[row[once], trial[once]] = values[once]
    if (count > 1).any():
        again = np.ones(len(place), dtype=bool)
        again[once] = False
        np.add.at(out, (row[again], trial[again]), values[again])


def _with_friction(time_s: Array, target: Array, start: Array, columns: Columns) -> Array:
    """Between changes of the target the motion is linear until the joint stops; stops are found exactly."""
    grid, held, frame = _grid(time_s, columns)
    step_s = np.diff(grid, axis=0)
    unique, inverse = np.unique(step_s.round(_DT_DIGITS), return_inverse=True)
    inverse = inverse.reshape(step_s.shape)
    a11, a12, a21, a22 = transition(unique[:, None], columns.omega, columns.zeta)
    low_pass = _fading(unique[:, None], columns)
    trials = np.arange(time_s.shape[1])
    path = np.empty((len(grid), *start.shape))
    q, v, smooth = start.copy(), np.zeros_like(start), target[0]
    path[0] = q
    friction = np.broadcast_to(columns.friction, q.shape)
    hold = np.broadcast_to(columns.friction * _breakaway(columns), q.shape)
    for k in range(len(step_s)):
        step = inverse[k]
        r = target[held[k], trials]
        if low_pass is not None:
            # Steps are short beside a low-pass that would show: its mean stands for it.
            behind = smooth - r
            r, smooth = r + low_pass[0][step] * behind, r + low_pass[1][step] * behind
        pull = r - q
        sign = np.sign(np.where(v == 0, pull, v))
        stuck = (v == 0) & (np.abs(pull) <= hold)
        error = friction * sign - pull
        moved = q - error + a11[step] * error + a12[step] * v
        speed = a21[step] * error + a22[step] * v
        turned = (speed * sign < 0) & ~stuck
        if turned.any():
            where = np.nonzero(turned)
            part = (step_s[k][where[0]], r[where], q[where], v[where], error[where])
            moved[where], speed[where] = _through_stop(*part, columns, where[1])
        q, v = np.where(stuck, q, moved), np.where(stuck, 0.0, speed)
        path[k + 1] = q
    return np.take_along_axis(path, frame[..., None], 0)


def _fading(h: Array, columns: Columns) -> tuple[Array, Array] | None:
    """What is left of a low-pass's distance from its target on the mean over time h, and at its end."""
    if columns.filtered is None or not columns.filtered.any():
        return None
    time_s = np.maximum(columns.filtered, _SHORTEST_S)
    fade = np.exp(-h / time_s)
    return (1 - fade) * time_s / np.maximum(h, _SHORTEST_S), fade


def _through_stop(
    h: Array, r: Array, q: Array, v: Array, error: Array, columns: Columns, column: Array
) -> tuple[Array, Array]:
    """State after time h of joints that come to a stop before it, and then stick or turn back."""
    omega, zeta, friction = columns.omega[column], columns.zeta[column], columns.friction[column]
    decay, beat = zeta * omega, omega**2 * (1 - zeta**2)
    root = np.maximum(np.sqrt(np.abs(beat)), _CRITICAL * omega)
    rising, falling = np.abs(v) * root, np.sign(v) * (omega**2 * error + decay * v)
    ratio = np.clip(rising / np.where(falling > 0, falling, np.inf), 0.0, 1 - 1e-12)
    stop = np.where(beat > 0, np.arctan2(rising, falling), np.arctanh(ratio)) / root
    stop = np.clip(stop, 0.0, h)
    a11, a12, _, _ = transition(stop, omega, zeta)
    rest = q - error + a11 * error + a12 * v
    pull = r - rest
    back = friction * np.sign(pull) - pull
    a11, _, a21, _ = transition(h - stop, omega, zeta)
    sticks = np.abs(pull) <= friction * _breakaway(columns)[column]
    return np.where(sticks, rest, rest - back + a11 * back), np.where(sticks, 0.0, a21 * back)


def _breakaway(columns: Columns) -> Array:
    """(C,) what breaking away takes, as a multiple of friction in motion."""
    return np.ones_like(columns.friction) if columns.stick is None else 1.0 + columns.stick


def _grid(time_s: Array, columns: Columns) -> tuple[Array, Array, Array]:
    """Times (M, T) between which nothing changes and no joint turns twice; the target's row in force at each;
    where the frames are."""
    count, trials = time_s.shape
    dt = np.diff(time_s, axis=0)
    typical = np.median(dt[dt > 0]) if (dt > 0).any() else 1.0
    parts = int(np.clip(np.ceil(columns.omega.max() * typical / _TURN_RAD), 1, MAX_PARTS))
    inner = [time_s[:-1] + dt * part / parts for part in range(1, parts)]
    arrival = time_s[1:] + max(columns.tau_s, 0.0)
    late = [np.minimum(arrival, time_s[-1])] if columns.tau_s > 0 else []
    grid = np.sort(np.concatenate([time_s, *inner, *late]), axis=0)
    held = np.empty(grid.shape, dtype=np.int64)
    frame = np.empty(time_s.shape, dtype=np.int64)
    for trial in range(trials):
        held[:, trial] = np.searchsorted(arrival[:, trial], grid[:, trial] + 1e-12, side="right")
        frame[:, trial] = np.searchsorted(grid[:, trial], time_s[:, trial], side="left")
    return grid, held.clip(0, count - 1), frame
