"""What others' datasets hold beside the pads is taken over as it is, if it is what LeRobot writes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.files import read_json
from lerobot_vtrefine.files.schema import LARGEST_NUMBER

STATISTICS = ("min", "max", "mean", "std", "count")
"""What LeRobot keeps of every feature; quantiles may come beside it."""


def read_stats(root: Path, features: Sequence[str]) -> dict[str, dict[str, Array]]:
    """``meta/stats.json`` of the features that there are; nothing where there is no such file.

    Raises:
        ValueError: names the feature whose statistics are missing, or are not numbers.
    """
    path = root / "meta" / "stats.json"
    if not path.is_file():
        return {}
    content = read_json(path)
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold statistics by feature")
    found = {}
    for key in features:
        if key not in content:
            continue
        values = content[key]
        if not isinstance(values, dict) or not set(STATISTICS) <= set(values):
            raise ValueError(f"{path}: {key} needs {', '.join(STATISTICS)}")
        found[key] = {name: _numbers(f"{path}: {key}.{name}", value) for name, value in values.items()}
        sizes = {name: array.shape for name, array in found[key].items() if name != "count"}
        if len(set(sizes.values())) > 1:
            raise ValueError(f"{path}: statistics of {key} differ in shape: {sizes}")
    return found


def check_frames(path: Path, table: pa.Table, only: str = "") -> None:
    """ValueError where a column of numbers, its name beginning with ``only``, has gaps or is not finite."""
    for name in table.column_names:
        if not name.startswith(only):
            continue
        values: Any = table[name].combine_chunks()
        while pa.types.is_nested(values.type) and not pa.types.is_struct(values.type):
            if values.null_count:
                raise ValueError(f"{path}: column {name[:60]!a} has empty rows")
            values = (values.storage if isinstance(values, pa.ExtensionArray) else values).flatten()
        number = pa.types.is_integer(values.type) or pa.types.is_floating(values.type)
        if only and not number:
            raise ValueError(f"{path}: column {name[:60]!a} must hold numbers, not {values.type}")
        if number and (values.null_count or not np.isfinite(values.to_numpy(zero_copy_only=False)).all()):
            raise ValueError(f"{path}: column {name[:60]!a} holds a value that is not a finite number")


def _numbers(where: str, value: Any) -> Array:
    rows: list[Any] = [value]
    while any(isinstance(item, list) for item in rows):
        rows = [inner for item in rows for inner in (item if isinstance(item, list) else [None])]
    if not rows or not all(isinstance(item, int | float) and not isinstance(item, bool) for item in rows):
        raise ValueError(f"{where} must hold numbers")
    if max(map(abs, rows)) > LARGEST_NUMBER:
        raise ValueError(f"{where} must be at most {LARGEST_NUMBER:g}")
    try:
        return np.asarray(value, float)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{where} must hold equally long rows of numbers") from error
