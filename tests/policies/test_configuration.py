"""Presets, explicit saving, wrong values, and the shipped configuration files."""

from pathlib import Path
from typing import Any

import draccus
import pytest
from aloha_columns import TACTILE_KEYS
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_vtrefine.datasets.features import DEPTH_KEY, RGB_KEY, STATE_KEY, dataset_features
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.observation import VisuoTactileConfig
from lerobot_vtrefine.policies.vt_dp3 import VtDp3Config

CONFIGS = sorted((Path(__file__).parents[2] / "configs" / "policy").glob("vt_dp3*.yaml"))
OTHERS = sorted(set(CONFIGS[0].parent.glob("*.yaml")) - set(CONFIGS))


def test_paper_preset_is_the_papers_network() -> None:
    config = VtDp3Config(device="cpu")
    assert config.point_dims == (64, 128, 256, 512)
    assert config.down_dims == (512, 1024, 2048)
    assert (config.horizon, config.n_obs_steps, config.n_action_steps) == (16, 2, 8)
    assert (config.num_train_timesteps, config.kernel_size) == (100, 5)
    assert config.observation.pool_rows == config.observation.pool_cols == 1


def test_preset_fills_only_what_was_not_set() -> None:
    view = VisuoTactileConfig(num_visual_points=99)
    config = VtDp3Config(device="cpu", preset="small", optimizer_lr=5e-4, observation=view)
    assert config.optimizer_lr == 5e-4
    assert config.observation.num_visual_points == 99
    assert config.observation.pool_cols == 4
    assert config.denoiser == "mlp"


def test_saved_configuration_is_explicit_and_survives(tmp_path: Path) -> None:
    config = VtDp3Config(device="cpu", preset="small", down_dims=(64, 64), modalities="visual")
    config.save_pretrained(tmp_path)
    loaded = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--preset=paper"])
    assert isinstance(loaded, VtDp3Config)
    assert loaded.preset == "paper"
    loaded.preset = "small"  # nothing else may have changed: every value was saved
    assert loaded == config


def test_chunks_start_at_the_current_observation() -> None:
    config = VtDp3Config(device="cpu", preset="small")
    assert config.observation_delta_indices == [-1, 0]
    assert config.action_delta_indices == list(range(16))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"preset": "huge"}, "choose from paper, small"),
        ({"modalities": "sound"}, "choose from visuo_tactile, visual, tactile"),
        ({"denoiser": "rnn"}, "choose from unet, mlp"),
        ({"horizon": 15}, "divisible by 4"),
        ({"n_action_steps": 17}, "within 1..16"),
        ({"preset": "small", "down_dims": (64, 32)}, "one repeated width"),
        ({"sampler": "euler"}, "choose from"),
        ({"ft_denoising_steps": 11}, "within 0..10"),
        ({"ft_noise_correlation": 1.0}, r"ft_noise_correlation must lie in \[0, 1\), got 1.0"),
    ],
)
def test_wrong_values_name_the_choices(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ParsingError, match=message):
        VtDp3Config(device="cpu", **values)


def policy_features(*without: str) -> dict[str, PolicyFeature]:
    """The dataset's input features, less some."""
    return {
        key: PolicyFeature(FeatureType.STATE, tuple(feature["shape"]))
        for key, feature in dataset_features(24, 32, ALOHA).items()
        if key.startswith("observation") and key not in without
    }


def test_data_without_the_needed_columns_is_refused_in_one_line() -> None:
    action = {"action": PolicyFeature(FeatureType.ACTION, (16,))}
    config = VtDp3Config(device="cpu", input_features=policy_features(), output_features=action)
    config.validate_features()
    config.input_features = policy_features(*TACTILE_KEYS)
    with pytest.raises(ValueError, match="and 1 more; record with") as error:
        config.validate_features()
    assert "\n" not in str(error.value)
    config.input_features = policy_features(DEPTH_KEY)  # of a robot that has pads, and no depth camera
    with pytest.raises(ValueError, match=r"camera named front .*policy.modalities=tactile needs none"):
        config.validate_features()
    config.modalities = "tactile"
    config.validate_features()
    config.input_features, config.modalities = policy_features(*TACTILE_KEYS), "visual"
    config.validate_features()
    config.input_features = {STATE_KEY: policy_features()[STATE_KEY]}
    with pytest.raises(ValueError, match=DEPTH_KEY):
        config.validate_features()
    config.input_features, config.output_features = policy_features(), {}
    with pytest.raises(ValueError, match="vector feature 'action'"):
        config.validate_features()


@pytest.mark.parametrize(
    ("key", "values", "told", "suits"),
    [
        (TACTILE_KEYS[2], 96, r"96 values a frame, and .*=aloha has 384 \(a pad's taxels\)", "visual"),
        ("observation.tactile_baseline.left_arm_left_finger", 1, "1 values a frame", "visual"),
        (STATE_KEY, 14, r"14 values a frame, and .*=aloha has 16 \(its joints\)", "pads"),
    ],
)
def test_another_robots_pads_or_joints_are_refused_in_one_line(
    key: str, values: int, told: str, suits: str
) -> None:
    changed = policy_features() | {key: PolicyFeature(FeatureType.STATE, (values,))}
    action = {"action": PolicyFeature(FeatureType.ACTION, (16,))}
    config = VtDp3Config(device="cpu", input_features=changed, output_features=action)
    with pytest.raises(ValueError, match=rf"the data's {key} holds {told}") as error:
        config.validate_features()
    assert "\n" not in str(error.value)
    setattr(config, "fusion" if suits == "pads" else "modalities", suits)
    config.validate_features()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_shipped_files_parse(path: Path) -> None:
    config = draccus.parse(TrainPipelineConfig, path, args=["--dataset.repo_id=local/tiny"])
    assert isinstance(config.policy, VtDp3Config)
    assert config.policy.preset == ("paper" if path.stem in ("vt_dp3_paper", "vt_dp3_visual") else "small")
    assert config.policy.fusion == ("pads" if path.stem == "vt_dp3_pads" else "cloud")
    assert config.policy.modalities == ("visual" if "visual" in path.stem else "visuo_tactile")


@pytest.mark.slow  # seconds for the import alone
@pytest.mark.parametrize("path", OTHERS, ids=lambda path: path.stem)
def test_lerobots_policies_get_what_a_colour_recording_of_aloha_has(path: Path) -> None:
    import lerobot.policies  # noqa: F401 (registers them)

    config = draccus.parse(TrainPipelineConfig, path, args=["--dataset.repo_id=local/tiny"])
    assert config.policy is not None
    assert config.policy.type == path.stem.removesuffix("_rgb")
    recorded = dataset_to_policy_features(
        dataset_features(60, 80, ALOHA, colour=VtRefineEnvConfig().rgb_size)
    )
    assert config.policy.input_features == {key: recorded[key] for key in (STATE_KEY, RGB_KEY)}


def test_there_are_shipped_files() -> None:
    assert [path.stem for path in CONFIGS] == ["vt_dp3_pads", "vt_dp3_paper", "vt_dp3_small", "vt_dp3_visual"]
    assert [path.stem for path in OTHERS] == ["act_rgb", "diffusion_rgb", "smolvla_rgb"]
