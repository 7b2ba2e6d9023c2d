"""ALOHA's leaders: two WidowX-250s arms moved by hand, read as 16 joint targets in the paper's order."""

import logging
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_vtrefine.datasets.features import joint_keys
from lerobot_vtrefine.drivers.arm_models import WIDOWX_250S
from lerobot_vtrefine.drivers.arm_pair import ArmPair
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.extras import ARMS, require
from lerobot_vtrefine.lerobot_compat.calibration_file import WholeCalibrationFile
from lerobot_vtrefine.teleoperators.config_aloha_leader import AlohaLeaderConfig

logger = logging.getLogger(__name__)


class AlohaLeader(WholeCalibrationFile, Teleoperator):
    """Two WidowX-250s arms without torque; keys `<joint>.pos` [rad, fingers m], as followers take them."""

    config_class = AlohaLeaderConfig
    name = "aloha_leader"

    def __init__(self, config: AlohaLeaderConfig) -> None:
        require("teleoperator type aloha_leader", ARMS)
        super().__init__(config)
        self.config = config
        self.body = get_embodiment("aloha")
        travel_m = self.body.fingers.travel_m
        self.pair = ArmPair(config.left_port, config.right_port, WIDOWX_250S, travel_m)
        self.pair.calibration = self.calibration

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """16 joint targets in the paper's order."""
        return dict.fromkeys(joint_keys(self.body), float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None: the leaders are not driven."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether both arms are connected."""
        return self.pair.is_connected

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Connect both arms, and calibrate them where needed.

        Raises:
            PortError: a port cannot be used; the message names it and the fix. Nothing stays connected.
        """
        try:
            self.pair.connect()
            if calibrate and not self.is_calibrated:
                self.calibrate()
            self.configure()
        except BaseException:
            self.disconnect()
            raise

    def configure(self) -> None:
        """Switch torque off, so that the arms can be moved by hand."""
        for arm in self.pair.arms.values():
            arm.set_up()

    @property
    def is_calibrated(self) -> bool:
        """Whether both arms are."""
        return self.pair.is_calibrated

    def calibrate(self) -> None:
        """Calibrate both arms by hand."""
        count = len(self.body.joints)
        self.pair.calibrate(input, self.body.lower[:count], self.body.upper[:count])
        self.calibration = self.pair.calibration
        self._save_calibration()
        logger.info("calibration saved to %s", self.calibration_fpath)

    def setup_motors(self) -> None:
        """Give new motors their ids and baud rates, for `lerobot-setup-motors`."""
        self.pair.setup_motors(input)

    @check_if_not_connected
    def get_action(self) -> RobotAction:
        """Where the leaders are, cut to the follower's limits."""
        target = np.clip(self.pair.read(), self.body.lower, self.body.upper)
        return dict(zip(self.action_features, map(float, target), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing: the leaders are not driven."""

    def disconnect(self) -> None:
        """Release both arms."""
        self.pair.release(torque_off=False)
