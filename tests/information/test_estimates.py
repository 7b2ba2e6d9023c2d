"""--policy.representation=estimates: the policy is told what the regressor of vtrefine-information tells."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from aloha_columns import BASELINE_KEYS, TACTILE_KEYS
from draccus import ParsingError
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature

from lerobot_vtrefine.datasets.features import ACTION_KEY, GRIDS_KEY, STATE_KEY
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.information.estimator import SENSES, Estimator, views_of
from lerobot_vtrefine.information.frames import Frames, collect_frames
from lerobot_vtrefine.information.study import Effort, save_keeper
from lerobot_vtrefine.policies.vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.estimates import NAMES, Estimates
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy

JOINTS = 16
TOUCH = SENSES["tactile"]


@pytest.fixture(scope="module")
def frames() -> Frames:
    views = views_of([TOUCH], "aloha", "small", "cpu")
    return collect_frames(
        VtRefineEnvConfig(start="grasped", episode_steps=6), 8, 8, views, torch.device("cpu")
    )


def make_estimator(frames: Frames, history: int = 1) -> Estimator:
    """Untrained, which tells wrong numbers, but its own."""
    torch.manual_seed(history)
    estimator = Estimator(TOUCH, frames, "aloha", "small", "cpu", history).eval()
    estimator.state_std.fill_(0.2)  # joints hardly move in so few frames, and roundings would be large
    return estimator


@pytest.fixture
def folder(frames: Frames, tmp_path: Path) -> Path:
    save_keeper(tmp_path, Effort())(TOUCH, make_estimator(frames))
    return tmp_path


def make_policy(folder: Path, stats: dict[str, Any] | None = None, **changes: Any) -> VtDp3Policy:
    settings: dict[str, Any] = {"preset": "small", "device": "cpu", "modalities": "tactile", "fusion": "pads"}
    settings |= {"representation": "estimates", "freeze_encoder": True, "pretrained_encoder": str(folder)}
    config = VtDp3Config(**settings | changes)
    columns = (STATE_KEY, *TACTILE_KEYS, *BASELINE_KEYS)
    config.input_features = {key: PolicyFeature(FeatureType.STATE, (JOINTS,)) for key in columns}
    config.output_features = {ACTION_KEY: PolicyFeature(FeatureType.ACTION, (JOINTS,))}
    return VtDp3Policy(config, dataset_stats=stats).eval()


def stats_of(low: np.ndarray, high: np.ndarray) -> dict[str, Any]:
    return {STATE_KEY: {"min": low, "max": high, "mean": low, "std": high - low}}


def processed(frames: Frames, low: np.ndarray, high: np.ndarray) -> dict[str, torch.Tensor]:
    """The first episodes' windows of two frames, as the policy's processor hands them over."""
    state = frames.columns["state"][:, 2:4]
    lower, upper = torch.as_tensor(low).float(), torch.as_tensor(high).float()
    return {
        STATE_KEY: 2 * (state - lower) / (upper - lower) - 1,
        GRIDS_KEY: frames.columns[f"grids/{GRIDS_KEY}"][:, 2:4].float(),
    }


RANGES = pytest.mark.parametrize("reach", [0.5, 2.0])


@RANGES
def test_the_policy_is_told_what_the_regressor_tells_whatever_the_joints_range(
    frames: Frames, folder: Path, reach: float
) -> None:
    middle = np.linspace(-0.3, 0.4, JOINTS)
    low, high = middle - reach, middle + 2 * reach
    policy = make_policy(folder, stats_of(low, high))
    told = policy.model.encoder.perceive(processed(frames, low, high))
    estimator = make_estimator(frames)
    for step in range(2):
        at = torch.arange(len(frames.length)), torch.full((len(frames.length),), 2 + step)
        with torch.no_grad():
            expected = estimator.head(estimator.features(estimator.window(frames, *at)))
        torch.testing.assert_close(told[:, step], expected, atol=2e-4, rtol=1e-4)
    assert told.shape[-1] == len(NAMES)
    assert policy.model.encoder.cond_dim == 2 * (len(NAMES) + 64)


def test_a_checkpoint_tells_the_same_and_another_dataset_changes_the_range(
    frames: Frames, folder: Path, tmp_path: Path
) -> None:
    low, high = np.full(JOINTS, -1.0), np.full(JOINTS, 1.5)
    policy = make_policy(folder, stats_of(low, high))
    told = policy.model.encoder.perceive(processed(frames, low, high))
    policy.save_pretrained(tmp_path / "checkpoint")
    (folder / "encoder_tactile_pads.safetensors").unlink()
    again = VtDp3Policy.from_pretrained(tmp_path / "checkpoint")
    torch.testing.assert_close(again.model.encoder.perceive(processed(frames, low, high)), told)
    other = np.full(JOINTS, -2.0), np.full(JOINTS, 2.0)
    moved = VtDp3Policy.from_pretrained(tmp_path / "checkpoint", dataset_stats=stats_of(*other))
    for model in (moved.model, moved.online):
        assert model is not None
        found = model.encoder.perceive(processed(frames, *other))
        torch.testing.assert_close(found, told, atol=2e-4, rtol=1e-4)


def test_cloning_leaves_the_estimates_as_they_are(frames: Frames, folder: Path) -> None:
    low, high = np.full(JOINTS, -1.0), np.full(JOINTS, 1.5)
    policy = make_policy(folder, stats_of(low, high)).train()
    assert policy.online is not None
    before = [weight.clone() for weight in policy.online.encoder.perception[-1].parameters()]
    batch = processed(frames, low, high)
    batch[ACTION_KEY] = torch.zeros(len(batch[STATE_KEY]), policy.config.horizon, JOINTS)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-2)
    policy(batch)[0].backward()
    optimizer.step()
    estimates = policy.online.encoder.estimates
    assert isinstance(estimates, Estimates)
    assert all(torch.equal(a, b) for a, b in zip(before, estimates.parameters(), strict=True))


def test_an_encoder_of_several_frames_tells_no_estimates(frames: Frames, tmp_path: Path) -> None:
    save_keeper(tmp_path, Effort(history=(3,)))(TOUCH, make_estimator(frames, history=3))
    with pytest.raises(ValueError, match=r"pads\.safetensors tells no estimates .*vtrefine-information"):
        make_policy(tmp_path)
    make_policy(tmp_path, representation="features")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"pretrained_encoder": "", "freeze_encoder": False}, "needs policy.pretrained_encoder"),
        ({"normalization_mapping": {"STATE": NormalizationMode.MEAN_STD}}, "needs STATE: MIN_MAX"),
        ({"representation": "guesses"}, "guesses"),
    ],
)
def test_settings_that_do_not_go_together(folder: Path, changes: dict[str, Any], said: str) -> None:
    with pytest.raises((ValueError, ParsingError), match=said):
        make_policy(folder, **changes)
