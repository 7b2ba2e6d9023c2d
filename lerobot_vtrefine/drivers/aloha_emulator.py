"""ALOHA's four arms on pseudo-terminals, with calibration files: LeRobot's commands without hardware."""

import errno
import json
import math
from contextlib import ExitStack
from pathlib import Path

from lerobot.motors.dynamixel.tables import MODEL_NUMBER_TABLE

from lerobot_vtrefine.drivers.arm_models import GRIPPER, VIPERX_300S, WIDOWX_250S, ArmModel
from lerobot_vtrefine.drivers.dynamixel_emulator import DynamixelEmulator, EmulatedMotor

ARMS = {"follower": VIPERX_300S, "leader": WIDOWX_250S}
SIDES = ("left", "right")

GRIPPER_ENDS = {VIPERX_300S: (1700, 2600), WIDOWX_250S: (1900, 2300)}
"""Positions of the closed and the open gripper [counts]."""

JOINT_ENDS = (100, 4000)
CENTRE = 2048
WAVE_COUNTS = 250.0
"""How far a leader's waist swings to either side [counts]."""

WAVE_S = 8.0
"""Time of one swing [s]."""


def arm_motors(model: ArmModel, speed: float) -> list[EmulatedMotor]:
    """Motors of one arm in its middle position; `speed` is how fast they follow their goals [counts/s]."""
    motors = model.bus_motors().values()
    return [EmulatedMotor(motor.id, MODEL_NUMBER_TABLE[motor.model], speed=speed) for motor in motors]


def arm_calibration(model: ArmModel) -> dict[str, dict[str, int]]:
    """Content of LeRobot's calibration file of two arms: zeros as assembled, and the gripper's two ends."""
    entries = {}
    for side in SIDES:
        for name, number, _ in model.motors:
            low, high = GRIPPER_ENDS[model] if name == GRIPPER else JOINT_ENDS
            entries[f"{side}_{name}"] = {
                "id": number,
                "drive_mode": 0,
                "homing_offset": 0,
                "range_min": low,
                "range_max": high,
            }
    return entries


class AlohaEmulator:
    """Followers and leaders: ports `FOLDER/follower_left` and so on, `FOLDER/calibration/follower.json`."""

    def __init__(self, folder: Path, *, speed: float = 8000.0) -> None:
        self.folder = folder
        self.buses = {
            f"{who}_{side}": DynamixelEmulator(arm_motors(model, speed), folder / f"{who}_{side}")
            for who, model in ARMS.items()
            for side in SIDES
        }
        self._stack = ExitStack()

    @property
    def calibration_dir(self) -> Path:
        """Where `follower.json` and `leader.json` are."""
        return self.folder / "calibration"

    def __enter__(self) -> "AlohaEmulator":
        self.calibration_dir.mkdir(parents=True, exist_ok=True)
        for who, model in ARMS.items():
            path = self.calibration_dir / f"{who}.json"
            text = json.dumps(arm_calibration(model))
            if path.exists() and path.read_text(encoding="utf-8") != text:
                reason = "this is the calibration of other arms; choose another folder"
                raise FileExistsError(errno.EEXIST, reason, str(path))
            path.write_text(text, encoding="utf-8")
        with ExitStack() as stack:
            for bus in self.buses.values():
                stack.enter_context(bus)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def wave(self, elapsed_s: float) -> None:
        """Move the leaders as an operator might: waists swing, grippers close and open."""
        phase = 2 * math.pi * elapsed_s / WAVE_S
        closed, opened = GRIPPER_ENDS[ARMS["leader"]]
        for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
            motors = self.buses[f"leader_{side}"].motors
            motors[1].shaft = CENTRE + sign * WAVE_COUNTS * math.sin(phase)
            motors[9].shaft = closed + (opened - closed) * (0.5 - 0.5 * math.cos(phase))

    def flags(self) -> list[str]:
        """What to give to LeRobot's commands."""
        lines = []
        for option, kind, who in (
            ("robot", "aloha_tactile_follower", "follower"),
            ("teleop", "aloha_leader", "leader"),
        ):
            ports = " ".join(f"--{option}.{side}_port={self.folder / f'{who}_{side}'}" for side in SIDES)
            lines.append(f"--{option}.type={kind} --{option}.id={who} {ports}")
            lines.append(f"--{option}.calibration_dir={self.calibration_dir}")
        return lines
