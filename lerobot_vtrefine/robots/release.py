"""Lets go of a robot of LeRobot's that is connected in part, which its own `disconnect` refuses to do."""

import logging
from collections.abc import Iterator
from typing import Any

from lerobot.motors.motors_bus import MotorsBusBase
from lerobot.robots.robot import Robot

logger = logging.getLogger(__name__)


def release(robot: Robot) -> None:
    """Disconnect a robot, or what of it is connected; failures are logged, and the rest is still let go.

    LeRobot's robots count as connected where all of their motors and cameras are: where a camera fails, the
    motors' port stays open, and nobody else can open it until the process ends.
    """
    _disconnect(robot)
    config = getattr(robot, "config", None)
    for part in _parts(robot):
        if isinstance(part, Robot):
            release(part)
        elif isinstance(part, MotorsBusBase):
            torque_off = getattr(config, "disable_torque_on_disconnect", True)
            _disconnect(part, torque_off)
            _disconnect(part, False)  # where motors that do not answer kept it open
        else:
            _disconnect(part)


def _parts(robot: Robot) -> Iterator[Any]:
    """What a robot holds that can be disconnected, also by name."""
    for value in vars(robot).values():
        for part in value.values() if isinstance(value, dict) else [value]:
            if callable(getattr(part, "disconnect", None)) and hasattr(part, "is_connected"):
                yield part


def _disconnect(part: Any, *arguments: bool) -> None:
    try:
        if part.is_connected:
            part.disconnect(*arguments)
    except Exception as error:  # whatever the device's package raises
        logger.error("%s could not be disconnected: %s", type(part).__name__, error)
