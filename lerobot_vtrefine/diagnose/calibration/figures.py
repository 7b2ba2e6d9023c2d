"""Drawings of a calibration: response curves, load cell, resampled parameters, presses over time."""

from pathlib import PurePath

import numpy as np

from lerobot_vtrefine.diagnose.calibration.fit import Calibration
from lerobot_vtrefine.diagnose.pad.press_trials import Press
from lerobot_vtrefine.diagnose.report.numbers import scale_of
from lerobot_vtrefine.pages.charts import Panel, drawing, span

MEASURED, MODEL, FAST = "m", "b", "a"
BINS = 14
MIN_COUNT = 8
DRAWN_FRAMES = 800
WIDTH, HEIGHT = 440.0, 290.0
SMALL_WIDTH, SMALL_HEIGHT = 350.0, 200.0
LEFT, RIGHT, TOP, BOTTOM = 62.0, 14.0, 26.0, 44.0


def _panel(width: float, height: float, x_range: tuple[float, float], y_range: tuple[float, float]) -> Panel:
    return Panel(LEFT, TOP, width - LEFT - RIGHT, height - TOP - BOTTOM, x_range, y_range)


def response_curves(calibration: Calibration) -> list[str]:
    """Reading over penetration (or load) per taxel, slow and fast motion apart, and the model's load."""
    curves = [_reading_curve(calibration)]
    if calibration.excitation.has_force and not calibration.presses.loaded:
        curves.append(_load_curve(calibration))
    return curves


def _reading_curve(calibration: Calibration) -> str:
    presses = calibration.presses.presses
    scale, name = (1.0, "force per taxel [N]") if calibration.presses.loaded else (1e3, "penetration [mm]")
    drive = scale * np.concatenate([press.drive[:, press.scored].ravel() for press in presses])
    rate = np.concatenate([np.abs(press.rate[:, press.scored]).ravel() for press in presses])
    measured = np.concatenate([press.signal.ravel() for press in presses])
    model = np.concatenate([signal.ravel() for signal in calibration.fitted.signals])
    pressed = drive > 0
    slow, fast = calibration.excitation.speeds_m_s
    middle = 0.5 * (slow + fast)
    groups = [(pressed, MEASURED)]
    if not calibration.presses.loaded:
        groups = [(pressed & (rate <= middle), MEASURED), (pressed & (rate > middle), FAST)]
    edges = np.linspace(0.0, float(drive[pressed].max(initial=1e-9)), BINS + 1)
    found = [(binned(drive[mask], measured[mask], model[mask], edges), style) for mask, style in groups]
    shown = [
        item for (_, mean, spread, expected), _ in found for item in (mean - spread, mean + spread, expected)
    ]
    panel = _panel(WIDTH, HEIGHT, span(edges, margin=0.02), span(*shown, zero=True))
    parts = [panel.frame(name, "counts above idle")]
    for (centre, mean, spread, expected), style in found:
        parts.append(panel.whiskers(centre, mean - spread, mean + spread))
        parts.append(panel.dots(centre, mean, style, 4))
        parts.append(panel.line(centre, expected, MODEL if style == MEASURED else f"{MODEL} dashed"))
    return drawing(WIDTH, HEIGHT, parts, f"reading over {name}")


