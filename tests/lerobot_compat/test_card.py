"""A tactile dataset pushed to a Hub and back: every value, and a card that says what the values are."""

import json
import shutil
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
import yaml
from aloha_columns import BASELINE_KEYS, PADS, TACTILE_KEYS
from lerobot.datasets import remove_feature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from local_hub import use_folder_as_hub

from lerobot_vtrefine.lerobot_compat import card


@pytest.fixture(autouse=True)
def restore() -> Generator[None]:
    yield
    card.uninstall()


def frames(dataset: LeRobotDataset) -> list[dict[str, object]]:
    return [dataset[index] for index in range(len(dataset))]


def test_push_and_pull_lose_nothing_and_the_card_describes_the_pads(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_folder_as_hub(monkeypatch, tmp_path / "hub")
    card.install()
    dataset = LeRobotDataset("local/tiny", root=tiny_dataset)
    dataset.push_to_hub(tags=["insertion"])
    pulled = LeRobotDataset("local/tiny", root=tmp_path / "pulled")
    assert pulled.meta.features == dataset.meta.features
    assert pulled.meta.total_episodes == dataset.meta.total_episodes == 3
    for ours, theirs in zip(frames(dataset), frames(pulled), strict=True):
        assert set(ours) == set(theirs)
        for key, value in ours.items():
            assert theirs[key] == value if isinstance(value, str) else theirs[key].equal(value), key

    text = (tmp_path / "hub" / "local" / "tiny" / "README.md").read_text()
    header = yaml.safe_load(text.split("---")[1])
    assert {"LeRobot", "tactile", "flexitac", "insertion"} <= set(header["tags"])
    for pad in PADS:
        assert f"| `observation.tactile.{pad}` | 12 x 32 | uint8 | adc counts |" in text
    assert "reshape(12, 32)" in text
    assert "0, 0, 0.75, 0, 1, 0, 0" in text  # the camera's pose
    assert "40, 40, 15.5, 11.5" in text  # its intrinsics
    assert "`left_waist.pos`" in text
    assert "noise_level` is above 0 are simulated" in text
    assert "3 episodes, 36 frames at 10 frames/s" in text


def test_idle_counts_on_the_card_are_those_of_the_data(tiny_dataset: Path) -> None:
    dataset = LeRobotDataset("local/tiny", root=tiny_dataset)
    column = np.stack(dataset.hf_dataset.with_format("numpy")[BASELINE_KEYS[0]])
    row = next(line for line in card.describe(dataset.meta).splitlines() if TACTILE_KEYS[0] in line)
    means = column.mean(axis=0)
    assert f"{np.median(means):.0f} ({means.min():.0f} to {means.max():.0f})" in row


def test_normalised_values_are_not_called_counts(tiny_dataset: Path) -> None:
    meta = LeRobotDataset("local/tiny", root=tiny_dataset).meta
    assert "Counts are what a board sends" in card.describe(meta)
    meta.features[TACTILE_KEYS[1]]["info"] = {"array_shape": [12, 32], "unit": "share of the frame's maximum"}
    text = card.describe(meta)
    assert "Counts are what a board sends" not in text
    assert "| share of the frame's maximum |" in text


def test_datasets_without_pads_keep_the_stock_card(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_folder_as_hub(monkeypatch, tmp_path / "hub")
    card.install()
    tiny = LeRobotDataset("local/tiny", root=tiny_dataset)
    blind = remove_feature(tiny, list(TACTILE_KEYS), output_dir=tmp_path / "blind", repo_id="local/blind")
    assert card.describe(blind.meta) == ""
    blind.push_to_hub()
    text = (tmp_path / "hub" / "local" / "blind" / "README.md").read_text()
    assert "FlexiTac" not in text
    assert "flexitac" not in text.split("---")[1]


def test_a_description_of_the_users_own_wins(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_folder_as_hub(monkeypatch, tmp_path / "hub")
    card.install()
    card.install()
    LeRobotDataset("local/tiny", root=tiny_dataset).push_to_hub(dataset_description="Plugs and sockets.")
    text = (tmp_path / "hub" / "local" / "tiny" / "README.md").read_text()
    assert "Plugs and sockets." in text
    assert "row-major" not in text


def test_untested_lerobot_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    before = LeRobotDataset.push_to_hub
    monkeypatch.setattr(card, "is_supported", lambda: False)
    card.install()
    assert LeRobotDataset.push_to_hub is before
    assert "untested" in caplog.text


def test_the_card_of_simulated_data_names_its_task_seeds_and_outcomes(
    tiny_dataset: Path, tmp_path: Path
) -> None:
    root = tmp_path / "simulated"
    shutil.copytree(tiny_dataset, root)
    meta = LeRobotDataset("local/tiny", root=root).meta
    assert "### Simulation" not in card.describe(meta)
    scene = {"pair": "round", "clearance_m": 0.002, "start": "grasped"}
    settings = {"scene": scene, "sensor_model": "default", "seed": 40, "include_failures": False}
    settings["degradation"] = {"lateral_std_m": 0.0008, "tilt_std_rad": 0.0}
    rows = [{"success": True, "time_to_success_s": 2.0 + k, "peak_force_n": 5.0} for k in range(3)]
    note = {"settings": settings, "next_seed": 47, "episodes": rows}
    (root / "meta" / "recording.json").write_text(json.dumps(note))
    text = card.describe(meta)
    assert "pair `round`, clearance 2 mm, start `grasped`" in text
    assert "errors (`lateral_std_m` 0.0008), in 7 attempts with environment seeds 40 to 46" in text
    assert "the 3 that succeeded were kept" in text
    assert "| time to success | 3.0 s | 3.8 s |" in text
    assert "3 of 3 episodes end in success" in text
