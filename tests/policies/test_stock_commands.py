"""LeRobot's own commands on a tiny dataset: train, resume, start from a checkpoint, two processes, edit."""

import importlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors import safe_open

from lerobot_vtrefine import register
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy

BIN = Path(sys.executable).parent
TINY = (
    "--policy.type=vt_dp3",
    "--policy.preset=small",
    "--policy.point_dims=[8,16]",
    "--policy.down_dims=[32,32]",
    "--policy.observation.num_visual_points=16",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
)
LOADED_RUN = ("--batch_size=4", "--log_freq=2", "--wandb.enable=false", "--num_workers=1")
"""LeRobot's own data loader: a spawned worker, instead of four that import LeRobot each."""
RUN = (*LOADED_RUN[:-1], "--num_workers=0")
"""In one process."""
CONFIGS = Path(__file__).parents[2] / "configs" / "policy"

pytestmark = pytest.mark.timeout(900)  # processes that import LeRobot, where others use the cores, too


def command(*arguments: object) -> str:
    """Run one of LeRobot's commands offline on one thread; returns what it printed."""
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "WANDB_MODE": "disabled"}
    words = [str(BIN / str(arguments[0])), *map(str, arguments[1:])]
    done = subprocess.run(
        words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:]
    return done.stdout


def train_here(patch: pytest.MonkeyPatch, *arguments: object) -> None:
    """Run ``lerobot-train`` in this process, which has imported LeRobot; raises what it raises."""
    from lerobot.scripts.lerobot_train import main

    patch.setenv("HF_HUB_OFFLINE", "1")
    patch.setattr("sys.argv", ["lerobot-train", *map(str, arguments)])
    main()


def data(root: Path) -> tuple[str, str]:
    """Flags that name a local dataset."""
    return "--dataset.repo_id=local/tiny", f"--dataset.root={root}"


