"""Where a recording set lies."""

from pathlib import Path

HEADER = "recording.json"


def header_of(folder: Path) -> Path:
    """Its recording.json.

    Raises:
        NotADirectoryError: ``folder`` is a file.
        ValueError: it is a LeRobot dataset.
        FileNotFoundError: there is no recording.json.
    """
    path = folder / HEADER
    if folder.is_file():
        raise NotADirectoryError(f"{folder} is a file; name the folder with {HEADER}")
    if path.is_file():
        return path
    if (folder / "meta" / "info.json").is_file():
        raise ValueError(f"{folder} is a LeRobot dataset; a recording set is a folder with {HEADER}")
    raise FileNotFoundError(f"{path}: no such file; a recording set is a folder with {HEADER}")
