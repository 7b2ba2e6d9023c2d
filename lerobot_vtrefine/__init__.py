"""LeRobot plugin for visuo-tactile policy learning with simulation fine-tuning (VT-Refine).

LeRobot's commands find it by themselves and register its policy, environment, processor steps, robots,
teleoperators and cameras; so does importing it after LeRobot. A script that imports it first calls
`register`.
Importing it alone stays light: neither LeRobot nor PyTorch is imported before something needs them, and no
simulator, Warp, serial port or plotting library at all.
"""

import sys

from lerobot_vtrefine.lerobot_compat import decoder_notice
from lerobot_vtrefine.lerobot_compat.local_places import refuse_missing_places
from lerobot_vtrefine.lerobot_compat.registration import LEROBOT, register
from lerobot_vtrefine.shipped import expand_command_line

__all__ = ["register"]

decoder_notice.install()
if LEROBOT in sys.modules:  # LeRobot's commands import plugins just before they parse their command line
    register()
    expand_command_line()
    refuse_missing_places()
