"""An emulated ALOHA rig: four boards, four buses of motors, all on pseudo-terminals."""

import json
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from lerobot.motors.dynamixel.tables import MODEL_NUMBER_TABLE

from lerobot_vtrefine.datasets.features import PADS
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.dynamixel_arm import VIPERX_300S, WIDOWX_250S, ArmModel
from lerobot_vtrefine.drivers.dynamixel_emulator import DynamixelEmulator, EmulatedMotor
from lerobot_vtrefine.drivers.emulator import PadEmulator
from lerobot_vtrefine.drivers.frames import FrameShape
from lerobot_vtrefine.drivers.pads_file import save_pads
from lerobot_vtrefine.drivers.sources import pattern_source

PAD = FrameShape(12, 32)
GRIPPER_ENDS = {VIPERX_300S: (1700, 2600), WIDOWX_250S: (1900, 2300)}
SIDES = ("left", "right")


@dataclass
class Rig:
    """Ports and emulators by name."""

    folder: Path
    boards: dict[str, PadEmulator]
    buses: dict[str, DynamixelEmulator]

    @property
    def pads_file(self) -> Path:
        return self.folder / "pads.yaml"

    def ports(self, who: str) -> dict[str, str]:
        return {f"{side}_port": self.buses[f"{who}_{side}"].port for side in SIDES}

    def motor(self, who: str, side: str, motor_id: int) -> EmulatedMotor:
        return self.buses[f"{who}_{side}"].motors[motor_id]


def motors_of(model: ArmModel) -> list[EmulatedMotor]:
    return [
        EmulatedMotor(motor.id, MODEL_NUMBER_TABLE[motor.model], speed=1e7)
        for motor in model.bus_motors().values()
    ]


def calibration_of(model: ArmModel) -> dict[str, dict[str, int]]:
    """A calibration file's content: zeros as assembled, the gripper's two ends."""
    entries = {}
    for side in SIDES:
        for name, number, _ in model.motors:
            low, high = GRIPPER_ENDS[model] if name == "gripper" else (100, 4000)
            entries[f"{side}_{name}"] = {
                "id": number,
                "drive_mode": 0,
                "homing_offset": 0,
                "range_min": low,
                "range_max": high,
            }
    return entries


def write_calibration(folder: Path, name: str, model: ArmModel) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(calibration_of(model)))


@contextmanager
def boards_of(
    folder: Path, names: tuple[str, ...], rate_hz: float = 60.0
) -> Generator[dict[str, PadEmulator]]:
    with ExitStack() as stack:
        yield {
            name: stack.enter_context(
                PadEmulator(
                    pattern_source(PAD, time.monotonic_ns, seed),
                    PAD,
                    folder / "boards" / name,
                    rate_hz=rate_hz,
                )
            )
            for seed, name in enumerate(names)
        }


def allow_slow_answers(patch: pytest.MonkeyPatch) -> None:
    """Emulated motors share this machine's processors with everything else; the SDK waits 34 ms."""
    patch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 120)


@contextmanager
def aloha_rig(folder: Path) -> Generator[Rig]:
    with ExitStack() as stack:
        boards = stack.enter_context(boards_of(folder, PADS))
        models = {"follower": VIPERX_300S, "leader": WIDOWX_250S}
        buses = {}
        for who, model in models.items():
            write_calibration(folder / "calibration", who, model)
            for side in SIDES:
                bus = DynamixelEmulator(motors_of(model), folder / "arms" / f"{who}_{side}")
                buses[f"{who}_{side}"] = stack.enter_context(bus)
        rig = Rig(folder, boards, buses)
        save_pads({name: PadConfig(board.port) for name, board in boards.items()}, rig.pads_file)
        yield rig
