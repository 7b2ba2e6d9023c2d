"""Folders that appear or change as a whole: a crash, a kill or a full disk leaves the old one or the new one.

Files that belong together are written into a folder beside their place (``beside``), which then takes that
place in one step (``put_in_place``). Linux exchanges two folders atomically; on file systems that cannot, the
old folder is moved aside first, and ``recover`` moves it back if the process died between the two renames.
"""

import ctypes
import errno
import glob
import os
import shutil
import stat
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

AT_FDCWD = -100
RENAME_EXCHANGE = 2
CANNOT_EXCHANGE = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EPERM)
CANNOT_SYNC = (errno.EINVAL, errno.ENOTSUP)
CANNOT_LINK = (errno.EPERM, errno.ENOTSUP, errno.EMLINK, errno.EXDEV, errno.ENOSYS)


@contextmanager
def beside(target: Path) -> Generator[Path]:
    """An empty folder in the one of ``target``, on its file system; removed, with what is in it, at the end.

    Those that killed processes left for ``target`` are removed first.

    Raises:
        ValueError, PermissionError, NotADirectoryError: as `check_replaceable`.
        OSError: no folder can be made where ``target`` lies; names it.
    """
    check_replaceable(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    recover(target)
    work = working_folder(target)
    try:
        _make(work, target)
        yield work
    finally:
        recover(target)


def _make(work: Path, target: Path) -> None:
    try:
        work.mkdir()
    except OSError as error:  # its name of the folder means nothing to who asked for the target
        reason = f"no folder can be made in {target.parent} ({error.strerror})"
        raise OSError(error.errno, reason, str(target)) from error


def working_folder(target: Path) -> Path:
    """Where this process prepares the next ``target``."""
    return target.with_name(f".{target.name}.partial-{os.getpid()}")


def check_replaceable(target: Path) -> None:
    """Raise where a folder cannot take the place of ``target``.

    Raises:
        OSError: as `check_place`.
        ValueError: ``target`` is mounted, holds this process or is the root of all folders.
    """
    if target.absolute() == target.absolute().parent:
        raise ValueError(f"{target} cannot be written as a whole; name a folder inside of it")
    check_place(target)
    if not target.exists():
        return
    reason = None
    if Path.cwd().is_relative_to(target):
        reason = "this command runs in it"
    elif target.is_mount():
        reason = "something is mounted there"
    if reason is not None:
        raise ValueError(f"{target} cannot be written as a whole: {reason}; name a folder inside of it")


def check_place(target: Path) -> None:
    """Raise where no folder ``target`` can be made.

    Raises:
        PermissionError: the folder that it lies in, or would, cannot be written to.
        NotADirectoryError: that is a file.
    """
    above = next(folder for folder in target.absolute().parents if folder.exists())
    if not above.is_dir():
        raise NotADirectoryError(f"{target} cannot be written: {above} is a file")
    if not os.access(above, os.W_OK | os.X_OK):
        raise PermissionError(f"{target} cannot be written: {above} is read-only; choose another folder")


def recover(target: Path) -> None:
    """Undo what this process, or one that is gone, began with ``target``; remove what it left beside it."""
    previous = _previous(target)
    if previous.exists() and not target.exists():
        previous.rename(target)
    shutil.rmtree(previous, ignore_errors=True)
    for left in target.parent.glob(f".{glob.escape(target.name)}.partial-*"):
        owner = left.name.rpartition("-")[2]
        if owner == str(os.getpid()) or not (owner.isdecimal() and _is_alive(int(owner))):
            shutil.rmtree(left, ignore_errors=True)


def put_in_place(work: Path, target: Path, whole: Sequence[str] = ()) -> None:
    """Make ``work`` the new ``target`` in one step; the old one is removed.

    What only the old one holds, such as a user's own files, is carried over, but for that in its folders
    ``whole``.
    """
    if target.is_dir():
        left_out = [str(target / name) for name in whole]

        def ignore(folder: str, names: list[str]) -> list[str]:
            return [name for name in names if str(Path(folder, name)) in left_out]

        shutil.copytree(
            target, work, symlinks=True, ignore=ignore, copy_function=_link_missing, dirs_exist_ok=True
        )
    flush(work)
    if not target.is_dir():
        work.rename(target)
    elif not _exchange(work, target):
        previous = _previous(target)
        target.rename(previous)
        work.rename(target)
        work = previous
    sync(target.parent)
    shutil.rmtree(work, ignore_errors=True)


def write_in_place(target: Path, name: Path, text: str) -> None:
    """Replace the text file ``name`` of the folder ``target``, whole or not at all."""
    with beside(target) as work:
        part = work / name.name
        part.write_text(text, encoding="utf-8")
        sync(part)
        part.replace(target / name)


def link_or_copy(source: str, target: str) -> None:
    """Give a file a second name; a copy where the file system has one name a file."""
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError as error:
        if error.errno not in CANNOT_LINK:
            raise
        shutil.copy2(source, target, follow_symlinks=False)


def _link_missing(source: str, target: str) -> None:
    if not os.path.lexists(target):
        link_or_copy(source, target)


def _previous(target: Path) -> Path:
    return target.with_name(f".{target.name}.previous")


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _exchange(one: Path, other: Path) -> bool:
    """Let two folders change places atomically; False where the system cannot."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    if rename(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in CANNOT_EXCHANGE:
        return False
    raise OSError(number, os.strerror(number), str(other))


def flush(folder: Path) -> None:
    """Let everything in ``folder`` reach the disk, so that it is whole after a power failure, too.

    Files with a second name were flushed under the first.
    """
    for path in folder.rglob("*"):
        status = path.lstat()
        if stat.S_ISDIR(status.st_mode) or (stat.S_ISREG(status.st_mode) and status.st_nlink == 1):
            sync(path)
    sync(folder)


def sync(path: Path) -> None:
    """Wait until a file's contents or a folder's names are on the disk.

    Folders of some file systems, such as those that a virtual machine shares, cannot be waited for.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in CANNOT_SYNC or not path.is_dir():
            raise
    finally:
        os.close(descriptor)
