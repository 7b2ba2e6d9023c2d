"""``report.html`` of a study: errors per quantity, and the expert's success."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

from lerobot_vtrefine.information.contact import PLACES, SHARES
from lerobot_vtrefine.information.curves import STYLES, clearance_charts, known_error_chart, style_of
from lerobot_vtrefine.information.quantities import AXES, PARTS, SHOWN_UNITS, unit_of
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
        networks={finding.network for finding in found.findings},
        contact=contact_charts(found),
        success=success_chart(found),
        known=[chart for kind in (LATERAL, TILT) if (chart := known_error_chart(found, kind))],
        clearances=clearance_charts(found, clearance_m, senses),
    )


@dataclass(frozen=True)
class Group:
    """The bars of one quantity."""

    name: str
    below: str
    """What is known of it unseen."""
    values: list[tuple[float, float, float] | None]
    """Height and interval of every finding's bar; None: not known."""


def error_chart(found: Study, part: str) -> str:
    """Errors of every finding in the six quantities of a part, as shares of what they are unseen."""
    groups = [
        _share_of(found.prior[name], unit_of(name)[1], axis, [item.rms[name] for item in found.findings])
        for axis in AXES
        for name in (f"{part}_{axis}",)
    ]
    return _grouped(found, part.replace("_", " "), "error", groups)


def contact_charts(found: Study) -> list[str]:
    """Where the contact is, and how often it and its side are told rightly; nothing without a contact."""
    unit = SHOWN_UNITS["x"][1]
    places = [
        _share_of(
            found.contact_unseen[name], unit, name[-1], [item.contact.get(name) for item in found.findings]
        )
        for name in PLACES
        if name in found.contact_unseen
    ]
    shares = [
        Group(
            name,
            percent_tick(found.contact_unseen[name]),
            [item.contact.get(name) for item in found.findings],
        )
        for name in SHARES
        if name in found.contact_unseen
    ]
    charts = ("place of the contact", "error", places), ("contact", "told rightly", shares)
    return [_grouped(found, *chart) for chart in charts if chart[2]]


def _share_of(unseen: float, unit: str, name: str, rms: Sequence[tuple[float, float, float] | None]) -> Group:
    """Errors as shares of what they are unseen."""
    scale = max(unseen, 1e-12)
    shares = [None if row is None else (row[0] / scale, row[1] / scale, row[2] / scale) for row in rms]
    return Group(name, f"{digits(unseen)} {unit}", shares)


def _grouped(found: Study, what: str, measure: str, groups: list[Group]) -> str:
    """A bar of every finding in every group."""
    panel = Panel(
        LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM, (0.0, float(len(groups))), (0.0, MOST)
    )
    parts = [panel.frame("", f"{what}: {measure}", x_ticks=False, y_text=percent_tick)]
    step = 0.8 / len(found.findings)
    for place, group in enumerate(groups):
        parts.append(label(panel.x(place + 0.5), HEIGHT - BOTTOM + 19, group.name, "middle", "name"))
        parts.append(label(panel.x(place + 0.5), HEIGHT - BOTTOM + 38, group.below, "middle"))
        for number, (finding, values) in enumerate(zip(found.findings, group.values, strict=True)):
            if values is not None:
                x = place + 0.1 + step * number
                parts += _bar(panel, x, step / len(groups), values, _style(finding, found))
    return drawing(WIDTH, HEIGHT, parts, f"{measure if measure != 'error' else 'errors of'} {what}")


def _style(finding: Finding, found: Study) -> str:
    faded = " faded" if finding.history > min(other.history for other in found.findings) else ""
    return style_of(finding) + faded


def _bar(panel: Panel, x: float, share: float, values: tuple[float, float, float], style: str) -> list[str]:
    """A bar up to the first of the values, with the others as its interval; ``share`` of the panel wide."""
    height, low, high = (min(value, MOST) for value in values)
    box = f'x="{panel.x(x):.1f}" y="{panel.y(height):.1f}" width="{0.9 * panel.width * share:.1f}"'
    middle = np.array([x + 0.45 * share * panel.x_range[1]])
    return [
        f'<rect class="bar {style}" {box} height="{panel.y(0) - panel.y(height):.1f}"/>',
        panel.whiskers(middle, np.array([low]), np.array([high])),
    ]


def success_chart(found: Study) -> str:
    """The expert that acts on the truth and on each set of senses; empty where it did not act."""
    shown = [("truth", found.true_success, "m")]
    shown += [
        (f"{item.senses.replace('_', '-')}, {item.history}", item.success, style_of(item))
        for item in found.findings
    ]
    bars = []
    for name, counted, style in shown:
        if counted is not None:
            interval = binomtest(*counted).proportion_ci(method="wilson")
            bars.append(Bar(name, counted[0] / counted[1], interval.low, interval.high, style))
    return bar_chart(bars, "success of the expert that acts on estimates") if bars else ""
