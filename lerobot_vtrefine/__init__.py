"""LeRobot plugin for visuo-tactile policy learning with simulation fine-tuning (VT-Refine).

Importing this package registers its policy, environment and processor steps with LeRobot. It stays light: no
simulator, Warp, serial port or plotting library is imported here.
"""

from lerobot_vtrefine import envs
from lerobot_vtrefine.policies import vt_dp3

__all__ = ["envs", "vt_dp3"]
