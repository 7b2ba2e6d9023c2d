"""``vtrefine-finetune`` asked to stop by Ctrl-C or SIGTERM: what it has learnt is saved, and goes on exactly.

As in ``test_killed_runs.py`` the command runs in a forked child, whose signals are its own.
"""

import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
import torch
from test_killed_runs import FLAGS, one_thread, progress, weights  # noqa: F401
from tiny_policy import ReachEnv, save_tiny_checkpoint

from lerobot_vtrefine.cli.finetune import main
from lerobot_vtrefine.finetune import pipeline
from lerobot_vtrefine.finetune.seeds import TRAINING_SEEDS
from lerobot_vtrefine.finetune.state_file import load_state
from lerobot_vtrefine.interrupts import AGAIN_AFTER_S

ITERATIONS = 3


class SlowEnv(ReachEnv):
    """Touches a file and waits at the start of an iteration, counted from 0."""

    def __init__(self, note: Path, wait_s: float, iteration: int) -> None:
        super().__init__(2)
        self.note, self.wait_s = note, wait_s
        self.first = TRAINING_SEEDS + iteration * self.num_envs * int(os.environ.get("WORLD_SIZE", "1"))

    def reset(self, seeds: Sequence[int]):
        if seeds[0] >= self.first and not self.note.exists():
            self.note.touch()
            until = time.monotonic() + self.wait_s
            while time.monotonic() < until:
                time.sleep(0.05)
        return super().reset(seeds)


def run_slowly(
    arguments: list[str], log: Path, wait_s: float, iteration: int, environment: dict[str, str]
) -> None:
    """In a child: the command, until a signal ends it; what it says goes to the log."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background hears less
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # another command's, in this process, may be another
    os.environ.update(environment)
    sys.stderr = log.open("w", buffering=1)
    os.dup2(sys.stderr.fileno(), 2)
    env = SlowEnv(log.with_suffix(".reached"), wait_s, iteration)
    pipeline.make_decision_env = lambda *_: env
    sys.argv = ["vtrefine-finetune", *arguments]
    os._exit(main())


def flags(start: Path, output: Path) -> list[str]:
    named = [f"--policy.path={start}", f"--output_dir={output}", f"--dppo.iterations={ITERATIONS}"]
    return [*named, *(flag for flag in FLAGS if not flag.startswith("--save_freq")), "--save_freq=10"]


@pytest.fixture
def start(tmp_path) -> Path:
    return save_tiny_checkpoint(tmp_path / "start")


@pytest.fixture
def whole(start, tmp_path, monkeypatch):
    """The run that nobody interrupts, and how to finish one in this process."""

    def finish(output: Path) -> Path:
        monkeypatch.setattr(pipeline, "make_decision_env", lambda env, num_envs, *rest: ReachEnv(num_envs))
        monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *flags(start, output)])
        assert main() == 0
        return output

    return finish(tmp_path / "whole"), finish


@pytest.fixture
def begin(start):
    """Starts the command in a child, which does not outlive the test."""
    children: list[BaseProcess] = []

    def run(output: Path, log: Path, wait_s: float, iteration: int = 1, **environment: str) -> BaseProcess:
        child = multiprocessing.get_context("fork").Process(
            target=run_slowly, args=(flags(start, output), log, wait_s, iteration, environment)
        )
        child.start()
        children.append(child)
        return child

    yield run
    for child in children:
        child.kill()


def wait_for(log: Path, *running: BaseProcess) -> None:
    deadline = time.monotonic() + 120
    while not log.with_suffix(".reached").is_file():
        assert all(child.is_alive() for child in running), log.read_text()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def ask(child: BaseProcess, number: int) -> None:
    assert child.pid is not None
    os.kill(child.pid, number)


def checkpoints(output: Path) -> list[str]:
    return sorted(path.name for path in output.glob("checkpoints/*"))


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_iteration_is_finished_and_goes_on_exactly(begin, whole, tmp_path, number, status):
    stopped, log = tmp_path / "stopped", tmp_path / "log"
    running = begin(stopped, log, wait_s=1.0)
    wait_for(log, running)
    ask(running, number)
    running.join(30)
    lines = log.read_text().splitlines()
    assert (running.exitcode, lines[-1]) == (
        status,
        "interrupted: the same command with --resume=true goes on from iteration 2",
    )
    assert lines.count(pipeline.STOPPING) == 1
    assert checkpoints(stopped) == ["000002", "last"]

    expected, finish = whole
    assert progress(stopped) == progress(expected)[:-1]
    finish(stopped)
    assert progress(stopped) == progress(expected)
    found = weights(stopped)
    assert all(torch.equal(value, found[key]) for key, value in weights(expected).items())


def test_a_signal_in_the_last_iteration_leaves_a_run_that_resuming_finishes_at_once(begin, whole, tmp_path):
    stopped, log = tmp_path / "stopped", tmp_path / "log"
    running = begin(stopped, log, wait_s=1.0, iteration=ITERATIONS - 1)
    wait_for(log, running)
    ask(running, signal.SIGTERM)
    running.join(30)
    assert running.exitcode == 143, "as long as nobody has told the outcome, it is not done"
    expected, finish = whole
    assert progress(stopped) == progress(expected)
    finish(stopped)
    assert progress(stopped) == progress(expected)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM)])
def test_a_second_signal_stops_at_once(begin, tmp_path, number, status):
    stopped, log = tmp_path / "stopped", tmp_path / "log"
    running = begin(stopped, log, wait_s=300.0)
    wait_for(log, running)
    ask(running, number)
    time.sleep(AGAIN_AFTER_S + 0.5)
    assert running.is_alive()
    ask(running, number)
    running.join(30)
    assert running.exitcode == status
    assert not checkpoints(stopped)
    if number == signal.SIGINT:
        assert log.read_text().splitlines()[-1].startswith("interrupted: no checkpoint yet")


def test_what_comes_before_the_first_iteration_is_not_waited_for(start, tmp_path, monkeypatch, capsys):
    """There is nothing to save, and loading, compiling and the first evaluation take minutes."""

    def evaluated(*_: object) -> dict[str, float]:
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("not stopped")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(pipeline, "evaluate", evaluated)
    monkeypatch.setattr(pipeline, "make_decision_env", lambda env, num_envs, *rest: ReachEnv(num_envs))
    monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *flags(start, tmp_path / "run")])
    try:
        assert main() == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err.splitlines()[-1].startswith("interrupted: no checkpoint yet")


def test_ranks_stop_together_when_one_of_them_is_asked(begin, tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    stopped, logs = tmp_path / "stopped", [tmp_path / f"log{rank}" for rank in range(2)]
    shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": port}
    running = [
        begin(stopped, log, 1.0, RANK=str(rank), LOCAL_RANK=str(rank), **shared)
        for rank, log in enumerate(logs)
    ]
    wait_for(logs[1], *running)
    ask(running[1], signal.SIGTERM)
    for child in running:
        child.join(30)
    assert [child.exitcode for child in running] == [143, 143], [log.read_text() for log in logs]
    assert checkpoints(stopped) == ["000002", "last"]
    state = stopped / "checkpoints" / "000002" / "training_state" / "dppo_state.safetensors"
    assert len(load_state(state)["ranks"]) == 2
