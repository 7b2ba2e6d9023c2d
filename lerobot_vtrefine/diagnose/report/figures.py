"""The pictures of a report: held-out traces, residuals, errors per trial, maps."""

from collections.abc import Sequence
from pathlib import PurePath

import numpy as np

from lerobot_vtrefine.diagnose.evidence import ResidualView, Trace, TrialError
from lerobot_vtrefine.diagnose.report.numbers import quantity, scale_of
from lerobot_vtrefine.diagnose.verdict import Heldout
from lerobot_vtrefine.pages.charts import Panel, drawing, label, span

WIDTH = 520.0
LEFT, RIGHT = 58.0, 14.0
CHANNELS = 2
"""Channels drawn per trial: the first ones of a trace."""
CHANNEL_HEIGHT, DRIVE_HEIGHT = 120.0, 46.0
SHOWN_TRIALS = 24
DRIVE_TITLES = {"depth_m": "depth", "force_n": "force", "command": "command", "x_m": "x", "y_m": "y"}
DRIVE_UNITS = {"m": "m", "n": "N", "rad": "rad", "s": "s"}


def trace_figure(trace: Trace, unit: str) -> str:
    """One trial: its strongest channels measured, simulated and extended, and below what drove it."""
    parts, top = [], 22.0
    times = trace.time_s
    x_range = span(times, margin=0.0)
    width = WIDTH - LEFT - RIGHT
    for k in range(min(CHANNELS, len(trace.channels))):
        lines = (trace.measured[:, k], trace.simulated[:, k], trace.extended[:, k])
        factor, name = scale_of(float(np.nanmax(np.abs(lines[0]))), unit)
        curves = [curve * factor for curve in lines]
        panel = Panel(LEFT, top, width, CHANNEL_HEIGHT, x_range, span(*curves))
        parts.append(panel.frame("", f"{trace.channels[k]} [{name}]", x_ticks=False))
        for curve, style in zip(curves, ("m", "a dashed", "b"), strict=True):
            parts.append(panel.line(times, curve, style))
        top += CHANNEL_HEIGHT + 30
    for name, values in trace.drive.items():
        title, drive_unit = _drive_title(name, unit)
        factor, shown = scale_of(float(np.nanmax(np.abs(values), initial=0.0)), drive_unit)
        panel = Panel(LEFT, top, width, DRIVE_HEIGHT, x_range, span(values * factor, zero=True))
        last = name == list(trace.drive)[-1]
        parts.append(panel.frame("time [s]", f"{title} [{shown}]", x_ticks=last, y_count=3))
        parts.append(panel.line(times, values * factor, "d"))
        top += DRIVE_HEIGHT + 30
    return drawing(WIDTH, top + 10, parts, f"{trace.file}: measured, simulated and extended")


def _drive_title(name: str, unit: str) -> tuple[str, str]:
    """Title and SI unit of a drive's name, as "depth_m" or "command"."""
    suffix = name.rpartition("_")[2]
    return DRIVE_TITLES.get(name, name.replace("_", " ")), DRIVE_UNITS.get(
        suffix, "rad" if unit == "rad" else "1"
    )


def residual_figure(view: ResidualView, unit: str) -> str:
    """Mean residual against one axis, before and after, with 95 % bands."""
    factor, name = scale_of(float(np.nanmax(np.abs(view.x), initial=0.0)), view.unit)
    bands = [band for band in (view.before_ci95, view.after_ci95) if band is not None]
    curves = [view.before, view.after, *bands]
    scale, shown = scale_of(float(np.nanmax(np.abs(view.before), initial=0.0)), unit)
    panel = Panel(
        LEFT,
        26,
        350 - LEFT - RIGHT,
        150,
        span(view.x * factor),
        span(*[c * scale for c in curves], zero=True),
    )
    title = f"{view.axis} [{name}]" if name else view.axis
    parts = [panel.frame(title, f"measured − predicted [{shown}]")]
    for mean, band, style in ((view.before, view.before_ci95, "a"), (view.after, view.after_ci95, "b")):
        if band is not None:
            parts.append(panel.band(view.x * factor, band[:, 0] * scale, band[:, 1] * scale, style))
        parts.append(panel.line(view.x * factor, mean * scale, style))
    return drawing(350, 222, parts, f"mean residual against {view.axis}")


def error_figure(heldout: Heldout, unit: str) -> str:
    """Held-out error of both models beside the noise floor, as bars."""
    rows = [("simulated", heldout.baseline, "a"), ("extended", heldout.extended, "b")]
    if heldout.noise_floor is not None:
        rows.append(("noise alone", heldout.noise_floor, "d"))
    longest = max(value for _, value, _ in rows) or 1.0
    parts = []
    for k, (name, value, style) in enumerate(rows):
        y, length = 10 + 34 * k, 130 * value / longest
        parts.append(label(96, y + 17, name, "end", "name"))
        parts.append(f'<rect class="bar {style}" x="106" y="{y}" width="{length:.1f}" height="24" rx="3"/>')
        parts.append(label(114 + length, y + 17, quantity(value, unit), "start", "value"))
    return drawing(350, 16 + 34 * len(rows), parts, "root mean squared error on held-out recordings")


def trial_figure(errors: Sequence[TrialError], unit: str) -> str:
    """Errors of held-out trials, from simulated to extended; the worst predicted ones if there are many."""
    ordered = sorted(errors, key=lambda error: -error.extended)[:SHOWN_TRIALS]
    factor, name = scale_of(max(max(e.baseline, e.extended) for e in ordered), unit)
    numbers = np.array([[e.baseline, e.extended] for e in ordered]) * factor
    height = 22.0 * len(ordered)
    panel = Panel(150, 24, WIDTH - 150 - 24, height, span(numbers, zero=True), (0.0, len(ordered)))
    parts = [panel.frame(f"root mean squared error [{name}]", "", y_count=0)]
    for k, error in enumerate(ordered):
        y = panel.y(len(ordered) - k - 0.5)
        before, after = (panel.x(value) for value in numbers[k])
        parts.append(label(142, y + 4, PurePath(error.file).stem, "end"))
        parts.append(f'<path class="grid" d="M{before:.1f} {y:.1f}H{after:.1f}"/>')
        parts.append(f'<circle class="dot a" cx="{before:.1f}" cy="{y:.1f}" r="5"/>')
        parts.append(f'<circle class="dot b" cx="{after:.1f}" cy="{y:.1f}" r="5"/>')
    return drawing(WIDTH, height + 68, parts, "error of every held-out recording")
