"""Dataset cards that say what tactile columns hold, and which simulation they come from.

`install` lets LeRobot's own `dataset.push_to_hub` (and so `lerobot-record`, `lerobot-rollout`) put this text
into the card's "Dataset Description". Datasets without pads keep LeRobot's card. Robots with pads call it
when they are made; elsewhere: `push_to_hub(dataset_description=describe(dataset.meta))`.
"""

import functools
import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_vtrefine.datasets.features import (
    ACTION_KEY,
    AGE_KEY,
    BASELINE_PREFIX,
    CAMERA_PREFIX,
    NOISE_LEVEL_KEY,
    STATE_KEY,
    TACTILE_PREFIX,
    TAXEL_UNIT,
)
from lerobot_vtrefine.datasets.simulation_card import describe_simulation
from lerobot_vtrefine.lerobot_compat.guard import is_supported
from lerobot_vtrefine.wording import plural

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)

TAGS = ("tactile", "flexitac")
PITCH_MM = 2.0
"""Distance of neighbouring taxels of a FlexiTac pad."""

Features = Mapping[str, Mapping[str, Any]]
Stats = Mapping[str, Mapping[str, Any]]


def pad_names(features: Features) -> list[str]:
    """Pads of a dataset, in the order of its columns."""
    return [key.removeprefix(TACTILE_PREFIX) for key in features if key.startswith(TACTILE_PREFIX)]


def describe(meta: "LeRobotDatasetMetadata") -> str:
    """Markdown for a tactile dataset's card; empty where the dataset has no pads."""
    features, stats = meta.features, meta.stats or {}
    if not pad_names(features):
        return ""
    parts = [
        _summary(meta),
        describe_simulation(meta.root),
        _pads(features, stats),
        _layout(features),
        _calibration(features, stats),
        _joints(features),
        _cameras(features, stats),
    ]
    return "\n\n".join(part for part in parts if part)


def _summary(meta: "LeRobotDatasetMetadata") -> str:
    robot = f", of the robot `{meta.robot_type}`" if meta.robot_type else ""
    tasks = "; ".join(map(str, meta.tasks.index)) if meta.tasks is not None else ""
    size = f"{plural(meta.total_episodes, 'episode')}, {plural(meta.total_frames, 'frame')}"
    return (
        f"{size} at {meta.fps} frames/s, with "
        f"{len(pad_names(meta.features))} FlexiTac tactile pads{robot}. Tasks: {tasks}.{_simulated(meta)}\n\n"
        "It loads with LeRobot alone; the plugin `lerobot_vtrefine` trains visuo-tactile policies on it."
    )


def _simulated(meta: "LeRobotDatasetMetadata") -> str:
    """What tells simulated frames: real depth has its own noise, so only theirs asks for more."""
    noise = (meta.stats or {}).get(NOISE_LEVEL_KEY, {}).get("max")
    if noise is None or not float(np.max(noise)) > 0:
        return ""
    return f" Frames whose `{NOISE_LEVEL_KEY}` is above 0 are simulated."


def _pads(features: Features, stats: Stats) -> str:
    rows = [
        "### Tactile pads",
        "",
        "| column | rows x columns | type | unit | idle counts, median (range) | highest |",
        "|---|---|---|---|---|---|",
    ]
    for name in pad_names(features):
        feature = features[TACTILE_PREFIX + name]
        info = feature.get("info") or {}
        shape = info.get("array_shape", list(feature["shape"]))
        idle = _range(stats.get(BASELINE_PREFIX + name), "mean")
        highest = stats.get(TACTILE_PREFIX + name, {}).get("max")
        most = f"{float(np.max(highest)):g}" if highest is not None else "-"
        size, unit = " x ".join(map(str, shape)), str(info.get("unit", "-")).replace("_", " ")
        rows.append(f"| `{TACTILE_PREFIX}{name}` | {size} | {feature['dtype']} | {unit} | {idle} | {most} |")
    return "\n".join(rows)


def _range(stats: Mapping[str, Any] | None, key: str) -> str:
    if stats is None or key not in stats:
        return "-"
    values = np.asarray(stats[key], float)
    return f"{np.median(values):.0f} ({values.min():.0f} to {values.max():.0f})"


def _layout(features: Features) -> str:
    info = features[TACTILE_PREFIX + pad_names(features)[0]].get("info") or {}
    shape = tuple(info.get("array_shape", features[TACTILE_PREFIX + pad_names(features)[0]]["shape"]))
    return (
        "### Layout\n\n"
        f"Columns are flat, row-major: `frame[key].reshape{shape}`. Taxels are {PITCH_MM:g} mm apart. In a "
        "pad's frame x points along columns, y along rows, z out of the pad; column 0 is at the fingertip. "
        "Rows are mirrored between the opposing fingers of a gripper: (r, c) faces (rows - 1 - r, c)."
    )


