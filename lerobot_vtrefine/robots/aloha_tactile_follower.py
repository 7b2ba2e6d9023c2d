"""ALOHA's followers with FlexiTac pads: 16-D state and action in the paper's order, four pads, cameras."""

import contextlib
import logging
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots.robot import Robot
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_vtrefine.datasets.features import joint_keys
from lerobot_vtrefine.drivers.arm_models import VIPERX_300S
from lerobot_vtrefine.drivers.arm_pair import ArmPair
from lerobot_vtrefine.drivers.dynamixel_arm import Floats
from lerobot_vtrefine.drivers.pad_set import PadSet
from lerobot_vtrefine.drivers.ports import PortError
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.extras import ARMS, require
from lerobot_vtrefine.lerobot_compat.calibration_file import WholeCalibrationFile
from lerobot_vtrefine.lerobot_compat.pad_features import configured_pads, pad_features
from lerobot_vtrefine.robots.camera_models import CameraModels
from lerobot_vtrefine.robots.config_aloha_tactile_follower import AlohaTactileFollowerConfig
from lerobot_vtrefine.robots.cut_commands import CutCommands
from lerobot_vtrefine.robots.extensions import extend_lerobot
from lerobot_vtrefine.robots.joint_targets import finite_targets
from lerobot_vtrefine.robots.pad_reading import pad_observation

logger = logging.getLogger(__name__)

BODY = ALOHA
PER_ARM, REVOLUTE = BODY.joints_per_arm, len(BODY.joints)
FINGERS = slice(REVOLUTE, PER_ARM)

RECENT_S = 0.05
"""Positions read within this time count as present where a target's distance is limited; it saves two bus
transactions per control period."""

REST_RAD = (0.0, -1.80, 1.55, 0.0, -1.57, 0.0)
"""Folded pose in which a ViperX-300s lies on its own base without torque (Interbotix's sleep pose)."""


