"""FlexiTac boards over USB serial: framing, reader threads, discovery, and an emulator on pseudo-terminals.

`board.PadReader` reads one board. Modules that open ports import pyserial (extra `hardware`); this package
itself does not.
"""

from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.frames import FrameShape, PadFrame

__all__ = ["FrameShape", "PadConfig", "PadFrame"]
