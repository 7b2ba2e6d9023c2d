"""--display_data=true shows pads as pictures: LeRobot's own commands, into a file instead of a window."""

from collections.abc import Generator
from pathlib import Path
from typing import Any

import lerobot.utils.visualization_utils as dispatch
import numpy as np
import pytest
from aloha_columns import PADS
from commands import follower_flags, leader_flags, run_command
from rig import Rig

from lerobot_vtrefine.cli.view_pads import main as view_pads
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.lerobot_compat import live_view

rr = pytest.importorskip("rerun")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(autouse=True)
def restore() -> Generator[None]:
    yield
    live_view.uninstall()


def logged(path: Path) -> dict[str, list[set[str]]]:
    """Entities of a rerun file -> column names of each of their chunks."""
    from rerun.recording import load_recording

    found: dict[str, list[set[str]]] = {}
    for chunk in load_recording(str(path)).chunks():
        names = set(chunk.to_record_batch().schema.names)
        found.setdefault(str(chunk.entity_path).lstrip("/"), []).append(names)
    return found


def shape_in(path: Path, entity: str) -> dict[str, Any]:
    from rerun.recording import load_recording

    for chunk in load_recording(str(path)).chunks():
        batch = chunk.to_record_batch()
        if str(chunk.entity_path).lstrip("/") == entity and "Image:format" in batch.schema.names:
            return batch.column("Image:format").to_pylist()[0][0]
    raise AssertionError(f"{entity} holds no image")


def test_teleoperating_shows_four_pictures(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "live.rrd"
    monkeypatch.setattr(rr, "spawn", lambda **_: rr.save(path))
    command = [*follower_flags(rig), *leader_flags(rig), "--teleop_time_s=1", "--fps=10"]
    run_command(monkeypatch, "teleoperate", [*command, "--display_data=true"])
    found = logged(path)
    for pad in PADS:
        picture = shape_in(path, f"observation.tactile.{pad}")
        assert (picture["width"], picture["height"]) == (32, 12)
    assert not [entity for entity in found if "baseline" in entity]
    assert any("Scalars:scalars" in names for names in found["observation.tactile_age"])
    assert any("Scalars:scalars" in names for names in found["observation.left_waist.pos"])


def test_view_pads_writes_a_rerun_file(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "new" / "pads.rrd"
    assert view_pads(["--pads_file", str(rig.pads_file), "--seconds", "0.6", "--save", str(path)]) == 0
    found = logged(path)
    for pad in PADS:
        assert shape_in(path, f"pads/{pad}")["width"] == 32
        assert f"health/{pad}" in found


def test_stale_pads_are_grey_and_pressed_taxels_bright() -> None:
    pads = {"thumb": PadConfig("/dev/a", rows=2, cols=3), "index": PadConfig("/dev/b", rows=2, cols=3)}
    counts = np.array([20, 20, 20, 20, 20, 200], np.uint8)
    idle = np.full(6, 20, np.uint8)
    observation = {
        "joint.pos": 0.5,
        "observation.tactile.thumb": counts,
        "observation.tactile_baseline.thumb": idle,
        "tactile.index": counts,
        "tactile_baseline.index": idle,
        "tactile_age": np.array([0.01, 5.0], np.float32),
        "camera.front.pose": np.zeros(7),
    }
    shown = live_view.drawable(observation, pads)
    assert set(shown) == {"joint.pos", "tactile.thumb", "tactile.index", "tactile_age"}
    thumb, index = shown["tactile.thumb"], shown["tactile.index"]
    assert thumb.shape == index.shape == (2, 3, 3)
    assert thumb.dtype == np.uint8
    assert thumb[1, 2].tolist() == [253, 231, 37]
    assert thumb[0, 0].tolist() == [68, 1, 84]
    assert (index == index[..., :1]).all()
    assert index[1, 2, 0] > index[0, 0, 0]


def test_wrapping_twice_draws_once_and_is_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[dict[str, Any]] = []

    def stock(observation: Any = None, action: Any = None, compress_images: bool = False) -> None:
        seen.append(observation)

    monkeypatch.setattr(dispatch, "log_rerun_data", stock)
    pads = {"thumb": PadConfig("/dev/a", rows=2, cols=3)}
    live_view.install(pads)
    live_view.install(pads)
    frame = {"tactile.thumb": np.zeros(6, np.uint8)}
    dispatch.log_visualization_data("rerun", observation=frame)
    dispatch.log_visualization_data("rerun", action={"joint.pos": 0.0})
    assert seen[0]["tactile.thumb"].shape == (2, 3, 3)
    assert seen[1] is None
    live_view.uninstall()
    assert dispatch.log_rerun_data is stock


def test_robots_one_after_the_other_are_each_shown_with_their_own_pads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A simulated one beside a real one whose pads bear the same names, and one that is none of ours."""
    seen: list[dict[str, Any]] = []
    monkeypatch.setattr(dispatch, "log_rerun_data", lambda observation=None, **_: seen.append(observation))
    for rows, cols in ((2, 3), (4, 3)):
        live_view.install({"thumb": PadConfig("/dev/a", rows=rows, cols=cols)})
    other = {"camera.gain": 1.0, "arm.pos": 0.5, "tactile_baseline.x": 2.0}
    for frame in (
        {"tactile.thumb": np.zeros(6, np.uint8)},
        {"tactile.thumb": np.zeros(12, np.uint8)},
        {"tactile.thumb": np.zeros(5, np.uint8)},
        other,
    ):
        dispatch.log_visualization_data("rerun", observation=frame)
    assert [frame["tactile.thumb"].shape for frame in seen[:3]] == [(2, 3, 3), (4, 3, 3), (5,)]
    assert seen[3] == other


def test_untested_lerobot_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    before = dispatch.log_rerun_data
    monkeypatch.setattr(live_view, "is_supported", lambda: False)
    live_view.install({"thumb": PadConfig("/dev/a")})
    assert dispatch.log_rerun_data is before
    assert "untested" in caplog.text
