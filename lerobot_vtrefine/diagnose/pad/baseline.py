"""The refitted baseline, and the noise that is left: where every comparison starts from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Setting
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import could_be_held, groups_apart
from lerobot_vtrefine.diagnose.pad.fitting import Fit, fit, rest
from lerobot_vtrefine.diagnose.pad.forward_model.run import LoweredBench, run_stages
from lerobot_vtrefine.diagnose.pad.model import NOMINAL_K_N, Composite, stiffness_from_load
from lerobot_vtrefine.diagnose.pad.noise import Noise, fit_frame_noise, fit_repeatability
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.repeated_frames import ages_s
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights, build_weights
from lerobot_vtrefine.diagnose.pad.whitening import Whitener

START_DAMPING_S = 3e-3
OFFSET_STEP_M = 5e-6
TOUCH_M = 4e-5
"""How well a recording's first touch is known [m]: two deviations of a good rig's repeatability."""
JUMP_DAMPING_S = 3e-3
"""Damping that readings at the touch are made allowance for, at least: k_d over k_n [s]."""
PLAUSIBLE_LOG_GAIN = 0.7
"""A weighted fit that moves the gain's logarithm further than this explains presses away as noise: readings
that are very late, say, leave the baseline so wrong that its weights mislead."""


@dataclass(frozen=True)
class Baseline:
    """A fit, the noise around it and the weights that follow from both.

    `plain` is the unweighted least-squares fit: the baseline that predicts plain readings best, and so the
    one that an extension is measured against.
    """

    fitted: Fit
    plain: Fit
    noise: Noise
    weights: tuple[TrialWeights, ...]


DAMPED = 0.01
"""Part of the springs' from which on damping's is visible."""
LEAST_C = 0.2
"""Range of the recordings' temperatures from which on something may be seen to follow it."""


def describe(presses: PressSet) -> Setting:
    """What candidates may know; the largest signal is not known before the first fit."""
    steps = np.concatenate([np.diff((press.whole or press).time_s) for press in presses.presses])
    spans = [float(press.time_s[-1] - press.time_s[0]) for press in presses.presses]
    starts = [press.trial.start_s for press in presses.presses]
    touched = np.zeros((presses.layout.rows, presses.layout.cols), dtype=bool)
    depth, company, row_company = 0.0, 1, 1
    for press in presses.presses:
        pressed = press.drive > 0
        touched[press.layout.lines, press.layout.columns] |= pressed.any(axis=0)
        company = max(company, int(pressed.sum(axis=(1, 2)).max(initial=0)))
        row_company = max(row_company, int(pressed.sum(axis=-1).max(initial=0)))
        depth = max(depth, float(press.drive.max()))
    positive = steps[steps > 0]
    frame_s = float(np.median(positive)) if len(positive) else 0.01
    return Setting(
        layout=presses.layout,
        top_counts=presses.full_scale,
        full_scale=presses.full_scale,
        frame_s=frame_s,
        duration_s=float(np.median(spans)),
        session_s=float(np.ptp(starts)),
        top_depth_m=_reach(depth, presses.loaded),
        loaded=presses.loaded,
        touched_rows=int(touched.any(axis=1).sum()),
        touched_cols=int(touched.any(axis=0).sum()),
        rest_session_s=presses.idle.session_s,
        rest_time_s=presses.idle.time_s,
        idle_course=presses.idle.course,
        idle_rates=_rows(presses.idle.rates),
        idle_counts=_rows(presses.idle.level.round(3)),
        temperature_c=_temperature(presses),
        row_company=row_company,
        company=company,
        ages_s=ages_s([press.rhythm for press in presses.presses]),
        repeats=could_be_held(presses),
        row_groups=groups_apart(presses, frame_s),
        returned=any(_returned(press) for press in presses.presses),
    )


def _rows(values: np.ndarray | None) -> tuple[tuple[float, ...], ...]:
    return () if values is None or not values.any() else tuple(tuple(row) for row in values.tolist())


def _returned(press: Press) -> bool:
    """Whether it presses taxels that an earlier recording pressed."""
    borne, layout = press.trial.borne, press.layout
    if borne is None or not len(borne.drive):
        return False
    before = layout.cut(borne.drive.max(axis=0) > 0)
    return bool((before & (press.drive > 0).any(axis=0)).any())


def _temperature(presses: PressSet) -> float | None:
    """Mean over the recordings [degrees Celsius]."""
    values = [press.trial.temperature_c for press in presses.presses]
    known = [value for value in values if value is not None and np.isfinite(value).all()]
    if len(known) < len(values) or np.ptp([value.mean() for value in known]) < LEAST_C:
        return None
    return float(np.mean([value.mean() for value in known]))


def _damping_share(model: Composite, presses: PressSet) -> float:
    """Mean size of damping's part over that of the springs', of what the baseline predicts under pressure."""
    if presses.loaded:
        return 0.0
    pressed = [(press.drive[press.drive > 0], press.rate[press.drive > 0]) for press in presses.presses]
    depth, rate = (sum(float(np.abs(pair[k]).sum()) for pair in pressed) for k in (0, 1))
    return float(model.values[1]) * rate / max(depth, 1e-12)


def _reach(top: float, loaded: bool) -> float:
    """Deepest press [m]; the load over the nominal stiffness where depth is not known."""
    return max(top / NOMINAL_K_N if loaded else top, 1e-6)


