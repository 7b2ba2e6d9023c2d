"""Devices that people hold, emulated where LeRobot's packages meet them."""

import ctypes
import enum
import json
import ssl
import struct
import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
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
def page_client(port: int, message_at: Callable[[float], dict]) -> Generator[None]:
    """A device on a page that `teleop` serves: every 20 ms it says what `message_at` makes of a time [s]."""
    websocket = pytest.importorskip("websocket")
    over = threading.Event()

    def stream() -> None:
        began, page = time.monotonic(), None
        while not over.is_set():
            try:
                if page is None:
                    options = {"cert_reqs": ssl.CERT_NONE, "check_hostname": False}
                    page = websocket.create_connection(f"wss://localhost:{port}/ws", sslopt=options)
                message = message_at(time.monotonic() - began)
                page.send(json.dumps({"type": "pose", "data": message}))
            except (OSError, websocket.WebSocketException):  # not served yet, or any more
                page = None
            time.sleep(0.02)

    thread = threading.Thread(target=stream, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def raised_phone(port: int, speed_m_s: float) -> AbstractContextManager[None]:
    """A phone that is touched and moved upwards; WebXR's y points up."""

    def message(seconds: float) -> dict:
        return {
            "position": {"x": 0.1, "y": 1.0 + speed_m_s * seconds, "z": -0.2},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            "move": True,
            "scale": 1.0,
            "gripper": "open",
            "reservedButtonA": False,
            "reservedButtonB": False,
        }

    return page_client(port, message)


class HidApi:
    """The C library hidapi with SpaceMouse Compacts plugged in, whose reports a test writes."""

    COMPACT = (0x256F, 0xC635)

    def __init__(self, patch: pytest.MonkeyPatch, mice: int = 1) -> None:
        easyhid = pytest.importorskip("easyhid.easyhid")
        self._ffi, self._paths = easyhid.ffi, [b"/dev/hidraw%d" % number for number in range(mice)]
        self._kept: list[object] = []
        self.reports: dict[bytes, list[bytes]] = {path: [] for path in self._paths}
        self.unplugged = False
        patch.setattr(easyhid, "hidapi", self)

    def report(self, kind: int, *values: int, mouse: int = 0) -> None:
        """Kind 1: the way (x right, y back, z down), 2: the turns about these, both as they go over USB."""
        self.reports[self._paths[mouse]].append(struct.pack("<B3h", kind, *values))

    def button(self, number: int, down: bool, mouse: int = 0) -> None:
        self.reports[self._paths[mouse]].append(bytes([3, down << number]))

    def hid_enumerate(self, _vendor: int, _product: int) -> object:
        found = self._ffi.NULL
        for path in reversed(self._paths):
            name = self._ffi.new("char[]", path)
            vendor, product = self.COMPACT
            info = {"path": name, "vendor_id": vendor, "product_id": product, "next": found}
            found = self._ffi.new("struct hid_device_info*", info)
            self._kept += [name, found]
        return found

    def hid_free_enumeration(self, _found: object) -> None: ...

    def hid_open_path(self, path: bytes) -> bytes:
        return path

    def hid_set_nonblocking(self, _device: bytes, _yes: bool) -> None: ...

    def hid_read(self, device: bytes, into: object, size: int) -> int:
        if self.unplugged:
            return -1
        waiting = self.reports[device]
        if not waiting:
            return 0
        report = waiting.pop(0)
        self._ffi.memmove(into, report, min(size, len(report)))
        return len(report)

    def hid_close(self, _device: bytes) -> None: ...
