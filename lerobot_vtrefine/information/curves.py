"""Curves of a study's page: success against errors of known sizes; errors and success against clearance."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest

from lerobot_vtrefine.information.estimator import POLICY
from lerobot_vtrefine.information.quantities import SHOWN_UNITS
from lerobot_vtrefine.information.study import Finding, Study
from lerobot_vtrefine.information.tolerance import LATERAL, TILT
from lerobot_vtrefine.pages.charts import Panel, drawing, percent_tick

WIDTH, HEIGHT = 520.0, 300.0
LEFT, RIGHT, TOP, BOTTOM = 62.0, 18.0, 28.0, 52.0
KNOWN = {
    LATERAL: (("x", "y"), *SHOWN_UNITS["x"], "error of where the hole is, per axis"),
    TILT: (("rx", "ry", "rz"), *SHOWN_UNITS["r"], "error of the plug's orientation, per axis"),
}
"""Axes of ``plug_in_socket`` that a kind of error is about, factor and unit, and words."""

STYLES = {"joints": "d", "visual": "a", "tactile": "m", "visuo_tactile": "b", "visuo_tactile_cloud": "b"}
"""Colours of the senses."""


def style_of(finding: Finding) -> str:
    """The senses' colour, with an outline where the network is not the policy's."""
    return STYLES[finding.senses] + ("" if finding.network == POLICY else f" {finding.network}")


def known_error_chart(found: Study, error: str) -> str:
    """Success against the size of an error that the expert is given, and where each set of senses stands."""
    axes, scale, unit, words = KNOWN[error]
    chosen = [item for item in found.tolerated if item.error == error or item.size == 0]
    if not chosen:
        return ""
    sizes = np.array([scale * item.size for item in chosen])
    rates, low, high = _rates([item.success for item in chosen])
    judged = [item for item in found.findings if item.success is not None]
    marks = [(error_of(item, axes), item) for item in judged]
    panel = _panel((0.0, 1.05 * max([*sizes, *(place for place, _ in marks)])), (0.0, 1.0))
    parts = [panel.frame(f"{words}, {unit}", "success of the expert", y_text=percent_tick)]
    parts += [
        panel.line(sizes, rates, "m"),
        panel.whiskers(sizes, low, high),
        panel.dots(sizes, rates, "m", 3.0),
    ]
    for place, item in marks:
        rate, *ends = _rates([item.success])
        at = np.array([place])
        parts += [panel.whiskers(at, *ends), panel.dots(at, rate, style_of(item))]
    return drawing(WIDTH, HEIGHT, parts, f"success against {words}")


def clearance_charts(found: Study, clearance_m: float, senses: Sequence[str]) -> list[str]:
    """Error of the plug's place over the hole, and success, against clearance; nothing of one clearance."""
    studies = dict(sorted({clearance_m: found, **found.at_clearance}.items()))
    if len(studies) < 2:
        return []
    scale, unit = SHOWN_UNITS["x"]
    gaps = np.array([scale * clearance for clearance in studies])
    history = min(item.history for item in found.findings)
    lines = {
        name: [
            next(f for f in s.findings if (f.senses, f.history) == (name, history)) for s in studies.values()
        ]
        for name in senses
    }
    errors = {name: np.array([error_of(f, ("x", "y")) for f in row]) for name, row in lines.items()}
    wide = (0.0, 1.1 * gaps[-1])
    panel = _panel(wide, (0.0, 1.1 * max(gaps[-1] / 2, *(row.max() for row in errors.values()))))
    parts = [panel.frame(f"clearance, {unit}", f"error of the plug over the hole, per axis, {unit}")]
    parts.append(panel.line(np.array([0.0, gaps[-1]]), np.array([0.0, gaps[-1] / 2]), "m"))
    for name, row in errors.items():
        parts += [panel.line(gaps, row, STYLES[name]), panel.dots(gaps, row, STYLES[name])]
    charts = [drawing(WIDTH, HEIGHT, parts, "error against clearance")]
    counts = {name: [f.success for f in row if f.success is not None] for name, row in lines.items()}
    if any(len(row) == len(gaps) for row in counts.values()):
        charts.append(_success_chart(studies, gaps, counts))
    return charts


def _success_chart(
    studies: dict[float, Study],
    gaps: np.ndarray,
    counts: dict[str, list[tuple[int, int]]],
) -> str:
    """Success against clearance: the truth, and every set of senses."""
    panel = _panel((0.0, 1.1 * gaps[-1]), (0.0, 1.0))
    parts = [panel.frame(f"clearance, {SHOWN_UNITS['x'][1]}", "success of the expert", y_text=percent_tick)]
    truth = [s.true_success for s in studies.values() if s.true_success is not None]
    for row, name in ((truth, "m"), *((row, STYLES[senses]) for senses, row in counts.items())):
        if len(row) == len(gaps):
            rates, low, high = _rates(row)
            parts += [
                panel.line(gaps, rates, name),
                panel.whiskers(gaps, low, high),
                panel.dots(gaps, rates, name),
            ]
    return drawing(WIDTH, HEIGHT, parts, "success against clearance")


def error_of(finding: Finding, axes: Sequence[str]) -> float:
    """RMS error of the plug in its socket over some axes, in the unit of the page."""
    return float(np.sqrt(np.mean([finding.rms[f"plug_in_socket_{axis}"][0] ** 2 for axis in axes])))


def _panel(x_range: tuple[float, float], y_range: tuple[float, float]) -> Panel:
    return Panel(LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, x_range, y_range)


def _rates(counts: Sequence[tuple[int, int] | None]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shares of successes, with both ends of Wilson's intervals."""
    found = [binomtest(*counted) for counted in counts if counted is not None]
    ends = [test.proportion_ci(method="wilson") for test in found]
    return (
        np.array([test.statistic for test in found]),
        np.array([end.low for end in ends]),
        np.array([end.high for end in ends]),
    )
