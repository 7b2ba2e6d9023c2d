"""Joint targets out of an action of LeRobot's."""

from collections.abc import Iterable

import numpy as np
from lerobot.lerobot_types import RobotAction


def finite_targets(action: RobotAction, keys: Iterable[str]) -> np.ndarray:
    """(J,) float64 targets in the order of ``keys``. Raises: ValueError where one is not a finite number."""
    targets = {key: float(action[key]) for key in keys}
    if wrong := [key for key, target in targets.items() if not np.isfinite(target)]:
        raise ValueError(f"the action's {', '.join(wrong)} must be finite: nothing was sent to the arms")
    return np.array(list(targets.values()))
