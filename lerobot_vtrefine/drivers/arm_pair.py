"""Two arms of one bimanual device, follower or leader: connected, calibrated, read and released together."""

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from lerobot.motors import MotorCalibration

from lerobot_vtrefine.drivers.arm_models import ArmModel
from lerobot_vtrefine.drivers.dynamixel_arm import DynamixelArm, Floats
from lerobot_vtrefine.drivers.ports import PortError

logger = logging.getLogger(__name__)

Calibration = dict[str, MotorCalibration]
Ask = Callable[[str], str]


class ArmPair:
    """A left and a right arm of one model, sixteen values: eight of the left arm, then eight of the right."""

    def __init__(self, left_port: str, right_port: str, model: ArmModel, travel_m: float) -> None:
        """Raise ValueError where both arms are on one port."""
        if left_port == right_port:
            raise ValueError(f"left_port and right_port are both {left_port}")
        ports = {"left": left_port, "right": right_port}
        self._readers: ThreadPoolExecutor | None = None
        self.arms = {name: DynamixelArm(name, port, model, travel_m) for name, port in ports.items()}

    @property
    def is_connected(self) -> bool:
        """Whether both ports are open."""
        return all(arm.is_connected for arm in self.arms.values())

    @property
    def is_calibrated(self) -> bool:
        """Whether both arms are."""
        return all(arm.is_calibrated for arm in self.arms.values())

    @property
    def calibration(self) -> Calibration:
        """Both arms' calibration, keys `left_<motor>`, `right_<motor>`."""
        return {
            f"{side}_{motor}": entry
            for side, arm in self.arms.items()
            for motor, entry in arm.calibration.items()
        }

    @calibration.setter
    def calibration(self, entries: Calibration) -> None:
        for side, arm in self.arms.items():
            prefix = f"{side}_"
            arm.calibration = {k.removeprefix(prefix): v for k, v in entries.items() if k.startswith(prefix)}

    def connect(self) -> None:
        """Open both ports and check the motors.

        Raises:
            PortError: a port cannot be used; the message names it and the fix. Neither stays open.
        """
        try:
            for arm in self.arms.values():
                arm.connect()
        except BaseException:
            self.release(torque_off=False)
            raise
        self._readers = ThreadPoolExecutor(len(self.arms), thread_name_prefix="arm")

    def calibrate(self, ask: Ask, lower: Floats, upper: Floats) -> None:
        """Calibrate both arms by hand; `lower` and `upper` are the joint limits of one arm (6,) [rad]."""
        for arm in self.arms.values():
            arm.calibrate(ask, lower, upper)

    def write_calibration(self) -> None:
        """Write the loaded calibration to the motors, with torque off."""
        for arm in self.arms.values():
            arm.write_calibration()

    def setup_motors(self, ask: Ask) -> None:
        """Give every motor its id and baud rate, one after the other."""
        for arm in self.arms.values():
            arm.setup_motors(ask)

    def read(self) -> Floats:
        """Measured state (16,) [rad, fingers m]; both arms at once, each waits for its own bus.

        Raises:
            PortError: an arm does not answer, or is not connected.
        """
        if self._readers is None:
            raise PortError(f"the arms on {' and '.join(arm.port for arm in self.arms.values())} are closed")
        return np.concatenate(list(self._readers.map(DynamixelArm.read, self.arms.values())))

    def release(self, *, torque_off: bool) -> None:
        """Close both ports, also after failures, which are logged."""
        if self._readers is not None:
            self._readers.shutdown()  # where one arm failed, the other may still be reading
            self._readers = None
        for arm in self.arms.values():
            try:
                arm.disconnect(torque_off=torque_off)
            except PortError as error:
                logger.error("%s", error)
