"""Files from outside: bounded before they are parsed, checked field by field, refused in one line.

`arrays` (.npy, .npz) and `tables` (Parquet) are imported by those who need them.
"""

from lerobot_vtrefine.files.paths import inside
from lerobot_vtrefine.files.schema import decode, limits
from lerobot_vtrefine.files.text import (
    check_settings,
    read_json,
    read_json_lines,
    read_number_rows,
    read_text,
    read_yaml,
)

__all__ = [
    "check_settings",
    "decode",
    "inside",
    "limits",
    "read_json",
    "read_json_lines",
    "read_number_rows",
    "read_text",
    "read_yaml",
]
