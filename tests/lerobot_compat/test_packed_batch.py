"""A batch in one buffer is the batch, wherever it is handed to."""

import pickle
from multiprocessing.reduction import ForkingPickler

import pytest
import torch
from torch import Tensor

from lerobot_vtrefine.lerobot_compat.packed_batch import PackedBatch


@pytest.fixture
def columns() -> dict[str, Tensor | list[str]]:
    """Odd sizes of many dtypes, so that nothing is aligned by chance; a view; an empty tensor; words."""
    return {
        "counts": torch.arange(7, dtype=torch.uint8).view(7, 1),
        "state": torch.randn(3, 2, 5)[:, :1],
        "is_pad": torch.tensor([True, False, True]),
        "index": torch.arange(3),
        "task": ["insert"] * 3,
        "depth": torch.randn(3, 1, 4, 4),
        "more counts": torch.arange(5, dtype=torch.uint8),
        "nothing": torch.empty(3, 0),
    }


@pytest.mark.parametrize(
    "handed_over",
    [
        lambda packed: packed,
        lambda packed: packed.to("cpu"),
        lambda packed: pickle.loads(ForkingPickler.dumps(packed)),
        lambda packed: pickle.loads(ForkingPickler.dumps(packed)).to("cpu", non_blocking=True),
    ],
    ids=["packed", "moved", "received", "received and moved"],
)
def test_columns_stay_what_they_are(columns, handed_over):
    found = handed_over(PackedBatch.of(columns))
    assert list(found) == list(columns)
    for key, value in columns.items():
        if isinstance(value, Tensor):
            assert found[key].dtype == value.dtype
            assert torch.equal(found[key], value)
        else:
            assert found[key] == value


def test_one_tensor_is_handed_over(columns):
    packed = PackedBatch.of(columns)
    storages = {value.untyped_storage().data_ptr() for value in packed.values() if isinstance(value, Tensor)}
    assert len(storages - {0}) == 1
    moved = packed.to("cpu")
    assert type(moved) is dict, "what changes afterwards is an ordinary batch"


@pytest.mark.gpu
def test_on_a_gpu_through_pinned_memory(columns):
    found = PackedBatch.of(columns).pin_memory().to("cuda", non_blocking=True)
    for key, value in columns.items():
        if isinstance(value, Tensor):
            assert found[key].is_cuda
            assert torch.equal(found[key].cpu(), value)
