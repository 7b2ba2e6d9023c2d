"""The MuJoCo simulation of bimanual insertion; knows neither LeRobot nor Gymnasium.

Import from the modules: `sim.config` is light (no simulator), `sim.scene` and `sim.simulation` need MuJoCo.
"""

from lerobot_vtrefine.sim.headless import prefer_headless_gl

prefer_headless_gl()  # MuJoCo reads MUJOCO_GL when it is first imported
