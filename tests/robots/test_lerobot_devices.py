"""LeRobot's gamepad, keyboard and phone drive a hand of the simulated robot through stock lerobot-record."""

from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from commands import dataset_flags, flags, run_command
from emulated_devices import Key, Listener, SdlGamepad, raised_phone, watch_keys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils import keyboard_input
from lerobot.utils.rotation import Rotation

from lerobot_vtrefine.datasets.features import ACTION_KEY
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.teleoperators import VtRefineEeConfig
from lerobot_vtrefine.teleoperators.hand_ik import TwoArmIk
from lerobot_vtrefine.teleoperators.hand_motion import still
from lerobot_vtrefine.teleoperators.inputs.lerobot_devices import LeRobotDevices, axes_of, sample_of
from lerobot_vtrefine.teleoperators.vtrefine_ee import VtRefineEe

FPS = 10
SECONDS = 1.5
LEFT, RIGHT = 0, 1


@pytest.fixture(autouse=True)
def restored() -> Generator[None]:
    yield
    phases.uninstall()


def recorded(patch: pytest.MonkeyPatch, root: Path, device: str) -> np.ndarray:
    """Actions (T, J) of an episode in which a device drives the right hand, from parts in hand."""
    robot = flags(robot__type="vtrefine_sim", robot__env="{start: grasped, num_threads: 1}", robot__seed=3)
    teleop = flags(
        teleop__type="vtrefine_ee", teleop__input="lerobot", teleop__devices=f"{{right: {device}}}"
    )
    run_command(patch, "record", [*robot, *teleop, *dataset_flags(root, 1, SECONDS, FPS)])
    dataset = LeRobotDataset("local/x", root=root)
    return np.array(dataset.hf_dataset.with_format("numpy")[ACTION_KEY])


def assert_raises_the_plug(actions: np.ndarray) -> None:
    """The right hand went up, the left one stayed, and neither opened or loosened its grip."""
    ik, body = TwoArmIk("aloha", 1 / FPS), get_embodiment("aloha")
    first, last = ik.hands(actions[0]), ik.hands(actions[-1])
    way = last[RIGHT].position - first[RIGHT].position
    assert 0.03 < way[2] < 0.13
    assert np.abs(way[:2]).max() < 0.005
    assert np.linalg.norm(last[LEFT].position - first[LEFT].position) < 1e-3
    openings = body.openings(actions)
    assert np.abs(openings - openings[0]).max() < 1e-6


def test_keyboard_ee_records_through_stock_lerobot_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch_keys(monkeypatch)
    begin = VtRefineEe.follow

    def follow(teleop: VtRefineEe, *where: object) -> None:
        begin(teleop, *where)
        Listener.latest.press(Key.shift_r)

    monkeypatch.setattr(VtRefineEe, "follow", follow)
    assert_raises_the_plug(recorded(monkeypatch, tmp_path / "d", "{type: keyboard_ee}"))


@pytest.mark.slow
def test_gamepad_records_through_stock_lerobot_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pad = SdlGamepad(monkeypatch)
    pad.tilt(3, -1.0)
    assert_raises_the_plug(recorded(monkeypatch, tmp_path / "d", "{type: gamepad}"))


@pytest.mark.slow
def test_phone_records_through_stock_lerobot_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("teleop", "hebi"):  # LeRobot asks for both, whatever the phone
        pytest.importorskip(package)
    with raised_phone(4443, speed_m_s=0.05):
        actions = recorded(monkeypatch, tmp_path / "d", "{type: phone, phone_os: android}")
    assert_raises_the_plug(actions)


def test_a_gamepad_is_read_as_lerobot_reads_it(monkeypatch: pytest.MonkeyPatch) -> None:
    pad = SdlGamepad(monkeypatch)
    devices = LeRobotDevices({"right": {"type": "gamepad"}}, FPS, speed_m_s=0.1)
    devices.connect()
    devices.restart({"right": 1.0})
    pad.tilt(1, -1.0)  # forward
    pad.press(7)  # open
    sample = devices.read()["right"]
    np.testing.assert_allclose(sample.position, [0.01, 0, 0], atol=1e-5)
    assert sample.grip == pytest.approx(0.8)
    pad.tilt(1, 0.0)
    pad.tilt(0, 1.0)  # right
    pad.press(7, down=False)
    pad.press(6)  # close
    sample = devices.read()["right"]
    np.testing.assert_allclose(sample.position, [0.01, -0.01, 0], atol=1e-5)
    assert sample.grip == pytest.approx(1.0)
    devices.disconnect()


