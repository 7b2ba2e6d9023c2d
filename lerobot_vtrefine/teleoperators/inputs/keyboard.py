"""Keys through pynput, as LeRobot's own keyboard teleoperator reads them: one block of keys per hand."""

import importlib
from collections.abc import Set as AbstractSet
from typing import Any

import numpy as np

from lerobot_vtrefine.teleoperators.inputs.speed import Push

KEYS = (
    {"forward": "w", "back": "s", "left": "a", "right": "d", "up": "e", "down": "c", "grip": "f"}
    | {"turn_left": "z", "turn_right": "x", "tip_up": "t", "tip_down": "g"},
    {"forward": "i", "back": "k", "left": "j", "right": "l", "up": "o", "down": ".", "grip": "h"}
    | {"turn_left": "m", "turn_right": ",", "tip_up": "p", "tip_down": "u"},
)
"""First arm, second arm. N, R and Q are LeRobot's: its recording goes on, starts an episode anew, and ends by
them."""
WAYS = (("forward", "back"), ("left", "right"), ("up", "down"))
TURNS = ((None, None), ("tip_down", "tip_up"), ("turn_left", "turn_right"))


def push_of(held: AbstractSet[str], pressed: AbstractSet[str], keys: dict[str, str]) -> Push:
    """What keys that are held, and keys that went down since the last look, ask of one hand."""

    def along(pairs: Any) -> np.ndarray:
        return np.array(
            [float(keys.get(one) in held) - float(keys.get(other) in held) for one, other in pairs]
        )

    return Push(along(WAYS), along(TURNS), keys["grip"] in pressed)


class Keyboard:
    """Needs a display, or on macOS the permission to watch keys."""

    def __init__(self) -> None:
        self._held: set[str] = set()
        self._pressed: set[str] = set()
        self._listener: Any = None

    def connect(self) -> None:
        """Watch the keys. Raises: ImportError where pynput is missing or finds no display."""
        try:
            keyboard = importlib.import_module("pynput.keyboard")
        except ImportError as error:
            raise ImportError(
                f"--teleop.input=keyboard needs pynput and a display ({error}): "
                "pip install 'lerobot_policy_vtrefine[teleop]'"
            ) from error
        self._listener = keyboard.Listener(on_press=self._down, on_release=self._up)
        self._listener.start()

    def pushes(self) -> list[Push]:
        """One per hand."""
        pressed, self._pressed = self._pressed, set()
        return [push_of(self._held, pressed, keys) for keys in KEYS]

    def disconnect(self) -> None:
        """Watch no longer."""
        if self._listener is not None:
            self._listener.stop()

    def _down(self, key: Any) -> None:
        name = getattr(key, "char", None)
        if name is not None and name.lower() not in self._held:
            self._held.add(name.lower())
            self._pressed.add(name.lower())

    def _up(self, key: Any) -> None:
        self._held.discard((getattr(key, "char", None) or "").lower())
