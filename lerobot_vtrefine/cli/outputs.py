"""Results of a command: all files at once or none, and no earlier ones replaced without being asked to."""

import tempfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from lerobot_vtrefine.folders import beside, check_replaceable, put_in_place, recover

OVERWRITE = "--overwrite=true"
"""As LeRobot's parser takes it; ours takes --overwrite alone."""


@contextmanager
def staged(
    output_dir: Path, names: Sequence[str], *, overwrite: bool, flag: str = "--overwrite"
) -> Generator[Path]:
    """A temporary folder for the files ``names``; when the block ends well, it becomes ``output_dir``.

    The folder changes as a whole, so that no result is ever seen beside one of another run. Other files that
    are there stay. ``flag`` is how ``overwrite`` is set.

    Raises:
        FileExistsError: a file of these names is there already and ``overwrite`` is not set.
        NotADirectoryError: ``output_dir`` is a file.
        ValueError: it is a folder that cannot be replaced as a whole, such as a mounted one.
    """
    if output_dir.exists() and not output_dir.is_dir():
        raise NotADirectoryError(f"--output_dir={output_dir} is a file; name a folder")
    target = output_dir.resolve()
    check_replaceable(target)
    recover(target)
    present = [name for name in names if (target / name).exists()]
    if present and not overwrite:
        raise FileExistsError(
            f"{output_dir / present[0]} exists; choose another --output_dir or add {flag} to replace it"
        )
    with beside(target) as folder:
        yield folder
        put_in_place(folder, target)


def check_file(flag: str, path: Path) -> None:
    """Raise OSError with the flag where a file cannot be written, before the work for it is done."""
    if path.is_dir():
        raise IsADirectoryError(f"{flag}={path} is a folder; name a file in it")
    _try(path.parent, f"{flag}={path}")


def check_new_file(flag: str, path: Path, *, overwrite: bool = False, how: str | None = None) -> None:
    """As `check_file`; and no file that is there is replaced without ``overwrite``, which ``how`` sets.

    Raises:
        FileExistsError: it is there; or another OSError of `check_file`.
    """
    check_file(flag, path)
    if path.exists() and not overwrite:
        raise FileExistsError(
            f"{path} exists; choose another {flag}" + (f" or add {how} to replace it" if how else "")
        )


def check_folder(flag: str, path: Path) -> None:
    """Raise OSError with the flag where no file can be written into a folder; make it where there is none."""
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(f"{flag}={path} is a file; name a folder")
    _try(path, f"{flag}={path}")


def _try(folder: Path, told: str) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (FileExistsError, NotADirectoryError):  # part of the way to it
        raise NotADirectoryError(f"{told} cannot be written: {folder} is not a folder") from None
    except OSError as error:
        raise OSError(error.errno, error.strerror, told) from error
