"""Names, shapes and units of what reality and simulation hand over: the one table.

Recorder, robot, environment and policy read it; nothing else spells these names. Shapes: ``...`` any leading
dimensions (none for one frame, ``m`` environments), ``J`` joints and ``P`` pads of ``T`` taxels, as the body
has them, ``H, W`` depth image height and width.

A *raw* observation is a dict of numpy arrays:

===================  =================  =======  ==========================================================
key                  shape              dtype    meaning
===================  =================  =======  ==========================================================
``state``            (..., J)           float32  joint positions, rad and m, in the embodiment's order
``tactile``          (..., P, T)        uint8    raw pad counts, row-major
``tactile_baseline`` (..., P, T)        uint8    idle counts of the same taxels
``depth_mm``         (..., H, W)        uint16   depth along the optical axis, mm; 0 = no return
``rgb``              (..., Hc, Wc, 3)   uint8    colour image of the same camera, where one is recorded
``camera_intrinsics`` (..., 4)          float32  fx, fy, cx, cy in pixels
``camera_pose``      (..., 7)           float32  x y z in m, qw qx qy qz: optical frame (OpenCV) in the world
``noise_level``      (..., 1)           float32  depth noise to add when the cloud is built; 0 on hardware
``tactile_age``      (..., P)           float32  age of the pads' frames in s; 0 in simulation
``limits``           (..., 2)           float32  what the parts bear: contact force in N, shift in the hand in
                                                 m; of a task that says so
===================  =================  =======  ==========================================================

``noise_level`` (hardware) and ``tactile_age`` (simulation) may be missing; they then count as 0. With
``limits`` comes one more column.

Datasets of both kinds have the same columns, joint names and robot type, because LeRobot merges only such.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from lerobot_vtrefine.embodiments import Embodiment

Array = np.ndarray[Any, np.dtype[Any]]

JOINT_SUFFIX = ".pos"
"""LeRobot's robots call the position of a joint so; recorded and simulated datasets do, too."""
CAMERA = "front"
"""The depth camera that sees the workspace, on every body, so that policies find it."""

OBS_PREFIX = "observation."
"""What LeRobot puts before the names of a robot's readings."""
TACTILE, BASELINE, TACTILE_AGE = "tactile", "tactile_baseline", "tactile_age"
"""A robot's names of pads' readings: ``tactile.<pad>``, ``tactile_baseline.<pad>``, and all their ages."""
TACTILE_PREFIX = f"{OBS_PREFIX}{TACTILE}."
BASELINE_PREFIX = f"{OBS_PREFIX}{BASELINE}."
CAMERA_PREFIX = f"{OBS_PREFIX}camera."
IMAGE_PREFIX = f"{OBS_PREFIX}images."
STATE_KEY = "observation.state"
ACTION_KEY = "action"
DEPTH_KEY = f"{IMAGE_PREFIX}{CAMERA}_depth"
RGB_KEY = f"{IMAGE_PREFIX}{CAMERA}"
"""Only where colour is recorded; both names are those of LeRobot's cameras with colour and depth."""
INTRINSICS_KEY = f"{CAMERA_PREFIX}{CAMERA}.intrinsics"
CAMERA_POSE_KEY = f"{CAMERA_PREFIX}{CAMERA}.pose"
NOISE_LEVEL_KEY = f"{CAMERA_PREFIX}{CAMERA}.noise_level"
LIMITS = "limits"
LIMITS_KEY = "observation.environment_state"
"""LeRobot's name for what is known and no joint: environments and datasets pass it on, and its ACT, diffusion
policy and TD-MPC read it. In ``observation.state`` limits would be taken for joints. There are two of them
also because LeRobot's loader makes a number, without a dimension, of a column of one.
"""
TRUTH_KEY = "observation.truth"
"""What only a simulation knows (``sim.truth``), where it was recorded for an auxiliary loss; none acts on it.
Below ``observation.``, because LeRobot's pipelines drop what is elsewhere.
"""
AGE_KEY = f"{OBS_PREFIX}{TACTILE_AGE}"
CLOUD_KEY = "observation.visuo_tactile"
"""Built by the policy's preprocessor from the raw columns; never stored."""
GRIDS_KEY = "observation.tactile_grids"
"""Readings of the pads as images, built likewise."""
SURFACE_KEY = "observation.surface"
"""The depth image as an image of points, built likewise: what the larger network of `information` reads."""

