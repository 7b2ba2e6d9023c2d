"""What the simulated environment is told of a robot and its sensors."""

from pathlib import Path
from typing import Any

import numpy as np
from kinds_of_recordings import robot_model, sensor_model
from mutant_kind import Kind, dump, either, of_json

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.factory import make_simulation
from lerobot_vtrefine.tactile import SensorModel


@run_cli
def simulated(folder: Path, **given: Any) -> None:
    """Two control steps of the environment; what it shows must be numbers."""
    config = VtRefineEnvConfig(start="grasped", backend="single", num_threads=1, **given)
    simulation = make_simulation(config, 1)
    simulation.reset(np.arange(1), np.array([0]))
    for _ in range(2):
        simulation.step(simulation.command_targets())
    for name, values in simulation.observe().items():
        assert np.isfinite(np.asarray(values, float)).all(), f"{name} is no number"


def warm_up() -> None:
    """One run with nothing given, which imports the simulator."""
    assert simulated(Path()) == 0


def with_reality(folder: Path) -> int:
    return simulated(folder, reality=folder / "reality.json")


def with_sensor(folder: Path) -> int:
    return simulated(folder, sensor_model=str(folder / "model.json"))


def reality_file(folder: Path) -> None:
    SensorModel.default().save(folder / "sensor.json")
    robot = {
        "control_latency_s": 0.04,
        "backlash_rad": {"left_elbow": 0.01},
        "encoder_offset_rad": {"right_shoulder": -0.005},
    }
    scene = {"part_friction": 0.2, "clearance_m": 0.0015, "gravity_compensation": True, "pad_friction": 1.0}
    sensor = {"sensor_model": "sensor.json"}
    dump(folder / "reality.json", {"schema": "vtrefine/reality@1", **sensor, "robot": robot, "scene": scene})


KINDS = (
    Kind(
        "robot model, reality",
        lambda folder: dump(folder / "reality.json", robot_model(ALOHA.joint_names)),
        of_json("reality.json"),
        with_reality,
        2,
        prepare=warm_up,
    ),
    Kind(
        "sensor model, environment",
        lambda folder: dump(folder / "model.json", sensor_model(12, 32)),
        of_json("model.json"),
        with_sensor,
        2,
        prepare=warm_up,
    ),
    Kind(
        "reality",
        reality_file,
        either(of_json("reality.json"), of_json("sensor.json")),
        with_reality,
        4,
        prepare=warm_up,
    ),
)
