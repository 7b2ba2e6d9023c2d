"""The ages of pads are one column, a value per pad in the order of the pads' columns.

The robot `tactile` sorts its pads by name. It had taken them in the order of the pads file, which is that of
the columns of what was recorded then, and of what is added when such a recording is resumed.
"""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.datasets.features import TACTILE, TACTILE_AGE, TACTILE_PREFIX


def ordered_ages(columns: Iterable[str], values: Mapping[str, Any]) -> NDArray[np.float32]:
    """A robot's ages (P,) [s] in the order of a dataset's columns; as they are where it has other pads.

    Args:
        columns: Of the dataset.
        values: The robot's observation, whose pads are in the order of its ages.
    """
    ages = np.asarray(values[TACTILE_AGE])
    order = _order(tuple(columns), tuple(values))
    return ages if ages.shape != (len(order),) else ages[list(order)]


@lru_cache(maxsize=8)
def _order(columns: tuple[str, ...], values: tuple[str, ...]) -> tuple[int, ...]:
    """The place among a robot's pads of every column's; none where it has other pads. Once for a recording:
    names are the same in every frame."""
    own = [key.removeprefix(f"{TACTILE}.") for key in values if key.startswith(f"{TACTILE}.")]
    wanted = [key.removeprefix(TACTILE_PREFIX) for key in columns if key.startswith(TACTILE_PREFIX)]
    return tuple(own.index(pad) for pad in wanted) if sorted(own) == sorted(wanted) else ()
