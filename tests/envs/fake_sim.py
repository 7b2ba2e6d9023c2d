"""A stand-in for the simulation: joints go where they are told, success comes after a seed-dependent time."""

from dataclasses import dataclass

import numpy as np
import torch

from lerobot_vtrefine.embodiments import ALOHA

HEIGHT, WIDTH = 6, 8


@dataclass
class FakeResult:
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    success: np.ndarray


class FakeSim:
    """As ``InsertionSim``; even seeds succeed after ``3 + seed % 5`` steps, odd ones never."""

    noise_level = 3.0
    embodiment = ALOHA
    privileged_names = ("time", "seed")

    def __init__(self, num_envs: int, episode_steps: int = 10) -> None:
        self.num_envs = num_envs
        self.episode_steps = episode_steps
        self.seeds = np.zeros(num_envs, np.int64)
        self.time = np.zeros(num_envs, np.int64)
        self.joints = np.zeros((num_envs, 16), np.float32)
        self.stepped: list[np.ndarray] = []
        self.observed: list[np.ndarray] = []
        self.camera_intrinsics = np.array([10.0, 10.0, WIDTH / 2, HEIGHT / 2])
        self.camera_pose = np.tile([0.0, 0, 1, 0, 1, 0, 0], (num_envs, 1))

    def reset(self, ids: np.ndarray, seeds: np.ndarray) -> None:
        self.seeds[ids], self.time[ids] = seeds, 0
        self.joints[ids] = np.asarray(seeds)[:, None] * 0.01

    def step(
        self, action: np.ndarray, ids: np.ndarray | None = None, images: np.ndarray | None = None
    ) -> FakeResult:
        ids = np.arange(self.num_envs) if ids is None else ids
        self.stepped.append(np.array(ids))
        self.time[ids] += 1
        self.joints[ids] = action
        success = (self.seeds[ids] % 2 == 0) & (self.time[ids] >= 3 + self.seeds[ids] % 5)
        truncated = (self.time[ids] >= self.episode_steps) & ~success
        return FakeResult(success.astype(float), success, truncated, success)

    def observe(self, ids: np.ndarray) -> dict[str, np.ndarray]:
        self.observed.append(np.array(ids))
        stamp = (self.time[ids] + 1).astype(np.uint8)
        return {
            "state": self.joints[ids].copy(),
            "tactile": np.broadcast_to(stamp[:, None, None], (len(ids), 4, 384)).copy(),
            "tactile_baseline": np.zeros((len(ids), 4, 384), np.uint8),
            "depth_mm": np.full((len(ids), HEIGHT, WIDTH), 700, np.uint16) + stamp[:, None, None],
        }

    def observe_tensors(self, ids: np.ndarray) -> dict[str, torch.Tensor]:
        frames = self.observe(ids)
        return {key: torch.from_numpy(value) for key, value in frames.items() if key != "depth_mm"} | {
            "depth_mm": torch.from_numpy(frames["depth_mm"].astype(np.int16))
        }

    def joint_state(self, ids: np.ndarray) -> np.ndarray:
        return self.joints[ids].copy()

    def privileged(self, ids: np.ndarray) -> np.ndarray:
        return np.stack([self.time[ids], self.seeds[ids]], 1).astype(np.float32)

    def metrics(self, ids: np.ndarray) -> dict[str, np.ndarray]:
        success = self.seeds[ids] % 2 == 0
        return {
            "success": success,
            "failure": np.zeros(len(ids), np.int64),
            "in_hand_shift_m": np.full(len(ids), 1e-3),
            "time_to_success_s": np.where(success, self.time[ids] * 0.1, np.nan),
        }
