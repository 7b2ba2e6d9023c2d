"""One raw frame gives one cloud: dataset item, environment observation and robot frame."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from aloha_columns import RAW_KEYS
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch.utils.data import DataLoader, default_collate

from lerobot_vtrefine.datasets.features import (
    ACTION_KEY,
    CAMERA_POSE_KEY,
    CLOUD_KEY,
    DEPTH_KEY,
    GRIDS_KEY,
    INTRINSICS_KEY,
    NOISE_LEVEL_KEY,
    STATE_KEY,
    baseline_keys,
    raw_to_env_observation,
    raw_to_frame,
    tactile_keys,
)
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.lerobot_compat import fast_reader
from lerobot_vtrefine.observation import build_visuo_tactile, num_points
from lerobot_vtrefine.observation.grids import pad_grids
from lerobot_vtrefine.policies.vt_dp3 import VtDp3Config, make_vt_dp3_pre_post_processors
from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import MIN_RANGE, check_stats, widen_narrow_ranges

MakeRaw = Callable[[np.random.Generator, float], dict[str, Any]]
WINDOWS = {key: [-0.1, 0.0] for key in (*RAW_KEYS, STATE_KEY)} | {"action": [i / 10 for i in range(16)]}


def make_config(dataset: LeRobotDataset, **values: Any) -> VtDp3Config:
    """A configuration with the dataset's features, as LeRobot's factory sets them."""
    features = dataset_to_policy_features(dataset.meta.features)
    outputs = {ACTION_KEY: features.pop(ACTION_KEY)}
    return VtDp3Config(
        device="cpu", preset="small", input_features=features, output_features=outputs, **values
    )


@pytest.fixture
def dataset(tiny_dataset: Path) -> LeRobotDataset:
    """The tiny dataset with the policy's windows."""
    return LeRobotDataset("local/tiny", root=tiny_dataset, delta_timestamps=WINDOWS)


@pytest.mark.parametrize("fusion", ["cloud", "pads"])
def test_batches_read_at_once_become_what_items_become(tiny_dataset: Path, fusion: str) -> None:
    fast_reader.install()
    dataset = LeRobotDataset("local/tiny", root=tiny_dataset, delta_timestamps=WINDOWS)
    preprocess, _ = make_vt_dp3_pre_post_processors(make_config(dataset, fusion=fusion), dataset.meta.stats)
    indices = [7, 0, 12]
    (at_once,) = DataLoader(dataset, batch_sampler=[indices])
    assert at_once[RAW_KEYS[0]].dtype == torch.uint8
    batches = []
    for frames in (default_collate([dataset[index] for index in indices]), at_once):
        torch.manual_seed(5)
        batches.append(preprocess(frames))
    assert set(batches[0]) == set(batches[1])
    for key, value in batches[0].items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, batches[1][key]), key


@pytest.mark.parametrize("noise_level", [0.0, 3.0])
def test_same_frame_same_cloud_everywhere(
    tmp_path: Path, write_dataset: Callable[..., None], make_raw: MakeRaw, noise_level: float
) -> None:
    write_dataset(tmp_path / "one", episodes=1, frames=2, seed=3, noise_level=noise_level)
    stored = LeRobotDataset("local/tiny", root=tmp_path / "one")
    preprocess, _ = make_vt_dp3_pre_post_processors(make_config(stored), stored.meta.stats)
    raw = make_raw(np.random.default_rng(3), noise_level)
    item = {key: value for key, value in stored[0].items() if key.startswith("observation")}
    environment = preprocess_observation(raw_to_env_observation({k: v[None] for k, v in raw.items()}, ALOHA))
    robot = prepare_observation_for_inference(raw_to_frame(raw, ALOHA), torch.device("cpu"))
    clouds, states = [], []
    for frame in (default_collate([item]), item, environment, robot):
        torch.manual_seed(11)
        batch = preprocess(dict(frame))
        assert not set(batch) & set(RAW_KEYS)
        clouds.append(batch[CLOUD_KEY])
        states.append(batch[STATE_KEY])
    for cloud, state in zip(clouds, states, strict=True):
        assert cloud.shape == (1, num_points(make_config(stored).observation), 5)
        assert torch.equal(cloud, clouds[0])
        assert torch.equal(state, states[0])
    torch.manual_seed(12)
    again = preprocess(dict(environment))[CLOUD_KEY]
    assert torch.equal(again, clouds[0]) is (noise_level == 0.0)


def test_cloud_and_images_are_built_of_the_raw_frame_and_only_state_is_normalised(
    dataset: LeRobotDataset,
) -> None:
    """Against the functions that build them: joint positions must still be in rad and m there."""
    preprocess, _ = make_vt_dp3_pre_post_processors(
        config := make_config(dataset, fusion="pads"), dataset.meta.stats
    )
    batch = default_collate([dataset[4]])
    del batch[NOISE_LEVEL_KEY]
    tactile, baseline = (
        torch.stack([batch[key] for key in keys(ALOHA)], dim=-2) for keys in (tactile_keys, baseline_keys)
    )
    camera = [batch[key] for key in (DEPTH_KEY, INTRINSICS_KEY, CAMERA_POSE_KEY)]
    got = preprocess(dict(batch))
    cfg, state = config.observation, batch[STATE_KEY]
    assert torch.equal(got[CLOUD_KEY], build_visuo_tactile(state, None, None, *camera, cfg))
    assert torch.equal(got[GRIDS_KEY], pad_grids(tactile, baseline, (12, 32), cfg))

    whole, _ = make_vt_dp3_pre_post_processors(config := make_config(dataset), dataset.meta.stats)
    got = whole(dict(batch))
    cloud = build_visuo_tactile(state, tactile, baseline, *camera, config.observation)
    assert torch.equal(got[CLOUD_KEY], cloud)
    low, high = (torch.as_tensor(dataset.meta.stats[STATE_KEY][name]) for name in ("min", "max"))
    assert torch.allclose(got[STATE_KEY], (2 * (state - low) / (high - low) - 1).float(), atol=1e-5)


