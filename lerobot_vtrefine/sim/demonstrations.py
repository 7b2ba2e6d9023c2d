"""What makes the scripted expert human-like: errors of its aim, unsteady hands, pauses, its own pace.

A person who teleoperates misjudges where the hole is, and holds to that judgement: the error is constant
over an episode, with slow tremor on top. Nothing here searches; a demonstration that misses fails, and is
not recorded.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TREMOR_HZ = (0.15, 0.6)  # slow wander of a hand, well below the control rate
_TREMOR_WAVES = 4
_HORIZON_STEPS = 1024  # pauses are drawn for this many control steps, then repeat


@dataclass(frozen=True)
class Degradation:
    """Sizes of the expert's errors; all zero is the clean expert.

    Standard deviations are per axis. Raises ValueError for negative values.
    """

    lateral_std_m: float = 0.0
    """Constant error of where the mouth of the socket is believed to be, across its axis."""
    tilt_std_rad: float = 0.0
    """Constant error of the plug's orientation, about each axis."""
    grasp_std_m: float = 0.0
    """Error of where a part is picked, along both axes of the pad; acts with start=table."""
    tremor_std_m: float = 0.0
    """Smooth wander of the hand with the plug, in the socket's plane."""
    pause_probability: float = 0.0
    """Chance per control step that a pause begins."""
    pause_steps: int = 4
    """Length of a pause in control steps."""
    pace_std: float = 0.0
    """Spread of the pace between episodes (of its logarithm)."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(
                    f"degradation.{entry.name} must be a finite number of at least 0, not {value}"
                )
        if self.pause_probability >= 1:
            raise ValueError(f"degradation.pause_probability must be below 1, not {self.pause_probability}")

    @classmethod
    def human_like(cls) -> "Degradation":
        """Return errors that leave demonstrations which succeed often, but not always."""
        return cls(
            lateral_std_m=8e-4,
            tilt_std_rad=math.radians(1.0),
            grasp_std_m=3e-3,
            tremor_std_m=2e-4,
            pause_probability=0.02,
            pace_std=0.15,
        )


class EpisodeErrors:
    """The errors of n environments, each a pure function of its episode's seed."""

    def __init__(self, degradation: Degradation, num_envs: int, control_hz: float) -> None:
        self._degradation = degradation
        self._control_hz = control_hz
        self.lateral_m = np.zeros((num_envs, 2))
        self.tilt_rad = np.zeros((num_envs, 3))
        self.grasp_m = np.zeros((num_envs, 2, 2))  # environment, arm, (along the finger, across it)
        self.pace = np.ones(num_envs)
        self._wave_rad_s = np.zeros((num_envs, 2, _TREMOR_WAVES))
        self._wave_phase = np.zeros((num_envs, 2, _TREMOR_WAVES))
        self._pauses = np.zeros((num_envs, _HORIZON_STEPS), bool)

    def draw(self, ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Draw the errors of environments `ids` (m,) for episodes with `seeds` (m,)."""
        size = self._degradation
        for env, seed in zip(ids, seeds, strict=True):
            rng = np.random.default_rng([int(seed), 0xE4])  # a stream of its own, apart from the reset's
            self.lateral_m[env] = size.lateral_std_m * rng.standard_normal(2)
            self.tilt_rad[env] = size.tilt_std_rad * rng.standard_normal(3)
            self.grasp_m[env] = size.grasp_std_m * rng.standard_normal((2, 2))
            self.pace[env] = math.exp(size.pace_std * rng.standard_normal())
            self._wave_rad_s[env] = 2 * np.pi * rng.uniform(*_TREMOR_HZ, (2, _TREMOR_WAVES))
            self._wave_phase[env] = rng.uniform(0, 2 * np.pi, (2, _TREMOR_WAVES))
            self._pauses[env] = _pauses(rng, size.pause_probability, size.pause_steps)

    def tremor_m(self, ids: NDArray[np.int64], step: NDArray[np.int64]) -> Array:
        """Return the wander (m, 2) [m] at control steps `step` (m,)."""
        time_s = step[:, None, None] / self._control_hz
        waves = np.sin(self._wave_rad_s[ids] * time_s + self._wave_phase[ids])
        return self._degradation.tremor_std_m * math.sqrt(2 / _TREMOR_WAVES) * waves.sum(-1)

    def paused(self, ids: NDArray[np.int64], step: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which of the environments `ids` pause at control steps `step` (m,)."""
        return self._pauses[ids, step % _HORIZON_STEPS]


def _pauses(rng: np.random.Generator, probability: float, length: int) -> NDArray[np.bool_]:
    begins = rng.random(_HORIZON_STEPS) < probability
    paused = np.zeros(_HORIZON_STEPS, bool)
    for start in np.flatnonzero(begins):
        paused[start : start + length] = True
    return paused
