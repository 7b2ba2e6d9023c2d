"""What the report draws, on recordings that no fit and no choice has seen."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.core.residual_views import residual_view
from lerobot_vtrefine.diagnose.evidence import ResidualView, Trace
from lerobot_vtrefine.diagnose.pad.noise import Noise
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet

TRACE_CHANNELS = 6


@dataclass(frozen=True)
class Predicted:
    """One held-out recording with both models' readings, at its scored taxels (T, n) [counts]."""

    press: Press
    measured: np.ndarray
    simulated: np.ndarray
    extended: np.ndarray


def predicted(
    presses: PressSet, simulated: Sequence[np.ndarray], extended: Sequence[np.ndarray]
) -> list[Predicted]:
    """Recordings with what both models say about them (T, n)."""
    rows = zip(presses.presses, simulated, extended, strict=True)
    return [Predicted(press, press.signal + press.idle, before, after) for press, before, after in rows]


def noise_floor(everyone: PressSet, locked: PressSet, noise: Noise, signals: Sequence[np.ndarray]) -> float:
    """Root mean squared error that repeating the same recording would leave [counts].

    Half the mean square between replicates of the locked recordings' conditions; the fitted noise where a
    condition was recorded once. `signals` are the expected ones of the locked recordings.
    """
    groups: dict[str, list[Press]] = defaultdict(list)
    for press in everyone.presses:
        groups[press.trial.condition].append(press)
    squares = []
    for press, signal in zip(locked.presses, signals, strict=True):
        others = [_half_square(press, other) for other in groups[press.trial.condition] if other is not press]
        known = [value for value in others if value is not None]
        fitted = float(np.mean(noise.sigma(signal) ** 2 + (noise.gain * signal) ** 2))
        squares.append(float(np.mean(known)) if known else fitted)
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def _half_square(press: Press, other: Press) -> float | None:
    """Half the mean square between two recordings of one command; None where frames do not match."""
    frames = min(len(press.signal), len(other.signal))
    mine, theirs = press.trial.time_s[:frames], other.trial.time_s[:frames]
    if frames < 8 or np.abs(mine - theirs).max() > 0.25 * np.median(np.diff(mine)):
        return None
    raw, again = press.trial.raw[:frames, press.taxels], other.trial.raw[:frames, press.taxels]
    return 0.5 * float(np.mean((raw - again) ** 2))


def traces(predicted: Sequence[Predicted]) -> tuple[Trace, ...]:
    """Held-out recordings at the taxels that answer most."""
    found = []
    for item in predicted:
        press = item.press
        strongest = np.argsort(-np.ptp(item.measured, axis=0), kind="stable")[:TRACE_CHANNELS]
        cols = press.layout.full_cols
        names = tuple(f"taxel ({press.taxels[k] // cols}, {press.taxels[k] % cols})" for k in strongest)
        drive = {
            name: values
            for name, values in (("depth_m", press.trial.depth_m), ("force_n", press.trial.force_n))
            if values is not None
        }
        found.append(
            Trace(
                press.trial.file,
                press.trial.condition,
                press.trial.time_s,
                names,
                item.measured[:, strongest],
                item.simulated[:, strongest],
                item.extended[:, strongest],
                drive,
            )
        )
    return tuple(found)


def residual_views(predicted: Sequence[Predicted], seed: int) -> tuple[ResidualView, ...]:
    """Mean residual against load, rate, history, position and time."""
    axes = [_axes(item) for item in predicted]
    views = []
    for name, (unit, _) in axes[0].items():
        trials = [
            (own[name][1], item.measured - item.simulated, item.measured - item.extended)
            for own, item in zip(axes, predicted, strict=True)
        ]
        views.append(residual_view(name, unit, trials, seed))
    return tuple(view for view in views if view is not None)


def _axes(item: Predicted) -> dict[str, tuple[str, np.ndarray]]:
    """Coordinates of every reading (T, n)."""
    press = item.press
    shape = item.measured.shape
    drive = press.drive[:, press.scored]
    expected = item.simulated - press.idle
    cols = press.layout.full_cols
    x, y = press.layout.pitch_m * (press.taxels % cols), press.layout.pitch_m * (press.taxels // cols)
    axes = {
        "load": ("counts", expected),
        "history": ("counts", np.maximum.accumulate(expected, axis=0) - expected),
        "column": ("m", np.broadcast_to(x, shape)),
        "row": ("m", np.broadcast_to(y, shape)),
        "time": ("s", np.broadcast_to(press.trial.time_s[:, None], shape)),
        "session": ("s", np.broadcast_to((press.trial.time_s + press.trial.start_s)[:, None], shape)),
    }
    if not press.loaded:
        axes["rate"] = ("m/s", np.where(drive > 0, press.rate[:, press.scored], 0.0))
        axes["depth"] = ("m", np.where(drive > -0.5, drive, np.nan))
    return axes


def residual_maps(predicted: Sequence[Predicted], presses: PressSet) -> dict[str, np.ndarray]:
    """Per taxel (R, C): RMS residual before and after, and the idle level."""
    shape = (presses.layout.rows, presses.layout.cols)
    sums = np.zeros((3, presses.layout.num_taxels))
    for item in predicted:
        sums[0, item.press.taxels] += ((item.measured - item.simulated) ** 2).sum(axis=0)
        sums[1, item.press.taxels] += ((item.measured - item.extended) ** 2).sum(axis=0)
        sums[2, item.press.taxels] += len(item.measured)
    root = np.sqrt(sums[:2] / np.maximum(sums[2], 1)).reshape(2, *shape)
    return {
        "rms residual before": root[0],
        "rms residual after": root[1],
        "idle level": presses.idle.level,
    }
