"""LeRobot plugin for visuo-tactile policy learning with simulation fine-tuning (VT-Refine).

Importing this package registers its policy, environment, processor steps, robots, teleoperators and cameras
with LeRobot. It stays light: neither LeRobot nor PyTorch is imported before something needs them, and no
simulator, Warp, serial port or plotting library at all.
"""

from lerobot_vtrefine.registration import register_or_wait

register_or_wait()
