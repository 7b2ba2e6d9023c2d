"""Fast equals, on sheets, of the stages with memory or delay."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.diagnose.pad.forward_model.fields import Context, Field, by_press
from lerobot_vtrefine.diagnose.pad.repeated_frames import slots
from lerobot_vtrefine.tactile.stages.base import Frame, Stage
from lerobot_vtrefine.tactile.stages.host import Latency, SampleAndHold, ScanSkew, taken_at_frames
from lerobot_vtrefine.tactile.stages.mechanics import Hysteresis, ViscoelasticRelaxation
from lerobot_vtrefine.tactile.stages.softening import FirstLoadSoftening

MAX_EXPONENT = 200.0


def low_passed(x: np.ndarray, time_s: np.ndarray, tau_s: float) -> np.ndarray:
    """x (T, ...) through one pole of `tau_s`, from rest at zero, exact for a signal linear between frames."""
    dt = np.diff(time_s)
    decay = np.exp(-dt / tau_s)
    ramp = 1.0 - np.where(dt > 0, (1.0 - decay) * tau_s / np.maximum(dt, 1e-12), 1.0)
    shape = (-1, *(1,) * (x.ndim - 1))
    push = (1.0 - decay).reshape(shape) * x[:-1] + ramp.reshape(shape) * (x[1:] - x[:-1])
    slow = np.zeros_like(x)
    begin = 0
    while begin < len(dt):
        # Growing exponentials instead of a recursion, in pieces short enough not to overflow.
        reach = np.searchsorted(time_s, time_s[begin] + MAX_EXPONENT * tau_s, side="right") - 1
        end = min(max(int(reach), begin + 1), len(dt))
        ages = np.minimum((time_s[begin + 1 : end + 1] - time_s[begin]) / tau_s, 600.0)
        grow = np.exp(ages).reshape(shape)
        slow[begin + 1 : end + 1] = (slow[begin] + np.cumsum(grow * push[begin:end], axis=0)) / grow
        begin = end
    return slow


def _relaxation(stage: ViscoelasticRelaxation, field: Field, context: Context) -> Field:
    taus = stage.tau_s if isinstance(stage.tau_s, tuple) else (stage.tau_s,)
    fractions = stage.fraction if isinstance(stage.fraction, tuple) else (stage.fraction,)

    def work(x: np.ndarray, time_s: np.ndarray, rows: np.ndarray) -> np.ndarray:
        relaxed = x.copy()
        for tau_s, fraction in zip(taus, fractions, strict=True):
            relaxed -= fraction * low_passed(x, time_s, tau_s)
        return np.maximum(relaxed, 0.0, out=relaxed) if stage.pushes_only else relaxed

    return by_press(field, context.sheet, work)


def delayed(x: np.ndarray, time_s: np.ndarray, delay_s: float) -> np.ndarray:
    """x (T, ...) as it was `delay_s` earlier, linear between frames, held before the first."""
    if len(time_s) < 2:
        return x
    wanted = time_s - delay_s
    after = np.searchsorted(time_s, wanted, side="right").clip(1, len(time_s) - 1)
    span = np.maximum(time_s[after] - time_s[after - 1], 1e-12)
    weight = ((wanted - time_s[after - 1]) / span).clip(0.0, 1.0).reshape(-1, *(1,) * (x.ndim - 1))
    earlier = x[after - 1]
    return earlier + weight * (x[after] - earlier)


def _latency(stage: Latency, field: Field, context: Context) -> Field:
    lag_s = float(stage.smoothing * stage.tau_s)

    def work(x: np.ndarray, time_s: np.ndarray, rows: np.ndarray) -> np.ndarray:
        late = delayed(x, time_s, float(stage.tau_s) - lag_s)
        return late[:1] + low_passed(late - late[:1], time_s, max(lag_s, 1e-6)) if stage.smoothing else late

    return by_press(field, context.sheet, work)


def _scan_skew(stage: ScanSkew, field: Field, context: Context) -> Field:
    sheet, out = context.sheet, np.zeros_like(field.values)
    of_rows = stage.of_rows(sheet.layout.rows)
    if of_rows is None:
        of_rows = stage.skew_s * np.arange(sheet.layout.rows) / max(sheet.layout.rows - 1, 1)
    of_cols = stage.cols_s * np.arange(sheet.layout.cols) / max(sheet.layout.cols - 1, 1)
    for press, time_s in enumerate(sheet.times_s):
        part = field.within(sheet, press)
        taxels = field.columns[part]
        delays = of_rows[sheet.rows[taxels]] + of_cols[sheet.cols[taxels]]
        x, late = field.values[: len(time_s), part], np.zeros((len(time_s), len(taxels)))
        for delay in np.unique(delays):
            late[:, delays == delay] = delayed(x[:, delays == delay], time_s, float(delay))
        out[: len(time_s), part] = late
    return Field(out, field.columns)


def interpolated(x: np.ndarray, time_s: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Columns of x (T, n), known at times (T,), at other times (K,); the ends go on as they are."""
    after = np.clip(np.searchsorted(time_s, at_s), 1, len(time_s) - 1)
    span = np.maximum(time_s[after] - time_s[after - 1], 1e-12)
    part = np.clip((at_s - time_s[after - 1]) / span, 0.0, 1.0)[:, None]
    return (1.0 - part) * x[after - 1] + part * x[after]


