"""Array features through LeRobot's stock recording commands.

LeRobot 0.6.1's recorder accepts float scalars and (H, W, 1 | 3) images only; its datasets accept any array.
Two functions stand between them. ``install`` wraps both in every loaded LeRobot module, so that a robot may
declare

    observation_features = {"tactile.left_arm_left_finger": ArraySpec((384,), "uint8", info), ...}

and ``lerobot-record``, ``--resume``, ``lerobot-rollout`` and ``lerobot-edit-dataset`` carry the columns.
Robots call ``install`` when they are made: commands with other robots stay untouched. Reading needs no
plugin. Declare arrays 1-D and give their real shape in ``info``: LeRobot can neither delete nor merge
episodes with 2-D columns.
"""

import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lerobot_vtrefine.datasets.features import AGE_KEY, TACTILE_AGE
from lerobot_vtrefine.lerobot_compat.guard import is_supported, lerobot_version
from lerobot_vtrefine.lerobot_compat.pad_ages import ordered_ages

PATCHED = ("hw_to_dataset_features", "build_dataset_frame")
Features = dict[str, dict[str, Any]]
_originals: dict[str, Callable[..., Any]] = {}
_wrappers: dict[str, Callable[..., Any]] = {}


class ArraySpec(tuple[int, ...]):
    """Shape of an array feature, with its dtype and the ``info`` that is stored beside it.

    A tuple, because LeRobot's rollout keeps only features that are tuples or joint positions.
    """

    dtype: str
    info: dict[str, Any] | None

    def __new__(
        cls, shape: tuple[int, ...], dtype: str = "float32", info: Mapping[str, Any] | None = None
    ) -> "ArraySpec":
        """Raises: ValueError for shapes that LeRobot cannot edit, TypeError for unknown dtypes."""
        if len(shape) != 1 or shape[0] < 1:
            raise ValueError(f"array features must be 1-D (put the real shape into info), got {shape}")
        spec = super().__new__(cls, shape)
        spec.dtype, spec.info = str(np.dtype(dtype)), dict(info) if info else None
        return spec

    def feature(self) -> dict[str, Any]:
        """The dataset feature; without ``names``, which would make LeRobot drop ``info``."""
        feature: dict[str, Any] = {"dtype": self.dtype, "shape": tuple(self)}
        return feature | ({"info": self.info} if self.info else {})


def _hw_to_dataset_features(
    hw_features: Mapping[str, Any], prefix: str, use_video: bool = True
) -> dict[str, dict[str, Any]]:
    """LeRobot's function for everything that is not an array, plus one column per array."""
    arrays = {key: spec for key, spec in hw_features.items() if isinstance(spec, ArraySpec)}
    others = {key: spec for key, spec in hw_features.items() if key not in arrays}
    features: Features = _originals["hw_to_dataset_features"](others, prefix, use_video)
    return features | {f"{prefix}.{key}": spec.feature() for key, spec in arrays.items()}


def _build_dataset_frame(
    ds_features: Mapping[str, dict[str, Any]], values: Mapping[str, Any], prefix: str
) -> dict[str, Any]:
    """LeRobot's function for everything that is not an array, plus the arrays in their declared dtype."""
    arrays = {key: feature for key, feature in ds_features.items() if _is_array(key, feature, prefix)}
    others = {key: feature for key, feature in ds_features.items() if key not in arrays}
    frame: dict[str, Any] = _originals["build_dataset_frame"](others, values, prefix)
    if AGE_KEY in arrays:
        values = {**values, TACTILE_AGE: ordered_ages(ds_features, values)}
    for key, feature in arrays.items():
        value = np.asarray(values[key.removeprefix(f"{prefix}.")])
        if value.dtype.kind != np.dtype(feature["dtype"]).kind:
            raise ValueError(f"{key} must be {feature['dtype']}, the robot returned {value.dtype}")
        frame[key] = value.astype(feature["dtype"], copy=False).reshape(tuple(feature["shape"]))
    return frame


def _is_array(key: str, feature: Mapping[str, Any], prefix: str) -> bool:
    """Columns that ``ArraySpec.feature`` made: under the prefix, numeric, and without names."""
    numeric = feature["dtype"] not in ("image", "video", "string", "language")
    return key.startswith(f"{prefix}.") and numeric and feature.get("names") is None


def _rebind(replacements: Mapping[Callable[..., Any], Callable[..., Any]]) -> int:
    """Replace functions wherever a loaded LeRobot module holds them; returns how many bindings changed."""
    changed = 0
    for module_name, module in list(sys.modules.items()):
        if not module_name.startswith("lerobot."):
            continue
        for name in PATCHED:
            current = vars(module).get(name)
            if current is not None and current in replacements:
                setattr(module, name, replacements[current])
                changed += 1
    return changed


def install() -> None:
    """Let stock recording carry ``ArraySpec`` features; idempotent, also picks up modules loaded since.

    Raises: RuntimeError on a LeRobot version whose recorder was not tested with this.
    """
    if not is_supported():
        found = ".".join(map(str, lerobot_version()))
        raise RuntimeError(f"recording arrays needs lerobot >=0.6.1,<0.7, found {found}")
    import lerobot.utils.feature_utils as source

    if not _originals:
        _originals.update({name: getattr(source, name) for name in PATCHED})
        _wrappers.update(zip(PATCHED, (_hw_to_dataset_features, _build_dataset_frame), strict=True))
    _rebind({_originals[name]: _wrappers[name] for name in PATCHED})


def uninstall() -> None:
    """Restore LeRobot's own functions."""
    _rebind({_wrappers[name]: _originals[name] for name in _originals})
