"""Pads as pictures in the live view of LeRobot's commands (`--display_data=true`, rerun and foxglove).

LeRobot 0.6.1 draws a 1-D observation as one curve per value: 384 of them per pad, and as many for its idle
counts. `install` lets the two functions that log observations see pictures of R x C pixels instead. Robots
call it when they are made, as they call `arrays.install`; commands with other robots stay untouched.
"""

import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lerobot_vtrefine.datasets.features import BASELINE, CAMERA_PREFIX, OBS_PREFIX, TACTILE, TACTILE_AGE
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.lerobot_compat.guard import is_supported
from lerobot_vtrefine.tactile.picture import colours

logger = logging.getLogger(__name__)

LOGGERS = ("log_rerun_data", "log_foxglove_data")
CONSTANT = CAMERA_PREFIX.removeprefix(OBS_PREFIX)
"""What keys begin with whose values never change during a session."""

Observation = Mapping[str, Any]


def drawable(observation: Observation, pads: Mapping[str, PadConfig]) -> dict[str, Any]:
    """The observation as it is shown: a picture per pad, grey while stale, without idle counts and constants.

    Args:
        observation: Keys with or without `observation.`; a pad that is missing is left out.
        pads: The robot's pads, in the order of its ages.
    """
    plain = {key.removeprefix(OBS_PREFIX): value for key, value in observation.items()}
    ages = np.atleast_1d(plain.get(TACTILE_AGE, np.zeros(len(pads))))
    shown = {key: value for key, value in plain.items() if not key.startswith((CONSTANT, f"{BASELINE}."))}
    for (name, pad), age_s in zip(pads.items(), ages, strict=False):
        key = f"{TACTILE}.{name}"
        if key not in plain:
            continue
        counts = np.asarray(plain[key]).reshape(pad.pad_shape)
        idle = np.asarray(plain.get(f"{BASELINE}.{name}", np.zeros_like(counts))).reshape(pad.pad_shape)
        shown[key] = colours(counts, idle, stale=age_s > pad.stale_after_s)
    return shown


def install(pads: Mapping[str, PadConfig]) -> None:
    """Show these pads as pictures from now on, beside those of robots that were made before.

    On a LeRobot version that was not tested it logs a warning and leaves LeRobot as it is.
    """
    import lerobot.utils.visualization_utils as dispatch

    if not is_supported() or not all(hasattr(dispatch, name) for name in LOGGERS):
        logger.warning("This LeRobot version is untested: --display_data shows pads as curves.")
        return
    if pads in _known:
        _known.remove(pads)
    _known.insert(0, pads)
    for name in LOGGERS:
        original = getattr(dispatch, name)
        setattr(dispatch, name, _drawing(getattr(original, "undrawn", original)))


def uninstall() -> None:
    """Restore LeRobot's own functions."""
    import lerobot.utils.visualization_utils as dispatch

    for name in LOGGERS:
        current = getattr(dispatch, name)
        setattr(dispatch, name, getattr(current, "undrawn", current))
    _known.clear()


_known: list[Mapping[str, PadConfig]] = []
"""The pads of every robot that was made, the latest first."""


def pads_of(observation: Observation) -> Mapping[str, PadConfig] | None:
    """Those of the robot that an observation is of; None where it is none of ours."""
    plain = {key.removeprefix(OBS_PREFIX): value for key, value in observation.items()}
    for pads in _known:
        here = [(pad, f"{TACTILE}.{name}") for name, pad in pads.items() if f"{TACTILE}.{name}" in plain]
        if here and all(np.asarray(plain[key]).size == np.prod(pad.pad_shape) for pad, key in here):
            return pads
    return None


def _drawing(original: Callable[..., None]) -> Callable[..., None]:
    """LeRobot's logging function, which gets pictures."""

    def log(observation: Observation | None = None, **others: Any) -> None:
        pads = pads_of(observation) if observation else None
        shown = observation if observation is None or pads is None else drawable(observation, pads)
        original(observation=shown, **others)

    log.undrawn = original  # ty: ignore[missing-attribute]
    return log