def _hold(stage: SampleAndHold, field: Field, context: Context) -> Field:
    """A free board's instants are those that the recording itself shows."""
    sheet, out = context.sheet, np.zeros_like(field.values)
    for press, (time_s, rhythm) in enumerate(zip(sheet.times_s, sheet.rhythms, strict=True)):
        if stage.irregular or stage.frame_s:
            part = field.within(sheet, press)
            at = (
                rhythm.taken_s(time_s) - float(stage.lag_s)
                if stage.irregular
                else taken_at_frames(time_s, float(stage.period_s), float(stage.frame_s))
            )
            out[: len(time_s), part] = interpolated(field.values[: len(time_s), part], time_s, at)
            continue
        phase = rhythm.phase(float(stage.period_s)) if stage.free else 0.0
        slot = slots(time_s, float(stage.period_s), phase)
        new = np.concatenate([[True], slot[1:] != slot[:-1]])
        part = field.within(sheet, press)
        held = np.maximum.accumulate(np.where(new, np.arange(len(slot)), 0))
        out[: len(time_s), part] = field.values[: len(time_s), part][held]
    return Field(out, field.columns)


def play(
    x: np.ndarray,
    half_width: float | np.ndarray,
    above: float | np.ndarray | None = None,
    resting: bool = False,
) -> np.ndarray:
    """Play operator on columns of x (T, n), as in the hysteresis stage: (T, n).

    Its band reaches from `above` (half its width by default) over x to the rest of the width below. It is
    reset at zero unless it keeps `resting` where it was let go.
    """
    above = half_width if above is None else above
    touched = (x > 0) | resting
    upper = np.where(touched, x + above, 0.0)
    out = np.where(touched, np.maximum(x + above - 2.0 * half_width, 0.0), 0.0)
    state = np.zeros(x.shape[1])
    for high, line in zip(upper, out, strict=True):
        np.maximum(np.minimum(state, high, out=high), line, out=line)
        state = line
    return out


def turned_back(x: np.ndarray, width: float) -> np.ndarray:
    """Unloading so far (T, n), as a part of `width` up to 1; taken back by loading, 0 without contact."""
    steps, touched = np.diff(x, axis=0, prepend=np.zeros_like(x[:1])) / max(width, 1e-12), x > 0
    out, state = np.empty_like(x), np.zeros(x.shape[1])
    for step, contact, line in zip(steps, touched, out, strict=True):
        np.clip(state - step, 0.0, 1.0, out=line)
        line *= contact
        state = line
    return out


def peak_share(x: np.ndarray) -> np.ndarray:
    """x (T, n) over its largest value since its column was last untouched; 1 while it rises."""
    out, peak = np.ones_like(x), np.zeros(x.shape[1])
    for row, line in zip(x, out, strict=True):
        peak = np.where(row > 0, np.maximum(peak, row), 0.0)
        np.divide(row, peak, out=line, where=peak > 0)
    return out


def _hysteresis(stage: Hysteresis, field: Field, context: Context) -> Field:
    widths = stage.width_m if isinstance(stage.width_m, tuple) else (stage.width_m,)
    fractions = stage.fraction if isinstance(stage.fraction, tuple) else (stage.fraction,)
    if stage.loop == "scaled":
        held = field.values.copy()
        for width_m, fraction in zip(widths, fractions, strict=True):
            held += fraction * field.values * turned_back(field.values, width_m * context.stiffness)
        return Field(np.maximum(held, 0.0), field.columns)
    if stage.loop == "peak":
        share = peak_share(field.values)
        bent = 1.0 + 4.0 * math.fsum(fractions) * share * (1.0 - share)
        return Field(np.maximum(field.values * bent, 0.0), field.columns)
    held = (1.0 - math.fsum(fractions)) * field.values
    for width_m, fraction in zip(widths, fractions, strict=True):
        half = 0.5 * width_m * context.stiffness
        above = 0.0 if stage.loop == "behind" else half
        held += fraction * play(field.values, half, above, stage.loop == "resting")
    return Field(np.maximum(held, 0.0), field.columns)


def _own_sequence(stage: Stage, field: Field, context: Context) -> Field:
    """The stage's own code, of a stage that treats every taxel by itself."""
    frame = Frame(context.sheet.layout, stiffness_n_per_m=context.stiffness)

    def work(x: np.ndarray, time_s: np.ndarray, rows: np.ndarray) -> np.ndarray:
        images = torch.from_numpy(np.ascontiguousarray(x))[:, None]
        return stage.sequence(images, torch.from_numpy(time_s), frame)[:, 0].numpy()

    return by_press(field, context.sheet, work)


MEMORY: dict[type, Callable[[Any, Field, Context], Field]] = {
    ViscoelasticRelaxation: _relaxation,
    Hysteresis: _hysteresis,
    FirstLoadSoftening: _own_sequence,
    Latency: _latency,
    ScanSkew: _scan_skew,
    SampleAndHold: _hold,
}
"""Stage -> its equal."""
