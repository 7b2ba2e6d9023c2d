"""An emulated ALOHA rig: four boards, four buses of motors, all on pseudo-terminals."""

import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from aloha_columns import PADS

from lerobot_vtrefine.drivers.aloha_emulator import SIDES, AlohaEmulator
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.dynamixel_emulator import DynamixelEmulator, EmulatedMotor
from lerobot_vtrefine.drivers.emulator import PadEmulator
from lerobot_vtrefine.drivers.frames import FrameShape
from lerobot_vtrefine.drivers.pads_file import save_pads
from lerobot_vtrefine.drivers.ports import PortError
from lerobot_vtrefine.drivers.sources import pattern_source
from lerobot_vtrefine.robots import AlohaTactileFollowerConfig
from lerobot_vtrefine.robots.aloha_tactile_follower import AlohaTactileFollower

PAD = FrameShape(12, 32)


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
    """Emulated motors share this process with everything else; the SDK waits 34 ms, here half a second."""
    patch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 250)


def take_motors_off(rig: Rig, bus: str, patch: pytest.MonkeyPatch) -> None:
    """All motors of a bus fall silent; from then on the SDK waits 52 ms, as nothing here can answer late."""
    rig.buses[bus].motors.clear()
    patch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 25)


@contextmanager
def aloha_rig(folder: Path) -> Generator[Rig]:
    with ExitStack() as stack:
        boards = stack.enter_context(boards_of(folder, PADS))
        arms = stack.enter_context(AlohaEmulator(folder, speed=1e7))
        rig = Rig(folder, boards, arms.buses)
        save_pads({name: PadConfig(board.port) for name, board in boards.items()}, rig.pads_file)
        yield rig


@contextmanager
def emulated_elsewhere(folder: Path) -> Generator[list[str]]:
    """Boards with test patterns and arms with waving leaders in another process; what LeRobot's flags are."""
    words = ["--folder", str(folder / "pads"), "--source", "pattern", "--arms", str(folder / "arms")]
    command = [sys.executable, "-m", "lerobot_vtrefine.cli.pad_emulator", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            lines = [process.stdout.readline().split() for _ in range(len(PADS) + 4)]
            ports, flags = lines[: len(PADS)], [flag for line in lines[len(PADS) :] for flag in line]
            pads_file = folder / "pads.yaml"
            save_pads({Path(port).name: PadConfig(port) for (port,) in ports}, pads_file)
            yield [*flags, f"--robot.pads_file={pads_file}"]
        finally:
            process.terminate()


def follower_config(rig: Rig, **changes: object) -> AlohaTactileFollowerConfig:
    settings = {
        "id": "follower",
        "calibration_dir": rig.folder / "calibration",
        "pads_file": rig.pads_file,
        "rest_s": 0.1,
        **rig.ports("follower"),
    }
    return AlohaTactileFollowerConfig(**(settings | changes))


def connect_error(rig: Rig, **changes: object) -> str:
    robot = AlohaTactileFollower(follower_config(rig, **changes))
    with pytest.raises(PortError) as caught:
        robot.connect()
    assert not robot.is_connected
    assert not robot.pads.is_connected
    return str(caught.value)
