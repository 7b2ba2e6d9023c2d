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

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lerobot_vtrefine.embodiments import embodiment_of
from lerobot_vtrefine.embodiments.robot_file import SCHEMA as ROBOT_MODEL_SCHEMA
from lerobot_vtrefine.embodiments.robot_file import RobotFile, decode_robot
from lerobot_vtrefine.files import decode, inside, limits, read_json
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.tactile import SensorModel

SCHEMA = "vtrefine/reality@1"
MAX_LATENCY_S = 1.0
MAX_ANGLE_RAD = 2 * np.pi


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
                if abs(value) > MAX_ANGLE_RAD:
                    raise ValueError(f"{name}.{joint} must not exceed a whole turn, got {value} rad")


@dataclass(frozen=True)
class HiddenScene:
    """What may differ in the scene, the task itself staying the same; None leaves it."""

    clearance_m: float | None = limits(1e-6, 0.02, above=0.0, default=None)
    part_friction: float | None = limits(1e-4, 10.0, above=0.0, default=None)
    pad_friction: float | None = limits(1e-4, 10.0, above=0.0, default=None)
    part_density: float | None = limits(1.0, 1e5, above=0.0, default=None)
    pad_time_constant_s: float | None = limits(1e-3, 1.0, above=0.0, default=None)
    servo_gain_scale: float | None = limits(1e-3, 100.0, above=0.0, default=None)
    gravity_compensation: bool | None = None


@dataclass(frozen=True)
class RealityFile:
    """Content of reality.json."""

    schema: Literal["vtrefine/reality@1"]
    sensor_model: str | dict[str, Any] | None = None
    robot: RobotFaults = field(default_factory=RobotFaults)
    scene: HiddenScene = field(default_factory=HiddenScene)


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
    data = read_json(path)
    try:
        return _from_dict(data, path.parent)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _from_dict(data: Any, folder: Path) -> Reality:
    if isinstance(data, dict) and data.get("schema") == ROBOT_MODEL_SCHEMA:
        return Reality(robot=_diagnosed(decode_robot(data)))
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise ValueError(f'reality must hold "schema": "{SCHEMA}"')
    content = decode(RealityFile, data, "reality")
    for joint in (*content.robot.backlash_rad, *content.robot.encoder_offset_rad):
        body = embodiment_of((joint,))
        if body is None or body.joint_of(joint) is None:
            raise ValueError(f"no arm has a joint {joint[:60]!r} that could have play or an encoder's offset")
    sensor = None
    if isinstance(content.sensor_model, str):
        sensor = SensorModel.load(inside(folder, content.sensor_model))
    elif content.sensor_model is not None:
        sensor = SensorModel.from_dict(content.sensor_model)
    given = {name: value for name, value in asdict(content.scene).items() if value is not None}
    reality = Reality(sensor, content.robot, given)
    reality.applied(SceneConfig())  # its own checks
    return reality


def _diagnosed(model: RobotFile) -> RobotFaults:
    """What a diagnosed robot does beyond the simulated one.

    Sag and friction are left out: the simulation has gravity and friction of its own; so are the fingers,
    which have no faults here.
    """
    by_name = {item.name.removesuffix(".pos"): item for item in model.joints}
    body = embodiment_of(tuple(by_name))
    if body is None:
        unknown = [name for name in by_name if embodiment_of((name,)) is None]
        what = f"no joint {unknown[0][:60]!r}" if unknown else "never all of the model's joints at once"
        raise ValueError(f"the simulated arms have {what}")
    arms = {name: item for name, item in by_name.items() if body.joint_of(name) is not None}
    strange = next(((name, law) for name, item in arms.items() for law in item.laws), None)
    if strange is not None:
        raise ValueError(
            f"the simulated arms know no law {strange[1][:60]!r}, which joint {strange[0]!r} has"
        )
    play = {name: item.backlash_command + item.backlash_output for name, item in arms.items()}
    return RobotFaults(
        min(model.control_latency_s, MAX_LATENCY_S),
        {name: value for name, value in play.items() if value},
        {name: item.encoder_offset for name, item in arms.items() if item.encoder_offset},
    )
