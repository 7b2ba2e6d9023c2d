"""Expert episodes from several simulation processes, in the order of their seeds."""

import itertools
import multiprocessing as mp
import os
import queue
import signal
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.process import BaseProcess
from typing import Any

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.demonstrations import Demonstration, expert_episodes
from lerobot_vtrefine.sim.demonstrations import Degradation

AHEAD = 8
"""Finished episodes that a worker may hold before it waits to be read."""
POLL_S = 1.0


@contextmanager
def demonstration_stream(
    config: VtRefineEnvConfig,
    degradation: Degradation,
    num_envs: int,
    first_seed: int,
    num_workers: int,
    with_truth: bool = False,
) -> Generator[Iterator[Demonstration]]:
    """Expert episodes of ``first_seed``, ``first_seed + 1``, ... without end, whatever ``num_workers``.

    With 0 workers this process simulates; otherwise worker ``w`` of ``W`` simulates every W-th seed from
    ``first_seed + w`` in a process of its own, so that simulation and the caller's writing overlap. There is
    one worker for each core at most: more take memory and no less time.
    """
    if num_workers == 0:
        yield expert_episodes(config, degradation, num_envs, itertools.count(first_seed), with_truth)
        return
    cores = os.cpu_count() or 1
    num_workers = min(num_workers, cores)
    threads = config.num_threads or cores // num_workers
    config = replace(config, num_threads=threads)
    context = mp.get_context("spawn")
    queues = [context.Queue(AHEAD) for _ in range(num_workers)]
    processes = [
        context.Process(
            target=_simulate,
            args=(
                config,
                degradation,
                num_envs,
                first_seed + worker,
                num_workers,
                with_truth,
                queues[worker],
            ),
            daemon=True,
        )
        for worker in range(num_workers)
    ]
    for process in processes:
        process.start()
    try:
        yield _round_robin(queues, processes)
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


def _simulate(
    config: VtRefineEnvConfig,
    degradation: Degradation,
    num_envs: int,
    first_seed: int,
    stride: int,
    with_truth: bool,
    out: Any,
) -> None:
    """Body of a worker process; an error travels to the reader."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    try:
        for demonstration in expert_episodes(
            config, degradation, num_envs, itertools.count(first_seed, stride), with_truth
        ):
            out.put(demonstration)
    except Exception as error:
        out.put(error)


def _round_robin(queues: list[Any], processes: Sequence[BaseProcess]) -> Iterator[Demonstration]:
    for worker in itertools.cycle(range(len(queues))):
        item = _next(queues[worker], processes[worker])
        if isinstance(item, Exception):
            raise item
        yield item


def _next(source: Any, process: BaseProcess) -> Demonstration | Exception:
    while True:
        try:
            return source.get(timeout=POLL_S)
        except queue.Empty:
            if not process.is_alive():
                return ValueError(
                    f"a simulation process ended with status {process.exitcode} (out of memory?);"
                    " try fewer --num_envs or --num_workers"
                )
