"""Diagnoses by hand, for tests of the report and of the command: no engine involved."""

from dataclasses import fields, replace

import numpy as np

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.evidence import Evidence, ResidualView, Trace, TrialError, not_tested
from lerobot_vtrefine.diagnose.verdict import Cause, Heldout, Parameter, Unknown, Verdict
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.hysteresis import Hysteresis
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle

BASELINE = SensorModel((KelvinVoigt(k_n=380.0, k_d=1.0), Gain(500.0), Idle(25.0, 0.0)))
EXTENDED = BASELINE.with_stage(Hysteresis(fraction=0.18, width_m=2e-4))


def traces(count, channels, unit):
    rng = np.random.default_rng(0)
    time = np.arange(240) / 30.0
    found = []
    for k in range(count):
        drive = np.interp(time, [0, 1, 3, 4, 5, 7, 8], [-0.3, -0.3, 1.0, 0.4, 0.9, -0.3, -0.3])
        shape = np.maximum(drive, 0)[:, None] * np.linspace(1.0, 0.5, len(channels))
        lagged = np.array([shape[max(i - 4, 0)] for i in range(240)])
        scale = 120.0 if unit == "counts" else 0.6
        name = "depth_m" if unit == "counts" else "command_rad"
        found.append(
            Trace(
                f"trial_{k:04d}.parquet",
                f"c{k // 2}",
                time,
                channels,
                scale * (lagged + rng.normal(0, 0.01, shape.shape)),
                scale * shape,
                scale * np.array([shape[max(i - 3, 0)] for i in range(240)]),
                {name: drive * (1e-3 if unit == "counts" else 0.6)},
            )
        )
    return tuple(found)


def residuals(unit):
    axes = {
        "load": ("N", np.linspace(0, 0.5, 12)),
        "rate": ("m/s", np.linspace(-0.01, 0.01, 12)),
        "history": ("s", np.linspace(0, 4, 12)),
        "position": ("m", np.linspace(-0.03, 0.03, 12)),
        "time": ("s", np.linspace(0, 600, 12)),
    }
    views = []
    for axis, (axis_unit, x) in axes.items():
        slope = np.linspace(-1, 1, 12) * (6.0 if unit == "counts" else 0.02)
        band = np.abs(slope).max() * 0.2
        after = 0.1 * slope
        views.append(
            ResidualView(
                axis,
                axis_unit,
                x,
                slope,
                after,
                np.column_stack([slope - band, slope + band]),
                np.column_stack([after - band, after + band]),
            )
        )
    return tuple(views)


def _made(values):
    """The verdict's fields go into the verdict."""
    own = {field.name for field in fields(Verdict)}
    verdict = Verdict(**{name: value for name, value in values.items() if name in own})
    verdict = replace(verdict, not_tested=not_tested(values["evidence"]))
    return Diagnosis(verdict, **{name: value for name, value in values.items() if name not in own})


def pad_diagnosis(**changes):
    """Hysteresis and a gain map found, crosstalk rejected; pass fields to change them."""
    gains = (1.0 + 0.15 * np.random.default_rng(1).normal(size=(6, 8))).tolist()
    values = {
        "status": "explained",
        "causes": (
            Cause(
                "taxel_gain_spread",
                "cause",
                {"sigma": Parameter(0.15, (0.12, 0.18), "1"), "map": Parameter(gains, None, "1")},
                1e-4,
                0.45,
            ),
            Cause(
                "hysteresis",
                "cause",
                {
                    "fraction": Parameter(0.18, (0.15, 0.21), "1"),
                    "width_m": Parameter(2.1e-4, (1.8e-4, 2.4e-4), "m"),
                },
                4e-4,
                0.2,
            ),
        ),
        "ambiguous_with": (),
        "unknown": Unknown(alarm=False),
        "heldout": Heldout(
            "rmse", 4.1, 2.4, 2.3, 0.657, (0.61, 0.70), tuple(f"trial_{k:04d}.parquet" for k in range(6))
        ),
        "minimum_detectable": {"crosstalk": 0.004, "latency": 0.006, "contact_offset": 3e-5},
        "next_experiment": None,
        "data_issues": (),
        "baseline_model": BASELINE,
        "extended_model": EXTENDED,
        "baseline_params": {
            "k_n": Parameter(380.0, (371.0, 390.0), "N/m"),
            "k_d": Parameter(1.0, (0.7, 1.3), "N*s/m"),
        },
        "evidence": (
            Evidence("crosstalk", 0.4, 0.99, 0.001, "rejected", "no more than chance gives"),
            Evidence(
                "hysteresis", 4e-5, 4e-4, 0.2, "accepted", "loading and unloading differ at every speed"
            ),
            Evidence("taxel_gain_spread", 1e-5, 1e-4, 0.45, "accepted", "a fixed map times the load"),
            Evidence(
                "baseline_drift",
                None,
                None,
                None,
                "not identifiable",
                "all trials were recorded in one minute",
            ),
        ),
        "traces": traces(6, ("taxel (2, 3)", "taxel (2, 4)"), "counts"),
        "residuals": residuals("counts"),
        "trial_errors": tuple(
            TrialError(f"trial_{k:04d}.parquet", f"c{k}", 4.0 + 0.2 * k, 2.3 + 0.1 * k) for k in range(6)
        ),
        "maps": {"rms residual before": np.full((6, 8), 4.0), "rms residual after": np.full((6, 8), 2.0)},
        "unit": "counts",
    }
    return _made(values | changes)


def robot_diagnosis(**changes):
    """Backlash or hysteresis-like lag that cannot be told apart, on two joints."""
    values = {
        "status": "ambiguous",
        "causes": (
            Cause(
                "gravity_sag",
                "cause",
                {"left_shoulder_rad": Parameter(0.021, (0.017, 0.026), "rad")},
                2e-4,
                0.4,
            ),
        ),
        "ambiguous_with": (("backlash", "control_latency"),),
        "heldout": Heldout(
            "rmse", 0.021, 0.012, 0.006, 0.67, (0.5, 0.8), tuple(f"trial_{k:04d}.parquet" for k in range(4))
        ),
        "minimum_detectable": {"encoder_offset": 0.002, "control_latency": 0.012},
        "next_experiment": {
            "decides": ["backlash", "control_latency"],
            "text": "Move each joint to and fro at two speeds, 0.1 and 0.5 rad/s, ten times.",
            "protocol": {"joints": ["left_shoulder"], "speeds_rad_s": [0.1, 0.5], "repetitions": 10},
        },
        "baseline_params": {"left_shoulder.natural_frequency": Parameter(21.0, (20.0, 22.5), "rad/s")},
        "evidence": (
            Evidence("gravity_sag", 1e-5, 2e-4, 0.4, "accepted", "follows the posture, not the motion"),
            Evidence("backlash", 1e-3, 4e-3, 0.15, "tie", "fits as well as control latency"),
            Evidence("control_latency", 1e-3, 4e-3, 0.14, "tie", "fits as well as backlash"),
        ),
        "traces": traces(4, ("left_shoulder", "left_elbow"), "rad"),
        "residuals": residuals("rad"),
        "trial_errors": (),
        "maps": {},
        "unit": "rad",
    }
    return pad_diagnosis(**(values | changes))