def binned(
    x: np.ndarray, measured: np.ndarray, model: np.ndarray, edges: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Bin centres, mean and deviation of the measured, mean of the model; bins with few values left out."""
    place = np.digitize(x, edges) - 1
    rows = []
    for index in range(len(edges) - 1):
        mask = place == index
        if mask.sum() >= MIN_COUNT:
            rows.append((x[mask].mean(), measured[mask].mean(), measured[mask].std(), model[mask].mean()))
    columns = np.array(rows).reshape(-1, 4).T
    return columns[0], columns[1], columns[2], columns[3]


def _load_curve(calibration: Calibration) -> str:
    measured, model = [], []
    damping_s = float(calibration.fitted.model.values[1])
    for press in calibration.presses.presses:
        load = press.trial.force_n
        if load is None or not np.isfinite(load).all():
            continue
        depth = np.where(press.drive > 0, np.maximum(press.drive + damping_s * press.rate, 0.0), 0.0)
        model.append(calibration.parameters["k_n"].value * depth.sum(axis=(1, 2)))
        measured.append(load)
    x, y = np.concatenate(measured), np.concatenate(model)
    keep = np.random.default_rng(0).permutation(len(x))[:DRAWN_FRAMES]
    both = span(x, y, np.zeros(1))
    panel = _panel(WIDTH, HEIGHT, both, both)
    ends = np.array([0.0, max(x.max(), y.max())])
    parts = [
        panel.frame("load cell [N]", "sum of the model's forces [N]"),
        panel.dots(x[keep], y[keep], MODEL, 1.5),
        panel.line(ends, ends, MEASURED),
    ]
    return drawing(WIDTH, HEIGHT, parts, "the model's load over the load cell's")


def resampled(calibration: Calibration) -> list[str]:
    """Resampled values of every parameter with its interval."""
    drawings = []
    for name, draws in calibration.draws.items():
        parameter = calibration.parameters[name]
        factor, unit = scale_of(float(np.max(np.abs(draws), initial=0.0)), parameter.unit)
        counts, edges = np.histogram(factor * np.asarray(draws), bins=30)
        value, *bounds = (factor * np.array([parameter.value, *(parameter.ci95 or ())], float)).tolist()
        x_range = span(edges, np.array([value, *bounds]))
        panel = _panel(SMALL_WIDTH, SMALL_HEIGHT, x_range, (0.0, 1.05 * float(counts.max())))
        parts = [
            panel.frame(f"{name} [{unit}]" if unit else name, "resampled values", y_count=0),
            panel.stairs(edges, counts.astype(float), MEASURED, filled=True),
            panel.rule(value, MODEL),
            *(panel.rule(bound, f"{MEASURED} dashed") for bound in bounds),
        ]
        drawings.append(drawing(SMALL_WIDTH, SMALL_HEIGHT, parts, f"resampled values of {name}"))
    return drawings


def presses_over_time(calibration: Calibration) -> list[tuple[str, str]]:
    """Mean of the pressed taxels over time, measured and modelled: best, typical and worst recording.

    Returns:
        captions and drawings.
    """
    errors = [
        float(np.sqrt(np.mean(values**2))) for values in calibration.fitted.residuals(calibration.presses)
    ]
    order = np.argsort(errors)
    chosen = order[np.unique(np.linspace(0, len(order) - 1, 3).round().astype(int))].tolist()
    means = []
    for index in chosen:
        press, model = calibration.presses.presses[index], calibration.fitted.signals[index]
        pressed = _pressed(press)
        means.append((press, press.signal[:, pressed].mean(1), model[:, pressed].mean(1)))
    y_range = span(*(side for _, *sides in means for side in sides), zero=True)
    drawings = []
    for index, (press, measured, model) in zip(chosen, means, strict=True):
        time_s = press.trial.time_s
        panel = _panel(SMALL_WIDTH, SMALL_HEIGHT + 20, span(time_s, margin=0.0), y_range)
        parts = [
            panel.frame("time [s]", "mean counts above idle"),
            panel.line(time_s, measured, MEASURED),
            panel.line(time_s, model, MODEL),
        ]
        picture = drawing(SMALL_WIDTH, SMALL_HEIGHT + 20, parts, f"{press.trial.file} over time")
        caption = f"{PurePath(press.trial.file).stem}, missed by {errors[index]:.1f} counts RMS"
        drawings.append((caption, picture))
    return drawings


def _pressed(press: Press) -> np.ndarray:
    """Which of the scored taxels the indenter reaches (n,) bool; all if none."""
    reached = np.atleast_1d(np.any(press.drive[:, press.scored] > 0, axis=0))
    return reached if np.any(reached) else np.ones(len(reached), bool)
