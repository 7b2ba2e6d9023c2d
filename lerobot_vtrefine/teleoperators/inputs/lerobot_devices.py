"""LeRobot's own end-effector teleoperators, one per hand: `gamepad`, `keyboard_ee` and `phone`.

They say how fast a hand is to move, or where a phone is; LeRobot turns that into joints by processors that a
program must put together. Here it becomes what every input of this package gives, in the operator's frame.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import draccus
import numpy as np
from draccus.utils import DraccusException
from lerobot.teleoperators import gamepad, keyboard, phone  # noqa: F401  (registers their types)
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.teleoperators.utils import make_teleoperator_from_config
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_vtrefine.lerobot_compat import arrow_keys
from lerobot_vtrefine.teleoperators.hand_motion import HandSample, moved, still

TYPES = ("gamepad", "keyboard_ee", "phone")
FORWARD_LEFT_UP = np.eye(3)
LEFT_BACK_UP = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""The frame of LeRobot's arrow keys, and the one that it assumes an iPhone to have, in the operator's."""
CLOSE, OPEN = 0, 2
"""What LeRobot's deltas say of the gripper; anything else leaves it as it is."""
GRIP_S = 0.5
"""An open hand is closed after holding the button for so long."""


class LeRobotDevices:
    """Reads a teleoperator of LeRobot for each of the arms that have one; the others stay.

    Args:
        devices: by arm, the fields of the teleoperator's configuration, `type` among them.
        fps: control steps per second.
        speed_m_s: a hand's speed under a key or a fully tilted stick.

    Raises:
        ValueError: a configuration is wrong; the message names the arm.
        ImportError: LeRobot lacks the package that reads the device.
    """

    def __init__(self, devices: Mapping[str, Mapping[str, Any]], fps: int, speed_m_s: float) -> None:
        self._devices = {arm: _make(arm, fields) for arm, fields in devices.items()}
        self._axes = {arm: axes_of(device.config) for arm, device in self._devices.items()}
        self._step_m, self._step_grip = speed_m_s / fps, 1.0 / (GRIP_S * fps)
        self.restart({})

    def connect(self) -> None:
        """Open all of them. Raises: ValueError for a device that is not there."""
        for arm, device in self._devices.items():
            device.connect()
            if not device.is_connected or not _answers(device):
                raise ValueError(
                    f"--teleop.devices: the {device.name} for the {arm} hand cannot be read here"
                )
            if isinstance(device, keyboard.KeyboardEndEffectorTeleop):
                arrow_keys.install(self)

    def restart(self, grips: Mapping[str, float]) -> None:
        """The devices are at rest, and the hands closed as they are."""
        self._samples = {arm: replace(still(), grip=grips.get(arm, 0.0)) for arm in self._devices}

    def read(self) -> dict[str, HandSample]:
        """The latest samples; a device that is gone, or has said nothing yet, gives none."""
        heard = {}
        for arm, device in self._devices.items():
            try:
                action = device.get_action()
            except DeviceNotConnectedError:  # such as by the keyboard's Esc
                continue
            if action:
                heard[arm] = sample_of(
                    action, self._axes[arm], self._samples[arm], self._step_m, self._step_grip
                )
        self._samples |= heard
        return heard

    def disconnect(self) -> None:
        """Close all of them."""
        arrow_keys.uninstall(self)
        for device in self._devices.values():
            if device.is_connected:
                device.disconnect()


def sample_of(
    action: Mapping[str, Any], axes: np.ndarray, before: HandSample, step_m: float, step_grip: float
) -> HandSample:
    """What an action of LeRobot's says after the sample before.

    Args:
        action: `delta_x`, `delta_y`, `delta_z` (shares of the full speed) and `gripper`; or a phone's pose.
        axes: (3, 3) the device's frame in the operator's.
        before: the last sample.
        step_m: way of one control step at full speed [m].
        step_grip: by how much a hand closes in one.
    """
    if "phone.pos" in action:
        opening = _phone_opening(action["phone.raw_inputs"])
        place = axes @ np.asarray(action["phone.pos"], float)
        turn = axes @ action["phone.rot"].as_matrix() @ axes.T
        sample = HandSample(place, turn, bool(action["phone.enabled"]), before.grip)
    else:
        delta = np.array([float(action[f"delta_{axis}"]) for axis in "xyz"])
        opening = {CLOSE: -1.0, OPEN: 1.0}.get(round(float(action.get("gripper", 1))), 0.0)
        sample = replace(moved(before, axes @ np.clip(delta, -1, 1) * step_m, np.zeros(3)), clutch=True)
    return replace(sample, grip=float(np.clip(before.grip - opening * step_grip, 0.0, 1.0)))


def axes_of(config: TeleoperatorConfig) -> np.ndarray:
    """(3, 3) the frame of a device's actions in the operator's: x forward, y left, z up."""
    if isinstance(config, phone.PhoneConfig):
        return LEFT_BACK_UP if config.phone_os == phone.config_phone.PhoneOS.IOS else FORWARD_LEFT_UP
    return LEFT_BACK_UP if config.type == "keyboard_ee" else FORWARD_LEFT_UP


def _phone_opening(inputs: Mapping[str, Any]) -> float:
    """Share of the full speed at which a phone opens the gripper, as LeRobot's own processor reads it."""
    if "a3" in inputs:
        return float(inputs["a3"])
    return float(inputs.get("reservedButtonA", 0.0)) - float(inputs.get("reservedButtonB", 0.0))


def _make(arm: str, fields: Mapping[str, Any]) -> Any:
    kind = fields.get("type") if isinstance(fields, Mapping) else None
    if kind not in TYPES:
        raise ValueError(
            f"--teleop.devices: the {arm} hand needs one of LeRobot's end-effector teleoperators, such as "
            f"{{{arm}: {{type: gamepad}}}}; choose from {', '.join(TYPES)}, not {kind}"
        )
    try:
        device: Teleoperator = make_teleoperator_from_config(draccus.decode(TeleoperatorConfig, dict(fields)))
    except (DraccusException, TypeError) as error:
        raise ValueError(f"--teleop.devices: {arm}: {error}") from error
    return device


def _answers(device: Any) -> bool:
    """LeRobot's gamepad only logs that none is plugged in."""
    return getattr(getattr(device, "gamepad", None), "running", True)
