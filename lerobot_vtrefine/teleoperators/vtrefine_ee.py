"""End-effector teleoperation: controllers move both hands, inverse kinematics moves the joints."""

import logging
import time
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.datasets.features import joint_keys
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.extras import TELEOPERATION, require
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.teleoperators.config_vtrefine_ee import VtRefineEeConfig
from lerobot_vtrefine.teleoperators.hand_motion import ClutchedHand, MotionSettings
from lerobot_vtrefine.teleoperators.inputs import Source, make_source

if TYPE_CHECKING:
    from lerobot_vtrefine.teleoperators.hand_ik import TwoArmIk

logger = logging.getLogger(__name__)

OUT_OF_REACH_M = 0.05
"""A wanted hand pose does not run farther ahead of the arm than this."""


class VtRefineEe(Teleoperator):
    """Joint targets `<joint>.pos` [rad, fingers m] of both arms, as the robots of this package take them.

    However the input behaves, no joint's target moves farther per action than its rate limit allows.
    """

    config_class = VtRefineEeConfig
    name = "vtrefine_ee"

    def __init__(self, config: VtRefineEeConfig) -> None:
        require("teleoperator type vtrefine_ee", TELEOPERATION)
        super().__init__(config)
        self.config = config
        self.body = get_embodiment(config.embodiment)
        self._source: Source = make_source(config, [arm.name for arm in self.body.arms])
        self._ik: TwoArmIk | None = None
        self._hands: list[ClutchedHand] = []
        self.latencies_s: list[float] = []
        """From reading the input to the joint targets, per action."""
        phases.install()

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Absolute joint targets in the embodiment's order."""
        return dict.fromkeys(joint_keys(self.body), float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether the input is open."""
        return self._ik is not None

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Open the input; the hands start at the robot's home until `follow` says where they are."""
        from lerobot_vtrefine.teleoperators.hand_ik import TwoArmIk

        ik = TwoArmIk(self.config.embodiment, 1.0 / self.config.fps, self.config.speed)
        settings = MotionSettings(
            scale=self.config.scale,
            operator=Rotation.from_euler("z", self.config.operator_yaw_rad).as_matrix(),
            tool_frame=self.config.frame == "tool",
            jump_m=self.config.jump_m,
            jump_rad=self.config.jump_rad,
        )
        try:
            self._source.connect()
        except BaseException:
            self._source.disconnect()  # of several devices, those before the one that failed are open
            raise
        self._hands = [ClutchedHand(settings, pose) for pose in ik.hands()]
        self._ik = ik

    def follow(self, positions: Mapping[str, float], fps: float) -> None:
        """The robot's joints are held here, by their action keys: the hands go on from there.

        Raises:
            ValueError: LeRobot's loop runs at another rate than the inverse kinematics.
        """
        assert self._ik is not None
        if fps != self.config.fps:
            raise ValueError(
                f"--teleop.fps={self.config.fps}, but this command asks {fps:g} times a second: "
                f"give --teleop.fps={fps:g}, so that hands move at the right speed"
            )
        self._ik.restart(np.array([positions[key] for key in self.action_features], float))
        for hand, pose in zip(self._hands, self._ik.hands(), strict=True):
            hand.restart(pose)
        closed = 1.0 - self.body.openings(self._ik.joints) / self.body.fingers.travel_m
        self._source.restart(
            {arm.name: float(grip) for arm, grip in zip(self.body.arms, closed, strict=True)}
        )

    def configure(self) -> None:
        """Nothing to configure."""

    @property
    def is_calibrated(self) -> bool:
        """Always: the clutch says where a motion begins."""
        return True

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    @check_if_not_connected
    def get_action(self) -> RobotAction:
        """The next joint targets: where the arms are wanted one control step from now."""
        assert self._ik is not None
        began = time.perf_counter()
        samples = self._source.read()
        wanted = [
            hand.update(samples.get(arm.name), reached)
            for hand, arm, reached in zip(self._hands, self.body.arms, self._ik.hands(), strict=True)
        ]
        targets = self._ik.step(wanted, [hand.grip for hand in self._hands])
        for hand, pose, reached in zip(self._hands, wanted, self._ik.hands(), strict=True):
            if np.linalg.norm(pose.position - reached.position) > OUT_OF_REACH_M:
                hand.hold_back(reached)
        self.latencies_s.append(time.perf_counter() - began)
        return dict(zip(self.action_features, map(float, targets), strict=True))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing: nothing is driven."""

    def disconnect(self) -> None:
        """Close the input."""
        self._source.disconnect()
        self._ik = None
        if self.latencies_s:
            milliseconds = 1e3 * np.array(self.latencies_s)
            logger.info(
                "from input to joint targets: %.1f ms (99 %% within %.1f ms)",
                np.median(milliseconds),
                np.percentile(milliseconds, 99),
            )
