"""The `tactile` robot: any registered LeRobot robot plus FlexiTac pads, by composition."""

from functools import cached_property
from typing import Any

import draccus
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_vtrefine.drivers.pad_set import PadSet
from lerobot_vtrefine.extras import PADS, require
from lerobot_vtrefine.lerobot_compat.pad_features import configured_pads, pad_features
from lerobot_vtrefine.robots.camera_models import CameraModels
from lerobot_vtrefine.robots.config_tactile import TactileConfig
from lerobot_vtrefine.robots.extensions import extend_lerobot
from lerobot_vtrefine.robots.pad_reading import pad_observation
from lerobot_vtrefine.robots.release import release


class Tactile(Robot):
    """Observations and actions of the base robot, plus `tactile.<pad>` arrays of raw counts."""

    config_class = TactileConfig
    name = "tactile"

    def __init__(self, config: TactileConfig) -> None:
        require("robot type tactile", PADS)
        super().__init__(config)
        self.config = config
        self.base = make_robot_from_config(base_config(config))
        pads = configured_pads(config.pads, config.pads_file)
        # Ages are one column, a value per pad: it must mean the same in all datasets that LeRobot merges or
        # resumes, though the pads file may name the pads in another order.
        self.pads = PadSet(dict(sorted(pads.items())))
        extend_lerobot(self.pads.configs)
        self._camera_models = CameraModels(config.camera_models, self.cameras)
        self._connected = False
        # LeRobot stores the name with a dataset, and asks for the type when a recording is resumed.
        self.name = self.robot_type = f"{Tactile.name}_{self.base.name}"

    @property
    def cameras(self) -> dict[str, Any]:
        """The base robot's cameras."""
        return getattr(self.base, "cameras", {})

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """The base robot's, the pads' and the camera models'."""
        own = pad_features(self.pads.configs) | self._camera_models.features
        clashing = sorted(set(own) & set(self.base.observation_features))
        if clashing:
            raise ValueError(f"the base robot already has {', '.join(clashing)}; choose other pad names")
        return {**self.base.observation_features, **own}

    @property
    def action_features(self) -> dict[str, Any]:
        """The base robot's."""
        return self.base.action_features

    @property
    def is_connected(self) -> bool:
        """Whether `connect` succeeded; it stays so when something is lost.

        LeRobot's commands disconnect only what is connected, and its own robots no longer count as that once
        a camera of theirs died: the motors' port would stay open, with torque on.
        """
        return self._connected

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Connect the pads, which must not be touched meanwhile, then the robot.

        Raises:
            PortError: a pad cannot be read; the message names port and fix. Whatever fails, nothing stays
                connected.
        """
        self.pads.connect()
        try:
            self.base.connect(calibrate)
            self._camera_models.connected()
        except BaseException:
            self._release()
            raise
        self._connected = True

    @property
    def is_calibrated(self) -> bool:
        """Whether the base robot is; pads calibrate themselves when connecting."""
        return self.base.is_calibrated

    def calibrate(self) -> None:
        """Calibrate the base robot, and take the pads' idle counts anew."""
        self.base.calibrate()
        if self.pads.is_connected:
            self.pads.measure_baselines()

    def configure(self) -> None:
        """Configure the base robot."""
        self.base.configure()

    def setup_motors(self) -> None:
        """Set up the base robot's motors.

        Raises:
            NotImplementedError: the base robot has no motor set-up.
        """
        setup = getattr(self.base, "setup_motors", None)
        if setup is None:
            raise NotImplementedError(f"{self.base.name} has no motor set-up")
        setup()

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """Pads first, at one moment with the joints; images, which take longest to fetch, after them."""
        values = pad_observation(self.pads)
        values |= self.base.get_observation()
        return self._camera_models.observe(values)

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Forward to the base robot."""
        return self.base.send_action(action)

    def disconnect(self) -> None:
        """Disconnect the robot, then the pads, also after a failure in between or where a part was lost."""
        try:
            if self.base.is_connected:
                self.base.disconnect()
        finally:
            self._release()

    def _release(self) -> None:
        self._connected = False
        release(self.base)
        self.pads.disconnect()


def base_config(config: TactileConfig) -> RobotConfig:
    """Configuration of the base robot; it inherits `id` and `calibration_dir` where it gives none.

    Raises:
        ValueError: no type, an unknown type, or a wrong field.
    """
    known = ", ".join(sorted(set(RobotConfig.get_known_choices()) - {Tactile.name}))
    kind = config.base.get("type")
    if kind not in RobotConfig.get_known_choices() or kind == Tactile.name:
        raise ValueError(
            f"--robot.base needs the type of the robot that carries the pads: one of {known}; got {kind!r}"
        )
    inherited = {"id": config.id, "calibration_dir": config.calibration_dir and str(config.calibration_dir)}
    fields = {key: value for key, value in inherited.items() if value is not None} | config.base
    try:
        return draccus.decode(RobotConfig, fields)
    except (draccus.utils.DraccusException, TypeError) as error:
        raise ValueError(f"--robot.base of type {kind}: {error}") from error
