"""A dataset in rerun: pads, cloud and motion are in the file, under one timeline."""

import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from lerobot_vtrefine.cli import view_data, view_pads
from lerobot_vtrefine.cli.report.cloud import body_of, build_cloud, recorded_cloud
from lerobot_vtrefine.cli.view_data import cloud_colours, clouds_of, pad_picture
from lerobot_vtrefine.datasets.features import DEPTH_KEY, STATE_KEY, raw_to_frame
from lerobot_vtrefine.embodiments import KINOVA
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.live_world import LiveWorld
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.view import rerun_viewer


def test_pads_cloud_and_motion_are_saved(tiny_dataset: Path, tmp_path: Path, capsys) -> None:
    pytest.importorskip("rerun")
    target = tmp_path / "shown" / "demos.rrd"
    assert view_data.main([f"--dataset.root={tiny_dataset}", f"--save={target}"]) == 0
    assert "1 episode, " in capsys.readouterr().out
    content = target.read_bytes()
    for entity in (b"/pads/left_arm_left_finger", b"/cloud", b"/depth", b"/command"):
        assert entity in content


def test_clouds_hold_what_was_seen_and_felt(tiny_dataset: Path) -> None:
    points, depth = next(clouds_of(tiny_dataset, 0))
    assert points.shape == (512 + 4 * 384, 5)
    assert depth.ndim == 2
    colours = cloud_colours(points)
    assert (colours[points[:, 4] == 0] == view_data.GREY).all()
    assert recorded_cloud(tiny_dataset).count("[") == len(points) + 1


def test_what_is_felt_lies_on_the_bodys_own_pads() -> None:
    world = LiveWorld(
        VtRefineEnvConfig(start="grasped", num_threads=1, scene=SceneConfig(embodiment="kinova"))
    )
    world.reset(0)
    frame = raw_to_frame(world.observe(), KINOVA)
    stored = io.BytesIO()
    Image.fromarray(frame[DEPTH_KEY][..., 0]).save(stored, "TIFF")
    points = build_cloud({**frame, DEPTH_KEY: {"bytes": stored.getvalue()}}, body_of(frame))
    felt = torch.from_numpy(points[points[:, 4] > 0.5, :3])
    pads, _ = KINOVA.pad_poses(torch.from_numpy(frame[STATE_KEY]))
    assert len(felt) == 4 * 384
    assert torch.cdist(felt, pads).min(dim=1).values.max() < 0.04  # half of a pad's diagonal
    assert body_of([key for key in frame if "left_pad" not in key]) is None


def test_a_pressed_taxel_is_bright_at_its_place() -> None:
    counts, idle = np.full(384, 4, np.uint8), np.full(384, 4, np.uint8)
    counts[2 * 32 + 5] = 200
    picture = pad_picture(counts, idle, PadLayout())
    assert picture.shape == (12, 32, 3)
    assert tuple(np.unravel_index(picture.sum(axis=2).argmax(), (12, 32))) == (2, 5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either --dataset.root=DIR or --dataset.repo_id=NAME"),
        (["--dataset.root=nowhere"], "nowhere"),
        (["--dataset.root=TINY", "--episodes=[0, 99]"], "episode 99 was asked for"),
        (["--dataset.root=TINY", "--save=TINY"], "is a folder; name a file in it"),
        (["--dataset.root=TINY", "--save=/proc/x.rrd"], "--save=/proc/x.rrd"),
        (["--dataset.root=TINY", "--save=/etc/hosts/x.rrd"], "x.rrd cannot be written: /etc/hosts is not a"),
        (["--dataset.root=TINY", "--episodes=first"], "argument --episodes: give a list such as '[0, 2]'"),
    ],
)
def test_bad_flags_are_one_line(arguments, message, tiny_dataset: Path, tmp_path: Path, capsys) -> None:
    pytest.importorskip("rerun")
    given = [argument.replace("TINY", str(tiny_dataset)) for argument in arguments]
    assert view_data.main([f"--save={tmp_path / 'x.rrd'}", *given]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_no_file_is_replaced_without_being_asked_to(tiny_dataset: Path, tmp_path: Path, capsys) -> None:
    pytest.importorskip("rerun")
    target = tmp_path / "demos.rrd"
    target.write_text("mine")
    given = [f"--dataset.root={tiny_dataset}", f"--save={target}"]
    assert view_data.main(given) == 2
    told = capsys.readouterr().err
    assert told == f"error: {target} exists; choose another --save or add --overwrite to replace it\n"
    assert target.read_text() == "mine"
    assert view_data.main([*given, "--overwrite"]) == 0
    assert b"/cloud" in target.read_bytes()


def test_an_interrupted_file_is_not_there(tiny_dataset: Path, tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("rerun")

    def interrupted(*_) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(view_data, "log_episode", interrupted)
    target = tmp_path / "demos.rrd"
    target.write_text("mine")
    given = [f"--dataset.root={tiny_dataset}", f"--save={target}", "--overwrite"]
    assert view_data.main(given) == 130
    assert target.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [target]


def test_a_file_that_a_full_disk_cut_off_is_told(
    tiny_dataset: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    pytest.importorskip("rerun")
    monkeypatch.setattr(view_data.shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    assert view_data.main([f"--dataset.root={tiny_dataset}", f"--save={tmp_path / 'x.rrd'}"]) == 2
    assert "error: the disk is full while writing" in capsys.readouterr().err


def test_a_missing_display_is_told_before_anything_is_opened(tiny_dataset: Path, monkeypatch, capsys) -> None:
    """rerun only logs that its viewer did not start, and programs that send to it wait for ever."""
    pytest.importorskip("rerun")
    monkeypatch.setattr(rerun_viewer.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(rerun_viewer, "_viewer_listens", lambda: False)
    shown = [f"--dataset.root={tiny_dataset}"], ["--ports", "nowhere", "--rerun"]
    for main, arguments in zip((view_data.main, view_pads.main), shown, strict=True):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: there is no display for the rerun viewer: write a file with --save=")
        assert error.count("\n") == 1
