import errno
import json
import multiprocessing
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from aloha_columns import TACTILE_KEYS
from lerobot.datasets import LeRobotDataset
from local_hub import use_folder_as_hub
from tiny_commands import lerobot_here, record

from lerobot_vtrefine.datasets.features import ACTION_KEY, DEPTH_KEY, NOISE_LEVEL_KEY, RGB_KEY, STATE_KEY
from lerobot_vtrefine.datasets.simulation_card import describe_simulation
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.demo_dataset import DemoDataset
from lerobot_vtrefine.envs.demo_workers import demonstration_stream
from lerobot_vtrefine.envs.demonstrations import Demonstration
from lerobot_vtrefine.lerobot_compat import card
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.simulation import InsertionSim
from lerobot_vtrefine.tactile import SensorModel


def read(root: Path) -> LeRobotDataset:
    return LeRobotDataset("local/vtrefine_demos", root=root)


def rows(root: Path) -> list[dict]:
    return json.loads((root / "meta" / "recording.json").read_text())["episodes"]


def same(left: Path, right: Path) -> None:
    first, second = read(left), read(right)
    assert len(first) == len(second)
    for index in range(0, len(first), 7):
        for key, value in first[index].items():
            assert np.array_equal(value, second[index][key]), (index, key)


def test_dataset_holds_successful_raw_episodes(demos: Path):
    dataset = read(demos)
    assert dataset.num_episodes == 3
    assert dataset.fps == 10
    assert [row["success"] for row in rows(demos)] == [True] * 3
    assert [row["steps"] for row in rows(demos)] == dataset.meta.episodes["length"]
    item = dataset[len(dataset) - 1]
    assert item[STATE_KEY].shape == item[ACTION_KEY].shape == (16,)
    assert item[DEPTH_KEY].shape == (1, 12, 16)
    assert item[NOISE_LEVEL_KEY].item() == 3.0
    assert max(int(item[key].max()) for key in TACTILE_KEYS) > 0
    assert 0.1 < float(item[DEPTH_KEY].max()) / 1000 < 2


@pytest.mark.usefixtures("started_quickly")
def test_more_workers_give_the_same_dataset(demos: Path, tmp_path: Path):
    again = tmp_path / "workers"
    assert record(again, "--num_episodes=3", "--num_envs=1", "--num_workers=2", "--seed=5") == 0
    same(demos, again)


def test_pads_that_were_fitted_anew_are_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    model, root = tmp_path / "sensor_model.json", tmp_path / "demos"
    flags = ("--num_envs=1", "--seed=5", f"--env.sensor_model={model}")
    SensorModel.named("default").save(model)
    assert record(root, "--num_episodes=1", *flags) == 0
    assert record(root, "--num_episodes=1", *flags) == 0
    SensorModel.named("paper").save(model)
    assert record(root, "--num_episodes=2", *flags) == 2
    assert "was recorded with other settings (sensor_model_file)" in capsys.readouterr().err


