"""The catalogue: one file per cause, each with its functional forms, the plain one first.

To add a cause, write its stage in `tactile/stages`, a file here with its `FORMS`, and list it below.
"""

from lerobot_vtrefine.diagnose.candidates import (
    baseline_drift,
    contact_offset,
    crosstalk,
    hysteresis,
    latency,
    mechanical_spreading,
    nonlinear_stiffness,
    pad_tilt,
    row_sharing,
    sample_and_hold,
    saturation,
    scan_skew,
    viscoelastic_relaxation,
)
from lerobot_vtrefine.diagnose.candidates.base import Form

CATALOGUE: tuple[Form, ...] = (
    *nonlinear_stiffness.FORMS,
    *saturation.FORMS,
    *viscoelastic_relaxation.FORMS,
    *hysteresis.FORMS,
    *row_sharing.FORMS,
    *crosstalk.FORMS,
    *mechanical_spreading.FORMS,
    *baseline_drift.FORMS,
    *latency.FORMS,
    *scan_skew.FORMS,
    *sample_and_hold.FORMS,
    *contact_offset.FORMS,
    *pad_tilt.FORMS,
)
"""Causes with a handful of parameters; maps (taxel_gain_spread, dead_taxels) are fitted in `maps`."""
