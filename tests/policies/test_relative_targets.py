"""Targets relative to the measured joints."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from torch import Tensor

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY, dataset_features
from lerobot_vtrefine.policies.vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.policies.vt_dp3.relative_targets import (
    MIN_OFFSET_RANGE,
    RelativeTargets,
    dataset_offsets,
    offset_ranges,
)

JOINTS, HORIZON = 3, 4
STATS = {
    "action": {"min": np.array([-1.0, 0.0, 2.0]), "max": np.array([1.0, 0.5, 5.0])},
    "observation.state": {"min": np.array([-2.0, 0.1, 2.0]), "max": np.array([1.0, 0.4, 4.0])},
}


def episodes(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    episode = np.repeat([0, 1, 2], [5, 1, 7])
    return (*(rng.normal(size=(len(episode), JOINTS)).astype(np.float32) for _ in range(2)), episode)


def test_ranges_of_offsets_are_those_of_every_chunk_in_turn() -> None:
    targets, joints, episode = episodes()
    low, high = offset_ranges(targets, joints, episode, HORIZON)
    for step in range(HORIZON):
        offsets = []
        for frame in range(len(episode)):
            later = list(range(frame, min(frame + step + 1, len(episode))))
            same = [k for k in later if episode[k] == episode[frame]]
            offsets.append(targets[same[-1]] - joints[frame])
        assert np.allclose(low[step], np.min(offsets, 0))
        assert np.allclose(high[step], np.max(offsets, 0))


def normalised(values: Tensor, key: str) -> Tensor:
    low, high = (torch.as_tensor(STATS[key][end]) for end in ("min", "max"))
    return (2 * (values - low) / (high - low) - 1).float()


def test_the_latent_is_the_offset_in_its_own_range() -> None:
    low, high = -np.ones((HORIZON, JOINTS), np.float32), np.full((HORIZON, JOINTS), 3.0, np.float32)
    high[0, 0] = low[0, 0]  # a joint that did not move
    ranges = RelativeTargets(HORIZON, JOINTS)
    ranges.set_normaliser(STATS)
    ranges.set_offsets((low, high))
    joints, targets = torch.randn(2, JOINTS), torch.randn(2, HORIZON, JOINTS)
    state, action = normalised(joints, "observation.state"), normalised(targets, "action")
    latent = ranges.to_latent(action, state)
    offsets = targets - joints[:, None]
    assert torch.allclose(latent[:, 1:], ((offsets + 1) / 2 - 1)[:, 1:], atol=1e-5)
    assert torch.allclose(latent[:, 0, 0], (offsets[:, 0, 0] + 1) / (MIN_OFFSET_RANGE / 2), rtol=1e-3)
    assert torch.allclose(ranges.to_targets(latent, state), action, atol=1e-5)
    assert torch.allclose(ranges.to_targets(latent[:, :2], state), action[:, :2], atol=1e-5)


def write_dataset(root: Path) -> None:
    targets, joints, episode = episodes()
    (root / "data" / "chunk-000").mkdir(parents=True)
    for number, rows in enumerate((slice(0, 6), slice(6, None))):
        columns = {
            "action": list(targets[rows]),
            "observation.state": list(joints[rows]),
            "episode_index": episode[rows],
        }
        pq.write_table(pa.table(columns), root / "data" / "chunk-000" / f"file-{number:03d}.parquet")


def test_a_dataset_on_disk_is_read_over_all_its_files(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    found, expected = dataset_offsets(tmp_path, HORIZON), offset_ranges(*episodes(), HORIZON)
    assert np.array_equal(found, expected)
    with pytest.raises(ValueError, match="holds no frames"):
        dataset_offsets(tmp_path / "elsewhere", HORIZON)


def make_policy(root: Path | None, **values: Any) -> VtDp3Policy:
    """A tiny policy without senses but joints, from a dataset on disk."""
    torch.manual_seed(0)
    features = {
        key: PolicyFeature(FeatureType.STATE, tuple(feature["shape"]))
        for key, feature in dataset_features(24, 32).items()
        if key.startswith("observation")
    }
    features[STATE_KEY] = PolicyFeature(FeatureType.STATE, (JOINTS,))
    config = VtDp3Config(
        device="cpu",
        preset="small",
        modalities="tactile",
        point_dims=(8, 16),
        down_dims=(32, 32),
        horizon=HORIZON,
        n_action_steps=2,
        relative_actions=True,
        input_features=features,
        output_features={ACTION_KEY: PolicyFeature(FeatureType.ACTION, (values.pop("targets", JOINTS),))},
        **values,
    )
    stats = {key: {end: value.copy() for end, value in ends.items()} for key, ends in STATS.items()}
    return VtDp3Policy(config, stats, root and SimpleNamespace(root=root)).eval()


def make_batch(policy: VtDp3Policy, size: int = 5) -> dict[str, Tensor]:
    state = torch.rand(size, 2, JOINTS) * 2 - 1
    return {key: torch.rand(size, 2, 20, 5) for key in policy.model.encoder.keys} | {STATE_KEY: state}


def test_the_same_chunk_denoised_elsewhere_moves_with_the_joints(tmp_path: Path) -> None:
    """The network is told nothing here, so that a chunk's only tie to the joints is its offset."""
    write_dataset(tmp_path)
    policy = make_policy(tmp_path)
    policy.model.encoder.forward = lambda batch: torch.zeros(5, policy.model.encoder.cond_dim)  # ty: ignore
    batch, noise = make_batch(policy), torch.randn(1, HORIZON, JOINTS).repeat(5, 1, 1)
    chunks = policy.sample_actions(batch, noise)
    assert policy.targets is not None
    half = (torch.as_tensor(STATS["action"]["max"]) - torch.as_tensor(STATS["action"]["min"])) / 2
    joint_half = torch.as_tensor(STATS["observation.state"]["max"] - STATS["observation.state"]["min"]) / 2
    apart = (chunks - chunks[:1]) * half
    expected = ((batch[STATE_KEY] - batch[STATE_KEY][:1])[:, -1] * joint_half)[:, None]
    assert torch.allclose(apart, expected.expand_as(apart), atol=1e-4)


