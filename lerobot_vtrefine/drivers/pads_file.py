"""The pads file: which pad is on which port. `vtrefine-find-pads` writes it, robot configurations read it."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.files import decode, read_yaml
from lerobot_vtrefine.whole_files import write_text

_NAME = re.compile(r"\w[\w.-]{0,99}")
_HEADER = "# FlexiTac pads by name, from vtrefine-find-pads. Ports name USB sockets: do not swap cables.\n"


def save_pads(pads: dict[str, PadConfig], path: Path) -> None:
    """Write the pads file; only what differs from the defaults."""
    defaults = asdict(PadConfig(port="-"))
    entries = {
        name: {key: value for key, value in asdict(pad).items() if key == "port" or value != defaults[key]}
        for name, pad in pads.items()
    }
    write_text(path, _HEADER + yaml.safe_dump({"pads": entries}, sort_keys=False))


def load_pads(path: Path) -> dict[str, PadConfig]:
    """Read the pads file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a pads file; the message names the pad and the key, and lists valid keys.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"pads file {path} does not exist; write it with: vtrefine-find-pads --output {path}"
        )
    try:
        content = read_yaml(path)
    except ValueError as error:
        raise ValueError(f"pads file {error}") from error
    entries = content.get("pads") if isinstance(content, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise ValueError(
            f"pads file {path} has no 'pads:' section with entries like 'left_pad: {{port: /dev/...}}'"
        )
    if others := sorted(map(str, set(content) - {"pads"})):
        raise ValueError(f"pads file {path} has no {others[0][:60]!r}; valid: pads")
    return decode_pads(entries, f"pads file {path}")


def decode_pads(entries: dict[str, Any], where: str) -> dict[str, PadConfig]:
    """Pad configurations of plain dictionaries; `where` starts error messages.

    Raises:
        ValueError: an entry is not a mapping, has an unknown key or a wrong value.
    """
    pads: dict[str, PadConfig] = {}
    for name, entry in entries.items():
        check_name(name, where)
        if isinstance(entry, PadConfig):
            pads[name] = entry
            continue
        if not isinstance(entry, dict) or "port" not in entry:
            raise ValueError(f"{where}: pad {name!r} needs a port: {{port: /dev/serial/by-path/...}}")
        try:
            pads[name] = decode(PadConfig, entry, "it")
        except ValueError as error:
            raise ValueError(f"{where}: pad {name!r}: {error}") from error
    check_distinct_ports(pads, where)
    return pads


def check_name(name: Any, where: str) -> None:
    """Raise ValueError where a pad cannot have this name: a robot's columns are called after it."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"{where}: {str(name)[:60]!r} cannot name a pad: use letters, digits, _ . and -")


def check_distinct_ports(pads: dict[str, PadConfig], where: str) -> None:
    """Raise ValueError where two pads claim one port."""
    owners: dict[str, str] = {}
    for name, pad in pads.items():
        other = owners.setdefault(str(Path(pad.port).resolve()), name)
        if other != name:
            raise ValueError(f"{where}: pads {other!r} and {name!r} are both on {pad.port}")
