"""Video frames of one environment: the scene beside its tactile pads.

The scene is drawn with OpenGL where that works, and else from the depth camera's rays as a shaded image, so
that videos exist on any machine.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_vtrefine.sim.menagerie_meshes import DrawnWorld
from lerobot_vtrefine.sim.pad_panel import BACKGROUND, Frame, Progress, pad_panel, panel_size
from lerobot_vtrefine.sim.task import FAILURES

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim

log = logging.getLogger(__name__)

GL_HELP = "install EGL (Debian: apt install libegl1 libgl1-mesa-dri) and start with MUJOCO_GL=egl"
_SHADOW_PX, _SAMPLES = 1024, 2
_GL_FAILURES: list[Exception] = []
"""Why this process has no OpenGL. It is not asked for again: GLFW without a display would abort then."""


@dataclass(frozen=True)
class CameraView:
    """A free camera: looks at `lookat_m` (world) from `distance_m`, angles in degrees as in MuJoCo."""

    lookat_m: tuple[float, float, float] = (0.0, 0.0, 0.11)
    distance_m: float = 0.54
    azimuth_deg: float = 180.0  # left arm on the left
    elevation_deg: float = -18.0


class VideoRenderer:
    """Draws environment `env` of `sim`.

    `backend` "auto" takes OpenGL when it works; "gl" raises RuntimeError with the fix when it does not;
    "rays" draws the depth image. With OpenGL, arms look as in MuJoCo Menagerie where its folder
    `menagerie_dir` is given.
    """

    def __init__(
        self,
        sim: "InsertionSim",
        env: int = 0,
        view: CameraView | None = None,
        width: int = 480,
        backend: Literal["auto", "gl", "rays"] = "auto",
        menagerie_dir: Path | None = None,
    ) -> None:
        self._sim = sim
        self._env = env
        self._pads = sim.embodiment.pad_names, sim.embodiment.pad_layout
        self._size = (panel_size(*self._pads)[0], width)
        self._scene = _make_scene(
            lambda: DrawnWorld(sim, env, menagerie_dir), view or CameraView(), self._size, backend
        )

    def frame(self) -> Frame:
        """Return the current frame, uint8 (H, W, 3); H and W are even, as video encoders want."""
        ids = np.array([self._env])
        before = self._sim.get_state(self._env)
        raw = self._sim.observe(ids)
        self._sim.set_state(self._env, before)  # looking draws sensor noise: nothing may depend on it
        scene = (
            self._scene.draw()
            if self._scene
            else shaded_depth(raw["depth_mm"][0], self._sim.camera_intrinsics)
        )
        panel = pad_panel(raw["tactile"][0], raw["tactile_baseline"][0], *self._pads, self._progress())
        joined = np.concatenate([_fit(scene, self._size), panel], axis=1)
        return np.ascontiguousarray(joined[: joined.shape[0] // 2 * 2, : joined.shape[1] // 2 * 2])

    def _progress(self) -> Progress:
        sim, env = self._sim, self._env
        seen = sim.metrics(np.array([env]))
        step, failure = int(sim.steps[env]), FAILURES[int(seen["failure"][0])]
        outcome = "success" if seen["success"][0] else failure.replace("_", " ")
        if outcome == "none":
            outcome = "time out" if step >= sim.episode_steps else ""
        return Progress(step, float(sim.seated_s[env]), sim.config.success.hold_s, outcome)

    def close(self) -> None:
        """Free the OpenGL context; later frames raise."""
        if self._scene:
            self._scene.close()


class _GlScene:
    """The scene through `mujoco.Renderer`."""

    def __init__(self, world: DrawnWorld, view: CameraView, size: tuple[int, int]) -> None:
        import mujoco

        self._world, model = world, world.model
        # The off-screen buffer must hold the frame; enlarging it in the model costs memory only here.
        model.vis.global_.offheight = max(model.vis.global_.offheight, size[0])
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, size[1])
        # Without a GPU, reflections and fine shadows cost five times the rest of the picture.
        model.vis.quality.shadowsize, model.vis.quality.offsamples = _SHADOW_PX, _SAMPLES
        self._renderer = mujoco.Renderer(model, *size)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.lookat = view.lookat_m
        self._camera.distance = view.distance_m
        self._camera.azimuth, self._camera.elevation = view.azimuth_deg, view.elevation_deg

    def draw(self) -> Frame:
        self._renderer.update_scene(self._world.data(), self._camera)
        return self._renderer.render()

    def close(self) -> None:
        self._renderer.close()


def _make_scene(
    make_world: Callable[[], DrawnWorld], view: CameraView, size: tuple[int, int], backend: str
) -> _GlScene | None:
    if backend not in ("auto", "gl", "rays"):
        raise ValueError(f"backend must be auto, gl or rays, not {backend!r}")
    if backend == "rays":
        return None
    if not _GL_FAILURES:
        world = make_world()
        try:
            return _GlScene(world, view, size)
        # OpenGL libraries fail with AttributeError, ImportError, FatalError, RuntimeError, ...
        except Exception as error:
            _GL_FAILURES.append(error.with_traceback(None))  # a traceback would keep the simulation alive
            if backend == "auto":
                log.warning("%s; drawing the depth image instead", _no_gl(error))
    if backend == "gl":
        raise RuntimeError(_no_gl(_GL_FAILURES[0])) from _GL_FAILURES[0]
    return None


def _no_gl(error: Exception) -> str:
    return f"no OpenGL to draw the scene with ({type(error).__name__}): {GL_HELP}"


def shaded_depth(depth_mm: NDArray[np.uint16], intrinsics: NDArray) -> Frame:
    """Shade a depth image (H, W) [mm, 0 = nothing] as if lit from the camera's upper left; uint8 (H, W, 3).

    `intrinsics` is (4,) fx, fy, cx, cy [px]. Surfaces are tinted by height in the image and darken with
    distance.
    """
    depth = depth_mm.astype(float).reshape(depth_mm.shape[:2])
    hit = depth > 0
    if not hit.any():
        return np.full((*depth.shape, 3), BACKGROUND, np.uint8)
    fx, fy, cx, cy = np.asarray(intrinsics, float)
    rows, cols = np.indices(depth.shape)
    points = np.stack([(cols - cx) / fx * depth, (rows - cy) / fy * depth, depth], axis=-1)
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True) + 1e-9
    light = np.array([-0.4, -0.6, -0.7]) / np.linalg.norm([0.4, 0.6, 0.7])
    near, far = np.percentile(depth[hit], (2, 98))
    fade = 1.0 - 0.4 * np.clip((depth - near) / max(far - near, 1.0), 0, 1)
    shade = (0.35 + 0.65 * np.abs(normal @ light)) * fade
    image = shade[..., None] * np.array([214, 210, 200])
    return np.where(hit[..., None], image, BACKGROUND).clip(0, 255).astype(np.uint8)


def _fit(frame: Frame, size: tuple[int, int]) -> Frame:
    """Scale into (height, width), keeping the aspect ratio, on a dark ground."""
    height, width = size
    if frame.shape[:2] == size:
        return frame
    scale = min(height / frame.shape[0], width / frame.shape[1])
    shape = (max(1, round(frame.shape[1] * scale)), max(1, round(frame.shape[0] * scale)))
    canvas = Image.new("RGB", (width, height), BACKGROUND)
    canvas.paste(Image.fromarray(frame).resize(shape), ((width - shape[0]) // 2, (height - shape[1]) // 2))
    return np.asarray(canvas)
