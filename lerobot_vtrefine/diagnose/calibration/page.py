"""``report.html`` and ``calibration.json`` of a calibration."""

from typing import Any

from lerobot_vtrefine.diagnose.calibration import figures
from lerobot_vtrefine.diagnose.calibration.fit import Calibration, fits_the_simulation
from lerobot_vtrefine.diagnose.report.numbers import interval
from lerobot_vtrefine.pages.render import render

SCHEMA = "vtrefine/calibration@1"
SIMULATED_FULL_SCALE = 255.0
"""Where the simulator's pads stop [counts]."""
WORDS = {
    "k_n": "stiffness per taxel",
    "k_d": "damping per taxel",
    "gain": "reading per force",
    "knee_counts": "saturation: where readings level off",
    "idle_mean": "idle level, mean over taxels",
    "noise_sigma": "noise of one reading at rest",
}


def summary(calibration: Calibration, source: str) -> dict[str, Any]:
    """All numbers as plain values."""
    found = calibration.excitation
    return {
        "schema": SCHEMA,
        "recording": source,
        "parameters": {
            name: {"value": item.value, "ci95": list(item.ci95) if item.ci95 else None, "unit": item.unit}
            for name, item in calibration.parameters.items()
        },
        "explained": calibration.explained,
        "rms_counts": calibration.rms_counts,
        "saturation_p": calibration.saturation_p,
        "recordings": found.recordings,
        "speeds_m_s": list(found.speeds_m_s),
        "peaks": found.peaks.tolist(),
        "remarks": remarks(calibration),
        "data_issues": [[issue.trial, issue.problem, issue.action] for issue in calibration.issues],
    }


def remarks(calibration: Calibration) -> list[str]:
    """What a user should know about the result, in sentences."""
    said = []
    k_d = calibration.parameters.get("k_d")
    value, bounds = (k_d.value, k_d.ci95) if k_d is not None else (None, None)
    if bounds is not None and value == 0.0:
        said.append(
            "k_d ended at 0: readings come later than the motion, as with a latency; vtrefine-diagnose tells."
        )
    elif bounds is not None and isinstance(value, float) and bounds[1] - bounds[0] > value:
        said.append("k_d is uncertain by half its value or more: record faster presses to know it better.")
    if calibration.rms_counts > 2.0 * calibration.noise_counts:
        said.append(
            f"The fit misses by {calibration.rms_counts:.1f} counts RMS, with noise of"
            f" {calibration.noise_counts:.1f}: something else is at work; vtrefine-diagnose names it."
        )
    if not fits_the_simulation(calibration.presses):
        layout = calibration.presses.layout
        said.append(
            f"The pad has {layout.rows} x {layout.cols} taxels, other than the simulator's: the model"
            " carries the idle level's mean and spread instead of its map."
        )
    if calibration.presses.full_scale != SIMULATED_FULL_SCALE:
        said.append(
            f"Full scale is {calibration.presses.full_scale:g} here; the simulator's pads stop at"
            f" {SIMULATED_FULL_SCALE:g}."
        )
    return said


def render_page(calibration: Calibration, source: str, model: str) -> str:
    """The page as HTML text; figures are embedded. `model` is where the fitted sensor model is."""
    rows = [
        (name, WORDS.get(name, name.replace("_", " ")), *interval(item.value, item.ci95, item.unit))
        for name, item in calibration.parameters.items()
        if isinstance(item.value, float)
    ]
    return render(
        "lerobot_vtrefine.diagnose.calibration",
        "page.html",
        source=source,
        model=model,
        calibration=calibration,
        rows=rows,
        remarks=remarks(calibration),
        stages=[stage.name for stage in calibration.model.stages],
        curves=figures.response_curves(calibration),
        speeds=not calibration.presses.loaded,
        draws=figures.resampled(calibration),
        presses=figures.presses_over_time(calibration),
    )