@pytest.fixture(scope="module")
def trained(tiny_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of ten steps of ``lerobot-train``, with a spawned worker as by LeRobot's default."""
    output = tmp_path_factory.mktemp("run") / "bc"
    command(
        "lerobot-train",
        *TINY,
        *LOADED_RUN,
        *data(tiny_dataset),
        f"--output_dir={output}",
        "--steps=10",
        "--save_freq=10",
    )
    saved = json.loads(
        (output / "checkpoints" / "last" / "pretrained_model" / "train_config.json").read_text()
    )
    assert (saved["num_workers"], saved["dataloader_multiprocessing_context"]) == (1, "spawn")
    return output


def average_steps(checkpoint: Path) -> int:
    """How often the moving average in a checkpoint was updated."""
    with safe_open(checkpoint / "pretrained_model" / "model.safetensors", framework="pt") as tensors:
        return int(tensors.get_tensor("ema.step"))


def test_training_writes_a_checkpoint_that_loads(trained: Path) -> None:
    policy = VtDp3Policy.from_pretrained(trained / "checkpoints" / "last" / "pretrained_model", strict=True)
    assert policy.config.point_dims == (8, 16)
    assert policy.config.observation.pool_rows == 2
    assert policy.config.fps == 10
    assert average_steps(trained / "checkpoints" / "000010") == 10


def test_a_checkpoint_is_judged(trained: Path, tmp_path: Path) -> None:
    """``lerobot-eval`` as users start it: a process that finds the package by itself."""
    command(
        "lerobot-eval",
        f"--policy.path={trained / 'checkpoints' / '000010' / 'pretrained_model'}",
        "--env.type=vtrefine",
        "--env.start=grasped",
        "--env.episode_steps=8",
        "--env.num_threads=1",
        f"--env.metrics_path={tmp_path / 'episodes.jsonl'}",
        "--env.video_episodes=0",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        f"--output_dir={tmp_path}",
    )
    assert len((tmp_path / "episodes.jsonl").read_text().splitlines()) == 2
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["pc_success"] == 0.0


def test_training_resumes_where_it_stopped(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    config = trained / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    train_here(
        monkeypatch,
        f"--config_path={config}",
        "--resume=true",
        "--steps=14",
        "--save_freq=14",
        "--num_workers=0",
    )
    assert "step:12" in capfd.readouterr().err
    assert average_steps(trained / "checkpoints" / "000014") == 14


def test_training_starts_from_a_checkpoint_on_another_dataset(
    trained: Path, tmp_path: Path, write_dataset: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_dataset(tmp_path / "other", episodes=1, frames=8, seed=7)
    train_here(
        monkeypatch,
        f"--policy.path={trained / 'checkpoints' / '000010' / 'pretrained_model'}",
        "--policy.push_to_hub=false",
        *RUN,
        *data(tmp_path / "other"),
        f"--output_dir={tmp_path / 'run'}",
        "--steps=4",
        "--save_freq=4",
    )
    saved = tmp_path / "run" / "checkpoints" / "000004" / "pretrained_model"
    assert json.loads((saved / "config.json").read_text())["down_dims"] == [32, 32]
    assert average_steps(saved.parent) == 14


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vt_dp3_paper", "vt_dp3_visual"])
def test_the_paper_network_trains_from_its_file(tiny_dataset: Path, tmp_path: Path, name: str) -> None:
    command(
        "lerobot-train",
        f"--config_path={CONFIGS / name}.yaml",
        "--policy.device=cpu",
        "--batch_size=8",
        "--steps=2",
        *data(tiny_dataset),
        f"--output_dir={tmp_path / 'run'}",
    )
    assert average_steps(tmp_path / "run" / "checkpoints" / "000002") == 2


@pytest.mark.slow
def test_two_processes_train_one_policy(tiny_dataset: Path, tmp_path: Path) -> None:
    printed = command(
        "torchrun",
        "--standalone",
        "--nproc_per_node=2",
        "--no-python",
        str(BIN / "lerobot-train"),
        *TINY,
        *RUN,
        *data(tiny_dataset),
        f"--output_dir={tmp_path / 'run'}",
        "--steps=4",
        "--save_freq=4",
    )
    assert "4 x 2 = 8" in printed
    assert average_steps(tmp_path / "run" / "checkpoints" / "000004") == 4


def test_evaluations_at_another_rate_are_refused_before_training(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    importlib.import_module("lerobot.scripts.lerobot_train")
    register()  # as the command does, which imports this package when it discovers plugins
    run = (*TINY, *RUN, *data(tiny_dataset), f"--output_dir={tmp_path / 'run'}", "--steps=1")
    with pytest.raises(SystemExit, match=r"error: --env\.fps=20, but the dataset holds 10 actions a second"):
        train_here(monkeypatch, *run, "--env.type=vtrefine", "--env.fps=20")


def test_training_without_pads_says_what_is_missing(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from aloha_columns import TACTILE_KEYS
    from lerobot.datasets import remove_feature

    tiny = LeRobotDataset("local/tiny", root=tiny_dataset)
    remove_feature(tiny, list(TACTILE_KEYS), output_dir=tmp_path / "blind", repo_id="local/tiny")
    run = (*RUN, *data(tmp_path / "blind"), f"--output_dir={tmp_path / 'run'}", "--steps=2")
    message = "needs columns that the data lacks: observation.tactile.left_arm_left_finger"
    with pytest.raises(ValueError, match=message) as told:
        train_here(monkeypatch, *TINY, *run)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("column", "values", "told"),
    [
        ("action", None, "no statistics of action"),
        ("observation.state", None, "no statistics of observation.state"),
        ("action", {"min": [float("nan")] * 16, "max": [1.0] * 16}, "not only finite statistics of action"),
    ],
)
def test_what_would_not_be_normalised_is_not_trained_on(
    tiny_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    column: str,
    values: dict[str, list[float]] | None,
    told: str,
) -> None:
    root = tmp_path / "own"
    shutil.copytree(tiny_dataset, root)
    stats = root / "meta" / "stats.json"
    found = json.loads(stats.read_text()) | {column: values}
    stats.write_text(json.dumps({key: value for key, value in found.items() if value is not None}))
    run = (*RUN, *data(root), f"--output_dir={tmp_path / 'run'}", "--steps=1")
    with pytest.raises(ValueError, match=rf"own/meta/stats\.json has {told}, by which .*recompute_stats$"):
        train_here(monkeypatch, *TINY, *run)


@pytest.mark.slow
def test_episodes_are_deleted_and_merged(tiny_dataset: Path, tmp_path: Path) -> None:
    command(
        "lerobot-edit-dataset",
        "--repo_id=local/tiny",
        f"--root={tiny_dataset}",
        "--new_repo_id=local/less",
        f"--new_root={tmp_path / 'less'}",
        "--operation.type=delete_episodes",
        "--operation.episode_indices=[1]",
    )
    command(
        "lerobot-edit-dataset",
        "--new_repo_id=local/more",
        f"--new_root={tmp_path / 'more'}",
        "--operation.type=merge",
        "--operation.repo_ids=['local/tiny', 'local/less']",
        f"--operation.roots=['{tiny_dataset}', '{tmp_path / 'less'}']",
    )
    tiny = LeRobotDataset("local/tiny", root=tiny_dataset)
    more = LeRobotDataset("local/more", root=tmp_path / "more")
    assert more.meta.total_episodes == 5
    assert more.meta.features == tiny.meta.features
    key = "observation.tactile.right_arm_left_finger"
    for row, source in ((0, 0), (35, 35), (36, 0), (48, 24), (59, 35)):
        assert more[row][key].tolist() == tiny[source][key].tolist()
        assert more[row]["observation.images.front_depth"].equal(
            tiny[source]["observation.images.front_depth"]
        )
