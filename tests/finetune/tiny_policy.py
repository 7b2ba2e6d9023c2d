"""A tiny ``vt_dp3`` checkpoint, and environments that speak its preprocessed batches without a simulator."""

from collections.abc import Sequence
from pathlib import Path

import torch
from lerobot.configs import FeatureType, PolicyFeature
from torch import Tensor

from lerobot_vtrefine.datasets.features import ACTION_KEY, CLOUD_KEY, STATE_KEY, dataset_features
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs.decisions import Decision
from lerobot_vtrefine.finetune.protocols import Observation
from lerobot_vtrefine.observation import VisuoTactileConfig, num_points
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import make_vt_dp3_pre_post_processors

POINTS = VisuoTactileConfig(num_visual_points=8, pixel_stride=1, pool_rows=12, pool_cols=32)


def tiny_config() -> VtDp3Config:
    """Seconds on a CPU."""
    config = VtDp3Config(
        preset="small",
        point_dims=(8, 8),
        point_features=8,
        down_dims=(32,),
        time_dim=8,
        horizon=8,
        n_action_steps=4,
        observation=POINTS,
        device="cpu",
    )
    columns = dataset_features(24, 32, ALOHA)
    config.input_features = {
        key: PolicyFeature(FeatureType.STATE, tuple(columns[key]["shape"])) for key in config.required_keys
    }
    config.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (16,))}
    return config


def save_tiny_checkpoint(path: Path, seed: int = 0) -> Path:
    """What behaviour cloning would have left: policy and processors in ``path``."""
    torch.manual_seed(seed)
    config = tiny_config()
    bounds = {"min": -torch.ones(16), "max": torch.ones(16)}
    processors = make_vt_dp3_pre_post_processors(config, {STATE_KEY: bounds, ACTION_KEY: bounds})
    for part in (VtDp3Policy(config), *processors):
        part.save_pretrained(path)
    return path


class ReachEnv:
    """Move joint 0 to a place that the cloud shows; sensor noise comes from the global generator."""

    max_decisions, privileged_dim = 3, 3

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs

    def reset(self, seeds: Sequence[int]) -> tuple[Observation, Tensor]:
        draws = [torch.rand(1, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        self.goal = torch.cat(draws) * 2 - 1
        self.decision = torch.zeros(self.num_envs)
        self.done = torch.zeros(self.num_envs, dtype=torch.bool)
        return self.observe()

    def observe(self) -> tuple[Observation, Tensor]:
        cloud = 0.02 * torch.randn(self.num_envs, 2, num_points(POINTS), 5)
        cloud[..., 0] += 0.1 * self.goal[:, None, None]
        state = torch.zeros(self.num_envs, 2, 16)
        state[..., 1] = self.decision[:, None]
        privileged = torch.stack([self.goal, self.decision, self.done.float()], dim=1)
        return {STATE_KEY: state, CLOUD_KEY: cloud}, privileged

    def step_chunk(self, actions: Tensor) -> Decision:
        error = (actions[:, :, 0].mean(1) - self.goal).abs()
        reached = (error < 0.3) & ~self.done
        self.decision = self.decision + 1
        truncated = (self.decision >= self.max_decisions) & ~reached & ~self.done
        self.done = self.done | reached | truncated
        obs, privileged = self.observe()
        info = {"success": reached, "error": error, "time": torch.where(reached, self.decision, torch.nan)}
        return Decision(obs, privileged, reached.float(), reached, truncated, info)
