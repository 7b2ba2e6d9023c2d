"""Processes that have imported what takes LeRobot seconds to import, but neither LeRobot nor this package.

This file as a program is the first of them; each line that it reads starts a copy of it, which runs some code
as ``python -c`` does.
"""

import atexit
import contextlib
import gc
import json
import os
import subprocess
import sys
import traceback
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
    """Start it, offline and with an empty cache; it ends with the block."""
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
    """Make copies until there are no more lines."""
    for module in IMPORTED:
        __import__(module)
    gc.freeze()
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            status = obey(json.loads(line))
            atexit._run_exitfuncs()
            sys.stdout.flush()
            os._exit(status)  # to take everything apart that was imported would take longer than most orders
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def obey(order: dict) -> int:
    """In a copy: run what the order says; the exit status, as Python has it."""
    for number, name in enumerate((os.devnull, *order["files"])):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
    os.environ.update(order["environment"])
    os.chdir(order["cwd"])
    sys.path.insert(0, "")
    sys.argv[:] = ["-c", *order["arguments"]]
    try:
        exec(order["code"], {"__name__": "__main__"})
    except SystemExit as stop:
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    main()
