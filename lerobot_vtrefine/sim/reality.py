"""A twin with hidden physics that stands in for reality: what one JSON file changes about the simulation.

    {"schema": "vtrefine/reality@1",
     "sensor_model": "hidden_sensor.json",
     "robot": {"control_latency_s": 0.04, "backlash_rad": {"left_elbow": 0.01},
               "encoder_offset_rad": {"right_shoulder": -0.005}},
     "scene": {"part_friction": 0.2, "clearance_m": 0.0015}}

Every part is optional. The names are those of diagnosis: `control_latency_s` delays commands, `backlash_rad`
is the full width of the play between command and servo, and an encoder reads `encoder_offset_rad` more than
is true. The ``sensor_model.json`` that diagnosis makes of a robot's recordings is read as well: its delay,
play and encoder offsets. Imports no simulator.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.tactile import SensorModel

SCHEMA = "vtrefine/reality@1"
ROBOT_MODEL_SCHEMA = "vtrefine/robot-model@1"
SCENE_FIELDS = (
    "clearance_m",
    "part_friction",
    "pad_friction",
    "part_density",
    "pad_time_constant_s",
    "servo_gain_scale",
    "gravity_compensation",
)
"""What may differ in the scene; the task itself stays the same."""
MAX_LATENCY_S = 1.0


@dataclass(frozen=True)
class RobotFaults:
    """What the arms do that the simulation does not know of; joints by name, grippers have none."""

    control_latency_s: float = 0.0
    backlash_rad: Mapping[str, float] = field(default_factory=dict)
    """Full width of play, by joint."""
    encoder_offset_rad: Mapping[str, float] = field(default_factory=dict)
    """Reading minus truth, by joint."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.control_latency_s <= MAX_LATENCY_S:
            raise ValueError(
                f"control_latency_s must lie in 0..{MAX_LATENCY_S:g} s, got {self.control_latency_s}"
            )
        for name, values in (
            ("backlash_rad", self.backlash_rad),
            ("encoder_offset_rad", self.encoder_offset_rad),
        ):
            for joint, value in values.items():
                if not isinstance(value, int | float) or not np.isfinite(value):
                    raise ValueError(f"{name}.{joint} must be a finite number, got {value!r}")
                if name == "backlash_rad" and value < 0:
                    raise ValueError(f"backlash_rad.{joint} must not be negative, got {value}")


@dataclass(frozen=True)
class Reality:
    """Everything that a reality file changes; None and empty parts leave the simulation as it is."""

    sensor_model: SensorModel | None = None
    robot: RobotFaults = field(default_factory=RobotFaults)
    scene: Mapping[str, Any] = field(default_factory=dict)

    def applied(self, scene: SceneConfig) -> SceneConfig:
        """The scene as it really is."""
        return replace(scene, **self.scene)


def load_reality(path: str | Path) -> Reality:
    """Read a reality file; a sensor model's path is relative to it.

    Raises:
        ValueError: names the file and what is wrong with it, with the valid names.
        FileNotFoundError: the file, or the sensor model that it names, does not exist.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return _from_dict(data, path.parent)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _from_dict(data: Any, folder: Path) -> Reality:
    if isinstance(data, dict) and data.get("schema") == ROBOT_MODEL_SCHEMA:
        return Reality(robot=_diagnosed(data))
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise ValueError(f'reality must hold "schema": "{SCHEMA}"')
    _check_keys("reality", data, ("schema", *(item.name for item in fields(Reality))))
    robot, scene = data.get("robot", {}), data.get("scene", {})
    _check_keys("robot", robot, tuple(item.name for item in fields(RobotFaults)))
    _check_keys("scene", scene, SCENE_FIELDS)
    sensor = data.get("sensor_model")
    if isinstance(sensor, str):
        sensor = SensorModel.load(folder / sensor)
    elif sensor is not None:
        sensor = SensorModel.from_dict(sensor)
    reality = Reality(sensor, RobotFaults(**robot), scene)
    reality.applied(SceneConfig())  # its own checks
    return reality


def _diagnosed(model: dict[str, Any]) -> RobotFaults:
    """What a diagnosed robot does beyond the simulated one.

    Sag and friction are left out: the simulation has gravity and friction of its own; so are the fingers,
    which have no faults here.
    """
    joints = model.get("joints")
    if not isinstance(joints, list) or not all(isinstance(item, dict) and "name" in item for item in joints):
        raise ValueError('robot model must hold a list "joints" of objects with a "name"')
    by_name = {str(item["name"]).removesuffix(".pos"): item for item in joints}
    unknown = [name for name in by_name if name not in ALOHA.joint_names]
    if unknown:
        raise ValueError(f"the simulated arms have no joint {unknown[0]!r}")
    arms = {name: item for name, item in by_name.items() if not name.endswith("_finger")}
    play = {
        n: item.get("backlash_command", 0.0) + item.get("backlash_output", 0.0) for n, item in arms.items()
    }
    offsets = {name: item.get("encoder_offset", 0.0) for name, item in arms.items()}
    return RobotFaults(
        min(model.get("control_latency_s", 0.0), MAX_LATENCY_S),
        {name: value for name, value in play.items() if value},
        {name: value for name, value in offsets.items() if value},
    )


def _check_keys(where: str, data: Any, valid: tuple[str, ...]) -> None:
    if not isinstance(data, dict):
        raise ValueError(f'"{where}" must be an object')
    for key in data:
        if key not in valid:
            raise ValueError(f"{where} has no {key!r}; valid: {', '.join(valid)}")
