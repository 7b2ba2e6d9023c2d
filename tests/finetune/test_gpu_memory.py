"""What torch keeps goes back when a GPU that others use is nearly full."""

import sys
from types import SimpleNamespace

import pytest
import torch

from lerobot_vtrefine.finetune.gpu_memory import GIB, give_back_unused, memory_taken


@pytest.mark.parametrize(("device", "free", "given_back"), [("cuda", 1, 1), ("cuda", 60, 0), ("cpu", 1, 0)])
def test_memory_is_given_back_where_little_is_left(
    monkeypatch, device: str, free: int, given_back: int
) -> None:
    calls = []
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (free, 100))
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: calls.append(1))
    give_back_unused(torch.device(device))
    assert len(calls) == given_back


@pytest.mark.parametrize(
    ("warp", "told"),
    [
        (None, {}),
        (SimpleNamespace(is_mempool_enabled=lambda _: False), {}),
        (
            SimpleNamespace(
                is_mempool_enabled=lambda _: True, get_mempool_used_mem_high=lambda name: len(name) * GIB
            ),
            {"warp_gib": 4.0},
        ),
    ],
)
def test_a_run_tells_how_much_memory_is_taken(monkeypatch, warp, told: dict[str, float]) -> None:
    asked = []
    monkeypatch.setattr(torch.cuda, "max_memory_reserved", lambda _: 3 * GIB)
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda _: asked.append("anew"))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (60 * GIB, 80 * GIB))
    monkeypatch.setitem(sys.modules, "warp", warp)
    assert memory_taken(torch.device("cuda")) == {"torch_gib": 3.0, "gpu_used_gib": 20.0} | told
    assert asked == ["anew"]
    assert memory_taken(torch.device("cpu")) == {}
