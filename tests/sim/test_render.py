"""Video frames: both ways to draw the scene, pads beside it, and no trace left in the episode."""

import sys
from itertools import combinations

import numpy as np
import pytest

from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim import headless, render
from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.pad_panel import Progress, pad_panel, panel_size
from lerobot_vtrefine.sim.render import VideoRenderer, shaded_depth
from lerobot_vtrefine.sim.simulation import InsertionSim

PADS = ALOHA.pad_names, ALOHA.pad_layout


@pytest.fixture(scope="module")
def sim() -> InsertionSim:
    sim = InsertionSim(SceneConfig(start="grasped"), num_envs=2, num_threads=1)
    sim.reset(np.arange(2), np.arange(2))
    return sim


def test_ray_frame_shows_scene_and_pads(sim: InsertionSim) -> None:
    frame = VideoRenderer(sim, 1, backend="rays").frame()
    assert frame.dtype == np.uint8
    assert frame.shape[0] % 2 == 0
    assert frame.shape[1] % 2 == 0
    scene, panel = frame[:, :480], frame[:, 480:]
    assert scene.std() > 10
    assert panel.std() > 10


def test_gl_frame_shows_the_scene(sim: InsertionSim) -> None:
    try:
        renderer = VideoRenderer(sim, 0, backend="gl")
    except RuntimeError as error:
        assert "MUJOCO_GL=egl" in str(error)  # noqa: PT017
        pytest.skip(f"no OpenGL on this machine: {error}")
    frame = renderer.frame()
    assert frame.shape == VideoRenderer(sim, 0, backend="rays").frame().shape
    assert frame[:, :480].std() > 20
    assert np.abs(frame[:, :480].astype(int) - np.roll(frame[:, :480], 40, axis=1)).mean() > 1
    renderer.close()


def test_looking_changes_nothing() -> None:
    readings = []
    for look in (False, True):
        sim = InsertionSim(SceneConfig(start="grasped"), num_envs=1, num_threads=1)
        sim.reset(np.arange(1), np.arange(1))
        renderer = VideoRenderer(sim, 0, backend="rays")
        for _ in range(3):
            sim.step(sim.command_targets(), np.arange(1))
            if look:
                renderer.frame()
        readings.append(sim.observe())
    for key, value in readings[0].items():
        np.testing.assert_array_equal(value, readings[1][key], err_msg=key)


def test_without_opengl_the_error_names_the_fix(sim: InsertionSim, monkeypatch: pytest.MonkeyPatch) -> None:
    import mujoco

    def broken(*_: object) -> None:
        raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

    monkeypatch.setattr(render, "_GL_FAILURES", [])
    monkeypatch.setattr(mujoco, "Renderer", broken)
    with pytest.raises(RuntimeError, match=r"no OpenGL .*install EGL .*MUJOCO_GL=egl") as error:
        VideoRenderer(sim, 0, backend="gl")
    assert "\n" not in str(error.value)
    assert render._GL_FAILURES[0].__traceback__ is None, "it would keep the simulation"


