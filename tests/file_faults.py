"""Kills a piece of work at each of its file operations, in forked processes."""

import builtins
import io
import os
import shutil
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from lerobot_vtrefine import folders

KILLED = 99
MODULES = (
    (os, ("mkdir", "rmdir", "rename", "replace", "unlink", "remove", "link", "symlink", "fsync")),
    (shutil, ("copyfile", "copy2")),
    (folders, ("_exchange",)),
    (pq.ParquetWriter, ("__init__", "write_table", "close")),
)


def _kill_before(patch: pytest.MonkeyPatch, at: int) -> None:
    """From now on, before file operation ``at`` the process ends, as by SIGKILL.

    Opening a file for writing counts twice: before it, and when the file is empty and nothing written yet.
    """
    done = 0

    def step() -> None:
        nonlocal done
        if done == at:
            os._exit(KILLED)
        done += 1

    def counted(original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            step()
            return original(*args, **kwargs)

        return call

    def opening(original: Callable[..., Any]) -> Callable[..., Any]:
        def call(file: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
            if not set(mode) & set("wxa+"):
                return original(file, mode, *args, **kwargs)
            step()
            opened = original(file, mode, *args, **kwargs)
            step()
            return opened

        return call

    for module, names in MODULES:
        for name in names:
            patch.setattr(module, name, counted(getattr(module, name)))
    wrapped = opening(io.open)
    patch.setattr(io, "open", wrapped)
    patch.setattr(builtins, "open", wrapped)


def in_fork(work: Callable[[], object]) -> int:
    """Exit status of a forked process that does ``work``: 0, 1 after an exception, or ``KILLED``."""
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", DeprecationWarning
        )  # of threads, which rest while nothing is simulated
        child = os.fork()
    if child == 0:
        status = 1
        try:
            work()
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at_each(
    prepare: Callable[[], object], work: Callable[[], object], stride: int = 1
) -> Iterator[int]:
    """Yield after each time that ``work``, prepared anew, was killed before every ``stride``-th operation."""
    at = 0
    while True:
        prepare()

        def doomed(at: int = at) -> None:
            with pytest.MonkeyPatch.context() as patch:
                _kill_before(patch, at)
                work()

        status = in_fork(doomed)
        if status == 0:
            return
        assert status == KILLED
        yield at
        at += stride


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below ``folder`` and its bytes; empty without one."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
