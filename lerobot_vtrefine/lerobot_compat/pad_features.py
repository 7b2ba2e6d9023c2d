"""Pads as robot features: arrays that stock `lerobot-record` carries through."""

from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.datasets.features import BASELINE, TACTILE, TACTILE_AGE, taxel_info
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.pads_file import load_pads
from lerobot_vtrefine.lerobot_compat.arrays import ArraySpec

Observation = dict[str, Any]


def configured_pads(pads: dict[str, PadConfig], pads_file: Path | None) -> dict[str, PadConfig]:
    """The robot's pads, from its configuration or from the pads file.

    Raises:
        ValueError: neither or both are given.
    """
    if bool(pads) == (pads_file is not None):
        raise ValueError(
            "give the pads either by --robot.pads_file=FILE (vtrefine-find-pads writes it) "
            "or by --robot.pads='{NAME: {port: /dev/...}}'"
        )
    return pads if pads_file is None else load_pads(pads_file)


def pad_features(pads: dict[str, PadConfig]) -> dict[str, ArraySpec]:
    """Features of the pads' counts, idle counts and ages."""
    features: dict[str, ArraySpec] = {}
    for kind in (TACTILE, BASELINE):
        for name, pad in pads.items():
            shape = (int(np.prod(pad.pad_shape)),)
            features[f"{kind}.{name}"] = ArraySpec(shape, "uint8", taxel_info(*pad.pad_shape))
    features[TACTILE_AGE] = ArraySpec((len(pads),), "float32")
    return features
