"""``vtrefine-finetune`` killed before each of its file operations, then resumed: nothing is lost or doubled.

The command runs in a forked child, which an audit hook kills with SIGKILL: buffers are not flushed, nothing
is tidied up.
"""

import multiprocessing
import os
import shutil
import signal
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from tiny_policy import ReachEnv, save_tiny_checkpoint

from lerobot_vtrefine.cli.finetune import main
from lerobot_vtrefine.finetune import logger, pipeline
from lerobot_vtrefine.finetune.logger import CLOCK

FLAGS = (
    "--env.type=vtrefine",
    "--eval.n_episodes=2",
    "--eval_freq=1",
    "--save_freq=1",
    "--dppo.type=small",
    "--dppo.num_envs=2",
    "--dppo.epochs=1",
    "--dppo.minibatch_decisions=6",
    "--dppo.critic_width=8",
    "--dppo.critic_warmup=1",
    "--resume=true",
)
CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.truncate")


def is_change(event: str, arguments: tuple, folder: str) -> bool:
    """Whether an audit event changes something in a folder."""
    if event == "open":
        path, _, flags = arguments
        return str(path).startswith(folder) and bool(flags & (os.O_WRONLY | os.O_RDWR))
    return event in CHANGES and any(str(item).startswith(folder) for item in arguments[:2])


def run_and_die(arguments: list[str], folder: Path, when: int | tuple[str, str]) -> None:
    """In a child: run the command and be killed before its `when`-th change of the folder, from 0 on, or
    before the first of an event and a name.
    """
    count = 0

    def hook(event: str, arguments: tuple) -> None:
        nonlocal count
        if is_change(event, arguments, str(folder)):
            path = arguments[1] if event == "os.symlink" else arguments[0]
            if when in (count, (event, Path(path).name)):
                os.kill(os.getpid(), signal.SIGKILL)
            count += 1

    sys.addaudithook(hook)
    sys.argv = ["vtrefine-finetune", *arguments]
    os._exit(main())


@pytest.fixture(autouse=True)
def one_thread():
    """A forked child has none of its parent's OpenMP threads, and would wait for them for ever."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Runs the command into a folder, in this process; with an operation, in one that is killed before it.

    Returns True where it was killed, and False where it came to its end.
    """
    start = save_tiny_checkpoint(tmp_path / "start")
    monkeypatch.setattr(pipeline, "make_decision_env", lambda env, num_envs, *rest: ReachEnv(num_envs))
    monkeypatch.setattr(logger, "draw_curves", lambda rows, path: path.write_text(str(len(rows))))

    def run(output: Path, iterations: int, when: int | tuple[str, str] | None = None) -> bool:
        named = [f"--policy.path={start}", f"--output_dir={output}", f"--dppo.iterations={iterations}"]
        if when is None:
            monkeypatch.setattr("sys.argv", ["vtrefine-finetune", *named, *FLAGS])
            assert main() == 0
            return False
        child = multiprocessing.get_context("fork").Process(
            target=run_and_die, args=([*named, *FLAGS], output, when)
        )
        child.start()
        child.join()
        assert child.exitcode in (0, -signal.SIGKILL)
        return child.exitcode != 0

    return run


def weights(output: Path) -> dict[str, torch.Tensor]:
    return load_file(output / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")


def progress(output: Path) -> list[str]:
    """The lines of progress.csv as they are written, without the columns that measure the machine."""
    header, *lines = (line.split(",") for line in (output / "progress.csv").read_text().splitlines())
    kept = [index for index, name in enumerate(header) if name not in CLOCK]
    return [",".join(cells[index] for index in kept) for cells in [header, *lines]]


@pytest.fixture
def uninterrupted(command, tmp_path):
    """A run of two iterations, and what is there of it before the checkpoint of the second, or of both."""
    whole = tmp_path / "whole"
    command(whole, 2)

    def begun(output: Path, checkpoints: int) -> Path:
        if checkpoints:
            shutil.copytree(whole, output, symlinks=True)
            shutil.rmtree(output / "checkpoints" / "000002")
            (output / "checkpoints" / "last").unlink()
            (output / "checkpoints" / "last").symlink_to("000001")
        return output

    return whole, begun


@pytest.fixture
def check_resumed(command, uninterrupted, monkeypatch):
    """Resumes a killed run and compares it with the uninterrupted one."""
    whole, _ = uninterrupted
    expected, rows = weights(whole), progress(whole)
    started_at: list[int] = []
    train = pipeline.train

    def watched(env, agent, state, *rest, **named):
        started_at.append(state.iteration)
        return train(env, agent, state, *rest, **named)

    def check(killed: Path, when: object) -> None:
        complete = [int(path.name) for path in (killed / "checkpoints").glob("*") if path.name.isdigit()]
        monkeypatch.setattr(pipeline, "train", watched)
        started_at.clear()
        command(killed, 2)
        assert started_at == [max(complete, default=0)], when
        assert progress(killed) == rows, when
        found = weights(killed)
        assert expected.keys() == found.keys()
        assert all(torch.equal(expected[key], found[key]) for key in expected), when
        assert not list(killed.rglob("*.part*")), when

    return check


@pytest.mark.parametrize(
    ("checkpoints", "when"),
    [
        (0, ("open", "progress.csv.part")),
        (0, ("os.mkdir", "checkpoints")),  # with two rows recorded
        (0, ("os.rename", "000001.partial")),
        (0, ("os.symlink", "last.partial")),
        (1, ("os.rename", "000002.partial")),
        (1, ("os.symlink", "last.partial")),
        (1, ("os.rename", "last.partial")),
    ],
)
def test_a_killed_run_ends_as_one_that_was_not(
    command, uninterrupted, check_resumed, tmp_path, checkpoints, when
):
    killed = uninterrupted[1](tmp_path / "killed", checkpoints)
    assert command(killed, 2, when)
    check_resumed(killed, when)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("checkpoints", [0, 1])
def test_a_run_killed_before_any_file_operation(command, uninterrupted, check_resumed, tmp_path, checkpoints):
    for operation in range(300):
        killed = uninterrupted[1](tmp_path / f"killed_{operation}", checkpoints)
        if not command(killed, 2, operation):
            break
        check_resumed(killed, operation)
        shutil.rmtree(killed)
    assert operation > 20