def _calibration(features: Features, stats: Stats) -> str:
    lines = ["### Units and calibration", ""]
    units = {(features[TACTILE_PREFIX + name].get("info") or {}).get("unit") for name in pad_names(features)}
    if units == {TAXEL_UNIT}:
        lines.append(
            "Counts are what a board sends: 8-bit readings of a voltage divider, monotonic in pressure but "
            "not linear, and not newtons. Nothing was filtered, clipped or normalised."
        )
    else:
        lines.append(
            "Values are not raw counts of a board; the table above names their unit where it is known."
        )
    if any(key.startswith(BASELINE_PREFIX) for key in features):
        lines.append(
            f"`{BASELINE_PREFIX}<pad>` holds the idle counts of the same taxels, measured on untouched pads "
            "at the start of each session: pressure shows in counts minus idle counts."
        )
    if AGE_KEY in features:
        worst = stats.get(AGE_KEY, {}).get("max")
        most = f"; the oldest here was {1e3 * float(np.max(worst)):.0f} ms" if worst is not None else ""
        lines.append(
            f"`{AGE_KEY}` [s], one value per pad in the order above, is the age of the pad's frame when it "
            f"was recorded. An age far above a frame period marks counts of a board that had stalled{most}."
        )
    return "\n".join(lines)


def _joints(features: Features) -> str:
    names = (features.get(STATE_KEY) or {}).get("names") or (features.get(ACTION_KEY) or {}).get("names")
    if not names:
        return ""
    fingers = [name for name in names if "finger" in name]
    unit = "radians, fingers in metres" if fingers else "the robot's own units"
    return (
        f"### Joints\n\n`{STATE_KEY}` and `{ACTION_KEY}` (absolute targets), in {unit}: "
        f"{', '.join(f'`{name}`' for name in names)}."
    )


def _cameras(features: Features, stats: Stats) -> str:
    cameras = {key.removeprefix(CAMERA_PREFIX).split(".")[0] for key in features if CAMERA_PREFIX in key}
    if not cameras:
        return ""
    lines = [
        "### Depth cameras",
        "",
        "Depth is uint16, millimetres along the optical axis, 0 where nothing was seen. Each frame holds the "
        "camera's model: intrinsics fx, fy, cx, cy [px] and the pose x, y, z [m], qw, qx, qy, qz of the "
        "optical frame (OpenCV) in the world.",
        "",
        "| camera | intrinsics | pose |",
        "|---|---|---|",
    ]
    for name in sorted(cameras):
        cells = [_constant(stats.get(f"{CAMERA_PREFIX}{name}.{part}")) for part in ("intrinsics", "pose")]
        lines.append(f"| `{name}` | {cells[0]} | {cells[1]} |")
    return "\n".join(lines)


def _constant(stats: Mapping[str, Any] | None) -> str:
    """The value of a column that does not change, or that it does."""
    if stats is None or "min" not in stats:
        return "see the column"
    low, high = np.asarray(stats["min"], float), np.asarray(stats["max"], float)
    if not np.allclose(low, high, rtol=1e-5, atol=1e-6):
        return "varies, see the column"
    return ", ".join(f"{value:.6g}" for value in low)


def install() -> None:
    """Let `LeRobotDataset.push_to_hub` describe tactile datasets; idempotent.

    On a LeRobot version that was not tested it logs a warning and leaves LeRobot as it is.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    original = LeRobotDataset.push_to_hub
    if hasattr(original, "undescribed"):
        return
    if not is_supported():
        logger.warning("This LeRobot version is untested: dataset cards will not describe the pads.")
        return

    @functools.wraps(original)
    def push_to_hub(
        self: LeRobotDataset,
        branch: str | None = None,
        tags: list[str] | None = None,
        *args: Any,
        **card: Any,
    ) -> None:
        if text := describe(self.meta):
            card.setdefault("dataset_description", text)
            tags = list(dict.fromkeys([*TAGS, *(tags or [])]))
        original(self, branch, tags, *args, **card)

    push_to_hub.undescribed = original  # ty: ignore[missing-attribute]
    LeRobotDataset.push_to_hub = push_to_hub  # ty: ignore[invalid-assignment]


def uninstall() -> None:
    """Restore LeRobot's own function."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    original = getattr(LeRobotDataset.push_to_hub, "undescribed", None)
    if original is not None:
        LeRobotDataset.push_to_hub = original