def test_where_nothing_is_plugged_in_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    devices = LeRobotDevices({"right": {"type": "gamepad"}}, FPS, 0.1)
    with pytest.raises(ValueError, match="the gamepad for the right hand cannot be read here"):
        devices.connect()
    devices.disconnect()


def test_arrow_keys_point_away_from_the_operator_and_a_left_keyboard_is_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    watch_keys(monkeypatch)
    devices = LeRobotDevices({"left": {"type": "keyboard_ee"}}, FPS, speed_m_s=0.1)
    devices.connect()
    for key in (Key.up, Key.left, Key.ctrl_l):
        Listener.latest.press(key)
    sample = devices.read()["left"]
    np.testing.assert_allclose(sample.position, [0.01, 0.01, 0], atol=1e-12)
    assert sample.grip == pytest.approx(0.2)
    Listener.latest.release(Key.ctrl_l)  # LeRobot then says -1, neither close nor open
    assert devices.read()["left"].grip == pytest.approx(0.2)
    Listener.latest.release(Key.esc)
    assert devices.read() == {}


def test_lerobot_record_leaves_the_arrows_to_a_keyboard_that_drives_a_hand(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    watch_keys(monkeypatch)
    names = {Key.left: "left", Key.right: "right", Key.esc: "esc"}
    monkeypatch.setattr(keyboard_input, "_PYNPUT_KEY_NAMES", dict(names))
    heard = [keyboard_input._resolve_pynput_key(key) for key in names]
    assert heard == ["left", "right", "esc"]
    devices = LeRobotDevices({"left": {"type": "keyboard_ee"}}, FPS, speed_m_s=0.1)
    devices.connect()
    LeRobotDevices({"left": {"type": "keyboard_ee"}}, FPS, speed_m_s=0.1).disconnect()  # none of its business
    heard = [keyboard_input._resolve_pynput_key(key) for key in names]
    devices.disconnect()
    assert heard == [None, None, "esc"]
    assert names == keyboard_input._PYNPUT_KEY_NAMES


def test_a_phones_place_and_turn_come_in_the_operators_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    watch_keys(monkeypatch)
    action = {
        "phone.pos": np.array([0.1, 0.2, 0.3]),
        "phone.rot": Rotation.from_rotvec(np.array([0.0, 0.0, 0.4])),
        "phone.raw_inputs": {"reservedButtonB": True},
        "phone.enabled": True,
    }
    config = LeRobotDevices({"left": {"type": "keyboard_ee"}}, FPS, 0.1)._devices["left"].config
    ios = sample_of(action, axes_of(config), still(), 0.01, 0.2)
    android = sample_of(action, np.eye(3), still(), 0.01, 0.2)
    np.testing.assert_allclose(ios.position, [-0.2, 0.1, 0.3])  # as LeRobot's own processor turns it
    np.testing.assert_allclose(android.position, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(ios.rotation, android.rotation, atol=1e-12)  # a turn about the vertical
    assert (ios.clutch, ios.grip) == (True, 0.2)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"input": "lerobot"}, "belong together"),
        ({"devices": {"right": {"type": "gamepad"}}}, "belong together"),
        ({"input": "lerobot", "devices": {"middle": {"type": "gamepad"}}}, "no arm is called middle"),
    ],
)
def test_wrong_settings_are_one_line(settings: dict, words: str) -> None:
    with pytest.raises(Exception, match=words):
        VtRefineEeConfig(**settings)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"type": "so101_leader"}, "choose from gamepad, keyboard_ee, phone, not so101_leader"),
        ("gamepad", "choose from gamepad, keyboard_ee, phone, not None"),
        ({"type": "gamepad", "deadzone": 1}, "right: .*deadzone"),
    ],
)
def test_other_devices_are_refused_in_one_line(fields: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        LeRobotDevices({"right": fields}, FPS, 0.1)


def test_a_device_that_is_missing_leaves_the_others_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    watch_keys(monkeypatch)
    names = {Key.left: "left"}
    monkeypatch.setattr(keyboard_input, "_PYNPUT_KEY_NAMES", dict(names))
    devices = {"left": {"type": "keyboard_ee"}, "right": {"type": "gamepad"}}
    teleoperator = VtRefineEe(VtRefineEeConfig(input="lerobot", devices=devices))
    with pytest.raises(ValueError, match="the gamepad for the right hand cannot be read here"):
        teleoperator.connect()
    assert not Listener.latest.is_alive()
    assert names == keyboard_input._PYNPUT_KEY_NAMES
