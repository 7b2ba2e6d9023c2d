"""Processes that have imported what takes LeRobot seconds to import, but neither LeRobot nor this package.

This file as a program is the first of them; each line that it reads starts a copy of it, which runs some code
as ``python -c`` does.
"""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Generator
from pathlib import Path

IMPORTED = ("av", "cv2", "datasets", "draccus", "gymnasium", "rich.progress", "torch._dynamo", "torchvision")
IMPORTED += ("scipy.optimize", "scipy.signal", "scipy.spatial.transform", "scipy.stats")


class LoadedProcess:
    """What copies can be made of."""

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        self._process, self._folder = process, folder

    def run(
        self, code: str, *arguments: str, cwd: Path = Path(), **environment: str
    ) -> subprocess.CompletedProcess[str]:
        """Run code in a copy, whose environment has these variables, too."""
        output, errors = self._folder / "output", self._folder / "errors"
        order = {"code": code, "arguments": arguments, "environment": environment, "cwd": str(cwd.resolve())}
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(order | {"files": [str(output), str(errors)]}), file=self._process.stdin, flush=True)
        status = int(self._process.stdout.readline())
        return subprocess.CompletedProcess([code, *arguments], status, output.read_text(), errors.read_text())


@contextlib.contextmanager
def loaded_process(folder: Path) -> Generator[LoadedProcess]:
    """Start it, offline and without a cache of its own; it ends with the block."""
    environment = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(folder), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, "-P", __file__],
        env=os.environ | environment | {"CUDA_VISIBLE_DEVICES": ""},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield LoadedProcess(process, folder)


def main() -> None:
    """Make copies until there are no more lines; returns in the copies, too."""
    for module in IMPORTED:
        __import__(module)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            begin(json.loads(line))
            return
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def begin(order: dict) -> None:
    """In a copy: what the order says; an error or an exit ends the process as it ends any other."""
    for number, name in enumerate((os.devnull, *order["files"])):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
    os.environ.update(order["environment"])
    os.chdir(order["cwd"])
    sys.path.insert(0, "")
    sys.argv[:] = ["-c", *order["arguments"]]
    exec(order["code"], {"__name__": "__main__"})


if __name__ == "__main__":
    main()
