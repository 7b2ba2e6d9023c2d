"""Commands side by side on one machine, each on its own share of cores and GPUs."""

import os
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lerobot_vtrefine.cli.pipeline.stages import own_sessions

POLL_S = 0.5


@dataclass(frozen=True)
class Share:
    """What one of several runs side by side may use of the machine."""

    cores: list[int]
    """Empty where the cores cannot be chosen."""
    gpu: str | None
    """As ``CUDA_VISIBLE_DEVICES`` names it; None without a GPU."""


Commands = Mapping[Path, Sequence[str]]
"""By the names of their folders."""
Needs = Mapping[Path, Sequence[Path]]
"""Which of the commands must have succeeded before one starts."""
Start = Callable[..., subprocess.Popen[bytes]]
"""What `own_sessions` gives."""


def run_all(commands: Commands, jobs: int, needs: Needs | None = None) -> None:
    """Run the commands, ``jobs`` side by side at most.

    Side by side, each prints to ``FOLDER.log`` and keeps to its own share of the machine. One that fails
    stops those alone that need it.

    Raises:
        subprocess.CalledProcessError: a command failed.
    """
    queue = Queue(list(commands), needs or {})
    jobs = max(1, min(jobs, len(commands)))
    run = run_in_turn if jobs == 1 else partial(run_together, jobs=jobs)
    with own_sessions() as start:
        failed = run(commands, queue, start)
    if failed:
        raise failed[0]


def run_one(command: Sequence[str], **options: Any) -> None:
    """Run a command in sight, with the options of ``subprocess.Popen``; it ends with this process.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    with own_sessions() as start:
        status = start(command, **options).wait()
    if status:
        raise subprocess.CalledProcessError(status, command)


class Queue:
    """Commands that wait for others, in order."""

    def __init__(self, waiting: list[Path], needs: Needs) -> None:
        self.waiting = waiting
        self._needs = needs
        self._done: set[Path] = set()

    def next(self) -> Path | None:
        """Take the first command that waits for nothing any more."""
        ready = (name for name in self.waiting if self._done.issuperset(self._needs.get(name, ())))
        found = next(ready, None)
        if found is not None:
            self.waiting.remove(found)
        return found

    def end(self, name: Path, failed: bool) -> None:
        """Note that a command has ended; those that need one that failed wait no longer."""
        if not failed:
            self._done.add(name)
            return
        while (
            other := next((one for one in self.waiting if name in self._needs.get(one, ())), None)
        ) is not None:
            self.waiting.remove(other)
            print(f"== {other.name}: left out for want of {name.name}", flush=True)
            self.end(other, failed=True)


def run_in_turn(commands: Commands, queue: Queue, start: Start) -> list[subprocess.CalledProcessError]:
    """Run the commands one after the other, in sight; the failures."""
    failed: list[subprocess.CalledProcessError] = []
    while (folder := queue.next()) is not None:
        print(f"\n== {folder.name}", flush=True)
        status = start(commands[folder]).wait()
        failed += [subprocess.CalledProcessError(status, commands[folder])] if status else []
        queue.end(folder, bool(status))
    return failed


def run_together(
    commands: Commands, queue: Queue, start: Start, jobs: int
) -> list[subprocess.CalledProcessError]:
    """Run the commands side by side; the failures."""
    free, running = shares(jobs), {}
    failed: list[subprocess.CalledProcessError] = []
    while queue.waiting or running:
        while free and (folder := queue.next()) is not None:
            share = free.pop(0)
            print(f"== {folder.name}: progress in {folder}.log", flush=True)
            running[folder] = (start_on(share, start, commands[folder], Path(f"{folder}.log")), share)
        for folder in [name for name, (child, _) in running.items() if child.poll() is not None]:
            child, share = running.pop(folder)
            free.append(share)
            if child.returncode:
                failed.append(subprocess.CalledProcessError(child.returncode, commands[folder]))
            print(f"== {folder.name}: {'failed' if child.returncode else 'done'}", flush=True)
            queue.end(folder, bool(child.returncode))
        time.sleep(POLL_S)
    return failed


def shares(jobs: int) -> list[Share]:
    """The machine, dealt out to ``jobs`` runs: cores in equal parts, GPUs by turns."""
    cores, gpus = usable_cores(), visible_gpus()
    part = len(cores) // jobs
    return [
        Share(cores[job * part : (job + 1) * part], gpus[job % len(gpus)] if gpus else None)
        for job in range(jobs)
    ]


def usable_cores() -> list[int]:
    """The cores that this process may use; none where the system does not tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    if named := os.environ.get("CUDA_VISIBLE_DEVICES"):
        return named.split(",")
    import torch

    return [str(index) for index in range(torch.cuda.device_count())]


def start_on(share: Share, start: Start, command: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """One command in the background, on its share of the machine."""
    log.parent.mkdir(parents=True, exist_ok=True)
    pin = partial(os.sched_setaffinity, 0, share.cores) if share.cores else None
    env = os.environ | ({"CUDA_VISIBLE_DEVICES": share.gpu} if share.gpu else {})
    with log.open("wb") as file:
        return start(command, stdout=file, stderr=subprocess.STDOUT, preexec_fn=pin, env=env)
