"""LeRobot's own policies learn from the colour image of the very data that vt_dp3 learns from."""

import importlib.util
from pathlib import Path

import pytest
from tiny_commands import TINY_ENV, finish, lerobot, record

from lerobot_vtrefine.shipped import find

COLOUR = "--env.rgb=true"
SMALL = {
    "act_rgb": (
        "--policy.pretrained_backbone_weights=null",
        "--policy.dim_model=32",
        "--policy.n_heads=2",
        "--policy.dim_feedforward=64",
        "--policy.n_encoder_layers=1",
    ),
    "diffusion_rgb": (
        "--policy.pretrained_backbone_weights=null",
        "--policy.down_dims=[32, 64]",
        "--policy.num_train_timesteps=4",
    ),
    "vt_dp3_small": (),
}


@pytest.fixture(scope="module")
def coloured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes with colour."""
    root = tmp_path_factory.mktemp("coloured") / "demos"
    assert record(root, "--num_episodes=2", "--num_envs=2", "--seed=5", COLOUR) == 0
    return root


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", list(SMALL))
def test_stock_commands_train_and_evaluate_it(coloured: Path, name: str, tmp_path: Path) -> None:
    if name == "diffusion_rgb" and importlib.util.find_spec("diffusers") is None:
        pytest.skip("pip install 'lerobot[diffusion]'")
    finish(
        lerobot(
            "train",
            f"--config_path={find('--config_path', name)}",
            "--dataset.repo_id=local/vtrefine_demos",
            f"--dataset.root={coloured}",
            "--policy.device=cpu",
            *SMALL[name],
            f"--output_dir={tmp_path / 'out'}",
            "--steps=2",
            "--save_freq=2",
            "--batch_size=2",
            "--num_workers=0",
            cache=tmp_path / "hf",
        )
    )
    output = finish(
        lerobot(
            "eval",
            f"--policy.path={tmp_path / 'out' / 'checkpoints' / 'last' / 'pretrained_model'}",
            "--policy.device=cpu",
            *TINY_ENV,
            COLOUR,
            "--env.episode_steps=6",
            "--env.video_episodes=0",
            "--eval.n_episodes=2",
            "--eval.batch_size=2",
            f"--output_dir={tmp_path / 'eval'}",
            cache=tmp_path / "hf",
        )
    )
    assert (tmp_path / "eval" / "eval_info.json").is_file(), output[-2000:]