def test_loss_is_that_of_the_offsets(tmp_path: Path) -> None:
    """Targets that are their own offsets' middle have a clean latent of zero: only noise is left to guess."""
    write_dataset(tmp_path)
    policy = make_policy(tmp_path, noise_draws=1)
    assert policy.targets is not None
    batch = make_batch(policy)
    zero = torch.zeros(5, HORIZON, JOINTS)
    batch[ACTION_KEY] = policy.targets.to_targets(zero, batch[STATE_KEY][:, -1])
    seen = []
    policy.online.denoiser.forward = lambda x, t, cond: seen.append((x, t)) or torch.zeros_like(x)  # ty: ignore
    policy.train()
    loss, _ = policy(batch)
    (noisy, t), process = seen[0], policy.process
    again = process.add_noise(zero, torch.ones_like(zero), t)  # the noise's share at each row's step
    noise = noisy / again
    assert torch.allclose(loss, noise.square().mean(), rtol=1e-3)


def test_a_checkpoint_keeps_the_ranges_and_follows_new_statistics(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data_set")
    policy = make_policy(tmp_path / "data_set")
    policy.save_pretrained(tmp_path / "saved")
    loaded = VtDp3Policy.from_pretrained(tmp_path / "saved")
    assert policy.targets is not None
    assert loaded.targets is not None
    for key, value in policy.targets.state_dict().items():
        assert torch.equal(value, loaded.targets.state_dict()[key]), key
    stats = {key: {"min": ends["min"] - 1, "max": ends["max"] + 1} for key, ends in STATS.items()}
    moved = VtDp3Policy.from_pretrained(
        tmp_path / "saved", dataset_stats=stats, dataset_meta=SimpleNamespace(root=tmp_path / "data_set")
    )
    assert moved.targets is not None
    assert torch.equal(moved.targets.offset, policy.targets.offset)
    assert torch.allclose(moved.targets.action[0], torch.as_tensor(STATS["action"]["min"] - 1).float())


def test_what_cannot_be_relative_is_refused() -> None:
    with pytest.raises(ValueError, match="has 3 joints and 2 targets"):
        make_policy(None, targets=2)
    with pytest.raises(ParsingError, match="needs MIN_MAX"):
        VtDp3Config(
            device="cpu",
            relative_actions=True,
            normalization_mapping={
                "STATE": NormalizationMode.MEAN_STD,
                "ACTION": NormalizationMode.MIN_MAX,
            },
        )
