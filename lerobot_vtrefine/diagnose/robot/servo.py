"""The joints' servo model: second-order response to zero-order-held commands, and what real joints add to it.

A joint's target r is its command, late by tau, through play of full width `play`, plus `push` (gravity's sag,
what a load bends). The servo follows:

    q'' = omega^2 (r - friction sign(q') - q) - 2 zeta omega q'          (friction as servo error, [rad])

and the encoder reads q + offset, possibly through play of its own (`loose`). Without friction every step is
exact, whatever the frames' spacing and the delay; with friction the step is split into `SUBSTEPS`.

Shapes: N frames, T trials, C columns. A column is one joint under one set of parameters: columns repeat
joints when several sets are tried at once.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.robot.batch import Batch

Array = np.ndarray

SUBSTEPS = 8
_CRITICAL = 1e-6
_DT_DIGITS = 6


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
    tau_s: float = 0.0
    """Every command acts this late."""
    push: Array | None = None
    """(N, T, C) added to the target."""


def simulate(batch: Batch, columns: Columns) -> Array:
    """Encoder readings (N, T, C) that follow from the commands and the first position alone."""
    start = batch.first_position[:, columns.joint] - columns.offset
    target = _play(batch.command[:, :, columns.joint], columns.play, start, columns.push)
    start = np.clip(target[0], start - columns.loose / 2, start + columns.loose / 2)
    if (columns.friction > 0).any():
        q = _with_friction(batch.time_s, target, start, columns)
    else:
        q = _linear(batch.time_s, target, start, columns)
    if (columns.loose > 0).any():
        first = batch.first_position[:, columns.joint] - columns.offset
        q = _dragged(q, columns.loose, first)
    return q + columns.offset


def _play(command: Array, width: Array, start: Array, push: Array | None) -> Array:
    """Target after play; at the beginning the joint rests where the play lets it."""
    rest = start if push is None else start - push[0]
    target = _dragged(command, width, rest) if (width > 0).any() else command
    return target if push is None else target + push


def _dragged(x: Array, width: Array, first: Array) -> Array:
    """The play operator along frames: the output moves only when the input leaves a window of that width."""
    half = width / 2
    out = np.empty_like(x)
    state = first
    for k in range(len(x)):
        state = np.minimum(np.maximum(state, x[k] - half), x[k] + half)
        out[k] = state
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
    a11, a12, a21, a22 = transition(unique[:, None], columns.omega, columns.zeta)
    held, extra = _arrivals(time_s, target, columns)
    out = np.empty_like(target)
    q, v = start, np.zeros_like(start)
    out[0] = q
    for k in range(len(dt)):
        step = inverse[k]
        error = q - held[k]
        q, v = held[k] + a11[step] * error + a12[step] * v, a21[step] * error + a22[step] * v
        if extra is not None:
            q, v = q + extra[0][k], v + extra[1][k]
        out[k + 1] = q
    return out


def _arrivals(time_s: Array, target: Array, columns: Columns) -> tuple[Array, tuple[Array, Array] | None]:
    """Target in force at the start of every interval (N-1, T, C), and what later arrivals add by its end."""
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
    change = target[where + 1, trial] - target[where, trial]
    extra = np.zeros((2, count - 1, *target.shape[1:]))
    _add(extra[0], row, trial, (1 - b11)[inverse] * change)
    _add(extra[1], row, trial, -b21[inverse] * change)
    arrived = (arrival[1:] + lane).T.ravel()
    # Arrivals up to and at the interval's start are in force there.
    held = np.searchsorted(arrived, (time_s + lane).ravel(), side="right").reshape(count, trials)
    held = (held - np.arange(trials) * (count - 1)).clip(0, count - 1)
    return np.take_along_axis(target, held[..., None], 0)[:-1], (extra[0], extra[1])


def _add(out: Array, row: Array, trial: Array, values: Array) -> None:
    """Sum values into out[row, trial]; almost always each place gets one."""
    place = row * out.shape[1] + trial
    _, once, count = np.unique(place, return_index=True, return_counts=True)
    out[row[once], trial[once]] = values[once]
    if (count > 1).any():
        again = np.ones(len(place), dtype=bool)
        again[once] = False
        np.add.at(out, (row[again], trial[again]), values[again])


def _delayed_mean(time_s: Array, target: Array, tau_s: float) -> Array:
    """Mean of the delayed target over every substep, (N-1, SUBSTEPS, T, C)."""
    count, trials = time_s.shape
    fractions = np.linspace(0, 1, SUBSTEPS + 1)
    out = np.empty((count - 1, SUBSTEPS, *target.shape[1:]))
    for trial in range(trials):
        t = time_s[:, trial]
        dt = np.diff(t)
        integral = np.concatenate(
            [np.zeros((1, target.shape[2])), np.cumsum(target[:-1, trial] * dt[:, None], 0)]
        )
        query = (t[:-1, None] + dt[:, None] * fractions) - tau_s
        index = np.clip(np.searchsorted(t, query, side="right") - 1, 0, count - 1)
        value = integral[index] + (query - t[index])[..., None] * target[index, trial]
        h = np.maximum(dt / SUBSTEPS, 1e-12)[:, None, None]
        out[:, :, trial] = np.diff(value, axis=1) / h
    return out


def _with_friction(time_s: Array, target: Array, start: Array, columns: Columns) -> Array:
    dt = np.diff(time_s, axis=0)
    unique, inverse = np.unique(dt.round(_DT_DIGITS), return_inverse=True)
    inverse = inverse.reshape(dt.shape)
    a11, a12, a21, a22 = transition(unique[:, None] / SUBSTEPS, columns.omega, columns.zeta)
    late = _delayed_mean(time_s, target, columns.tau_s) if columns.tau_s > 0 else None
    out = np.empty_like(target)
    q, v = start, np.zeros_like(start)
    out[0] = q
    friction = columns.friction
    for k in range(len(dt)):
        step = inverse[k]
        m11, m12, m21, m22 = a11[step], a12[step], a21[step], a22[step]
        for part in range(SUBSTEPS):
            r = target[k] if late is None else late[k, part]
            pull = r - q
            # At rest the friction takes up what the servo pulls, as far as it can.
            sign = np.sign(np.where(v == 0, pull, v))
            stuck = (v == 0) & (np.abs(pull) <= friction)
            error = -(pull - friction * sign)
            moved, speed = q - error + m11 * error + m12 * v, m21 * error + m22 * v
            # It never reverses a motion: where it would, the joint stops for the rest of the step.
            turned = speed * sign < 0
            until_stop = v * v / np.maximum(np.abs(v) + np.abs(speed), 1e-12) * np.sign(v)
            stopped = q + 0.5 * until_stop * dt[k][:, None] / SUBSTEPS
            q = np.where(stuck, q, np.where(turned, stopped, moved))
            v = np.where(turned | stuck, 0.0, speed)
        out[k + 1] = q
    return out
