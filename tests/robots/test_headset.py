"""A headset's two controllers: through the server of its page, and through the page in a browser."""

import json
import shutil
import socket
import time
from collections.abc import Callable, Generator
from pathlib import Path

import numpy as np
import pytest
from commands import dataset_flags, flags, run_command, train
from emulated_devices import page_client
from ports import free_port
from scipy.spatial.transform import Rotation
from test_vtrefine_ee import as_controllers, expert_targets

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.lerobot_compat import phases
from lerobot_vtrefine.teleoperators import VtRefineEeConfig
from lerobot_vtrefine.teleoperators.inputs.headset import HeadsetControllers, pose_of
from lerobot_vtrefine.teleoperators.vtrefine_ee import VtRefineEe

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
ARMS = ["left", "right"]
FPS = 10
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
FORWARD_LEFT_UP = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""WebXR's z axis points back, its x axis to the right, its y axis up."""


@pytest.fixture(autouse=True)
def restored() -> Generator[None]:
    yield
    phases.uninstall()


@pytest.fixture
def port() -> int:
    pytest.importorskip("teleop")
    return free_port()


def hand(place: object, turn: object = UPRIGHT, squeeze: bool = True, trigger: bool = False) -> dict:
    x, y, z, w = turn
    return {
        "position": dict(zip("xyz", map(float, place), strict=True)),
        "orientation": {"x": float(x), "y": float(y), "z": float(z), "w": float(w)},
        "squeeze": squeeze,
        "trigger": trigger,
    }


def message(**hands: dict) -> dict:
    """What the page sends."""
    return {"move": False, "position": dict.fromkeys("xyz", 0), "orientation": dict.fromkeys("xyzw", 0)} | {
        "hands": hands
    }


def until(true: Callable[[], object], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_controllers_place_and_turn_come_in_the_operators_frame() -> None:
    pose = pose_of(hand((0.1, 1.2, -0.3), Rotation.from_euler("y", 90, degrees=True).as_quat()))
    np.testing.assert_allclose(pose[:3, 3], [0.3, -0.1, 1.2])
    np.testing.assert_allclose(pose[:3, 0], [0, 1, 0], atol=1e-12)  # turned to the left, seen from above
    assert not np.isfinite(pose_of(hand((0, 0, 0), (0, 0, 0, 0)))[:3, :3]).any()


def test_clutch_trigger_and_lost_tracking() -> None:
    headset = HeadsetControllers(0, ARMS, timeout_s=0.05)
    headset.hear(np.eye(4), message(left=hand((0, 0, 0))))
    headset.restart({"left": 0.6, "right": 0.0})  # it holds something, whatever was heard before
    assert headset.read()["left"].grip == 0.6

    def heard(**hands: dict) -> dict:
        headset.hear(np.eye(4), message(**hands))
        return headset.read()

    assert heard(left=hand((0, 0, 0), squeeze=False))["left"].clutch is False
    assert heard(left=hand((0, 0, 0), trigger=True), right=hand((0, 0, 0)))["left"].grip == 0.0
    assert heard(left=hand((0, 0, 0), trigger=True))["left"].grip == 0.0  # held
    assert heard(left=hand((0, 0, 0)))["left"].grip == 0.0
    assert heard(left=hand((0, 0, 0), trigger=True))["left"].grip == 1.0
    assert set(heard(right=hand((0, 0, 0)))) == {"right"}  # the left one is not tracked
    time.sleep(0.06)
    assert headset.read() == {}


def test_a_port_that_is_taken_is_one_line() -> None:
    pytest.importorskip("teleop")
    with socket.socket() as other:
        other.bind(("localhost", 0))
        other.listen()
        taken = other.getsockname()[1]
        with pytest.raises(ValueError, match=f"port {taken} is taken: .*--teleop.headset_port"):
            HeadsetControllers(taken, ARMS, timeout_s=1.0).connect()


def test_both_hands_follow_what_comes_through_the_pages_socket(port: int) -> None:
    teleop = VtRefineEe(VtRefineEeConfig(input="headset", headset_port=port, timeout_s=5.0))
    teleop.connect()
    shown = {"left": hand((0, 1, 0)), "right": hand((0.3, 1, 0))}
    with page_client(port, lambda _seconds: message(**shown)):
        until(lambda: len(teleop._source.read()) == 2)
        teleop.get_action()
        start = teleop._ik.hands()
        shown["left"] = hand((0, 1.03, 0))  # up
        shown["right"] = hand((0.3, 1, -0.03))  # forward: towards -x, where the operator looks
        until(lambda: teleop._source.read()["right"].position[0] > 0.02)
        for _ in range(20):
            teleop.get_action()
    ways = [after.position - before.position for before, after in zip(start, teleop._ik.hands(), strict=True)]
    np.testing.assert_allclose(ways, [[0, 0, 0.03], [-0.03, 0, 0]], atol=1e-3)
    teleop.disconnect()


@pytest.mark.slow
def test_a_headset_inserts_through_stock_lerobot_record_and_a_policy_trains_on_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: int
) -> None:
    targets = expert_targets(VtRefineEnvConfig(start="grasped", num_threads=1), seed=3)
    people, asked = as_controllers(targets), []
    act = VtRefineEe.get_action

    def get_action(teleop: VtRefineEe) -> dict:
        until(lambda: len(teleop._source.read()) == 2)
        action = act(teleop)
        asked.append(action)
        return action

    def now(_seconds: float) -> dict:
        step = min(len(asked), len(targets) - 1)
        hands = {}
        for arm in ARMS:
            place = FORWARD_LEFT_UP.T @ people[f"{arm}_position"][step]
            turn = Rotation.from_quat(people[f"{arm}_quaternion"][step], scalar_first=True).as_matrix()
            turn = FORWARD_LEFT_UP.T @ turn @ FORWARD_LEFT_UP
            hands[arm] = hand(place, Rotation.from_matrix(turn).as_quat())
        return message(**hands)

    monkeypatch.setattr(VtRefineEe, "get_action", get_action)
    teleop = flags(teleop__type="vtrefine_ee", teleop__input="headset", teleop__headset_port=port)
    robot = flags(robot__type="vtrefine_sim", robot__env="{start: grasped, num_threads: 1}", robot__seed=3)
    root = tmp_path / "recorded"
    with page_client(port, now):
        run_command(monkeypatch, "record", [*robot, *teleop, *dataset_flags(root, 1, 10.0, FPS)])
    row = json.loads((root / "meta" / "recording.json").read_text())["episodes"][0]
    print(row)
    assert row["success"]
    policy = train(monkeypatch, root, tmp_path / "out", steps=2)
    assert (policy / "model.safetensors").is_file()


