"""Two recordings in one folder: the second is turned away, and the first loses nothing."""

import os
import signal
import socket
import warnings
from collections.abc import Generator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from file_faults import in_fork
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_vtrefine.lerobot_compat import safe_recording
from lerobot_vtrefine.lerobot_compat.claim import Claim

FEATURES = {
    "action": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]},
    "observation.images.front_depth": {
        "dtype": "image",
        "shape": (4, 6, 1),
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True},
    },
}


@pytest.fixture(autouse=True)
def safe() -> Generator[None]:
    safe_recording.install()
    yield
    safe_recording.uninstall()


def add(dataset: LeRobotDataset, value: int) -> None:
    for _ in range(3):
        depth = np.full((4, 6, 1), value, np.uint16)
        action = np.full(2, value, np.float32)
        dataset.add_frame({"action": action, "observation.images.front_depth": depth, "task": "insert"})


def resume(root: Path) -> LeRobotDataset:
    return LeRobotDataset.resume("local/x", root=root)


def test_a_running_recording_is_left_alone(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    running = LeRobotDataset.create("local/x", 10, FEATURES, root=root, use_videos=False)
    add(running, 1)
    with pytest.raises(ValueError, match=r"another recording goes on in .*dataset: end it first, or choose"):
        resume(root)
    running.save_episode()
    running.finalize()
    later = resume(root)
    with pytest.raises(ValueError, match="another recording goes on"):
        resume(root)
    add(later, 2)
    later.save_episode()
    later.finalize()
    kept = LeRobotDataset("local/x", root=root)
    assert [kept[index]["action"][0].item() for index in range(len(kept))] == [1, 1, 1, 2, 2, 2]


def test_a_killed_recording_holds_nothing(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    running = LeRobotDataset.create("local/x", 10, FEATURES, root=root, use_videos=False)
    running.finalize()

    def killed() -> None:
        add(resume(root), 1)
        os.kill(os.getpid(), signal.SIGKILL)

    assert in_fork(killed) == -signal.SIGKILL
    resume(root).finalize()


def test_a_process_that_outlives_the_recording_holds_nothing(tmp_path: Path) -> None:
    """As those that write images, when the recording is killed."""
    claim = Claim(tmp_path)
    ours, its = socket.socketpair()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which the child does not use
        child = os.fork()
    if child == 0:
        its.send(b"I live")
        its.recv(1)
        os._exit(0)
    ours.recv(6)
    claim.close()
    with closing(Claim(tmp_path)), pytest.raises(ValueError, match="another recording"):
        Claim(tmp_path)
    ours.send(b".")
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    for end in (ours, its):
        end.close()
