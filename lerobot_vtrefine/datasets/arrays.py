"""Carries array features of robots through LeRobot's stock recording code: the one module that extends it.

LeRobot 0.6.1's datasets hold any array, but the code between robot and dataset passes only float scalars
(merged into `observation.state`) and images. `install` replaces the two functions that decide this by ones
that also know `ArraySpec`, and leave every other feature to LeRobot's own. Robots with arrays call it when
they are made; commands with other robots stay untouched. Stored datasets are plain LeRobot datasets, and
readers need none of this.

Arrays are stored flat, one 1-D column each: two-dimensional columns break `lerobot-edit-dataset`. They carry
no `names`: LeRobot would rebuild such features and drop their `info`.
"""

import functools
import inspect
import logging
import sys
from collections.abc import Callable
from typing import Any, Self

import numpy as np

from lerobot_vtrefine.datasets.lerobot_version import FIRST_SUPPORTED, FIRST_UNSUPPORTED, is_supported

logger = logging.getLogger(__name__)

Features = dict[str, dict[str, Any]]

SIGNATURES = {
    "hw_to_dataset_features": ("hw_features", "prefix", "use_video"),
    "build_dataset_frame": ("ds_features", "values", "prefix"),
}
"""Functions of `lerobot.utils.feature_utils` that are replaced, and the parameters they must have."""


class ArraySpec(tuple[int, ...]):
    """Declares an array in a robot's `observation_features`; the observation's value is a 1-D array.

    It is the tuple of the array's shape, as LeRobot expects of anything that is not a float.

    Attributes:
        dtype: numpy dtype name of the stored column.
        info: Static facts kept with the feature, such as the two-dimensional shape and the unit. LeRobot
            refuses to merge datasets whose info differs: keep what varies between sessions in columns of its
            own.
    """

    dtype: str
    info: dict[str, Any]

    def __new__(cls, shape: tuple[int, ...], dtype: str, info: dict[str, Any] | None = None) -> Self:
        """Raises ValueError unless the shape is one-dimensional."""
        if len(shape) != 1:
            raise ValueError(f"arrays are stored flat: shape must be one-dimensional, got {tuple(shape)}")
        spec = super().__new__(cls, shape)
        spec.dtype = np.dtype(dtype).name
        spec.info = dict(info or {})
        return spec

    def __getnewargs__(self) -> tuple[tuple[int, ...], str, dict[str, Any]]:
        return tuple(self), self.dtype, self.info

    def feature(self) -> dict[str, Any]:
        """The dataset feature."""
        return {"dtype": self.dtype, "shape": tuple(self)} | ({"info": dict(self.info)} if self.info else {})


def array_features(hw_features: dict[str, Any], prefix: str) -> Features:
    """Dataset features of the arrays among a robot's features."""
    return {f"{prefix}.{key}": v.feature() for key, v in hw_features.items() if isinstance(v, ArraySpec)}


def is_array_feature(feature: dict[str, Any]) -> bool:
    """Whether a dataset feature is an array of ours: numeric, 1-D, without names."""
    numeric = feature["dtype"] not in ("image", "video", "string", "language")
    return numeric and len(feature["shape"]) == 1 and not feature.get("names")


def array_frame(ds_features: Features, values: dict[str, Any], prefix: str) -> dict[str, Any]:
    """One frame of the array features.

    Raises:
        ValueError: a value is missing or has another size; the message names the feature.
    """
    frame: dict[str, Any] = {}
    for key, feature in ds_features.items():
        name = key.removeprefix(f"{prefix}.")
        if name not in values:
            raise ValueError(f"the robot's observation lacks {name!r}, which the dataset stores as {key!r}")
        value = np.asarray(values[name])
        if value.shape != tuple(feature["shape"]):
            raise ValueError(
                f"{name!r} has shape {value.shape}, the dataset stores {tuple(feature['shape'])}"
            )
        frame[key] = value.astype(feature["dtype"], copy=False)
    return frame


def install() -> None:
    """Makes LeRobot's recording code carry `ArraySpec` features; does nothing when done before.

    Raises:
        ImportError: this LeRobot is none that the extension was made for.
    """
    from lerobot.utils import feature_utils

    if getattr(feature_utils.hw_to_dataset_features, "carries_arrays", False):
        return
    check_lerobot(feature_utils)
    for name, wrap in (("hw_to_dataset_features", _with_features), ("build_dataset_frame", _with_frame)):
        original = getattr(feature_utils, name)
        _rebind(name, original, wrap(original))


def check_lerobot(feature_utils: Any) -> None:
    """Raises ImportError unless this LeRobot has the version and the functions that `install` knows."""
    first, last = (".".join(map(str, v)) for v in (FIRST_SUPPORTED, FIRST_UNSUPPORTED))
    if not is_supported():
        raise ImportError(
            f"recording pads needs LeRobot >= {first}, < {last}: pip install 'lerobot>={first},<{last}'"
        )
    for name, parameters in SIGNATURES.items():
        function = getattr(feature_utils, name, None)
        if function is None or tuple(inspect.signature(function).parameters) != parameters:
            raise ImportError(
                f"recording pads cannot extend this LeRobot, whose {name} has changed; "
                f"use a release >= {first}, < {last}"
            )


def _rebind(name: str, original: Callable[..., Any], replacement: Callable[..., Any]) -> None:
    """Replaces a function in every loaded LeRobot module that has imported it."""
    for module_name, module in list(sys.modules.items()):
        if module_name.split(".")[0] == "lerobot" and getattr(module, name, None) is original:
            setattr(module, name, replacement)
            logger.debug("%s.%s carries arrays", module_name, name)


def _with_features(original: Callable[..., Features]) -> Callable[..., Features]:
    @functools.wraps(original)
    def hw_to_dataset_features(hw_features: dict[str, Any], prefix: str, use_video: bool = True) -> Features:
        others = {key: value for key, value in hw_features.items() if not isinstance(value, ArraySpec)}
        return original(others, prefix, use_video) | array_features(hw_features, prefix)

    hw_to_dataset_features.__dict__["carries_arrays"] = True
    return hw_to_dataset_features


def _with_frame(original: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    from lerobot.utils.constants import DEFAULT_FEATURES

    @functools.wraps(original)
    def build_dataset_frame(ds_features: Features, values: dict[str, Any], prefix: str) -> dict[str, Any]:
        arrays = {
            key: feature
            for key, feature in ds_features.items()
            if key.startswith(f"{prefix}.") and key not in DEFAULT_FEATURES and is_array_feature(feature)
        }
        others = {key: feature for key, feature in ds_features.items() if key not in arrays}
        return original(others, values, prefix) | array_frame(arrays, values, prefix)

    return build_dataset_frame
