"""Checks of lengths in `recording.json`: millimetres where the format wants metres."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.pad.indenters import mesh_extent_m
from lerobot_vtrefine.diagnose.quality.edits import NO_VERDICT, SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.quality.rules import COARSEST_MM, INDENTER_M, PITCH_M
from lerobot_vtrefine.diagnose.recordings import RecordingSet

MM_PER_M = 1e3


def check_sizes(recordings: RecordingSet) -> Iterator[Finding]:
    """Distances of taxels and sizes of indenters that no pad and no indenter has."""
    if recordings.kind != "pad":
        return
    pitch_m = recordings.pitch_m
    factor = _factor(pitch_m, PITCH_M)
    if factor is None:
        yield Finding(None, f"pad.pitch_m is {pitch_m:.3g}, which no pad has in metres", NO_VERDICT)
        return
    if factor > 1:
        setting = {"pitch_m": pitch_m / factor}
        yield Finding(None, _in_mm("pad.pitch_m", pitch_m), _divided(factor), setting=setting)
    for index, trial in enumerate(recordings.trials):
        name, size_m = _size(trial.object)
        factor = _factor(size_m, INDENTER_M)
        if factor is None:
            yield Finding(index, f"object.{name} is {size_m:.3g}, which no indenter has in metres", SET_ASIDE)
        elif factor > 1:
            mended = replace(trial, object=_scaled(trial.object, 1.0 / factor))
            yield Finding(index, _in_mm(f"object.{name}", size_m), _divided(factor), mended)


def _factor(length_m: float, limits_m: tuple[float, float]) -> float | None:
    """What a length must be divided by: 1 if it is plausible, 1000 if it is so in millimetres, else None."""
    low, high = limits_m
    if low <= length_m <= high:
        return 1.0
    plausible = length_m >= COARSEST_MM and length_m / MM_PER_M <= high
    return MM_PER_M if length_m > high and plausible else None


def _in_mm(name: str, length: float) -> str:
    return f"{name} is {length:.3g}: millimetres instead of metres"


def _divided(factor: float) -> str:
    return f"repaired: divided by {factor:.4g}"


def _size(spec: dict[str, Any]) -> tuple[str, float]:
    """Name of the field that gives an indenter's size, and its largest length [m]."""
    if spec["shape"] == "flat":
        return "size_m", max(spec["size_m"])
    if spec["shape"] == "mesh":
        return "file", mesh_extent_m(spec)
    return "radius_m", spec["radius_m"]


def _scaled(spec: dict[str, Any], factor: float) -> dict[str, Any]:
    if spec["shape"] == "flat":
        return spec | {"size_m": tuple(factor * side for side in spec["size_m"])}
    if spec["shape"] == "mesh":
        scale = factor * np.asarray(spec.get("scale", 1.0), dtype=float)
        return spec | {"scale": scale.tolist()}
    return spec | {"radius_m": factor * spec["radius_m"]}
