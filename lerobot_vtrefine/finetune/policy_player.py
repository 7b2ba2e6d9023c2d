"""A policy that plays episodes as evaluations during DPPO do: by chunks, with the deployment sampler."""

from pathlib import Path

import numpy as np
import torch

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.finetune.agents import load_policy
from lerobot_vtrefine.finetune.config import PaperDppo
from lerobot_vtrefine.finetune.evaluation import deployed_chunks
from lerobot_vtrefine.finetune.noise import policy_noise
from lerobot_vtrefine.finetune.pipeline import make_practice
from lerobot_vtrefine.finetune.protocols import Observation, execute, select, start


class PolicyPlayer:
    """``envs.grasps.Player`` of a ``vt_dp3`` checkpoint, before or after DPPO, on ``device``.

    Raises: ValueError for a checkpoint of another policy type, FileNotFoundError where there is none.
    """

    def __init__(self, path: Path, config: VtRefineEnvConfig, num_envs: int, device: str) -> None:
        policy = load_policy(path, [f"--device={device}"])
        practice = make_practice(policy, path, config, PaperDppo(num_envs=num_envs))
        self._env, self._agent = practice.env, practice.agent
        self._generator = policy_noise(self._agent.device, 0)
        self._obs: Observation = {}

    @property
    def episodes(self) -> Episodes:
        """The running simulation."""
        return self._env.episodes

    def start(self, seeds: np.ndarray) -> None:
        """Start an episode in every environment (n,); all noise follows from the first seed."""
        torch.manual_seed(int(seeds[0]))
        self._generator = policy_noise(self._agent.device, int(seeds[0]))
        self._obs, _ = start(self._env, seeds.tolist(), self._agent.device)

    @torch.no_grad()
    def move(self) -> None:
        """One chunk of actions."""
        ids = torch.as_tensor(self.episodes.active, device=self._agent.device)
        conditions = self._agent.conditions(select(self._obs, ids))
        chunks = deployed_chunks(self._agent, *conditions, self._generator)
        self._obs = execute(self._env, chunks, ids).obs
