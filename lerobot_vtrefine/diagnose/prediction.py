"""What a sensor model predicts for a recorded press: the one path of diagnosis, prediction and report."""

import numpy as np
import torch

from lerobot_vtrefine.diagnose.indenters import trial_forces, trial_heights
from lerobot_vtrefine.diagnose.recordings import Trial
from lerobot_vtrefine.diagnose.refinement import (
    needs_refinement,
    refined,
    refined_motion,
    refined_times,
    substeps,
)
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.replay import finite_rate, replay
from lerobot_vtrefine.tactile.stages.readout import Quantisation


def predict_trial(model: SensorModel, trial: Trial, layout: PadLayout) -> np.ndarray:
    """Expected readings of a trial, idle level included, clipped to the converter's range: (N, R*C) counts.

    Reads the trial's motion (or load, where it has no `depth_m`) and never its `raw`. Noise and rounding are
    left out: the mean is what predicts best.
    """
    count = substeps(trial.time_s) if needs_refinement(model.stages) else 1
    depth, force, rate = None, None, None
    if trial.depth_m is None:
        force = refined(trial_forces(trial, layout), count)
    else:
        heights = trial_heights(trial, layout)
        rate = finite_rate(torch.as_tensor(trial.time_s), torch.as_tensor(heights)).numpy()
        depth, rate = refined_motion(heights, rate, trial.time_s, count)
    times = refined_times(trial.time_s, count)
    fine = replay(model, times, depth, rate, force_n=force, layout=layout, start_s=trial.start_s)
    predicted = fine[::count]
    converter = model.find("quantisation")
    limit = converter.full_scale_counts if isinstance(converter, Quantisation) else np.inf
    return predicted.numpy().astype(float).reshape(len(trial.time_s), -1).clip(0.0, limit)