def first_guess(presses: PressSet, setting: Setting) -> Composite:
    """Proportional to depth (or load), by least squares."""
    top, bottom = 0.0, 0.0
    for press in presses.presses:
        depth = np.maximum(press.drive[:, press.scored], 0.0)
        top, bottom = top + float((depth * press.signal).sum()), bottom + float((depth**2).sum())
    gain = top / bottom if bottom > 0 and top > 0 else presses.full_scale / setting.top_depth_m
    return Composite(setting, np.array([np.log(gain), 0.0 if setting.loaded else START_DAMPING_S]))


def offset_tangents(
    model: Composite, presses: PressSet, signals: Sequence[np.ndarray], step_m: float = OFFSET_STEP_M
) -> list[np.ndarray] | None:
    """Change of the signal per metre of contact offset (T, n) per recording; None when driven by load."""
    if presses.loaded:
        return None
    shifted = run_stages(model.stages(), LoweredBench(presses.bench, step_m))
    return [(a - b) / step_m for a, b in zip(shifted, signals, strict=True)]


def touch_doubts(model: Composite, presses: PressSet) -> list[np.ndarray] | None:
    """Deviation of readings (T, n) [counts] that may or may not be touched yet; None when driven by load.

    Damping makes a reading jump at the touch. A recording's first touch is known to some micrometres only,
    and whether a frame falls before or after the jump cannot be had from a linear change.
    """
    if presses.loaded:
        return None
    values = model.values.copy()
    values[1] = max(float(values[1]), JUMP_DAMPING_S)
    jumpy = model.at(values)
    early, here, late = (
        run_stages(jumpy.stages(), LoweredBench(presses.bench, by)) for by in (-TOUCH_M, 0.0, TOUCH_M)
    )
    return [0.5 * np.abs(a - 2.0 * s + b) for a, s, b in zip(early, here, late, strict=True)]


def recording_deviations(
    fitted: Fit, presses: PressSet, noise: Noise, offsets: Sequence[np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Every recording's own relative gain and first touch, by least squares: (K,), (K,) [m].

    Args:
        offsets: `offset_tangents` of the fit.
    """
    gains, touches = [], []
    for index, (press, signal) in enumerate(zip(presses.presses, fitted.signals, strict=True)):
        sigma = noise.sigma(signal)
        columns = [signal] if offsets is None else [signal, offsets[index]]
        matrix = np.stack([(column / sigma).ravel() for column in columns], axis=1)
        target = ((press.signal - signal) / sigma).ravel()
        solution = np.linalg.lstsq(matrix, target, rcond=1e-6)[0]
        gains.append(float(solution[0]))
        touches.append(float(solution[1]) if len(solution) > 1 else 0.0)
    return np.array(gains), np.array(touches)


def weigh(
    fitted: Fit, presses: PressSet, noise: Noise | None = None
) -> tuple[Noise, tuple[TrialWeights, ...]]:
    """Noise of a fit (within recordings unless given; between recordings always), and the weights."""
    if noise is None:
        groups = fitted.model.setting.row_groups
        noise = fit_frame_noise(presses, fitted.residuals(presses), fitted.signals, groups)
    offsets = offset_tangents(fitted.model, presses, fitted.signals)
    gains, touches = recording_deviations(fitted, presses, noise, offsets)
    noise = fit_repeatability(noise, gains, touches, presses.conditions)
    return noise, tuple(build_weights(noise, fitted.signals, offsets, touch_doubts(fitted.model, presses)))


def plain_weights(presses: PressSet) -> list[TrialWeights]:
    """Every recording counts alike, every reading in it alike: what the plain mean squared error measures."""
    weights = []
    for press in presses.presses:
        sigma = np.full(press.signal.shape, np.sqrt(press.signal.size))
        weights.append(TrialWeights(sigma, Whitener(0.0), np.zeros((press.signal.size, 0)), np.zeros((0, 0))))
    return weights


def fit_baseline(presses: PressSet) -> Baseline:
    """Refit gain, stiffness and damping, then the noise, then both again with the right weights."""
    setting = describe(presses)
    guess = first_guess(presses, setting)
    fitted = plain = fit(guess, presses, plain_weights(presses))
    k_n = stiffness_from_load(presses, fitted.model)
    top = max((float(np.max(signal)) for signal in fitted.signals if signal.size), default=1.0)
    gain = float(plain.model.values[0])
    setting = replace(
        setting,
        top_counts=max(top, presses.full_scale / 255.0),
        log_gain=gain,
        damped=_damping_share(plain.model, presses) > DAMPED,
    )
    model = replace(fitted.model, setting=setting, k_n=k_n or NOMINAL_K_N)
    fitted = replace(fitted, model=model)
    noise, weights = weigh(fitted, presses)
    refitted = fit(fitted.model, presses, weights)
    if abs(refitted.model.values[0] - fitted.model.values[0]) < PLAUSIBLE_LOG_GAIN:
        fitted = refitted
        noise, weights = weigh(fitted, presses)
    plain = fit(replace(plain.model, setting=setting, k_n=model.k_n), presses, plain_weights(presses), 2)
    refitted = fit(fitted.model, presses, weights)
    if abs(refitted.model.values[0] - plain.model.values[0]) >= PLAUSIBLE_LOG_GAIN:
        refitted = rest(plain.model, presses, weights)
    return Baseline(refitted, plain, noise, tuple(weights))
