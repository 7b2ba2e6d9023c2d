"""LeRobot's own commands, run in this process with the arguments a user types."""

import importlib
from pathlib import Path

import pytest
from rig import Rig


def flags(**values: object) -> list[str]:
    return [f"--{name.replace('__', '.')}={value}" for name, value in values.items()]


def run_command(patch: pytest.MonkeyPatch, name: str, arguments: list[str]) -> None:
    """Runs `lerobot-<name>`; raises what the command raises."""
    module = importlib.import_module(f"lerobot.scripts.lerobot_{name}")
    with patch.context() as argv:
        argv.setattr("sys.argv", [f"lerobot-{name}", *arguments])
        module.main()


def follower_flags(rig: Rig, identity: str = "follower") -> list[str]:
    ports = rig.ports("follower")
    return flags(
        robot__type="aloha_tactile_follower",
        robot__id=identity,
        robot__calibration_dir=rig.folder / "calibration",
        robot__left_port=ports["left_port"],
        robot__right_port=ports["right_port"],
        robot__pads_file=rig.pads_file,
        robot__rest_s=0.1,
    )


def leader_flags(rig: Rig) -> list[str]:
    ports = rig.ports("leader")
    return flags(
        teleop__type="aloha_leader",
        teleop__id="leader",
        teleop__calibration_dir=rig.folder / "calibration",
        teleop__left_port=ports["left_port"],
        teleop__right_port=ports["right_port"],
    )


def dataset_flags(root: Path, episodes: int, seconds: float, fps: int) -> list[str]:
    return flags(
        dataset__repo_id="local/emulated",
        dataset__root=root,
        dataset__num_episodes=episodes,
        dataset__episode_time_s=seconds,
        dataset__reset_time_s=0,
        dataset__fps=fps,
        dataset__single_task="insert the plug",
        dataset__video="false",
        dataset__push_to_hub="false",
        play_sounds="false",
    )


def train(patch: pytest.MonkeyPatch, root: Path, output: Path, steps: int) -> Path:
    """Trains a tiny policy; returns its folder."""
    run = flags(
        dataset__repo_id="local/emulated",
        dataset__root=root,
        policy__type="vt_dp3",
        policy__preset="small",
        policy__point_dims="[8,16]",
        policy__down_dims="[32,32]",
        policy__n_action_steps=4,
        policy__observation__num_visual_points=16,
        policy__device="cpu",
        policy__push_to_hub="false",
        output_dir=output,
        batch_size=4,
        num_workers=0,
        steps=steps,
        save_freq=steps,
        wandb__enable="false",
    )
    run_command(patch, "train", run)
    return output / "checkpoints" / "last" / "pretrained_model"
