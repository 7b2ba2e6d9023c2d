"""Figures of a calibration: response curves, load cell, resampled parameters, presses over time."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lerobot_vtrefine.diagnose.calibration.fit import Calibration
from lerobot_vtrefine.diagnose.pad.press_trials import Press

MEASURED, MODEL, FAST = "#1f6fb4", "#d1601f", "#7a3f9d"
BINS = 14
MIN_COUNT = 8


def response_curves(calibration: Calibration) -> Figure:
    """Reading over penetration (or load) per taxel, slow and fast motion apart, and the model's load."""
    presses = calibration.presses
    columns = 1 if presses.loaded or not calibration.excitation.has_force else 2
    figure = Figure(figsize=(5.2 * columns, 3.6), layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    _reading_curve(axes[0], calibration)
    if columns == 2:
        _load_curve(axes[1], calibration)
    return figure


def _reading_curve(axis: Axes, calibration: Calibration) -> None:
    presses = calibration.presses.presses
    scale, name = (1.0, "force per taxel [N]") if calibration.presses.loaded else (1e3, "penetration [mm]")
    drive = scale * np.concatenate([press.drive[:, press.scored].ravel() for press in presses])
    rate = np.concatenate([np.abs(press.rate[:, press.scored]).ravel() for press in presses])
    measured = np.concatenate([press.signal.ravel() for press in presses])
    model = np.concatenate([signal.ravel() for signal in calibration.fitted.signals])
    pressed = drive > 0
    slow, fast = calibration.excitation.speeds_m_s
    middle = 0.5 * (slow + fast)
    groups = [("all", pressed, MEASURED)]
    if not calibration.presses.loaded:
        groups = [("slow", pressed & (rate <= middle), MEASURED), ("fast", pressed & (rate > middle), FAST)]
    edges = np.linspace(0.0, float(drive[pressed].max(initial=1e-9)), BINS + 1)
    for label, mask, colour in groups:
        centre, mean, spread, expected = binned(drive[mask], measured[mask], model[mask], edges)
        axis.errorbar(
            centre, mean, spread, fmt="o", ms=4, lw=1, color=colour, alpha=0.8, label=f"measured, {label}"
        )
        axis.plot(
            centre, expected, color=colour, ls="--" if label == "fast" else "-", label=f"model, {label}"
        )
    axis.set_xlabel(name)
    axis.set_ylabel("counts above idle")
    axis.legend(fontsize=10, frameon=False)


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


def _load_curve(axis: Axes, calibration: Calibration) -> None:
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
    keep = np.random.default_rng(0).permutation(len(x))[:4000]
    axis.plot(x[keep], y[keep], ".", ms=2, color=MODEL, alpha=0.4)
    top = float(max(x.max(), y.max()))
    axis.plot([0, top], [0, top], color="black", lw=0.8)
    axis.set_xlabel("load cell [N]")
    axis.set_ylabel("sum of the model's forces [N]")


def resampled(calibration: Calibration) -> Figure:
    """Resampled values of every parameter with its interval."""
    names = list(calibration.draws)
    figure = Figure(figsize=(3.1 * len(names), 2.5), layout="constrained")
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    for axis, name in zip(axes, names, strict=True):
        parameter = calibration.parameters[name]
        axis.hist(calibration.draws[name], bins=30, color=MEASURED, alpha=0.5)
        axis.axvline(parameter.value, color=MODEL, lw=1.6)
        for bound in parameter.ci95 or ():
            axis.axvline(bound, color="black", lw=0.8, ls="--")
        axis.set_title(f"{name} [{parameter.unit}]", fontsize=10)
        axis.set_yticks([])
        axis.tick_params(labelsize=10)
    return figure


def presses_over_time(calibration: Calibration, number: int = 3) -> Figure:
    """Mean of the pressed taxels over time, measured and modelled: best, typical and worst recording."""
    errors = [
        float(np.sqrt(np.mean(values**2))) for values in calibration.fitted.residuals(calibration.presses)
    ]
    order = np.argsort(errors)
    chosen = order[np.unique(np.linspace(0, len(order) - 1, number).round().astype(int))].tolist()
    figure = Figure(figsize=(3.9 * len(chosen), 2.7), layout="constrained")
    axes = figure.subplots(1, len(chosen), squeeze=False)[0]
    for axis, index in zip(axes, chosen, strict=True):
        press = calibration.presses.presses[index]
        pressed = _pressed(press)
        time_s = press.trial.time_s
        axis.plot(time_s, press.signal[:, pressed].mean(1), color=MEASURED, lw=1.4, label="measured")
        model = calibration.fitted.signals[index]
        axis.plot(time_s, model[:, pressed].mean(1), color=MODEL, lw=1.1, label="model")
        axis.set_title(f"{press.trial.file}: RMS {errors[index]:.1f} counts", fontsize=10)
        axis.set_xlabel("time [s]", fontsize=10)
        axis.tick_params(labelsize=10)
    axes[0].set_ylabel("mean counts above idle", fontsize=10)
    axes[0].legend(fontsize=10, frameon=False)
    return figure


def _pressed(press: Press) -> np.ndarray:
    """Which of the scored taxels the indenter reaches (n,) bool; all if none."""
    reached = np.atleast_1d(np.any(press.drive[:, press.scored] > 0, axis=0))
    return reached if np.any(reached) else np.ones(len(reached), bool)
