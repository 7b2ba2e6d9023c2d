"""The feature table: one raw frame through dataset and environment gives the same tensors."""

import ast
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from aloha_columns import BASELINE_KEYS, RAW_KEYS, TACTILE_KEYS
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.utils.constants import OBS_ENV_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_vtrefine.datasets import features as table
from lerobot_vtrefine.datasets.features import (
    ACTION_KEY,
    AGE_KEY,
    DEPTH_KEY,
    NOISE_LEVEL_KEY,
    STATE_KEY,
    dataset_features,
    env_key_map,
    env_observation_shapes,
    raw_to_env_observation,
    raw_to_frame,
)
from lerobot_vtrefine.embodiments import ALOHA, KINOVA, Embodiment
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.decisions import _tensor, policy_columns
from lerobot_vtrefine.sim.config import RandomizationConfig

MakeRaw = Callable[[np.random.Generator, float], dict[str, Any]]


def test_dataset_and_environment_hand_over_the_same_values(tiny_dataset: Path, make_raw: MakeRaw) -> None:
    item = LeRobotDataset("local/tiny", root=tiny_dataset)[0]
    raw = make_raw(np.random.default_rng(0), 3.0)  # what the fixture wrote first
    batch = preprocess_observation(
        raw_to_env_observation({key: value[None] for key, value in raw.items()}, ALOHA)
    )
    assert set(batch) == {STATE_KEY, *RAW_KEYS}
    for key, value in batch.items():
        stored = item[key].float().reshape(value.shape)
        assert torch.equal(stored, value), key
    assert item[DEPTH_KEY].shape == (1, 24, 32)
    for keys, source in ((TACTILE_KEYS, "tactile"), (BASELINE_KEYS, "tactile_baseline")):
        for pad, key in enumerate(keys):
            assert item[key].tolist() == raw[source][pad].tolist(), key


def test_dataset_keeps_units_and_array_shapes(tiny_dataset: Path) -> None:
    features = LeRobotDataset("local/tiny", root=tiny_dataset).meta.features
    assert features[TACTILE_KEYS[0]]["info"] == {"array_shape": [12, 32], "unit": "adc_counts"}
    assert features[DEPTH_KEY]["info"]["depth_unit"] == "mm"


@pytest.mark.parametrize("body", [ALOHA, KINOVA], ids=lambda body: body.name)
def test_state_and_action_name_the_bodys_joints_as_lerobots_robots_do(body: Embodiment) -> None:
    """Otherwise LeRobot refuses to merge simulated with recorded data."""
    features = dataset_features(24, 32, body)
    for key in (STATE_KEY, ACTION_KEY):
        assert features[key]["names"] == [f"{joint}.pos" for joint in body.joint_names]
        assert features[key]["shape"] == (body.num_joints,)


def test_environment_spaces_match_the_observation(make_raw: MakeRaw) -> None:
    observation = raw_to_env_observation(make_raw(np.random.default_rng(0), 3.0), ALOHA)
    shapes = env_observation_shapes(24, 32, ALOHA)
    assert set(shapes) == set(observation)
    for key, (shape, highest) in shapes.items():
        assert observation[key].shape == shape
        assert observation[key].dtype == np.float32
        assert (highest == 255.0) == key.startswith(("tactile.", "tactile_baseline."))
    assert set(env_key_map(ALOHA)) == {*shapes, "action"}


def test_limits_are_one_more_column_that_lerobot_knows(make_raw: MakeRaw) -> None:
    """They stand beside the joints, in LeRobot's own column for it, and nothing else changes.

    There are two: a column of one reaches policies without its dimension.
    """
    raw = make_raw(np.random.default_rng(0), 3.0)
    told = {**raw, "limits": np.array([4.5, 0.25], np.float32)}
    plain, frame = raw_to_frame(raw, ALOHA), raw_to_frame(told, ALOHA)
    assert frame.pop(OBS_ENV_STATE).tolist() == [4.5, 0.25]
    assert plain.keys() == frame.keys()
    features = dataset_features(24, 32, ALOHA, limited=True)
    assert dataset_to_policy_features(features)[OBS_ENV_STATE] == PolicyFeature(FeatureType.ENV, (2,))
    assert {key for key in features if key != OBS_ENV_STATE} == set(dataset_features(24, 32, ALOHA))
    observation = raw_to_env_observation({key: value[None] for key, value in told.items()}, ALOHA)
    batch = preprocess_observation(dict(observation))
    assert batch[OBS_ENV_STATE].tolist() == [[4.5, 0.25]]
    window = {key: _tensor(value[None, None]) for key, value in told.items()}
    assert torch.equal(policy_columns(window, ALOHA)[OBS_ENV_STATE][0], batch[OBS_ENV_STATE])
    shapes = env_observation_shapes(24, 32, ALOHA, limited=True)
    assert shapes.keys() == observation.keys()
    assert env_key_map(ALOHA, limited=True)["environment_state"] == OBS_ENV_STATE
    config = VtRefineEnvConfig(randomization=RandomizationConfig(contact_force_n=(2.0, 8.0)))
    assert env_to_policy_features(config)[OBS_ENV_STATE] == PolicyFeature(FeatureType.ENV, (2,))
    assert OBS_ENV_STATE not in env_to_policy_features(VtRefineEnvConfig())


def test_hardware_needs_no_noise_level_and_simulation_no_age(make_raw: MakeRaw) -> None:
    raw = make_raw(np.random.default_rng(0), 3.0)
    assert raw_to_frame(raw, ALOHA)[AGE_KEY].tolist() == [0.0] * 4
    raw["tactile_age"] = np.array([0.1, 0.2, 0.3, 0.4])
    del raw["noise_level"]
    assert raw_to_frame(raw, ALOHA)[NOISE_LEVEL_KEY].tolist() == [0.0]
    assert raw_to_frame(raw, ALOHA)[AGE_KEY].tolist() == raw["tactile_age"].astype(np.float32).tolist()


def test_columns_are_spelt_in_one_module_only() -> None:
    """Other modules import the names; what docstrings and messages say is no column."""
    package = Path(table.__file__).parents[1]
    built = "surface|visuo_tactile|tactile_grids"
    kinds = rf"(state|environment_state|{built}|tactile_age|(tactile|tactile_baseline|camera|images)\.\S*)"
    column = re.compile(rf"observation\.{kinds}|(tactile|tactile_baseline|camera|images)\.|tactile_age")
    spelt = {
        f"{path.relative_to(package)}: {node.value}"
        for path in sorted(package.rglob("*.py"))
        if path != Path(table.__file__)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and column.fullmatch(node.value)
    }
    assert spelt == set()


def test_what_is_missing_is_named(make_raw: MakeRaw) -> None:
    raw = make_raw(np.random.default_rng(0), 3.0)
    del raw["tactile"]
    with pytest.raises(ValueError, match="lacks tactile"):
        raw_to_frame(raw, ALOHA)
    with pytest.raises(ValueError, match="camera size"):
        dataset_features(0, 32, ALOHA)
