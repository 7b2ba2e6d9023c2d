"""Per-episode metrics as JSON lines, readable after a stock ``lerobot-eval``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.files import decode, limits, read_json_lines


@dataclass(frozen=True)
class _Episode:
    """What every line has; measurements come beside it."""

    success: bool
    seed: int = limits(0, 2**63)
    steps: int = limits(0, 1e9)
    failure: str | None = None


@dataclass(frozen=True)
class _Values:
    values: dict[str, float | bool | str | None]


def episode_rows(columns: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """One plain dict per finished episode from columns of length m."""
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, map(_plain, row), strict=True)) for row in rows]


def _plain(value: Any) -> Any:
    """NaN (not measured, e.g. time to success of a failure) becomes null: JSON has no NaN."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


class EpisodeLog:
    """Appends one line per finished episode; several processes may share the file (O_APPEND)."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)

    def append(self, rows: list[dict[str, Any]]) -> None:
        """Write ``rows``, one JSON object a line, in one write; on a full disk, none of them.

        Half a line would take the first row of the next evaluation with it, and leave a file that cannot be
        read.
        """
        data, written = "".join(json.dumps(row) + "\n" for row in rows).encode(), 0
        with self.path.open("ab", buffering=0) as file:
            try:
                while written < len(data):
                    written += file.write(data[written:])
            except OSError as error:
                file.truncate(file.tell() - written)
                raise OSError(error.errno, error.strerror, str(self.path)) from error


def read_episode_log(path: Path, first_seed: int, num_episodes: int) -> list[dict[str, Any]]:
    """The rows of seeds ``first_seed .. first_seed + num_episodes - 1``, the latest run of each.

    ``lerobot-eval`` fills its last batch with surplus episodes, which this drops.

    Raises:
        FileNotFoundError: if there is no file at ``path``.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"no episode metrics at {path}; evaluate with --env.metrics_path={path}")
    by_seed = {}
    for number, row in enumerate(read_json_lines(path), start=1):
        try:
            by_seed[decode(_Episode, row, "it", others=True).seed] = row
            decode(_Values, {"values": row}, "it")
        except ValueError as error:
            raise ValueError(f"{path}: entry {number} is not an episode: {error}") from error
    wanted = range(first_seed, first_seed + num_episodes)
    return [by_seed[seed] for seed in wanted if seed in by_seed]
