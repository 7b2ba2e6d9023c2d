"""Which control steps of an episode have their sensors read."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ReadSchedule:
    """Sensors are read at step 0 and at the last ``window`` steps of every run of ``every`` steps.

    A policy that decides every ``n_action_steps`` steps from ``n_obs_steps`` frames needs
    ``ReadSchedule(n_action_steps, n_obs_steps)``: with (8, 2) the steps 0, 7, 8, 15, 16, ... are read.
    (1, 1), the default, reads every step.
    """

    every: int = 1
    window: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.window <= self.every:
            raise ValueError(
                f"read_window must lie in 1..read_every: got read_window={self.window},"
                f" read_every={self.every}"
            )

    def reads(self, steps: np.ndarray) -> np.ndarray:
        """Whether the frame after ``steps`` (m,) control steps is read -> (m,) bool."""
        phase = np.asarray(steps) % self.every
        return (phase == 0) | (phase > self.every - self.window)
