"""What people hold in their hands. Packages are imported by the input that needs them."""

from collections.abc import Mapping
from typing import Protocol

from lerobot_vtrefine.teleoperators.config_vtrefine_ee import VtRefineEeConfig
from lerobot_vtrefine.teleoperators.hand_motion import HandSample

__all__ = ["Source", "make_source"]


class Source(Protocol):
    """Controllers of both hands."""

    def connect(self) -> None:
        """Open the device."""
        ...

    def restart(self, grips: Mapping[str, float]) -> None:
        """An episode begins, with hands closed so far by arm: 0 open, 1 closed."""
        ...

    def read(self) -> dict[str, HandSample]:
        """The latest samples by arm; an arm whose controller is not seen is left out."""
        ...

    def disconnect(self) -> None:
        """Close the device."""
        ...


def make_source(config: VtRefineEeConfig, arms: list[str]) -> Source:
    """The input of a configuration.

    Raises:
        ValueError: a recording cannot be read, or a device of LeRobot's is not configured rightly.
        ImportError: the package that reads the device is missing.
    """
    if config.input == "recording":
        from lerobot_vtrefine.teleoperators.inputs.recording import RecordedControllers

        assert config.path is not None
        return RecordedControllers(config.path, arms)
    if config.input == "excitation":
        from lerobot_vtrefine.teleoperators.inputs.excitation import Excitation

        return Excitation(arms, config.fps)
    if config.input == "webxr":
        from lerobot_vtrefine.teleoperators.inputs.webxr import WebXrControllers

        return WebXrControllers({arm: config.webxr_ports[arm] for arm in arms}, config.timeout_s)
    if config.input == "headset":
        from lerobot_vtrefine.teleoperators.inputs.headset import HeadsetControllers

        return HeadsetControllers(config.headset_port, arms, config.timeout_s)
    if config.input == "lerobot":
        from lerobot_vtrefine.teleoperators.inputs.lerobot_devices import LeRobotDevices

        return LeRobotDevices(config.devices, config.fps, config.key_speed_m_s)
    return _speed_controllers(config, arms)


def _speed_controllers(config: VtRefineEeConfig, arms: list[str]) -> Source:
    """Devices that say how fast, not where."""
    from lerobot_vtrefine.teleoperators.inputs.speed import Pushes, SpeedControllers

    device: Pushes
    if config.input == "gamepad":
        from lerobot_vtrefine.teleoperators.inputs.gamepad import Gamepad

        device = Gamepad()
    elif config.input == "spacemouse":
        from lerobot_vtrefine.teleoperators.inputs.spacemouse import SpaceMice

        device = SpaceMice(config.spacemice, arms)
    else:
        from lerobot_vtrefine.teleoperators.inputs.keyboard import Keyboard

        device = Keyboard()
    step_m, step_rad = config.key_speed_m_s / config.fps, config.key_speed_rad_s / config.fps
    return SpeedControllers(device, arms, step_m, step_rad)
