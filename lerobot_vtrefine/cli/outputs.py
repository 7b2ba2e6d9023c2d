"""Results of a command: all files at once or none, and no earlier ones replaced without being asked to."""

import os
import shutil
import tempfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def staged(output_dir: Path, names: Sequence[str], *, overwrite: bool) -> Generator[Path]:
    """A temporary folder for the files ``names``; they move to ``output_dir`` when the block ends well.

    Raises:
        FileExistsError: a file of these names is there already and ``overwrite`` is not set.
        NotADirectoryError: ``output_dir`` is a file.
    """
    if output_dir.exists() and not output_dir.is_dir():
        raise NotADirectoryError(f"--output_dir={output_dir} is a file; name a folder")
    present = [name for name in names if (output_dir / name).exists()]
    if present and not overwrite:
        raise FileExistsError(
            f"{output_dir / present[0]} exists; choose another --output_dir or add --overwrite to replace it"
        )
    created = not output_dir.exists()
    output_dir.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=".partial-", dir=output_dir))
    try:
        yield folder
        for name in names:
            (output_dir / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(folder / name, output_dir / name)  # noqa: PTH105  atomic on one file system, and says so
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if created and not any(output_dir.iterdir()):
            output_dir.rmdir()
