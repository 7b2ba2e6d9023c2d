"""Names of everything that the generator can hide in data."""

from collections.abc import Callable

import numpy as np

from hidden import electronics, mechanics, outside
from hidden.scene import Effect, Pad

Factory = Callable[[Pad, float, np.random.Generator], Effect]

FORMS: dict[str, dict[str, Factory]] = {
    "nonlinear_stiffness": {
        "power": mechanics.power,
        "cubic": mechanics.cubic,
        "exponential": mechanics.exponential,
        "densification": mechanics.densification,
    },
    "saturation": {
        "tanh": electronics.knee,
        "rational": electronics.rational_knee,
        "exponential": electronics.exponential_knee,
        "arctan": electronics.arctan_knee,
    },
    "viscoelastic_relaxation": {
        "prony": mechanics.prony,
        "prony_pair": mechanics.prony_pair,
        "log_creep": mechanics.log_creep,
        "stretched": mechanics.stretched,
        "power_creep": mechanics.power_creep,
    },
    "hysteresis": {
        "play": mechanics.play_loop,
        "prandtl_ishlinskii": mechanics.many_plays,
        "bouc_wen": mechanics.bouc_wen,
        "preisach": mechanics.preisach,
        "branch": mechanics.branch,
        "below_peak": mechanics.below_peak,
        "resting": mechanics.resting_play,
    },
    "first_load_softening": {"let_go": mechanics.first_load},
    "taxel_gain_spread": {
        "log_normal": electronics.log_normal_gains,
        "gradient": electronics.gradient_gains,
        "columns": electronics.line_gains,
        "border": electronics.border_gains,
    },
    "dead_taxels": {"scattered": electronics.dead_scattered, "line": electronics.dead_line},
    "row_sharing": {"divider": electronics.row_divider, "circuit": electronics.row_circuit},
    "crosstalk": {
        "both": electronics.crosstalk,
        "columns": electronics.crosstalk_columns,
        "strongest": electronics.crosstalk_strongest,
        "one_sided": electronics.crosstalk_one_sided,
    },
    "mechanical_spreading": {
        "gaussian": mechanics.gaussian_spread,
        "exponential": mechanics.exponential_spread,
        "neighbours": mechanics.neighbour_spread,
        "box": mechanics.box_spread,
    },
    "baseline_drift": {
        "linear": electronics.drift,
        "warm_up": electronics.warm_up,
        "random_walk": electronics.wandering,
        "temperature": electronics.thermal,
    },
    "latency": {
        "constant": electronics.delay,
        "jitter": electronics.delay_jitter,
        "filter": electronics.delay_filter,
    },
    "scan_skew": {"rows": electronics.skew, "blocks": electronics.skew_blocks},
    "sample_and_hold": {"from_start": electronics.hold, "free_running": electronics.hold_free},
    "contact_offset": {
        "shift": mechanics.offset,
        "wander": mechanics.offset_wander,
        "soft": mechanics.offset_soft,
    },
    "pad_tilt": {"plane": mechanics.tilt, "wobble": mechanics.tilt_wobble},
    "outside": {
        "mains_hum": outside.hum,
        "frame_parity": outside.parity,
        "direction": outside.direction,
        "aging": outside.aging,
        "stick_slip": outside.stick_slip,
        "neighbour_pad": outside.neighbour,
        "clock_warp": outside.clock_warp,
        "bowl": outside.bowl,
        "thermal_gain": outside.thermal_gain,
        "contact_age": outside.fatigue_of_contact,
    },
}
"""Family -> form -> factory; a family's first form is the contract's own."""

CAUSES = tuple(name for name in FORMS if name != "outside")

PAIRS = (
    ("hysteresis", "row_sharing"),
    ("latency", "taxel_gain_spread"),
    ("viscoelastic_relaxation", "baseline_drift"),
    ("nonlinear_stiffness", "taxel_gain_spread"),
    ("crosstalk", "hysteresis"),
    ("mechanical_spreading", "latency"),
    ("dead_taxels", "viscoelastic_relaxation"),
    ("pad_tilt", "baseline_drift"),
    ("contact_offset", "scan_skew"),
    ("sample_and_hold", "row_sharing"),
    ("nonlinear_stiffness", "saturation"),
    ("viscoelastic_relaxation", "hysteresis"),
)
TRIPLES = (
    ("hysteresis", "taxel_gain_spread", "latency"),
    ("row_sharing", "viscoelastic_relaxation", "baseline_drift"),
)

# On these rigs a cause leaves no trace at all.
INVISIBLE = {
    "1x1": (
        "taxel_gain_spread",
        "dead_taxels",
        "row_sharing",
        "crosstalk",
        "mechanical_spreading",
        "scan_skew",
        "pad_tilt",
    ),
    "force": ("contact_offset", "pad_tilt", "nonlinear_stiffness"),
}


def visible(cause: str, rig_name: str) -> bool:
    """Whether a cause acts on the readings of a rig at all."""
    single = rig_name.startswith("1x1") and cause in INVISIBLE["1x1"]
    return not single and not (rig_name.endswith("force") and cause in INVISIBLE["force"])