IMAGINARY_HEADSET = """
    const pose = (x, y, z) => ({
        emulatedPosition: false,
        transform: {position: {x, y, z}, orientation: {x: 0, y: 0, z: 0, w: 1}},
    });
    const poses = {left: pose(-0.2, 1.1, -0.3), right: pose(0.2, 1.2, -0.4)};
    const source = (handedness, ...pressed) => (
        {handedness, gripSpace: handedness, gamepad: {buttons: pressed.map((down) => ({pressed: down}))}}
    );
    const session = {
        inputSources: [source("left", false, true), source("right", true, false)],
        addEventListener: () => {},
        updateRenderState: () => {},
        requestReferenceSpace: async () => "room",
        requestAnimationFrame: (draw) =>
            setTimeout(() => draw(performance.now(), {getPose: (space) => poses[space]}), 14),
    };
    window.loseRight = () => { poses.right.emulatedPosition = true; };
    window.XRWebGLLayer = class {};
    Object.defineProperty(navigator, "xr", {value: {
        isSessionSupported: async (mode) => mode === "immersive-vr",
        requestSession: async (mode) => { window.mode = mode; return session; },
    }});
"""
"""WebXR as a headset's browser has it: the left controller squeezed, the right one's trigger pulled."""


@pytest.mark.slow
def test_the_page_in_a_browser_sends_both_controllers(port: int) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no browser is installed")
    headset = HeadsetControllers(port, ARMS, timeout_s=1.0)
    headset.connect()
    until(lambda: socket.socket().connect_ex(("localhost", port)) == 0)
    with sync_api.sync_playwright() as started:
        shown = started.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = shown.new_page(ignore_https_errors=True)
        page.add_init_script(IMAGINARY_HEADSET)
        page.goto(f"https://localhost:{port}")
        page.wait_for_selector("text=Connected.")
        page.click("#start")
        page.wait_for_selector("text=Controllers: left and right")
        until(lambda: len(headset.read()) == 2)
        heard = headset.read()
        assert page.evaluate("window.mode") == "immersive-vr"
        page.evaluate("loseRight()")
        page.wait_for_selector("text=Controllers: left")
        until(lambda: set(headset.read()) == {"left"})
        shown.close()
    np.testing.assert_allclose(heard["left"].position, [0.3, 0.2, 1.1])
    np.testing.assert_allclose(heard["right"].position, [0.4, -0.2, 1.2])
    assert (heard["left"].clutch, heard["left"].grip) == (True, 0.0)
    assert (heard["right"].clutch, heard["right"].grip) == (False, 1.0)
