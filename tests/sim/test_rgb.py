"""The colour camera sees what the depth camera sees, from the same place, in colours that are the parts'."""

import sys
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from types import ModuleType

import numpy as np
import pytest

from lerobot_vtrefine.sim.config import RandomizationConfig, SceneConfig, WarpConfig
from lerobot_vtrefine.sim.rgb import RgbCamera
from lerobot_vtrefine.sim.simulation import InsertionSim

HEIGHT, WIDTH = 60, 80  # of the depth camera, so that pixels correspond


def make(num_envs: int, **settings: object) -> InsertionSim:
    return InsertionSim(SceneConfig(start="grasped"), num_envs=num_envs, num_threads=1, **settings)


def orange(image: np.ndarray) -> np.ndarray:
    """Pixels that show the plug."""
    red, green, blue = image.astype(int).transpose(2, 0, 1)
    return (red > 100) & (red > 1.5 * green) & (green > 1.5 * blue)


def seen_points(sim: InsertionSim, env: int) -> np.ndarray:
    """What the depth camera sees, (H, W, 3) in the world [m]."""
    depth = sim.depth_mm()[env] / 1e3
    camera = sim.scene.camera
    rays = camera.directions().reshape(HEIGHT, WIDTH, 3)
    return (rays * depth[..., None]) @ camera.rotation.T + camera.position_m


def plug_extent(sim: InsertionSim) -> float:
    """The furthest that a part of the plug is from its origin [m]."""
    model = sim.scene.model
    own = model.geom_bodyid == model.body("plug").id
    return float((np.linalg.norm(model.geom_pos[own], axis=1) + model.geom_rbound[own]).max())


@pytest.mark.slow
def test_orange_pixels_are_where_the_depth_camera_sees_the_plug() -> None:
    sim = make(2)
    sim.reset(np.arange(2), np.array([3, 4]))
    images = RgbCamera(sim, HEIGHT, WIDTH).images(np.arange(2))
    assert images.shape == (2, HEIGHT, WIDTH, 3)
    plug, _ = sim.part_poses()
    for env in range(2):
        shown = orange(images[env])
        away = np.linalg.norm(seen_points(sim, env) - plug[env, :3], axis=-1)
        assert shown.sum() > 30
        assert away[shown].max() < plug_extent(sim)
        assert np.median(away[~shown]) > plug_extent(
            sim
        )  # a bound that the rest of the picture does not keep


@pytest.mark.slow
def test_a_world_is_drawn_alone_as_among_others_and_follows_its_own_state() -> None:
    sim = make(3)
    sim.reset(np.arange(3), np.array([3, 4, 5]))
    camera = RgbCamera(sim, HEIGHT, WIDTH)
    together = camera.images(np.arange(3))
    assert np.array_equal(camera.images(np.array([2]))[0], together[2])
    assert np.array_equal(camera.images(np.array([0, 2])), together[[0, 2]])
    depth = sim.depth_mm()
    moved = np.abs(np.diff(together.astype(int), axis=0)).max(-1) > 40
    differs = np.abs(np.diff(depth.astype(int), axis=0)) > 2
    assert moved.any()
    assert (moved & differs).sum() > 0.5 * moved.sum()  # a colour changes where something stands elsewhere


@pytest.mark.slow
def test_the_camera_moves_with_the_depth_camera() -> None:
    sim = make(2, randomization=RandomizationConfig(camera_position_m=0.03, camera_rotation_rad=0.05))
    sim.reset(np.arange(2), np.array([3, 3]))
    camera = RgbCamera(sim, HEIGHT, WIDTH)
    first, second = camera.images(np.arange(2))
    assert np.array_equal(first, second)  # one seed, one view
    sim.reset(np.array([1]), np.array([8]))
    first, second = camera.images(np.arange(2))
    assert np.mean(first != second) > 0.2


def test_a_mujoco_warp_without_renderer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    old = ModuleType("mujoco_warp")
    old.__spec__ = ModuleSpec("mujoco_warp", None)
    monkeypatch.setitem(sys.modules, "mujoco_warp", old)
    unused: Callable[..., InsertionSim] = make
    with pytest.raises(ImportError, match="lacks create_render_context: pip install -U mujoco-warp"):
        RgbCamera(unused, HEIGHT, WIDTH)


@pytest.mark.gpu
def test_a_gpu_draws_the_same_pictures() -> None:
    pictures = {}
    for device in ("cpu", "cuda"):
        sim = make(3, backend="warp", warp=WarpConfig(device=device))
        sim.reset(np.arange(3), np.array([3, 4, 5]))
        pictures[device] = RgbCamera(sim, HEIGHT, WIDTH).images(np.arange(3)).astype(int)
    assert np.mean(np.abs(pictures["cpu"] - pictures["cuda"]).max(-1) > 8) < 0.02  # edges alone
