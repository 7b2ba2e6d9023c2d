"""The public files in one place: their JSON Schemas, and what a recording's columns mean.

Schemas follow from the dataclasses that files are read by; `schemas/` holds them for programs that are not
ours, as written by `vtrefine-diagnose --help_format=NAME`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.diagnose.joints import stages as joint_stages
from lerobot_vtrefine.diagnose.recordings import SHAPES, Entry, Header
from lerobot_vtrefine.diagnose.servo.model import ServoFile
from lerobot_vtrefine.diagnose.verdict import VerdictFile
from lerobot_vtrefine.embodiments.robot_file import MAX_JOINTS, RobotFile
from lerobot_vtrefine.files.json_schema import DIALECT, json_schema
from lerobot_vtrefine.sim.reality import RealityFile
from lerobot_vtrefine.tactile.model import SCHEMA as SENSOR_MODEL_SCHEMA
from lerobot_vtrefine.tactile.stages.base import STAGES, Stage

PAD_COLUMNS = {
    "time_s": "host time of the frame, from the trial's start [s]",
    "x_m": "indenter's axis along the columns, from the pad's centre [m]",
    "y_m": "indenter's axis along the rows, from the pad's centre [m]",
    "depth_m": "how far its lowest point lies below the undeformed face, negative above it [m]; "
    "optional where force_n is there",
    "force_n": "total normal force of a load cell [N]; optional where depth_m is there",
    "tilt_x_rad": "indenter's rotation about +x [rad]; optional",
    "tilt_y_rad": "indenter's rotation about +y [rad]; optional",
    "temperature_c": "temperature [degrees Celsius]; optional",
    "raw": "list of rows x cols readings, row by row, before any normalisation or removal of the idle level",
}
"""Columns of a pad's trial, one row per frame."""
ROBOT_COLUMNS = {
    "time_s": "host time of the frame, from the trial's start [s]",
    "command": "list of commanded positions, one per joint [rad, m for fingers]",
    "position": "list of measured positions, one per joint [rad, m for fingers]",
    "load": "list of measured loads, one per joint, in any unit; optional",
    "torque_on": "1 while a servo with a described plant drives, 0 while it lets go; optional",
    "temperature_c": "of such a servo [degrees Celsius]; optional",
}
"""Columns of a robot's trial, one row per frame."""


def _recording() -> dict[str, Any]:
    shapes = [_indenter(shape) for shape in SHAPES]
    found = json_schema(Header, others=True)
    found["properties"]["object"] = {"anyOf": [*shapes, {"type": "null"}]}
    trials = found["properties"]["trials"]
    trials["minItems"] = 1
    trials["items"]["properties"]["object"] = found["properties"]["object"]
    return found


def _indenter(shape: str) -> dict[str, Any]:
    found = json_schema(SHAPES[shape], others=True)
    found["properties"]["shape"] = {"const": shape}
    return found | {"title": shape}


def _sensor_model() -> dict[str, Any]:
    """One kind of model for each kind of recordings; its "schema" says which."""
    kinds = {
        "of a pad": _pad_model(),
        "of a robot's joints": _robot_model(),
        "of a servo with a known load": json_schema(ServoFile),
    }
    return {"oneOf": [{"title": title, **kind} for title, kind in kinds.items()]}


def _pad_model() -> dict[str, Any]:
    return {
        "type": "object",
        "properties": {
            "schema": {"const": SENSOR_MODEL_SCHEMA},
            "stages": {"type": "array", "items": {"oneOf": [_stage(cls) for cls in STAGES.values()]}},
        },
        "required": ["schema", "stages"],
        "additionalProperties": False,
    }


def _stage(cls: type[Stage]) -> dict[str, Any]:
    found = json_schema(cls)
    found["properties"] = {"stage": {"const": cls.name}, **found["properties"]}
    return found | {"title": cls.name, "required": ["stage", *found["required"]]}


def _robot_model() -> dict[str, Any]:
    found = json_schema(RobotFile)
    joints = found["properties"]["joints"]
    joints |= {"minItems": 1, "maxItems": MAX_JOINTS}
    laws = joints["items"]["properties"]["laws"]
    number = laws["additionalProperties"]
    laws |= {
        "properties": dict.fromkeys(joint_stages.parameters(), number),
        "additionalProperties": False,
    }
    return found


_MAKERS: dict[str, Callable[[], dict[str, Any]]] = {
    "recording.json": _recording,
    "verdict.json": lambda: json_schema(VerdictFile, others=True),
    "sensor_model.json": _sensor_model,
    "reality.json": lambda: json_schema(RealityFile),
}
FORMATS = tuple(_MAKERS)


def schema_of(name: str) -> dict[str, Any]:
    """The JSON Schema of one of FORMATS; ValueError lists them."""
    check_choice("--help_format", name, FORMATS)
    return {"$schema": DIALECT, "title": name, **_MAKERS[name]()}


def describe_recording() -> str:
    """A recording set for people, on one screen."""
    lines = [
        "A recording set is a folder with recording.json and one Parquet file per trial.",
        "Metres, newtons, radians, seconds throughout.",
        "",
        "recording.json",
    ]
    for where, kind in (("", Header), ("trials[].", Entry)):
        for item in dataclasses.fields(kind):
            needed = item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING
            lines.append(f"  {where}{item.name}{'' if needed else '  (optional)'}")
    lines.append(f"  object.shape is one of {', '.join(SHAPES)}, with radius_m, size_m or file")
    for title, columns in (
        ("Columns of a pad's trial", PAD_COLUMNS),
        ("Columns of a robot's trial", ROBOT_COLUMNS),
    ):
        lines += ["", title, *(f"  {name:<14}{text}" for name, text in columns.items())]
    lines += [
        "",
        "Record 16 trials or more: 8 conditions (same motion, same place), each twice, in mixed order.",
        "vtrefine-diagnose --template=FOLDER writes an example,",
        f"--help_format=NAME prints the JSON Schema of {', '.join(FORMATS)};",
        "that of sensor_model.json holds one kind each for pads, robots' joints and servos.",
    ]
    return "\n".join(lines)
