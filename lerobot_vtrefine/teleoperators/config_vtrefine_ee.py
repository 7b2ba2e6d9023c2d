"""Configuration of end-effector teleoperation."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.teleoperators.config import TeleoperatorConfig

from lerobot_vtrefine.embodiments import DEFAULT_BODY, get_embodiment
from lerobot_vtrefine.lerobot_compat.config_errors import told_by_lerobot

INPUTS = ("keyboard", "gamepad", "spacemouse", "headset", "webxr", "lerobot", "recording", "excitation")
FRAMES = ("world", "tool")


@TeleoperatorConfig.register_subclass("vtrefine_ee")
@dataclass(kw_only=True)
class VtRefineEeConfig(TeleoperatorConfig):
    """Both hands of a robot, moved by hand-held controllers, gamepad, SpaceMice, keys, or LeRobot's devices.

    Attributes:
        embodiment: Whose arms: the name of a robot of this package.
        input: keyboard, gamepad, spacemouse, headset (its two controllers, in its browser), webxr (a phone
            per hand, in its browser), lerobot (its own teleoperators, see devices), recording, or excitation
            (nobody: the hands sway so that every joint moves back and forth, for vtrefine-diagnose).
        devices: For input=lerobot, by the arm's name: one of LeRobot's end-effector teleoperators with its
            fields, such as "{right: {type: gamepad}}". An arm without one stays where it is.
        path: The recorded controllers, for input=recording: an .npz file, see docs/teleoperation.md.
        headset_port: Port of the page that the headset opens.
        spacemice: By the arm's name, the number of its SpaceMouse among those that are plugged in, from 0. An
            arm without one stays where it is.
        webxr_ports: Port of the page for each hand's device, by the arm's name.
        fps: Control steps a second; the command must run at the same rate.
        scale: Way of a hand per way of its controller.
        frame: world, or tool: along the hand's own axes.
        operator_yaw_rad: Where the operator looks, about the world's z axis, from its x axis. By default
            towards -x, with the left arm on the left.
        speed: Share of the joints' rate limits that may be used, above 0 to 1.
        jump_m: A controller that moves farther in one control step was lost for a moment, and moves nothing.
        jump_rad: The same for turns.
        timeout_s: A device that says nothing for this long is gone, and moves nothing.
        key_speed_m_s: Speed of a hand under a key or a fully tilted stick or cap.
        key_speed_rad_s: The same for turns.
    """

    embodiment: str = DEFAULT_BODY
    input: str = "keyboard"
    devices: dict[str, Any] = field(default_factory=dict)
    path: Path | None = None
    headset_port: int = 4443
    spacemice: dict[str, int] = field(default_factory=lambda: {"right": 0})
    webxr_ports: dict[str, int] = field(default_factory=lambda: {"left": 4443, "right": 4444})
    fps: int = 10
    scale: float = 1.0
    frame: str = "world"
    operator_yaw_rad: float = math.pi
    speed: float = 1.0
    jump_m: float = 0.15
    jump_rad: float = 1.0
    timeout_s: float = 0.3
    key_speed_m_s: float = 0.08
    key_speed_rad_s: float = 0.5

    @told_by_lerobot
    def __post_init__(self) -> None:
        for name, value, choices in (("input", self.input, INPUTS), ("frame", self.frame, FRAMES)):
            if value not in choices:
                raise ValueError(f"--teleop.{name}={value} is unknown; choose from {', '.join(choices)}")
        if (self.input == "recording") != (self.path is not None):
            raise ValueError("--teleop.input=recording and --teleop.path=FILE.npz belong together")
        if (self.input == "lerobot") != bool(self.devices):
            raise ValueError(
                '--teleop.input=lerobot and --teleop.devices="{right: {type: gamepad}}" belong together'
            )
        arms = [arm.name for arm in get_embodiment(self.embodiment).arms]
        per_arm = {"devices": self.devices, "spacemice": self.spacemice if self.input == "spacemouse" else {}}
        for flag, given in per_arm.items():
            if unknown := [name for name in given if name not in arms]:
                raise ValueError(
                    f"--teleop.{flag}: no arm is called {unknown[0]}; choose from {', '.join(arms)}"
                )
        if self.input == "webxr" and (unserved := [name for name in arms if name not in self.webxr_ports]):
            raise ValueError(f"--teleop.webxr_ports names no port for the arm {unserved[0]}")
        if min(self.spacemice.values(), default=0) < 0:
            raise ValueError(f"--teleop.spacemice counts from 0, got {self.spacemice}")
        for name in ("fps", "scale", "jump_m", "jump_rad", "timeout_s", "key_speed_m_s", "key_speed_rad_s"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"--teleop.{name} must be above 0, got {getattr(self, name)}")
        if not 0 < self.speed <= 1:
            raise ValueError(f"--teleop.speed must lie within 0 .. 1, and above 0, got {self.speed}")
