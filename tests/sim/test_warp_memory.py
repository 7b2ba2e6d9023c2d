"""Memory of recorded work, without a GPU: Warp calls these allocators on GPUs only."""

from contextlib import nullcontext
from types import SimpleNamespace

import pytest

wp = pytest.importorskip("warp")
from lerobot_vtrefine.sim.backends import warp_memory  # noqa: E402
from lerobot_vtrefine.sim.backends.warp_memory import ALIGNMENT, Arena, Tally, arena_of, padded  # noqa: E402


@pytest.fixture
def device():
    return wp.get_device("cpu")


def test_an_arena_of_what_was_tallied_is_enough_time_after_time(device):
    released = []
    pool = SimpleNamespace(allocate=lambda size: size, deallocate=lambda ptr, _: released.append(ptr))
    tally = Tally(SimpleNamespace(get_allocator=lambda: pool))
    for sizes in ([4, 400], [4000, 12], [8]):
        tally.rewind()
        for size in sizes:
            tally.deallocate(tally.allocate(size), size)
    assert released == [4, 400, 4000, 12, 8]
    assert tally.most == padded(4000) + padded(12)
    arena = Arena(tally.most, device)
    first = [arena.allocate(4000), arena.allocate(12)]
    assert first[1] - first[0] == padded(4000)
    with pytest.raises(RuntimeError, match="too small"):
        arena.allocate(1)
    arena.rewind()
    assert [arena.allocate(4000), arena.allocate(12)] == first


def test_recordings_share_the_arena_of_the_largest(device):
    small = arena_of(1000, device, None)
    large = arena_of(5000, device, small)
    assert large is not small
    assert arena_of(4000, device, large) is large
    assert arena_of(padded(5000) + ALIGNMENT, device, large) is not large


def test_work_is_done_once_and_recorded_in_the_arena_that_is_there(device, monkeypatch):
    """As on a GPU, with allocators that are asked by hand."""
    asked, waits, given = [], [], []

    def allocator(_, one):
        asked.append(one)
        return nullcontext()

    pool = SimpleNamespace(allocate=lambda size: 0, deallocate=lambda *_: None)
    gpu = SimpleNamespace(get_allocator=lambda: pool, is_cuda=True)
    monkeypatch.setattr(warp_memory, "Arena", lambda size, _: Arena(size, device))
    monkeypatch.setattr(wp, "ScopedAllocator", allocator)
    monkeypatch.setattr(wp, "ScopedCapture", lambda *_, **__: nullcontext(SimpleNamespace(graph="graph")))
    monkeypatch.setattr(wp, "synchronize_device", waits.append)
    large = warp_memory.record(lambda: given.append(asked[-1].allocate(5000)), 3, gpu)
    assert [type(one) for one in asked] == [Tally, Arena]
    assert waits == [gpu] * 3
    assert len(given) == 6
    assert len(set(given[3:])) == 1
    small = warp_memory.record(lambda: given.append(asked[-1].allocate(1000)), 1, gpu, large.arena)
    assert small.arena is large.arena
    assert given[-1] == given[-3]
    assert large.arena.size == padded(5000)


def test_what_is_recorded_on_a_cpu_works_in_the_arena():
    """Arrays of its own would be gone when it is done again."""
    cpu, places = wp.get_device("cpu"), []
    made = warp_memory.record(lambda: places.append(wp.zeros(1000, dtype=float, device=cpu).ptr), 1, cpu)
    begin = made.arena._block.ptr
    assert begin <= places[-1] < begin + made.arena.size