VISUAL_KEYS = (DEPTH_KEY, INTRINSICS_KEY, CAMERA_POSE_KEY)
TAXEL_UNIT = "adc_counts"


def joint_keys(body: Embodiment) -> list[str]:
    """A robot's names of its joints' positions and of their targets, in the order of the state."""
    return [f"{name}{JOINT_SUFFIX}" for name in body.joint_names]


def tactile_keys(body: Embodiment) -> tuple[str, ...]:
    """Columns of the pads' counts, in the order of the body's pads."""
    return tuple(f"{TACTILE_PREFIX}{pad}" for pad in body.pad_names)


def baseline_keys(body: Embodiment) -> tuple[str, ...]:
    """Columns of the pads' idle counts."""
    return tuple(f"{BASELINE_PREFIX}{pad}" for pad in body.pad_names)


def raw_keys(body: Embodiment) -> tuple[str, ...]:
    """What comes with the joint positions, to build the cloud from; the preprocessor drops it afterwards."""
    return (*tactile_keys(body), *baseline_keys(body), AGE_KEY, *VISUAL_KEYS, NOISE_LEVEL_KEY)


class Column(NamedTuple):
    """One dataset column: where its values come from in the raw observation, and how it is stored."""

    key: str
    source: str
    """Key of the raw observation."""
    dtype: str
    shape: tuple[int, ...]
    pad: int | None = None
    """Index along the raw observation's pad dimension."""

    def value(self, raw: Mapping[str, Array]) -> Array:
        """This column of a raw observation, shape (..., *shape) in the column's dtype."""
        value = raw[self.source] if self.pad is None else raw[self.source][..., self.pad, :]
        return np.ascontiguousarray(value, dtype=self.dtype)


@cache
def columns(body: Embodiment, limited: bool = False) -> tuple[Column, ...]:
    """Every array column; the depth image comes on top because LeRobot stores it as an image.

    ``limited``: of a task that states its limits.
    """
    taxels = (body.pad_layout.num_taxels,)
    return (
        Column(STATE_KEY, "state", "float32", (body.num_joints,)),
        *(Column(key, TACTILE, "uint8", taxels, pad) for pad, key in enumerate(tactile_keys(body))),
        *(Column(key, BASELINE, "uint8", taxels, pad) for pad, key in enumerate(baseline_keys(body))),
        Column(AGE_KEY, TACTILE_AGE, "float32", (len(body.pad_names),)),
        Column(INTRINSICS_KEY, "camera_intrinsics", "float32", (4,)),
        Column(CAMERA_POSE_KEY, "camera_pose", "float32", (7,)),
        Column(NOISE_LEVEL_KEY, "noise_level", "float32", (1,)),
        *([Column(LIMITS_KEY, LIMITS, "float32", (2,))] if limited else []),
    )


def taxel_info(rows: int, cols: int) -> dict[str, Any]:
    """What datasets say of the flat column of a pad with so many taxels."""
    return {"array_shape": [rows, cols], "unit": TAXEL_UNIT}


def dataset_features(
    camera_height: int,
    camera_width: int,
    body: Embodiment,
    colour: tuple[int, int] | None = None,
    limited: bool = False,
    truth_size: int = 0,
) -> dict[str, dict[str, Any]]:
    """Features of a body's data for ``LeRobotDataset.create``; `colour` is a colour image's height and width,
    `limited` as in ``columns``, `truth_size` how much of the truth is recorded.

    Colour is a video, depth is kept exactly (TIFF, uint16 mm). Calibration is stored in
    columns, not in ``info``: LeRobot refuses to merge datasets whose ``info`` differs. Array columns carry no
    ``names``: LeRobot's recording code would rebuild such features and drop their ``info``.
    """
    if camera_height < 1 or camera_width < 1:
        raise ValueError(f"camera size must be positive, got {camera_height} x {camera_width}")
    layout = body.pad_layout
    features: dict[str, dict[str, Any]] = {}
    for column in columns(body, limited):
        features[column.key] = {"dtype": column.dtype, "shape": column.shape}
        if column.source in (TACTILE, BASELINE):
            features[column.key]["info"] = taxel_info(layout.rows, layout.cols)
    names = {"names": joint_keys(body)}
    features[STATE_KEY] |= names
    features[DEPTH_KEY] = {
        "dtype": "image",
        "shape": (camera_height, camera_width, 1),
        "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True},
    }
    if truth_size:
        features[TRUTH_KEY] = {"dtype": "float32", "shape": (truth_size,)}
    if colour is not None:
        channels = ["height", "width", "channels"]
        features[RGB_KEY] = {"dtype": "video", "shape": (*colour, 3), "names": channels}
    features[ACTION_KEY] = {"dtype": "float32", "shape": (body.num_joints,), **names}
    return features