def test_training_batches_keep_masks_and_windows(dataset: LeRobotDataset) -> None:
    preprocess, _ = make_vt_dp3_pre_post_processors(make_config(dataset), dataset.meta.stats)
    batch = preprocess(default_collate([dataset[0], dataset[5], dataset[11]]))
    assert batch[CLOUD_KEY].shape == (3, 2, 448, 5)
    assert batch[STATE_KEY].shape == (3, 2, 16)
    assert batch[ACTION_KEY].shape == (3, 16, 16)
    assert batch["action_is_pad"].dtype == torch.bool
    assert batch["action_is_pad"].sum(dim=1).tolist() == [4, 9, 15]
    assert batch[f"{DEPTH_KEY}_is_pad"].tolist() == [[True, False], [False, False], [False, False]]
    for key in (STATE_KEY, ACTION_KEY):
        assert batch[key].min() >= -1 - 1e-5
        assert batch[key].max() <= 1 + 1e-5


def test_actions_come_back_as_joint_targets(dataset: LeRobotDataset) -> None:
    preprocess, postprocess = make_vt_dp3_pre_post_processors(make_config(dataset), dataset.meta.stats)
    item = dataset[2]
    normalised = preprocess(default_collate([item]))[ACTION_KEY]
    assert torch.allclose(postprocess(normalised[:, 0]), item[ACTION_KEY][:1], atol=1e-5)


def test_saved_pipeline_builds_the_same_batch(tmp_path: Path, dataset: LeRobotDataset) -> None:
    config = make_config(dataset, modalities="visual")
    for pipeline in make_vt_dp3_pre_post_processors(config, dataset.meta.stats):
        pipeline.save_pretrained(tmp_path)
    loaded, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    fresh, _ = make_vt_dp3_pre_post_processors(config, dataset.meta.stats)
    batch = default_collate([dataset[4]])
    torch.manual_seed(0)
    expected = fresh(dict(batch))
    torch.manual_seed(0)
    got = loaded(dict(batch))
    for key in (CLOUD_KEY, STATE_KEY, ACTION_KEY):
        assert torch.equal(expected[key], got[key])
    assert got[CLOUD_KEY].shape[-2] == config.observation.num_visual_points


def test_joints_that_never_moved_stay_harmless() -> None:
    stats = {
        STATE_KEY: {"min": np.array([0.5, -1.0, 0.1]), "max": np.array([0.5, 1.0, 0.1 + 1e-6])},
        ACTION_KEY: {"min": np.array([0.0]), "max": np.array([0.0])},
    }
    widen_narrow_ranges(stats)
    spread = stats[STATE_KEY]["max"] - stats[STATE_KEY]["min"]
    assert spread.tolist() == pytest.approx([MIN_RANGE, 2.0, MIN_RANGE])
    assert stats[ACTION_KEY]["max"].tolist() == pytest.approx([MIN_RANGE / 2])
    once = {key: {name: value.copy() for name, value in entry.items()} for key, entry in stats.items()}
    widen_narrow_ranges(stats)
    for key, entry in once.items():
        for name, value in entry.items():
            assert stats[key][name].tolist() == pytest.approx(value.tolist())


def test_statistics_are_needed_of_what_is_normalised_and_of_nothing_else(dataset: LeRobotDataset) -> None:
    config, root = make_config(dataset), dataset.root
    check_stats(config, {key: dataset.meta.stats[key] for key in (STATE_KEY, ACTION_KEY)}, root)
    with pytest.raises(ValueError, match=rf"stats\.json has no statistics of {STATE_KEY}, by which"):
        check_stats(config, None, root)
    modes = config.normalization_mapping | {"STATE": NormalizationMode.IDENTITY}
    config = make_config(dataset, normalization_mapping=modes)
    check_stats(config, {ACTION_KEY: dataset.meta.stats[ACTION_KEY]}, root)


def test_missing_columns_and_missing_noise_level(dataset: LeRobotDataset) -> None:
    config = make_config(dataset)
    preprocess, _ = make_vt_dp3_pre_post_processors(config, dataset.meta.stats)
    batch = default_collate([dataset[4]])
    del batch[NOISE_LEVEL_KEY]
    first, second = preprocess(dict(batch))[CLOUD_KEY], preprocess(dict(batch))[CLOUD_KEY]
    assert torch.equal(first, second)
    del batch[DEPTH_KEY]
    with pytest.raises(ValueError, match=f"lacks '{DEPTH_KEY}'"):
        preprocess(dict(batch))


def test_policy_type_is_found_by_its_name() -> None:
    assert PreTrainedConfig.get_choice_class("vt_dp3") is VtDp3Config
