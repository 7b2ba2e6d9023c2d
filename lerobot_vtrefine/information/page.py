"""``report.html`` of a study: errors per quantity, and the expert's success."""

import numpy as np
from scipy.stats import binomtest

from lerobot_vtrefine.information.curves import STYLES, clearance_charts, known_error_chart
from lerobot_vtrefine.information.quantities import AXES, PARTS, unit_of
from lerobot_vtrefine.information.study import Finding, Study
from lerobot_vtrefine.information.tolerance import LATERAL, TILT
from lerobot_vtrefine.pages.charts import Panel, digits, drawing, label, percent_tick
from lerobot_vtrefine.pages.rates import Bar, bar_chart
from lerobot_vtrefine.pages.render import render

WIDTH, HEIGHT = 520.0, 260.0
LEFT, RIGHT, TOP, BOTTOM = 62.0, 14.0, 26.0, 52.0
MOST = 1.1
"""Errors are shown up to this many times what they are before anything is seen."""


def render_page(found: Study, pair: str, clearance_m: float) -> str:
    """The page as HTML text."""
    senses = list(dict.fromkeys(finding.senses for finding in found.findings))
    return render(
        "lerobot_vtrefine.information",
        "page.html",
        pair=pair,
        verdict=found.verdict.reason,
        keys=[(name.replace("_", "-"), STYLES[name]) for name in senses],
        history=sorted({finding.history for finding in found.findings}),
        errors=[error_chart(found, part) for part in PARTS],
        success=success_chart(found),
        known=[chart for kind in (LATERAL, TILT) if (chart := known_error_chart(found, kind))],
        clearances=clearance_charts(found, clearance_m, senses),
    )


def error_chart(found: Study, part: str) -> str:
    """Errors of every finding in the six quantities of a part, as shares of what they are unseen."""
    names = [f"{part}_{axis}" for axis in AXES]
    panel = Panel(
        LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, (0.0, float(len(names))), (0.0, MOST)
    )
    title = f"{part.replace('_', ' ')}: error"
    parts = [panel.frame("", title, x_ticks=False, y_text=percent_tick)]
    step = 0.8 / len(found.findings)
    for place, name in enumerate(names):
        prior, (_, unit) = found.prior[name], unit_of(name)
        parts.append(label(panel.x(place + 0.5), HEIGHT - BOTTOM + 19, AXES[place], "middle", "name"))
        parts.append(label(panel.x(place + 0.5), HEIGHT - BOTTOM + 38, f"{digits(prior)} {unit}", "middle"))
        for number, finding in enumerate(found.findings):
            x = place + 0.1 + step * number
            parts += _bar(
                panel,
                x,
                step,
                [value / max(prior, 1e-12) for value in finding.rms[name]],
                _style(finding, found),
            )
    return drawing(WIDTH, HEIGHT, parts, f"errors of {part.replace('_', ' ')}")


def _style(finding: Finding, found: Study) -> str:
    faded = " faded" if finding.history > min(other.history for other in found.findings) else ""
    return STYLES[finding.senses] + faded


def _bar(panel: Panel, x: float, step: float, values: list[float], style: str) -> list[str]:
    """A bar up to the first of the values, with the other two as its interval."""
    height, low, high = (min(value, MOST) for value in values)
    box = f'x="{panel.x(x):.1f}" y="{panel.y(height):.1f}" width="{0.9 * panel.width * step / len(AXES):.1f}"'
    middle = np.array([x + 0.45 * step])
    return [
        f'<rect class="bar {style}" {box} height="{panel.y(0) - panel.y(height):.1f}"/>',
        panel.whiskers(middle, np.array([low]), np.array([high])),
    ]


def success_chart(found: Study) -> str:
    """The expert that acts on the truth and on each set of senses; empty where it did not act."""
    shown = [("truth", found.true_success, "m")]
    shown += [
        (f"{item.senses.replace('_', '-')}, {item.history}", item.success, STYLES[item.senses])
        for item in found.findings
    ]
    bars = []
    for name, counted, style in shown:
        if counted is not None:
            interval = binomtest(*counted).proportion_ci(method="wilson")
            bars.append(Bar(name, counted[0] / counted[1], interval.low, interval.high, style))
    return bar_chart(bars, "success of the expert that acts on estimates") if bars else ""
