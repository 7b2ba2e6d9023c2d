"""Recorded controllers: one sample per control step, from an .npz file.

For each arm, by its name: `<arm>_position` (T, 3) [m] and `<arm>_quaternion` (T, 4; w, x, y, z) in the
operator's frame, `<arm>_clutch` (T,) bool, `<arm>_grip` (T,) from 0 (open) to 1, and, where tracking can be
lost, `<arm>_tracked` (T,) bool.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.files.arrays import read_arrays
from lerobot_vtrefine.teleoperators.hand_motion import HandSample

SHAPES = {"position": (3,), "quaternion": (4,), "clutch": (), "grip": ()}
NEVER = np.full((3, 3), np.nan)


class RecordedControllers:
    """Plays the file once per episode; after its end the controllers are not seen any more.

    Raises:
        ValueError: the file cannot be read, or lacks an array.
    """

    def __init__(self, path: Path, arms: list[str]) -> None:
        self._arrays, self._arms = read_arrays(path, "biuf"), arms
        lengths = set()
        for arm in arms:
            for name, shape in SHAPES.items():
                values = self._arrays.get(f"{arm}_{name}")
                if values is None or values.shape[1:] != shape:
                    raise ValueError(f"{path} needs {arm}_{name} of shape (T, {', '.join(map(str, shape))})")
                lengths.add(len(values))
        if len(lengths) != 1:
            raise ValueError(f"{path}: the arrays differ in length: {sorted(lengths)}")
        self._length = lengths.pop()
        self._next = 0

    def connect(self) -> None:
        """Begin."""
        self._next = 0

    def restart(self, grips: Mapping[str, float]) -> None:
        """Begin again; the recording says how far hands are closed."""
        self._next = 0

    def read(self) -> dict[str, HandSample]:
        """The next samples."""
        index, self._next = self._next, self._next + 1
        if index >= self._length:
            return {}
        return {arm: self._sample(arm, index) for arm in self._arms if self._tracked(arm, index)}

    def disconnect(self) -> None:
        """Nothing to close."""

    def _tracked(self, arm: str, index: int) -> bool:
        tracked = self._arrays.get(f"{arm}_tracked")
        return tracked is None or bool(tracked[index])

    def _sample(self, arm: str, index: int) -> HandSample:
        of = {name: self._arrays[f"{arm}_{name}"][index] for name in SHAPES}
        quaternion = np.asarray(of["quaternion"], float)
        is_turn = np.isfinite(quaternion).all() and np.linalg.norm(quaternion) > 0
        rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix() if is_turn else NEVER
        return HandSample(np.asarray(of["position"], float), rotation, bool(of["clutch"]), float(of["grip"]))
