"""A small drawing of every cause that can be named: dashed as simulated, solid as measured."""

from html import escape

STEP = "M8 58H40V16H112"
RAMP = "M8 60L112 12"
FLAT = "M8 36H112"
PEAK = "M8 60H46V14H74V60H112"
WAVE = "M8 36C22 4 36 4 50 36S78 68 92 36S106 18 112 14"

SHAPES: dict[str, tuple[str, str, str]] = {
    "nonlinear_stiffness": (RAMP, "M8 60C60 56 92 40 112 8", "reading over depth"),
    "saturation": (RAMP, "M8 60L66 33C80 27 90 26 112 26", "reading over force"),
    "viscoelastic_relaxation": (STEP, "M8 58H40V30C60 18 80 14 112 13", "reading over time"),
    "hysteresis": (
        RAMP,
        "M8 60C60 60 92 40 112 12C80 12 40 30 8 60",
        "reading over depth, loading and unloading",
    ),
    "taxel_gain_spread": (FLAT, "M8 36H20V24H36V46H52V30H68V52H84V28H100V38H112", "gain over taxels"),
    "dead_taxels": (FLAT, "M8 36H44V62H60V36H84V62H92V36H112", "reading over taxels"),
    "row_sharing": (PEAK, "M8 60H46V34H74V60H112", "reading along a row"),
    "supply_droop": (RAMP, "M8 60C44 42 80 32 112 28", "reading over the pad's load"),
    "crosstalk": (PEAK, "M8 52H46V14H74V52H112", "reading along a row"),
    "mechanical_spreading": (PEAK, "M8 60C36 60 44 18 60 18S84 60 112 60", "reading along a row"),
    "baseline_drift": (FLAT, "M8 50C40 44 80 28 112 16", "idle level over time"),
    "latency": (STEP, "M8 58H62V16H112", "reading over time"),
    "control_latency": (STEP, "M8 58H62V16H112", "position over time"),
    "scan_skew": (STEP, "M8 58H36V44H48V30H60V16H112", "rows over time"),
    "sample_and_hold": (RAMP, "M8 60H30V50H54V38H78V26H102V14H112", "reading over time"),
    "contact_offset": (RAMP, "M8 60H36L112 25", "reading over depth"),
    "pad_tilt": (FLAT, "M8 52L112 20", "height over the pad"),
    "encoder_offset": (RAMP, "M8 46L112 -2", "measured over true position"),
    "backlash": (WAVE, "M8 40C24 12 34 12 44 12C58 12 66 60 80 60C92 60 100 34 112 24", "position over time"),
    "joint_friction": (RAMP, "M8 60H30L34 44H58L62 32H86L90 20H112", "position over time"),
    "gravity_sag": (FLAT, "M8 36C50 38 80 46 112 60", "position over reach"),
    "gripper_compliance": (RAMP, "M8 60L60 36H112", "opening over command"),
    "depth_scale": (RAMP, "M8 60L112 30", "measured over true distance"),
    "object_friction": (RAMP, "M8 60L50 41H112", "shear over push"),
}
"""Paths of 120 by 72 units as simulated and as it is, and what is drawn over what."""


def effect_drawing(name: str) -> str:
    """The drawing of a cause as inline SVG; empty for one that has none."""
    if name not in SHAPES:
        return ""
    before, after, axes = (escape(text, quote=True) for text in SHAPES[name])
    return (
        f'<svg class="effect" viewBox="0 0 120 72" role="img" aria-label="{axes}"><title>{axes}</title>'
        f'<path class="was" d="{before}"/><path class="is" d="{after}"/></svg>'
    )
