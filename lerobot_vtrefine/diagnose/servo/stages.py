"""What a real servo adds to the simulated one, one law each.

To add a law, register a `Stage` here; a file of the catalogue (`servo/candidates`) then frees its parameters.
The laws of friction are those of Duclusaud et al., "Extended Friction Models for the Physics Simulation of
Servo Actuators" (arXiv 2410.08650), whose models M2 to M6 are sums of them.

Shapes: C columns (sets of parameters) of T trials; parameters are (C, 1).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

Array = np.ndarray
ROOM_C = 25.0
"""Temperature at which a winding has its plain resistance."""
Values = Mapping[str, Array]


@dataclass
class Now:
    """What a law may ask about the servo at one instant, (C, T) or (T,)."""

    speed: Array
    """[rad/s]"""
    duty: Array
    """Part of the supply on the motor, -1..1."""
    temperature_c: Array
    motor: Array | float = 0.0
    """Torque of the motor [Nm]."""
    gravity: Array | float = 0.0
    """Torque of the load [Nm]."""


@dataclass(frozen=True)
class Limits:
    """Of one parameter. In Nm, torques are parts of the load's weight; `start` is also its typical size."""

    low: float
    high: float
    start: float
    unit: str


@dataclass(frozen=True)
class Stage:
    """One law: what it adds at its place. Where all its parameters are zero, it adds nothing.

    Places: "friction", the torque that holds the shaft back [Nm]; "resistance", a part of the winding's;
    "duty", a part of the largest duty; "delay" of commands [s]; "play" of the encoder [rad].
    """

    place: Literal["friction", "resistance", "duty", "delay", "play"]
    law: Callable[[Now, Values], Array]
    parameters: Mapping[str, Limits]


def _slow(now: Now, speed: Array) -> Array:
    """1 at rest, falling with speed (Tustin's form of the Stribeck effect)."""
    return np.exp(-np.abs(now.speed) / speed.clip(1e-6))


def _quadratic(now: Now, values: Values) -> Array:
    """The square of the lesser of motor's and load's torque, while they oppose each other (M6)."""
    lifts = np.abs(now.gravity) < np.abs(now.motor)
    lesser = np.where(
        lifts,
        values["quadratic_load"] * np.square(now.gravity),
        values["quadratic_motor"] * np.square(now.motor),
    )
    opposed = np.sign(now.motor) != np.sign(now.gravity)
    return _slow(now, values["quadratic_speed"]) * np.where(opposed, lesser, 0.0)


_SPEED = Limits(0.01, 3.0, 0.5, "rad/s")
"""Beyond some rad/s, what fades with speed cannot be distinguished from what does not."""

STAGES: list[Stage] = [
    Stage(
        "friction",
        lambda now, v: v["load_friction"] * np.abs(now.motor - now.gravity),
        {"load_friction": Limits(0.0, 0.95, 0.1, "1")},
    ),
    Stage(
        "friction",
        lambda now, v: np.abs(v["motor_friction"] * now.motor - v["carried_friction"] * now.gravity),
        {
            "motor_friction": Limits(0.0, 0.95, 0.2, "1"),
            "carried_friction": Limits(0.0, 0.95, 0.05, "1"),
        },
    ),
    Stage(
        "friction",
        lambda now, v: v["stiction"] * _slow(now, v["stiction_speed"]),
        {"stiction": Limits(0.0, 1.0, 0.05, "Nm"), "stiction_speed": _SPEED},
    ),
    Stage(
        "friction",
        lambda now, v: (
            np.abs(v["motor_stiction"] * now.motor - v["carried_stiction"] * now.gravity)
            * _slow(now, v["load_stiction_speed"])
        ),
        {
            "motor_stiction": Limits(0.0, 0.95, 0.1, "1"),
            "carried_stiction": Limits(0.0, 0.95, 0.1, "1"),
            "load_stiction_speed": _SPEED,
        },
    ),
    Stage(
        "friction",
        _quadratic,
        {
            "quadratic_motor": Limits(0.0, 20.0, 0.5, "1/Nm"),
            "quadratic_load": Limits(0.0, 20.0, 0.5, "1/Nm"),
            "quadratic_speed": _SPEED,
        },
    ),
    Stage(
        "resistance",
        # Current passes the source only while a pulse is on: the motor gets duty (supply - current source). A
        # capacitor that averages the pulses would make the duty a square.
        lambda now, v: v["source_resistance"] * np.abs(now.duty),
        {"source_resistance": Limits(0.0, 10.0, 0.1, "1")},
    ),
    Stage(
        "resistance",
        lambda now, v: v["heating"] * (now.temperature_c - ROOM_C),
        {"heating": Limits(0.0, 0.01, 0.004, "1/K")},  # copper: 0.0039, and cases warm less than windings
    ),
    Stage(
        "duty",
        lambda now, v: -v["missing_duty"],
        {"missing_duty": Limits(0.0, 0.9, 0.1, "1")},
    ),
    Stage("delay", lambda now, v: v["delay"], {"delay": Limits(0.0, 0.2, 0.01, "s")}),
    Stage("play", lambda now, v: v["play"], {"play": Limits(0.0, 0.5, 0.01, "rad")}),
]


def register(stage: Stage) -> Stage:
    """Add a law of one's own."""
    STAGES.append(stage)
    return stage