class AlohaTactileFollower(WholeCalibrationFile, Robot):
    """Two ViperX-300s arms; keys `<joint>.pos` [rad], fingers [m], and `tactile.<pad>` raw counts."""

    config_class = AlohaTactileFollowerConfig
    name = "aloha_tactile_follower"

    def __init__(self, config: AlohaTactileFollowerConfig) -> None:
        require("robot type aloha_tactile_follower", ARMS)
        super().__init__(config)
        self.config = config
        self.body = BODY
        travel_m = self.body.fingers.travel_m
        self.pair = ArmPair(config.left_port, config.right_port, VIPERX_300S, travel_m)
        self.pair.calibration = self.calibration
        self.pads = PadSet(aloha_pads(config))
        extend_lerobot(self.pads.configs)
        self.cameras = make_cameras_from_configs(config.cameras)
        self._camera_models = CameraModels(config.camera_models, self.cameras)
        limits = f"the joints' limits and --robot.max_step_rad={config.max_step_rad:g}"
        self._cuts = CutCommands(self.body, limits)
        self._connected = False

    # --- features -----------------------------------------------------------------------------------

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """16 joints, cameras, pads, camera models."""
        return {
            **self.action_features,
            **self._camera_features,
            **pad_features(self.pads.configs),
            **self._camera_models.features,
        }

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """16 joint targets in the paper's order."""
        return dict.fromkeys(joint_keys(self.body), float)

    @property
    def _camera_features(self) -> dict[str, tuple[int, int, int]]:
        features: dict[str, tuple[int, int, int]] = {}
        for name, camera in self.config.cameras.items():
            if not (camera.height and camera.width):
                raise ValueError(f"camera {name} needs its size: width, height and fps in --robot.cameras")
            height, width = camera.height, camera.width
            if getattr(camera, "use_rgb", True):
                features[name] = (height, width, 3)
            if getattr(camera, "use_depth", False):
                features[f"{name}_depth"] = (height, width, 1)
        return features

    # --- connection ---------------------------------------------------------------------------------

    @property
    def is_connected(self) -> bool:
        """Whether `connect` succeeded; it stays so when something is lost.

        LeRobot's commands disconnect only what is connected: arms must be released, too, where a camera died.
        """
        return self._connected

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Connect everything, calibrate where needed, and hold calibrated arms where they are.

        Raises:
            PortError: a port cannot be used; the message names it and the fix. Nothing stays connected.
        """
        try:
            self.pads.connect()
            self.pair.connect()
            if calibrate and not self.is_calibrated:
                self.calibrate()
            for camera in self.cameras.values():
                camera.connect()
            self._camera_models.connected()
            if self.is_calibrated:
                self.configure()
            else:
                logger.warning("%s is not calibrated: torque stays off; run lerobot-calibrate", self)
        except BaseException:
            self._release()
            raise
        self._connected = True
        logger.info("%s connected", self)

    def configure(self) -> None:
        """Set modes and limits, then hold the arms where they are; they must be calibrated."""
        for arm in self.pair.arms.values():
            arm.configure(self.config.gripper_current_ma, self.config.torque_limit)
            arm.hold()

    def disconnect(self) -> None:
        """Move the arms to rest, switch torque off, release everything, also after failures."""
        try:
            if self.config.rest_on_disconnect:
                self._rest()
        finally:
            self._release()
            if told := self._cuts.describe():
                logger.warning("%s", told)

    def _rest(self) -> None:
        for arm in self.pair.arms.values():
            with contextlib.suppress(PortError):  # an arm that is gone cannot be moved
                if arm.is_connected and arm.holding:
                    arm.move_to(np.array([*REST_RAD, *arm.read()[FINGERS]]), self.config.rest_s)

    def _release(self) -> None:
        self._connected = False
        with contextlib.ExitStack() as stack:  # the arms first, and everything whatever fails
            for camera in self.cameras.values():
                if camera.is_connected:
                    stack.callback(camera.disconnect)
            stack.callback(self.pads.disconnect)
            stack.callback(self.pair.release, torque_off=True)

    # --- calibration --------------------------------------------------------------------------------

    @property
    def is_calibrated(self) -> bool:
        """Whether both arms are."""
        return self.pair.is_calibrated

    def calibrate(self) -> None:
        """Calibrate both arms by hand, or write the calibration file's values to the motors."""
        if self.calibration and not self._asked_anew():
            self.pair.write_calibration()
            return
        self.pair.calibrate(input, self.body.lower[:REVOLUTE], self.body.upper[:REVOLUTE])
        self.calibration = self.pair.calibration
        self._save_calibration()
        logger.info("calibration saved to %s", self.calibration_fpath)

    def setup_motors(self) -> None:
        """Give new motors their ids and baud rates, for `lerobot-setup-motors`."""
        self.pair.setup_motors(input)

    def _asked_anew(self) -> bool:
        text = f"Press ENTER to use the calibration of {self.id}, or type c and ENTER to calibrate anew: "
        return input(text).strip().lower() == "c"

    # --- observation and action ---------------------------------------------------------------------

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """Joints and pads at one moment, then images."""
        values: RobotObservation = dict(zip(self.action_features, map(float, self.pair.read()), strict=True))
        values |= pad_observation(self.pads)
        for name, camera in self.cameras.items():
            if getattr(camera, "use_rgb", True):
                values[name] = camera.read_latest()
            if getattr(camera, "use_depth", False):
                values[f"{name}_depth"] = camera.read_latest_depth()  # ty: ignore[missing-attribute]
        return self._camera_models.observe(values)

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """Send joint targets, cut to the joints' limits and to `max_step_rad` from where the joints are.

        Returns:
            The targets sent; each right finger mirrors its left finger.

        Raises:
            ValueError: a target is not a number; nothing is sent.
        """
        wanted = finite_targets(action, self.action_features)
        sent = []
        for index, arm in enumerate(self.pair.arms.values()):
            part = slice(index * PER_ARM, (index + 1) * PER_ARM)
            target = np.clip(wanted[part], self.body.lower[part], self.body.upper[part])
            sent.append(limit_step(target, arm.recent(RECENT_S), self.config.max_step_rad))
            arm.write(sent[-1])
        targets = np.concatenate(sent)
        self._cuts.count(wanted, targets)
        return dict(zip(self.action_features, map(float, targets), strict=True))


def limit_step(target: Floats, present: Floats, max_step_rad: float) -> Floats:
    """Targets (8,) with joints at most one step from the present ones; the right finger mirrors the left."""
    limited = present + np.clip(target - present, -max_step_rad, max_step_rad)
    limited[FINGERS] = BODY.fingers.targets(target[REVOLUTE : REVOLUTE + 1])
    return limited


def aloha_pads(config: AlohaTactileFollowerConfig) -> dict[str, Any]:
    """The four pads in the paper's order.

    Raises:
        ValueError: pads are missing, unknown, or not 12 x 32.
    """
    pads = configured_pads(config.pads, config.pads_file)
    names, layout = BODY.pad_names, BODY.pad_layout
    if set(pads) != set(names):
        raise ValueError(
            f"{AlohaTactileFollower.name} needs the pads {', '.join(names)}; got {', '.join(pads)}"
        )
    shape = (layout.rows, layout.cols)
    wrong = [f"{name} {pad.pad_shape}" for name, pad in pads.items() if pad.pad_shape != shape]
    if wrong:
        raise ValueError(
            f"pads must be {layout.rows} x {layout.cols} (set pad_rows, row_offset): {', '.join(wrong)}"
        )
    return {name: pads[name] for name in names}
