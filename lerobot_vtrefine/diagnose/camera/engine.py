"""The diagnosis of a camera: depth images of episodes in, camera_extrinsics and depth_scale out."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.camera.frames import DepthFrames, read_frames
from lerobot_vtrefine.diagnose.camera.problem import CANDIDATES, CameraProblem, Candidate, Fit
from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.engine import Inference, Progress, infer
from lerobot_vtrefine.diagnose.core.problem import OptionalRemarks
from lerobot_vtrefine.diagnose.core.resampling import draws_of
from lerobot_vtrefine.diagnose.core.rules import SURE
from lerobot_vtrefine.diagnose.core.summary import tell
from lerobot_vtrefine.diagnose.verdict import Parameter

_NAMES = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
_DRAWS = 1000
_NEXT = {
    "decides": [item.cause for item in CANDIDATES],
    "text": "Record episodes in which the arms come close to the camera and reach far from it: a scale grows "
    "with distance, a shift does not.",
    "protocol": {"distances_m": [0.3, 0.9], "episodes": 8},
}


def diagnose_camera(root: Path, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """Judge the camera of a LeRobot dataset with depth images, stated camera pose and intrinsics.

    Raises ValueError if the dataset lacks one of them.
    """
    return diagnose_frames(read_frames(root), seed, progress)


def diagnose_frames(frames: DepthFrames, seed: int = 0, progress: Progress | None = None) -> Diagnosis:
    """The same for frames in memory."""
    found = infer(CameraProblem(frames), seed, progress)
    return tell(found, CameraAccount(found))


class CameraAccount(OptionalRemarks):
    """See `core.problem.Account`; errors are depths in metres. No view is recorded twice, so that
    the noise is unknown; images always show both causes."""

    unit = "m"
    metric = "rmse of depth [m]"

    def __init__(self, found: Inference[CameraProblem, Fit, Candidate]) -> None:
        self.problem, self.fit, self.seed = found.selection.problem, found.selection.fit, found.seed

    def parameters(self, cause: str, channels: tuple[int, ...]) -> Mapping[str, Parameter]:
        """What the cause sets, with intervals by drawing whole episodes."""
        registration, place = self.fit.registration, self.problem.place
        draws = draws_of(len(self.problem.episodes), self.seed, _DRAWS)
        counts = np.stack([np.bincount(row, minlength=len(self.problem.episodes)) for row in draws])
        drawn = np.stack([registration.reweighted(weights[place].astype(float)) for weights in counts])
        low, high = np.percentile(drawn, [2.5, 97.5], axis=0)
        theta = registration.theta
        if cause == "depth_scale":
            value, *ends = (float(np.exp(x[6])) for x in (theta, low, high))
            return {"factor": Parameter(value, (ends[0], ends[1]), "1")}
        return {
            key: Parameter(float(theta[k]), (float(low[k]), float(high[k])), key.rpartition("_")[2])
            for k, key in enumerate(_NAMES)
        }

    def baseline_parameters(self) -> Mapping[str, Parameter]:
        """Empty: the stated camera has none."""
        return {}

    def model(self, fit: Fit) -> None:
        """None: simulations take the camera's place and scale from their own settings."""

    def minimum_detectable(self) -> Mapping[str, float]:
        """Smallest shift [m] and deviation of the scale from 1 that stand out from the episodes' scatter."""
        total, slope = self.fit.registration.normal.sum(0), self.fit.registration.slope
        score = np.stack([np.bincount(self.problem.place, column) for column in slope.T], 1)
        out = {}
        for candidate in CANDIDATES:
            free = np.array(candidate.free)
            inverse = np.linalg.pinv(total[np.ix_(free, free)])
            centred = (score - score.mean(0))[:, free]
            error = np.sqrt(np.diag(inverse @ (centred.T @ centred) @ inverse))
            out[candidate.cause] = float(SURE * error[:3].max())
        return out

    def causes(self) -> Sequence[str]:
        """Names of the catalogue: pose and scale."""
        return tuple(item.cause for item in CANDIDATES)

    def next_experiment(self, rivals: Sequence[Any], alarms: Sequence[Any]) -> Mapping[str, Any] | None:
        """What to record where pose and scale tie."""
        return _NEXT if rivals else None
