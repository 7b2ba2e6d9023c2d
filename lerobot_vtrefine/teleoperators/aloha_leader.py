"""ALOHA's leaders: two WidowX-250s arms moved by hand, read as 16 joint targets in the paper's order."""

import logging
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_vtrefine.drivers.dynamixel_arm import WIDOWX_250S, DynamixelArm
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.teleoperators.config_aloha_leader import AlohaLeaderConfig

logger = logging.getLogger(__name__)


class AlohaLeader(Teleoperator):
    """Two WidowX-250s arms without torque; keys `<joint>.pos` [rad, fingers m], as followers take them."""

    config_class = AlohaLeaderConfig
    name = "aloha_leader"

    def __init__(self, config: AlohaLeaderConfig) -> None:
        super().__init__(config)
        self.config = config
        self.body = get_embodiment("aloha")
        travel_m = self.body.fingers.travel_m
        ports = {"left": config.left_port, "right": config.right_port}
        self.arms = {name: DynamixelArm(name, port, WIDOWX_250S, travel_m) for name, port in ports.items()}
        for name, arm in self.arms.items():
            entries = self.calibration.items()
            arm.calibration = {k.removeprefix(f"{name}_"): v for k, v in entries if k.startswith(f"{name}_")}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """16 joint targets in the paper's order."""
        return {f"{joint}.pos": float for joint in self.body.joint_names}

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None: the leaders are not driven."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether both arms are connected."""
        return all(arm.is_connected for arm in self.arms.values())

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Connects both arms, and calibrates them where needed.

        Raises:
            PortError: a port cannot be used; the message names it and the fix. Nothing stays connected.
        """
        try:
            for arm in self.arms.values():
                arm.connect()
            if calibrate and not self.is_calibrated:
                self.calibrate()
            self.configure()
        except BaseException:
            self._release()
            raise

    def configure(self) -> None:
        """Switches torque off, so that the arms can be moved by hand."""
        for arm in self.arms.values():
            arm.configure(gripper_current_ma=None)

    @property
    def is_calibrated(self) -> bool:
        """Whether both arms are."""
        return all(arm.is_calibrated for arm in self.arms.values())

    def calibrate(self) -> None:
        """Calibrates both arms by hand."""
        for arm in self.arms.values():
            arm.calibrate(input, self.body.lower[:6], self.body.upper[:6])
        self.calibration = {
            f"{name}_{motor}": entry
            for name, arm in self.arms.items()
            for motor, entry in arm.calibration.items()
        }
        self._save_calibration()
        logger.info("calibration saved to %s", self.calibration_fpath)

    @check_if_not_connected
    def get_action(self) -> RobotAction:
        """Where the leaders are, cut to the follower's limits."""
        state = np.concatenate([arm.read() for arm in self.arms.values()])
        target = np.clip(state, self.body.lower, self.body.upper)
        return dict(zip(self.action_features, map(float, target), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Does nothing: the leaders are not driven."""

    def disconnect(self) -> None:
        """Releases both arms."""
        self._release()

    def _release(self) -> None:
        for arm in self.arms.values():
            try:
                arm.disconnect(torque_off=False)
            except (ConnectionError, OSError) as error:
                logger.error("%s arm (%s): %s", arm.name, arm.port, error)
