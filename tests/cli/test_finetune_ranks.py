"""``vtrefine-finetune`` under ``torchrun`` with two CPU processes and the real simulation."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.common.train_utils import update_last_checkpoint
from tiny_commands import TINY_ENV

from lerobot_vtrefine.finetune.logger import read_progress
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS
from lerobot_vtrefine.finetune.state_file import load_state

BIN = Path(sys.executable).parent
ENVS, EPISODE_STEPS, ITERATIONS, SEED = 2, 8, 2, 40


def finetune(checkpoint: Path, output: Path, episodes: Path, *arguments: str) -> str:
    """Run the command as two ranks; returns what both printed."""
    dppo = (
        "type=small",
        f"num_envs={ENVS}",
        f"iterations={ITERATIONS}",
        "epochs=2",
        "minibatch_decisions=2",
        "critic_width=16",
        "critic_warmup=0",
    )
    command = [
        *(str(BIN / "torchrun"), "--standalone", "--nproc_per_node=2", "--no-python"),
        *(str(BIN / "vtrefine-finetune"), f"--policy.path={checkpoint}", f"--output_dir={output}"),
        *(*TINY_ENV, f"--env.episode_steps={EPISODE_STEPS}", f"--env.metrics_path={episodes}"),
        *(f"--dppo.{item}" for item in dppo),
        *(f"--seed={SEED}", "--eval.n_episodes=4", "--eval_freq=2", "--save_freq=1", *arguments),
    ]
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def run(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, str]:
    """Output folder of two iterations, the file of all its episodes, and what was printed."""
    folder = tmp_path_factory.mktemp("ranks")
    printed = finetune(checkpoint, folder / "run", folder / "episodes.jsonl")
    return folder / "run", folder / "episodes.jsonl", printed


def seeds(episodes: Path) -> list[int]:
    """Sorted seeds of all episodes that ended."""
    return sorted(json.loads(line)["seed"] for line in episodes.read_text().splitlines())


def trained_state(output: Path) -> dict:
    """Critic, optimisers and every rank's random states after the last iteration."""
    path = output / "checkpoints" / f"{ITERATIONS:06d}" / "training_state" / "dppo_state.safetensors"
    return load_state(path)


@pytest.mark.slow  # without a simulator: test_two_ranks.py
def test_every_rank_plays_its_own_episodes(run: tuple[Path, Path, str]) -> None:
    """Two ranks of two environments: no episode twice, none left out."""
    first = TRAINING_SEEDS + SEED
    trained = list(range(first, first + 2 * ENVS * ITERATIONS))
    evaluated = list(range(EVALUATION_SEEDS, EVALUATION_SEEDS + 2 * ENVS))
    assert seeds(run[1]) == sorted(2 * evaluated + trained)  # evaluated before training and after


@pytest.mark.slow
def test_one_rank_writes_and_all_are_counted(run: tuple[Path, Path, str]) -> None:
    output, _, printed = run
    rows = read_progress(output)
    assert [row["iteration"] for row in rows] == [0, 1, 2]
    assert rows[-1]["env_steps"] == 2 * ENVS * EPISODE_STEPS * ITERATIONS
    assert rows[-1]["initial_log_ratio"] < 1e-4
    assert rows[-1]["approx_kl"] > 0, "the second epoch must see a changed policy"
    assert printed.count("iteration 1: ") == 1
    assert sorted(path.name for path in (output / "checkpoints").iterdir()) == ["000001", "000002", "last"]
    ranks = trained_state(output)["ranks"]
    assert len(ranks) == 2
    assert not ranks[0]["generator"].equal(ranks[1]["generator"]), "ranks must explore with different noise"


@pytest.mark.slow
def test_resumed_ranks_end_where_the_uninterrupted_ones_did(
    run: tuple[Path, Path, str], checkpoint: Path, tmp_path: Path
) -> None:
    resumed = tmp_path / "run"
    shutil.copytree(run[0], resumed, symlinks=True)
    shutil.rmtree(resumed / "checkpoints" / "000002")  # as if interrupted during the second iteration
    update_last_checkpoint(resumed / "checkpoints" / "000001")
    finetune(checkpoint, resumed, tmp_path / "episodes.jsonl", "--resume=true")
    torch.testing.assert_close(trained_state(resumed), trained_state(run[0]), rtol=0, atol=0)
    clock = {"seconds", "rollout_s", "steps_per_s"}
    kept = [
        [{key: row[key] for key in row.keys() - clock} for row in read_progress(output)]
        for output in (run[0], resumed)
    ]
    assert kept[0] == kept[1]
