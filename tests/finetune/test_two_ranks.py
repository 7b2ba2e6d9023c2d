"""Two CPU ranks, as torchrun starts them: their update is that of one process with all the data.

Each owns its seeds.
"""

import json
import multiprocessing

import pytest
import torch
from tiny_policy import save_tiny_checkpoint
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
from two_ranks import main

from lerobot_vtrefine.finetune.distributed import claim_gpu
from lerobot_vtrefine.finetune.logger import read_progress


def launch(*arguments: object) -> None:
    """Start two ranks as torchrun does, but as copies of this process, and wait for them."""
    agent = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=2,
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
        start_method="fork",
    )
    elastic_launch(agent, main)(*arguments)


@pytest.fixture(scope="module")
def ranks(tmp_path_factory):
    """What each of two ranks found; and the run's folder.

    To import LeRobot in every rank would take most of the time; the command `torchrun` itself starts those of
    cli/test_finetune_ranks.py. Its agent takes over signals, and so is a process of its own.
    """
    folder = tmp_path_factory.mktemp("ranks")
    checkpoint = save_tiny_checkpoint(folder / "start")
    agent = multiprocessing.get_context("fork").Process(target=launch, args=(folder, checkpoint))
    agent.start()
    agent.join()
    assert agent.exitcode == 0
    return [json.loads((folder / f"rank{rank}.json").read_text()) for rank in range(2)], folder / "run"


def test_update_over_two_ranks_equals_one_process_with_all_data(ranks):
    for found in ranks[0]:
        assert found["difference"] < 2e-4  # Adam's first steps amplify rounding
        assert found["moved"] > 10 * found["difference"], "other data must give another result"
        assert found["metrics"] == pytest.approx([0, 0], abs=1e-5)


def test_metrics_are_averaged_over_ranks_and_finite_entries(ranks):
    for found in ranks[0]:
        assert found["mean"] == {"x": 3.0, "only_0": 1.0, "only_1": 4.0}


def test_each_rank_owns_its_environments(ranks):
    first, second = (found["seeds"] for found in ranks[0])
    assert len(first) == len(second) > 0
    assert not set(first) & set(second)


def test_each_rank_explores_with_noise_of_its_own(ranks):
    first, second = (found["noise"] for found in ranks[0])
    assert first != second


def test_one_run_is_recorded(ranks):
    rows = read_progress(ranks[1])
    assert [row["iteration"] for row in rows] == [0, 1, 2]
    assert (ranks[1] / "checkpoints" / "last" / "pretrained_model" / "model.safetensors").is_file()


@pytest.mark.parametrize(
    ("local_rank", "gpus", "expected"), [("3", 4, [3]), ("3", 2, [1]), (None, 4, []), ("0", 0, [])]
)
def test_each_rank_takes_its_own_gpu(monkeypatch, local_rank, gpus, expected):
    """Without this every rank would work on the first GPU, which NCCL refuses."""
    taken = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "set_device", taken.append)
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    if local_rank is not None:
        monkeypatch.setenv("LOCAL_RANK", local_rank)
    claim_gpu()
    assert taken == expected
