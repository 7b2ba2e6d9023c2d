"""Commands side by side on one machine, each on its own share of cores and GPUs."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from lerobot_vtrefine.cli.errors import run_cli

POLL_S = 0.5


@dataclass(frozen=True)
class Share:
    """What one of several runs side by side may use of the machine."""

    cores: list[int]
    """Empty where the cores cannot be chosen."""
    gpu: str | None
    """As ``CUDA_VISIBLE_DEVICES`` names it; None without a GPU."""


def run_all(commands: dict[Path, list[str]], jobs: int) -> None:
    """Run the commands, by the names of their folders, ``jobs`` side by side.

    Side by side, each prints to ``FOLDER.log`` and keeps to its own share of the machine. One that fails
    does not stop the others.

    Raises:
        subprocess.CalledProcessError: a command failed.
    """
    failed: list[subprocess.CalledProcessError] = []
    if jobs == 1:
        for folder, command in commands.items():
            print(f"\n== {folder.name}", flush=True)
            status = subprocess.run(command, check=False).returncode
            failed += [subprocess.CalledProcessError(status, command)] if status else []
    else:
        failed = run_together(commands, jobs)
    if failed:
        raise failed[0]


def run_together(commands: dict[Path, list[str]], jobs: int) -> list[subprocess.CalledProcessError]:
    """Run the commands side by side; the failures."""
    free, waiting, running = shares(jobs), list(commands), {}
    failed: list[subprocess.CalledProcessError] = []
    try:
        while waiting or running:
            while waiting and free:
                folder, share = waiting.pop(0), free.pop(0)
                print(f"== {folder.name}: progress in {folder}.log", flush=True)
                running[folder] = (start(commands[folder], folder, share), share)
            for folder in [name for name, (child, _) in running.items() if child.poll() is not None]:
                child, share = running.pop(folder)
                free.append(share)
                if child.returncode:
                    failed.append(subprocess.CalledProcessError(child.returncode, commands[folder]))
                print(f"== {folder.name}: {'failed' if child.returncode else 'done'}", flush=True)
            time.sleep(POLL_S)
    finally:
        for child, _ in running.values():
            child.terminate()
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
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return named.split(",") if named else [str(index) for index in range(torch.cuda.device_count())]


def start(command: list[str], folder: Path, share: Share) -> subprocess.Popen:
    """One command in the background, on its share of the machine."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    pin = partial(os.sched_setaffinity, 0, share.cores) if share.cores else None
    env = os.environ | ({"CUDA_VISIBLE_DEVICES": share.gpu} if share.gpu else {})
    with Path(f"{folder}.log").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, preexec_fn=pin, env=env)


def run_script(entry: Callable[[], None]) -> None:
    """Run a script's entry as `run_cli` does; the status of a command that failed is its own."""
    try:
        sys.exit(run_cli(entry)())
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
