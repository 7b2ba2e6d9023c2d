"""Stages of the sensor model, by domain; importing this package registers them all."""

from lerobot_vtrefine.tactile.stages import (
    contact,
    dividers,
    host,
    hysteresis,
    mechanics,
    readout,
    softening,
    surface,
)
from lerobot_vtrefine.tactile.stages.base import STAGES, Frame, Stage, register, stage_class

__all__ = [
    "STAGES",
    "Frame",
    "Stage",
    "contact",
    "dividers",
    "host",
    "hysteresis",
    "mechanics",
    "readout",
    "register",
    "softening",
    "stage_class",
    "surface",
]
