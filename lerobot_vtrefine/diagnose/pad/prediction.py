"""What a sensor model predicts for a recorded press: the one path of diagnosis, prediction and report."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.motion import instants, instants_of, motion, warmth
from lerobot_vtrefine.diagnose.recordings import Trial
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.replay import replay
from lerobot_vtrefine.tactile.stages.readout import Quantisation


def predict_trial(model: SensorModel, trial: Trial, layout: PadLayout) -> np.ndarray:
    """Expected readings of a trial, idle level included, clipped to the converter's range: (N, R*C) counts.

    Reads the trial's motion (or load, where it has no `depth_m`) and never its `raw`. Noise and rounding are
    left out: the mean is what predicts best.
    """
    times, frames = instants_of(trial, layout, instants(tuple(model.stages)))
    drive, rate = motion(trial, layout, times)
    loaded, borne = trial.depth_m is None, trial.borne
    fine = replay(
        model,
        times,
        None if loaded else drive,
        None if loaded else rate,
        force_n=drive if loaded else None,
        layout=layout,
        start_s=trial.start_s,
        temperature_c=warmth(trial, times),
        borne=None if borne is None else (borne.drive, borne.age_s, borne.path),
    )
    converter = model.find("quantisation")
    limit = converter.full_scale_counts if isinstance(converter, Quantisation) else np.inf
    predicted = fine[frames].numpy().astype(float)
    return predicted.reshape(len(trial.time_s), -1).clip(0.0, limit)