def _columns_of(raw: Mapping[str, Array], body: Embodiment) -> dict[str, Array]:
    """All array columns of a raw observation; what may be missing becomes 0."""
    lead = raw["state"].shape[:-1] if "state" in raw else ()
    may_be_missing = {"noise_level": 1, TACTILE_AGE: len(body.pad_names)}
    absent = {key: width for key, width in may_be_missing.items() if key not in raw}
    raw = {**raw, **{key: np.zeros((*lead, width), np.float32) for key, width in absent.items()}}
    chosen = columns(body, LIMITS in raw)
    missing = {column.source for column in chosen} - set(raw)
    if missing:
        raise ValueError(f"raw observation lacks {', '.join(sorted(missing))}")
    return {column.key: column.value(raw) for column in chosen}


def raw_to_frame(raw: Mapping[str, Array], body: Embodiment) -> dict[str, Array]:
    """One raw observation (no leading dimensions) as a frame for ``LeRobotDataset.add_frame``.

    The caller adds ``action`` (J,) float32 and ``task``.
    """
    if raw["state"].shape != (body.num_joints,):
        raise ValueError(f"a frame needs state of shape ({body.num_joints},), got {raw['state'].shape}")
    depth = np.ascontiguousarray(raw["depth_mm"], np.uint16)[..., None]
    more = {key: raw[source] for key, source in ((RGB_KEY, "rgb"), (TRUTH_KEY, "truth")) if source in raw}
    return {**_columns_of(raw, body), DEPTH_KEY: depth, **more}


def raw_to_env_observation(raw: Mapping[str, Array], body: Embodiment) -> dict[str, Any]:
    """A raw observation (leading dimensions allowed) as an environment observation.

    LeRobot's ``preprocess_observation`` turns its keys into the dataset's (``agent_pos`` becomes
    ``observation.state``). Everything is float32, counts too, because ``lerobot-eval --eval.recording=true``
    stores nothing else. Depth is (..., 1, H, W) in mm, exactly what the dataset loader yields. Only colour
    stays uint8 (..., H, W, 3), below ``pixels``, where LeRobot expects it.
    """
    observation: dict[str, Any] = {
        key.removeprefix(OBS_PREFIX): value.astype(np.float32, copy=False)
        for key, value in _columns_of(raw, body).items()
    }
    observation["agent_pos"] = observation.pop("state")
    observation[DEPTH_KEY.removeprefix(OBS_PREFIX)] = raw["depth_mm"].astype(np.float32)[..., None, :, :]
    if "rgb" in raw:
        observation["pixels"] = {CAMERA: raw["rgb"]}
    return observation


def env_observation_shapes(
    camera_height: int, camera_width: int, body: Embodiment, limited: bool = False
) -> dict[str, tuple[tuple[int, ...], float]]:
    """Shape of every environment observation key, without leading dimensions, and the largest value of counts
    (infinite for everything else).
    """
    shapes = {
        column.key.removeprefix(OBS_PREFIX): (column.shape, 255.0 if column.dtype == "uint8" else np.inf)
        for column in columns(body, limited)
    }
    shapes["agent_pos"] = shapes.pop("state")
    shapes[DEPTH_KEY.removeprefix(OBS_PREFIX)] = ((1, camera_height, camera_width), np.inf)
    return shapes


def env_key_map(body: Embodiment, *, colour: bool = False, limited: bool = False) -> dict[str, str]:
    """Environment observation key -> dataset key (LeRobot's ``features_map``, the action included).

    Colour, which comes below ``pixels``, goes by the name that LeRobot gives it: ``lerobot-eval`` records
    only such images.
    """
    pixels = {RGB_KEY: RGB_KEY} if colour else {}
    keys = [*(column.key for column in columns(body, limited) if column.key != STATE_KEY), DEPTH_KEY]
    own = {"agent_pos": STATE_KEY, "action": ACTION_KEY, **pixels}
    return own | {key.removeprefix(OBS_PREFIX): key for key in keys}
