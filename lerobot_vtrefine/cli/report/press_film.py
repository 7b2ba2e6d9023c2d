"""One held-out press in motion: measured, simulated and extended, side by side."""

from pathlib import PurePath

import numpy as np

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
from lerobot_vtrefine.diagnose.predict import predict_frames
from lerobot_vtrefine.diagnose.quality import in_si_units
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.pages.pads import colour_scale, pad_film
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel

MOST_FRAMES = 60
IDLE_FRAMES = 3
"""First frames of a trial, in which nothing touches the pad."""


def press_film(diagnosis: Diagnosis, recordings: RecordingSet) -> dict[str, str] | None:
    """The film of the typical held-out trial, its caption and scale; None where there is nothing to show."""
    models = [model for model in diagnosis.measured_models if isinstance(model, SensorModel)]
    shown = typical_trial(diagnosis, recordings)
    if shown is None or len(models) < 2:
        return None
    layout = PadLayout(recordings.rows, recordings.cols, recordings.pitch_m)
    sides = [shown.raw]
    for model in models:
        sides.append(predict_frames(shown, lambda trial, model=model: predict_trial(model, trial, layout)))
    stride = -(-len(shown.time_s) // MOST_FRAMES)
    films = [
        np.clip(side - np.nanmean(side[:IDLE_FRAMES], axis=0), 0, None)[::stride].reshape(
            -1, recordings.rows, recordings.cols
        )
        for side in sides
    ]
    top = max(float(np.nanmax(films[0])), 1e-9)
    frame_s = float(np.median(np.diff(shown.time_s))) * stride
    return {
        "source": pad_film(films, top, frame_s),
        "caption": f"{PurePath(shown.file).stem}, which no fit has seen",
        "scale": colour_scale(top, "counts above idle"),
    }


def typical_trial(diagnosis: Diagnosis, recordings: RecordingSet) -> Trial | None:
    """The held-out trial with the median error, in SI units; None for robots or without held-out trials."""
    if recordings.kind != "pad" or not diagnosis.trial_errors:
        return None
    ranked = sorted(diagnosis.trial_errors, key=lambda error: error.extended)
    name = ranked[len(ranked) // 2].file
    mended, _ = in_si_units(recordings)
    return next((t for t in mended.trials if t.file == name and isinstance(t, Trial)), None)
