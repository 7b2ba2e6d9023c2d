"""How often the expert succeeds when it acts on estimates in place of the truth: no actions are learnt.

Parts on a table are grasped by the truth, whatever the senses: regressors know where parts lie in the hands,
and where they are before that only roughly (`scale.py`). So the question is what insertion needs.
"""

import numpy as np
import torch
from torch import Tensor

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.information.estimator import Estimator
from lerobot_vtrefine.information.frames import Views, view_columns
from lerobot_vtrefine.information.quantities import Grasps, part_poses
from lerobot_vtrefine.sim.expert import ScriptedExpert

FIRST_SEED = 4_000_000
"""Episodes that no regressor has seen."""


class Believer:
    """Keeps the history of sensor readings and says where the parts seem to be, once they are in the hands.

    One environment's estimates since then are averaged with the weights of an exponential filter: parts move
    little in their hands, and an estimate from one frame trembles.
    """

    SMOOTHING = 0.3

    def __init__(
        self, episodes: Episodes, estimator: Estimator, views: Views, grasps: Grasps, device: torch.device
    ) -> None:
        self._episodes, self._estimator, self._views = episodes, estimator, views
        self._grasps, self._device = grasps, device
        self._window: dict[str, Tensor] = {}
        self._believed = np.zeros((episodes.num_envs, 0))
        self._in_hand = np.zeros(episodes.num_envs, bool)

    def start(self) -> None:
        """Forget everything and read the first frames."""
        frame = self._frame(self._episodes.ids)
        self._window = {
            key: value[:, None].repeat_interleave(self._estimator.history, 1) for key, value in frame.items()
        }
        self._believed = self._estimate(self._episodes.ids)
        self._in_hand = self._episodes.sim.in_hand.copy()

    def look(self, ids: np.ndarray) -> None:
        """Take in the newest frames of environments ``ids`` (m,)."""
        rows = torch.as_tensor(ids, device=self._device)
        for key, value in self._frame(ids).items():
            window = self._window[key]
            window[rows] = torch.cat([window[rows, 1:], value[:, None]], 1)
        weight = np.where(self._in_hand[ids], self.SMOOTHING, 1.0)[:, None]
        self._believed[ids] += weight * (self._estimate(ids) - self._believed[ids])
        self._in_hand[ids] = self._episodes.sim.in_hand[ids]

    def part_poses(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses of plug and socket, each (m, 7): believed ones in the hands, true ones before that."""
        sim = self._episodes.sim
        q = np.asarray(sim.joint_state(ids), float)
        believed = part_poses(sim.scene.embodiment, q, self._believed[ids], self._grasps)
        known = ~self._in_hand[ids, None]
        plug, socket = (
            np.where(known, true, seen) for true, seen in zip(sim.part_poses(ids), believed, strict=True)
        )
        return plug, socket

    def _frame(self, ids: np.ndarray) -> dict[str, Tensor]:
        raw = {key: value[ids] for key, value in self._episodes.raw.items()}
        columns = view_columns(raw, self._episodes.sim.scene.embodiment, self._views, self._device)
        return {key: value.float() for key, value in columns.items()}

    @torch.no_grad()
    def _estimate(self, ids: np.ndarray) -> np.ndarray:
        rows = torch.as_tensor(ids, device=self._device)
        return (
            self._estimator({key: value[rows] for key, value in self._window.items()}).double().cpu().numpy()
        )


def expert_success(
    config: VtRefineEnvConfig,
    num_episodes: int,
    num_envs: int,
    estimator: Estimator | None,
    views: Views,
    grasps: Grasps,
    device: torch.device,
) -> np.ndarray:
    """Success (at least ``num_episodes``,) bool of the clean expert on estimates; None: on the truth."""
    episodes = make_episodes(config, num_envs)
    believer = None if estimator is None else Believer(episodes, estimator, views, grasps, device)
    expert = ScriptedExpert(episodes.sim, part_poses=None if believer is None else believer.part_poses)
    return play(episodes, expert, num_episodes, believer)


def play(
    episodes: Episodes, expert: ScriptedExpert, num_episodes: int, believer: Believer | None = None
) -> np.ndarray:
    """Success (at least ``num_episodes``,) bool of an expert; sensors are read for a believer alone."""
    successes = []
    for first in range(0, num_episodes, episodes.num_envs):
        episodes.reset(episodes.ids, FIRST_SEED + first + episodes.ids)
        if believer is not None:
            believer.start()
        expert.reset(episodes.ids)
        targets = np.zeros((episodes.num_envs, episodes.sim.scene.embodiment.num_joints))
        while len(running := episodes.active):
            targets[running] = expert.act(running)
            episodes.step(targets, reads=believer is not None)
            if believer is not None and len(episodes.active):
                believer.look(episodes.active)
        successes.append(episodes.success.copy())
    return np.concatenate(successes)
