"""Which code, command and machine a run had, for the files that it leaves."""

import json
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

from lerobot_vtrefine.cores import usable_cores

FILE_NAME = "provenance.json"
PACKAGE = Path(__file__).parents[2]
FOLDERS = re.compile(r"(?<![\w.])/(?:[^/\s'\"=,]+/)+")


@cache
def commit() -> str | None:
    """The checkout's commit, with ``+`` where files differ from it; None outside a checkout."""
    if _git("ls-files", "--error-unmatch", "__init__.py") is None:  # installed, maybe below another project
        return None
    return _git("describe", "--always", "--dirty=+", "--exclude=*", "--abbrev=7")


def _git(*arguments: str) -> str | None:
    """What git prints about the package's folder; None where it fails or is not installed."""
    try:
        done = subprocess.run(["git", "-C", str(PACKAGE), *arguments], capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.decode().strip()


def command() -> str:
    """This process's command line; absolute folders are cut, so that it names no machine."""
    line = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return FOLDERS.sub(".../", line)


def machine() -> str:
    """Cores and GPUs that this process may use, for example ``16 cores, 1 x NVIDIA H200``."""
    import torch

    gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    return ", ".join(
        [f"{usable_cores()} cores", *(f"{gpus.count(name)} x {name}" for name in dict.fromkeys(gpus))]
    )


def provenance() -> dict[str, str | None]:
    """``commit``, ``command`` and ``machine`` of this process."""
    return {"commit": commit(), "command": command(), "machine": machine()}


def write_provenance(folder: Path) -> None:
    """Leave ``provenance.json`` in a run's folder; the one of the process that finished the run stays."""
    path = folder / FILE_NAME
    if not path.exists():
        path.write_text(json.dumps(provenance(), indent=2) + "\n", encoding="utf-8")
