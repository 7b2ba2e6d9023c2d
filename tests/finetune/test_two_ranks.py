"""Two CPU processes under torchrun: the update equals one process with all the data; each owns its seeds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tiny_policy import save_tiny_checkpoint

from lerobot_vtrefine.finetune.distributed import claim_gpu
from lerobot_vtrefine.finetune.logger import read_progress


@pytest.fixture(scope="module")
def ranks(tmp_path_factory):
    """What each of two ranks found; and the run's folder."""
    folder = tmp_path_factory.mktemp("ranks")
    checkpoint = save_tiny_checkpoint(folder / "start")
    script = Path(__file__).with_name("two_ranks.py")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    path = os.pathsep.join([str(script.parent), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    done = subprocess.run(
        [*command, str(script), str(folder), str(checkpoint)],
        env=environment,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
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