def test_without_opengl_videos_still_come(
    sim: InsertionSim, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked = []

    def fail(*_: object) -> None:
        asked.append(True)
        raise RuntimeError("no display")

    monkeypatch.setattr(render, "_GL_FAILURES", [])
    monkeypatch.setattr(render, "_GlScene", fail)
    frame = VideoRenderer(sim, 0).frame()
    assert "drawing the depth image instead" in caplog.text
    np.testing.assert_array_equal(frame, VideoRenderer(sim, 0, backend="rays").frame())
    VideoRenderer(sim, 0)
    assert asked == [True], "GLFW that failed once aborts the process when it is asked again"


def test_unknown_backend_lists_the_choices(sim: InsertionSim) -> None:
    with pytest.raises(ValueError, match="auto, gl or rays"):
        VideoRenderer(sim, 0, backend="vulkan")  # ty: ignore[invalid-argument-type]


def test_panel_brightens_where_a_pad_is_pressed() -> None:
    idle = np.full((4, 384), 20, np.uint8)
    pressed = idle.copy()
    pressed[2, :32] = 180  # row 0 of the third pad
    before, after = (pad_panel(counts, idle, *PADS, Progress(3, np.nan, 1.0)) for counts in (idle, pressed))
    rows, cols = np.nonzero(np.abs(after.astype(int) - before).sum(-1) > 60)
    height, width = panel_size(*PADS)
    assert before.shape == (height, width, 3)
    # Inside the third quarter: its label and the band of its first row.
    assert height * 0.5 < rows.min() < rows.max() < height * 0.7
    assert np.ptp(cols) > 0.8 * width


def test_panel_shows_how_the_hold_fills() -> None:
    """The more of the hold is done, the more of the ring is green; an outcome takes the second line."""
    idle = np.zeros((4, 384), np.uint8)
    green = []
    for seated_s in (np.nan, 0.0, 0.3, 0.6, 1.0):
        panel = pad_panel(idle, idle, *PADS, Progress(3, seated_s, hold_s=1.0)).astype(int)[:34, -40:]
        green.append(int((panel[..., 1] - panel[..., 0] > 60).sum()))
    assert green[0] == green[1] == 0
    assert np.all(np.diff(green[1:]) > 50)
    ends = ("", "success", "contact force", "time out")
    panels = [pad_panel(idle, idle, *PADS, Progress(3, np.nan, 1.0, outcome))[:34] for outcome in ends]
    assert all((one != other).any() for one, other in combinations(panels, 2))


def test_frame_tells_hold_and_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    monkeypatch.setattr(render, "pad_panel", lambda *given: told.append(given[-1]) or pad_panel(*given))
    sim = InsertionSim(SceneConfig(start="grasped"), TaskConfig(episode_steps=2), num_envs=2, num_threads=1)
    sim.reset(np.arange(2), np.arange(2))
    renderer = VideoRenderer(sim, 1, backend="rays")
    state = sim.get_state(1)
    for held, success, failure in ((0, False, 0), (1, False, 0), (4, False, 0), (11, True, 0), (0, False, 2)):
        state["episode"] |= {"hold_steps": held, "success": success, "failure": failure}
        sim.set_state(1, state)
        renderer.frame()
    for _ in range(2):
        sim.set_state(1, state | {"episode": state["episode"] | {"failure": 0}})
        sim.step(sim.command_targets())
        state = sim.get_state(1)
    renderer.frame()
    assert [progress.held for progress in told] == pytest.approx([0.0, 0.0, 0.3, 1.0, 0.0, 0.0])
    assert [progress.outcome for progress in told] == ["", "", "", "success", "contact force", "time out"]


def test_shading_tells_surfaces_apart_and_leaves_holes_dark() -> None:
    depth = np.full((40, 60), 500, np.uint16)
    depth[10:20, 20:30] = 400
    depth[:3] = 0
    image = shaded_depth(depth, np.array([80.0, 80.0, 30.0, 20.0]))
    assert image.shape == (40, 60, 3)
    np.testing.assert_array_equal(image[0], np.broadcast_to((24, 26, 32), (60, 3)))
    assert int(image[15, 25, 0]) > int(image[30, 25, 0]) + 10


@pytest.mark.parametrize(
    ("environment", "has_egl", "expected"),
    [
        ({}, True, "egl"),
        ({}, False, None),
        ({"DISPLAY": ":0"}, True, None),
        ({"MUJOCO_GL": "osmesa"}, True, "osmesa"),
    ],
)
def test_headless_choice(
    monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], has_egl: bool, expected: str | None
) -> None:
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(headless, "_has_egl", lambda: has_egl)
    headless.prefer_headless_gl()
    import os

    assert os.environ.get("MUJOCO_GL") == expected
    monkeypatch.delenv("MUJOCO_GL", raising=False)
