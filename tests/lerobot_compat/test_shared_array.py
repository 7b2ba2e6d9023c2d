"""Arrays reach started processes without a copy, bit for bit, and nothing of them stays open."""

import multiprocessing
import os
import pickle
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_vtrefine.lerobot_compat.shared_array import SharedArray


def counts() -> Any:
    return np.random.default_rng(0).integers(0, 2**16, (500, 200), dtype=np.uint16)


def read_all(array: SharedArray, answers: "SimpleQueue[Any]") -> None:
    """In another process: what the array says, and whether it lies in memory that the parent mapped too."""
    mapped = "memfd:vtrefine-frames" in Path("/proc/self/maps").read_text()
    answers.put((int(array.values.sum(dtype=np.int64)), array.values.flags.writeable, mapped))


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="shared on Linux only")
def test_started_processes_read_one_copy() -> None:
    values = counts()
    array = SharedArray(values)
    context = multiprocessing.get_context("spawn")
    answers = context.SimpleQueue()
    workers = [context.Process(target=read_all, args=(array, answers)) for _ in range(2)]
    for worker in workers:
        worker.start()
    told = [answers.get() for _ in workers]
    for worker in workers:
        worker.join()
    assert told == [(int(values.sum(dtype=np.int64)), False, True)] * 2
    assert (array.values == values).all()


def test_open_descriptors_go_with_the_array() -> None:
    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    before = descriptors()
    array = SharedArray(counts()[:10])
    array._shared()
    assert descriptors() > before
    del array
    assert descriptors() == before


def test_other_pickles_carry_the_contents() -> None:
    array = SharedArray(counts()[:10])
    array._shared()
    copy = pickle.loads(pickle.dumps(array))
    assert (copy.values == array.values).all()
