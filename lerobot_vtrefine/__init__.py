"""LeRobot plugin for visuo-tactile policy learning with simulation fine-tuning (VT-Refine).

Importing this package registers its policy, environment, processor steps, robots, teleoperators and cameras
with LeRobot. It stays light: no simulator, Warp, serial port or plotting library is imported here.
"""

from lerobot_vtrefine import cameras, envs, robots, teleoperators
from lerobot_vtrefine.policies import vt_dp3

__all__ = ["cameras", "envs", "robots", "teleoperators", "vt_dp3"]
