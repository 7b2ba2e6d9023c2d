"""What torch keeps goes back when a GPU that others use is nearly full."""

import pytest
import torch

from lerobot_vtrefine.finetune.gpu_memory import give_back_unused


@pytest.mark.parametrize(("device", "free", "given_back"), [("cuda", 1, 1), ("cuda", 50, 0), ("cpu", 1, 0)])
def test_memory_is_given_back_where_little_is_left(
    monkeypatch, device: str, free: int, given_back: int
) -> None:
    calls = []
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (free, 100))
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: calls.append(1))
    give_back_unused(torch.device(device))
    assert len(calls) == given_back