def test_touch_of_another_kind_is_not_appended(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Whole touch, its mean and that of another dataset look alike to who trains on them."""
    root, other = tmp_path / "demos", tmp_path / "other"
    flags = ("--num_envs=1", "--seed=5")
    of_demos = ("--env.ablate=touch", f"--env.ablate_dataset={demos}")
    assert record(root, "--num_episodes=1", *flags, *of_demos) == 0
    assert "with `--env.ablate=touch`" in describe_simulation(root)
    assert record(root, "--num_episodes=1", *flags, *of_demos) == 0
    assert record(root, "--num_episodes=2", *flags) == 2
    assert "was recorded with other settings (ablate, ablate_dataset)" in capsys.readouterr().err

    assert record(other, "--num_episodes=1", *flags) == 0
    assert record(root, "--num_episodes=2", *flags, of_demos[0], f"--env.ablate_dataset={other}") == 2
    assert "was recorded with other settings (ablate_dataset)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("saved", "told"),
    [
        (2, "{} keeps 2 episodes; the same command goes on"),
        (0, "nothing was recorded yet; the same command begins anew"),
    ],
)
def test_an_interrupt_says_what_is_left(saved, told, tmp_path, monkeypatch, capsys):
    def interrupted(demos: DemoDataset, demonstration: Demonstration) -> None:
        if demos.num_episodes == saved:
            raise KeyboardInterrupt
        append(demos, demonstration)

    append = DemoDataset.append
    monkeypatch.setattr(DemoDataset, "append", interrupted)
    assert record(tmp_path / "demos", "--num_episodes=3", "--num_envs=4", "--seed=5") == 130
    assert capsys.readouterr().err.splitlines()[-1] == f"interrupted: {told.format(tmp_path / 'demos')}"
    assert (tmp_path / "demos").exists() == (saved > 0)


@pytest.mark.usefixtures("started_quickly")
def test_there_is_one_worker_for_each_core_at_most(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    with demonstration_stream(VtRefineEnvConfig(), Degradation(), 1, 5, num_workers=500):
        assert len(multiprocessing.active_children()) == 1


def test_rerun_continues_to_the_requested_number(demos: Path, tmp_path: Path):
    root = tmp_path / "grown"
    assert record(root, "--num_episodes=1", "--num_envs=4", "--seed=5") == 0
    assert read(root).num_episodes == 1
    assert record(root, "--num_episodes=3", "--num_envs=2", "--seed=5") == 0
    same(demos, root)
    assert rows(root) == rows(demos)
    assert record(root, "--num_episodes=3", "--seed=5") == 0  # nothing left to do
    assert rows(root) == rows(demos)


def test_failures_are_kept_on_request(tmp_path: Path):
    root = tmp_path / "all"
    far_off = ("--degradation.lateral_std_m=0.05", "--include_failures=true")
    assert record(root, "--num_episodes=2", "--num_envs=2", *far_off) == 0
    assert [row["success"] for row in rows(root)] == [False, False]
    assert [row["seed"] for row in rows(root)] == [0, 1]
    assert all(row["failure"] != "none" for row in rows(root))


def test_stock_tools_accept_the_dataset(demos: Path, tmp_path: Path):
    shutil.copytree(demos, tmp_path / "copy")
    lerobot_here(
        "edit_dataset",
        "--repo_id=local/vtrefine_demos",
        f"--root={demos}",
        "--new_repo_id=local/fewer",
        f"--new_root={tmp_path / 'fewer'}",
        "--operation.type=delete_episodes",
        "--operation.episode_indices=[1]",
    )
    lerobot_here(
        "edit_dataset",
        "--new_repo_id=local/merged",
        f"--new_root={tmp_path / 'merged'}",
        "--operation.type=merge",
        "--operation.repo_ids=['local/vtrefine_demos', 'local/copy']",
        f"--operation.roots=['{demos}', '{tmp_path / 'copy'}']",
    )
    lerobot_here(
        "dataset_viz",
        "--repo-id=local/vtrefine_demos",
        f"--root={demos}",
        "--episode-index=0",
        "--num-workers=0",
        "--save=1",
        f"--output-dir={tmp_path / 'viz'}",
    )
    whole, fewer, merged = read(demos), read(tmp_path / "fewer"), read(tmp_path / "merged")
    assert (fewer.num_episodes, merged.num_episodes) == (2, 6)
    assert len(merged) == 2 * len(whole)
    start = whole.meta.episodes["dataset_from_index"][2]
    for key in (ACTION_KEY, DEPTH_KEY, *TACTILE_KEYS):
        assert np.array_equal(whole[start][key], fewer[whole.meta.episodes["length"][0]][key]), key
        assert np.array_equal(whole[start][key], merged[len(whole) + start][key]), key
    assert list((tmp_path / "viz").glob("*.rrd"))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--num_episodes=0"], "--num_episodes must be at least 1"),
        (["--push_to_hub=true"], "--repo_id=local/vtrefine_demos: give a name on the Hub"),
        (["--num_envs=0"], "--num_envs must be at least 1"),
        (["--seed=-1"], "--seed must lie between 0 and 9007199254740991, got -1"),
        (["--seed=99999999999999999999"], "--seed must lie between 0 and 9007199254740991, got 99999"),
        (["--env.pair=star"], "round, square, hexagon"),
        (["--env.clearance_m=-1"], "clearance_m must be above 0"),
        (["--env.clearance_m=0"], "clearance_m must be above 0"),
        (["--env.clearance_m=0.05"], "too large for the round plug"),
        (["--env.pair=automate/00186", "--env.mesh_dir=nowhere"], "nowhere"),
        (["--degradation.lateral_std_m=-1"], "lateral_std_m"),
    ],
)
def test_bad_flags_end_in_one_line(flags, message, tmp_path, capsys):
    assert record(tmp_path / "x", *flags) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("error:")
    assert message in last
    assert not (tmp_path / "x").exists()


def test_the_root_of_all_folders_is_no_dataset(capsys) -> None:
    assert record(Path("/"), "--num_episodes=1") == 2
    assert "error: / cannot be written as a whole; name a folder inside of it" in capsys.readouterr().err


class Painter:
    """A colour camera whose pictures tell the control step."""

    def __init__(self, sim: InsertionSim, height: int, width: int) -> None:
        self.sim, self.shape = sim, (height, width, 3)

    def images(self, ids: np.ndarray) -> np.ndarray:
        return np.stack([np.full(self.shape, 4 * step, np.uint8) for step in self.sim.steps[ids]])


def test_colour_is_recorded_as_a_video_and_continued(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr("lerobot_vtrefine.sim.rgb.RgbCamera", Painter)
    root = tmp_path / "coloured"
    flags = ("--num_envs=1", "--seed=5", "--env.rgb=true", "--env.rgb_size=[32, 48]")
    assert record(root, "--num_episodes=1", *flags) == 0
    assert record(root, "--num_episodes=2", *flags) == 0
    dataset = read(root)
    assert dataset.features[RGB_KEY]["dtype"] == "video"
    assert dataset.features[DEPTH_KEY]["dtype"] == "image"
    for index in (0, 3, len(dataset) - 1):
        item = dataset[index]
        assert item[RGB_KEY].shape == (3, 32, 48)
        assert 255 * float(item[RGB_KEY].mean()) == pytest.approx(4 * int(item["frame_index"]), abs=3)
    assert record(root, "--num_episodes=3", "--num_envs=1", "--seed=5") == 2
    assert "other settings (colour)" in capsys.readouterr().err


def test_a_finished_recording_is_uploaded_with_its_card(demos: Path, tmp_path: Path, monkeypatch):
    use_folder_as_hub(monkeypatch, tmp_path / "hub")
    shutil.copytree(demos, tmp_path / "copy")
    sharing = ("--push_to_hub=true", "--repo_id=me/demos")
    assert record(tmp_path / "copy", "--num_episodes=3", "--seed=5", *sharing) == 0
    card.uninstall()
    pushed = tmp_path / "hub" / "me" / "demos"
    assert "in 3 attempts with environment seeds 5 to 7" in (pushed / "README.md").read_text()
    same(demos, pushed)


def test_other_settings_are_refused(demos: Path, tmp_path, capsys):
    shutil.copytree(demos, tmp_path / "copy")
    assert record(tmp_path / "copy", "--num_episodes=4", "--seed=5", "--degradation.lateral_std_m=0.001") == 2
    assert "other settings (degradation)" in capsys.readouterr().err
    same(demos, tmp_path / "copy")


def test_full_disk_at_the_first_image_is_one_line_and_the_command_goes_on(tmp_path, capsys, monkeypatch):
    def full(*args: object, **kwargs: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    root, sizes = tmp_path / "demos", ("--num_episodes=1", "--num_envs=1")
    with monkeypatch.context() as patch:
        patch.setattr("PIL.Image.Image.save", full)
        patch.setattr("lerobot_vtrefine.envs.demo_dataset.disk_is_full", lambda *_: True)
        assert record(root, *sizes) == 2
    told = capsys.readouterr().err
    assert f"error: the disk is full: {root} keeps 0 episodes; free some space" in told
    assert "Error writing image" not in told
    assert record(root, *sizes) == 0
    assert "1 episode in" in capsys.readouterr().out


def test_full_disk_is_one_line_and_keeps_the_episodes(demos: Path, tmp_path, capsys, monkeypatch):
    root = tmp_path / "copy"
    shutil.copytree(demos, root)

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pyarrow.parquet.ParquetWriter.write_table", full)
    assert record(root, "--num_episodes=4", "--num_envs=1", "--seed=5") == 2
    assert "keeps 3 episodes; free some space and run the same command" in capsys.readouterr().err
    same(demos, root)
