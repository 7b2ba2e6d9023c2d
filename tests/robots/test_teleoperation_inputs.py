"""Each of vtrefine_ee's own inputs raises the right hand's plug through stock lerobot-record."""

import sys
from collections.abc import Generator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commands import dataset_flags, flags, run_command
from emulated_devices import HidApi, Listener, SdlGamepad, page_client, raised_phone
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from ports import free_port
from test_headset import hand, message
from test_lerobot_devices import assert_raises_the_plug

from lerobot_vtrefine.datasets.features import ACTION_KEY
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.teleoperators.vtrefine_ee import VtRefineEe

FPS, SECONDS = 10, 1.5
RIGHT_STICK_BACK, RIGHT_SHOULDER = 4, 5


@pytest.fixture(autouse=True)
def restored() -> Generator[None]:
    yield
    phases.uninstall()


def keyboard(patch: pytest.MonkeyPatch, _stack: ExitStack) -> list[str]:
    patch.setitem(sys.modules, "pynput", SimpleNamespace())
    patch.setitem(sys.modules, "pynput.keyboard", SimpleNamespace(Listener=Listener))
    begin = VtRefineEe.follow

    def follow(teleop: VtRefineEe, *where: object) -> None:
        begin(teleop, *where)
        Listener.latest.press(SimpleNamespace(char="o"))

    patch.setattr(VtRefineEe, "follow", follow)
    return []


def gamepad(patch: pytest.MonkeyPatch, _stack: ExitStack) -> list[str]:
    pad = SdlGamepad(patch)
    pad.press(RIGHT_SHOULDER)
    pad.tilt(RIGHT_STICK_BACK, -1.0)
    return []


def spacemouse(patch: pytest.MonkeyPatch, _stack: ExitStack) -> list[str]:
    HidApi(patch).report(1, 0, 0, -350)
    return []


def headset(_patch: pytest.MonkeyPatch, stack: ExitStack) -> list[str]:
    pytest.importorskip("teleop")
    port = free_port()
    still = hand((-0.2, 1.0, -0.3))
    stack.enter_context(
        page_client(port, lambda s: message(left=still, right=hand((0.2, 1.0 + 0.05 * s, -0.3))))
    )
    return flags(teleop__headset_port=port)


def webxr(_patch: pytest.MonkeyPatch, stack: ExitStack) -> list[str]:
    pytest.importorskip("teleop")
    ports = {"left": free_port(), "right": free_port()}
    stack.enter_context(raised_phone(ports["right"], speed_m_s=0.05))
    return flags(teleop__webxr_ports=str(ports).replace("'", ""))


@pytest.mark.slow
@pytest.mark.parametrize("device", [keyboard, gamepad, spacemouse, headset, webxr], ids=lambda d: d.__name__)
def test_it_records_through_stock_lerobot_record(
    device: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = flags(robot__type="vtrefine_sim", robot__env="{start: grasped, num_threads: 1}", robot__seed=3)
    teleop = flags(teleop__type="vtrefine_ee", teleop__input=device.__name__)
    root = tmp_path / "d"
    with ExitStack() as stack:
        teleop += device(monkeypatch, stack)
        run_command(monkeypatch, "record", [*robot, *teleop, *dataset_flags(root, 1, SECONDS, FPS)])
    actions = LeRobotDataset("local/x", root=root).hf_dataset.with_format("numpy")[ACTION_KEY]
    assert_raises_the_plug(np.array(actions))
