"""How precisely must one know where the plug is? The expert's success against an error of a known size."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.information.closed_loop import play
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.expert import ScriptedExpert

LATERAL, TILT = "lateral", "tilt"
SIZES: dict[str, tuple[float, ...]] = {
    LATERAL: (0.0, 0.0003, 0.0006, 0.001, 0.0015, 0.002, 0.003),
    TILT: tuple(np.radians((1.0, 2.0, 3.0, 4.0, 6.0)).tolist()),
}
"""Standard deviations per axis: of where the hole is believed to be [m], of the plug's orientation [rad]. An
error stays for an episode, as that of a part's place in its hand does.
"""


@dataclass(frozen=True)
class Tolerated:
    """The expert with an error of one size."""

    error: str
    """``LATERAL`` or ``TILT``."""
    size: float
    """As in ``SIZES``."""
    success: tuple[int, int]
    """Of episodes."""


def tolerance(
    config: VtRefineEnvConfig, num_episodes: int, num_envs: int, told: Callable[[int], None] = lambda _: None
) -> list[Tolerated]:
    """Success at every size, on the same episodes (at least ``num_episodes``); without sensors, so quickly.

    The first size of ``LATERAL``, zero, stands for both kinds.
    """
    episodes = make_episodes(config, num_envs)
    found = []
    for error, sizes in SIZES.items():
        for size in sizes:
            known = Degradation(lateral_std_m=size) if error == LATERAL else Degradation(tilt_std_rad=size)
            done = play(episodes, ScriptedExpert(episodes.sim, known), num_episodes)
            found.append(Tolerated(error, size, (int(done.sum()), len(done))))
            told(1)
    return found
