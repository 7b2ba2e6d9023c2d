"""LeRobot plugin for visuo-tactile policy learning with simulation fine-tuning (VT-Refine).

Importing this package registers its policy, environment and processor steps with LeRobot. It stays light: no
simulator, Warp, serial port or plotting library is imported here.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("lerobot_policy_vtrefine")
except PackageNotFoundError:  # running from a source tree that was never installed
    __version__ = "0.0.0"
