"""Devices that people hold, emulated where LeRobot's packages meet them."""

import ctypes
import enum
import json
import ssl
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

FULL = 32767
"""A fully tilted stick, as SDL counts."""


class SdlGamepad:
    """A joystick of SDL's own making: pygame sees it as it sees one that is plugged in."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        patch.setenv("SDL_VIDEODRIVER", "dummy")
        patch.setenv("SDL_AUDIODRIVER", "dummy")
        pygame = pytest.importorskip("pygame")
        found = list(Path(pygame.__file__).parent.parent.glob("pygame.libs/libSDL2-2*"))
        if not found:
            pytest.skip("this pygame brings no SDL library of its own")
        self._sdl = ctypes.CDLL(str(found[0]))
        self._sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        pygame.init()
        pygame.joystick.init()
        assert self._sdl.SDL_JoystickAttachVirtual(1, 6, 11, 0) >= 0  # a game controller's axes and buttons
        self._stick = ctypes.c_void_p(self._sdl.SDL_JoystickOpen(0))

    def tilt(self, axis: int, share: float) -> None:
        self._sdl.SDL_JoystickSetVirtualAxis(self._stick, axis, ctypes.c_int16(round(share * FULL)))

    def press(self, button: int, down: bool = True) -> None:
        self._sdl.SDL_JoystickSetVirtualButton(self._stick, button, ctypes.c_uint8(down))


class Key(enum.Enum):
    up, down, left, right, shift, shift_r, ctrl_l, ctrl_r, esc = range(9)


class Listener:
    """pynput's listener, with the keys that a test presses."""

    latest: "Listener"

    def __init__(self, on_press: object, on_release: object) -> None:
        self.press, self.release, self._alive = on_press, on_release, False
        Listener.latest = self

    def start(self) -> None:
        self._alive = True

    def stop(self) -> None:
        self._alive = False

    def is_alive(self) -> bool:
        return self._alive


def watch_keys(patch: pytest.MonkeyPatch) -> None:
    """LeRobot believes that pynput is installed and sees a display."""
    from lerobot.teleoperators.keyboard import teleop_keyboard

    patch.setattr(teleop_keyboard, "keyboard", SimpleNamespace(Listener=Listener, Key=Key))
    patch.setattr(teleop_keyboard, "PYNPUT_AVAILABLE", True)
    patch.setattr(teleop_keyboard, "pynput_can_capture", lambda: True)
    patch.setattr(teleop_keyboard, "require_package", lambda *_args, **_names: None)


@contextmanager
def raised_phone(port: int, speed_m_s: float) -> Generator[None]:
    """A phone on the page that `teleop` serves: touched, and moved upwards; WebXR's y points up."""
    websocket = pytest.importorskip("websocket")
    over = threading.Event()

    def stream() -> None:
        began, page = time.monotonic(), None
        while not over.is_set():
            try:
                if page is None:
                    options = {"cert_reqs": ssl.CERT_NONE, "check_hostname": False}
                    page = websocket.create_connection(f"wss://localhost:{port}/ws", sslopt=options)
                height = 1.0 + speed_m_s * (time.monotonic() - began)
                pose = {
                    "position": {"x": 0.1, "y": height, "z": -0.2},
                    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                    "move": True,
                    "scale": 1.0,
                    "gripper": "open",
                    "reservedButtonA": False,
                    "reservedButtonB": False,
                }
                page.send(json.dumps({"type": "pose", "data": pose}))
            except OSError:  # not served yet, or any more
                page = None
            time.sleep(0.02)

    thread = threading.Thread(target=stream, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
