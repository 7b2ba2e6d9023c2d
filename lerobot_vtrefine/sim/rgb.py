"""The colour camera of all worlds, beside the depth camera and with its view, by mujoco_warp's ray caster.

It needs no OpenGL, and a picture is the same whichever backend steps the worlds.
"""

from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.extras import require
from lerobot_vtrefine.sim.rotations import quat_to_matrix
from lerobot_vtrefine.tactile.contact_query import start_warp

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim

Array = np.ndarray

RENDERER = ("create_render_context", "refit_bvh", "render")
"""What must be there of mujoco_warp."""
SKY = (0.80, 0.84, 0.88, 1.0)
FLIP = np.diag([1.0, -1.0, -1.0])
"""From the optical frame (OpenCV) to MuJoCo's cameras, which look along -z with y up."""


class RgbCamera:
    """Colour images of the worlds of `sim`, m of them addressed by sorted ids.

    Raises:
        ImportError: mujoco_warp is missing, or has no renderer.
    """

    def __init__(self, sim: "InsertionSim", height: int, width: int) -> None:
        require("--env.rgb=true", ("mujoco_warp",))
        import mujoco_warp

        if missing := [name for name in RENDERER if not hasattr(mujoco_warp, name)]:
            raise ImportError(
                f"--env.rgb=true needs a mujoco_warp that renders; version {version('mujoco-warp')} lacks "
                f"{missing[0]}: pip install -U mujoco-warp"
            )
        start_warp()
        self._renderer, self._sim, self._size = mujoco_warp, sim, (height, width)
        model, worlds = sim.scene.model, sim.num_envs
        with wp.ScopedDevice(sim.device):
            self._model = mujoco_warp.put_model(model)
            self._data = mujoco_warp.make_data(model, nworld=worlds, nconmax=1, njmax=1)
            self._context = mujoco_warp.create_render_context(
                model,
                nworld=worlds,
                cam_res=(width, height),
                render_rgb=True,
                render_depth=False,
                background_color=SKY,
            )
            self._model.geom_size = wp.zeros((worlds, model.ngeom), dtype=wp.vec3)
        self._put_lights(model)

    def images(self, ids: Array) -> Array:
        """Colour images (m, H, W, 3) uint8 of worlds `ids` at their present state."""
        position, rotation, size = self._sim.geometry(ids)
        data, pose = self._data, self._sim.camera_pose[ids].astype(float)
        # Asked for are the first m worlds of the renderer's: it needs not draw the others.
        data.nworld = len(ids)
        self._put(data.geom_xpos, position)
        self._put(data.geom_xmat, rotation)
        self._put(self._model.geom_size, size)
        self._put(data.cam_xpos, pose[:, None, :3])
        self._put(data.cam_xmat, (quat_to_matrix(pose[:, 3:]) @ FLIP)[:, None])
        with wp.ScopedDevice(self._sim.device):
            self._renderer.refit_bvh(self._model, data, self._context)
            self._renderer.render(self._model, data, self._context)
        packed = self._context.rgb_data[: len(ids)].numpy()  # uint32, bytes b, g, r, a
        pixels = np.ascontiguousarray(packed).view(np.uint8).reshape(len(ids), *self._size, 4)
        return np.ascontiguousarray(pixels[..., 2::-1])

    def _put(self, target: Any, values: Array | torch.Tensor) -> None:
        """Values (m, ...) into the first rows of an array of the renderer's."""
        rows = wp.to_torch(target)[: len(values)]
        rows.copy_(torch.as_tensor(values).reshape(rows.shape))

    def _put_lights(self, model: mujoco.MjModel) -> None:
        """Put the lights at the same place in every world; they never move."""
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        for target, value in (
            (self._data.light_xpos, data.light_xpos),
            (self._data.light_xdir, data.light_xdir),
        ):
            self._put(target, np.tile(value, (self._sim.num_envs, 1, 1)))
