from pathlib import Path

import numpy as np
import pytest
from fake_sim import HEIGHT, WIDTH, FakeSim
from lerobot.datasets import LeRobotDataset

from lerobot_vtrefine.datasets.features import BASELINE_KEYS, DEPTH_KEY, TACTILE_KEYS
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs import ablation
from lerobot_vtrefine.envs.ablation import make_ablation, mean_frame
from lerobot_vtrefine.envs.episodes import Episodes


def test_mean_frame_is_the_mean_of_the_datasets_items(tiny_dataset: Path):
    dataset = LeRobotDataset("local/tiny", root=tiny_dataset)
    items = [dataset[index] for index in range(len(dataset))]
    for key, mean in mean_frame(tiny_dataset, (TACTILE_KEYS[1], DEPTH_KEY)).items():
        assert mean == pytest.approx(np.mean([item[key].numpy() for item in items], axis=0)), key


def test_large_datasets_are_sampled_evenly(tiny_dataset: Path, monkeypatch):
    monkeypatch.setattr(ablation, "MAX_FRAMES", 2)
    dataset = LeRobotDataset("local/tiny", root=tiny_dataset)
    ends = [dataset[index][TACTILE_KEYS[0]].numpy() for index in (0, len(dataset) - 1)]
    mean = mean_frame(tiny_dataset, TACTILE_KEYS[:1])[TACTILE_KEYS[0]]
    assert mean == pytest.approx(np.mean(np.array(ends, float), axis=0))


@pytest.mark.parametrize(("part", "replaced"), [("touch", "tactile"), ("vision", "depth_mm")])
def test_only_the_ablated_part_changes(part, replaced, monkeypatch):
    means = {key: np.full(384, 17.4) for key in TACTILE_KEYS} | {
        key: np.full(384, 10.0) for key in BASELINE_KEYS
    }
    means[DEPTH_KEY] = np.full((1, HEIGHT, WIDTH), 650.6)
    monkeypatch.setattr(ablation, "mean_frame", lambda root, keys: {key: means[key] for key in keys})
    plain, ablated = Episodes(FakeSim(2)), Episodes(FakeSim(2), make_ablation(part, Path("somewhere"), ALOHA))
    for episodes in (plain, ablated):
        episodes.reset(np.arange(2), np.arange(2))
        episodes.step(np.zeros((2, 16)))
    idle = ablated.raw["tactile_baseline"].astype(int) if part == "touch" else 0
    assert np.unique(ablated.raw[replaced] - idle).tolist() == [{"touch": 7, "vision": 651}[part]]
    for key in set(plain.raw) - {replaced}:
        assert np.array_equal(plain.raw[key], ablated.raw[key]), key
        assert plain.raw[key].dtype == ablated.raw[key].dtype


def test_none_changes_nothing():
    assert make_ablation("none", None, ALOHA) is None


def test_missing_dataset_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="ablate_dataset"):
        make_ablation("touch", tmp_path / "nothing", ALOHA)


def test_touch_ablation_hides_the_idle_level(monkeypatch):
    """Pads idle at different counts; what remains above the baseline must be the same for all of them."""
    means = {key: np.full(384, 30.0) for key in TACTILE_KEYS} | {
        key: np.full(384, 25.0) for key in BASELINE_KEYS
    }
    monkeypatch.setattr(ablation, "mean_frame", lambda root, keys: {key: means[key] for key in keys})
    baseline = np.stack([np.full((4, 384), level, np.uint8) for level in (10, 40)])
    raw = make_ablation("touch", Path("somewhere"), ALOHA)(
        {"tactile": baseline + 50, "tactile_baseline": baseline}
    )
    assert np.array_equal(raw["tactile"] - baseline, np.full((2, 4, 384), 5))
    assert raw["tactile"].dtype == np.uint8


def test_pixels_without_return_do_not_shift_the_mean_depth(tmp_path):
    frames = iter([np.array([[0.0, 600.0]]), np.array([[500.0, 700.0]])])
    assert _mean_depth(list(frames), tmp_path) == pytest.approx(np.array([[500.0, 650.0]]))


def _mean_depth(frames: list[np.ndarray], root: Path) -> np.ndarray:
    class Rows:
        features = (DEPTH_KEY,)
        hf_dataset = property(lambda self: self)

        def __init__(self, *_: object, **__: object) -> None: ...
        def select_columns(self, _: list[str]) -> list[dict[str, np.ndarray]]:
            return [{DEPTH_KEY: frame} for frame in frames]

    (root / "meta").mkdir()
    (root / "meta" / "info.json").write_text("{}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lerobot.datasets.lerobot_dataset.LeRobotDataset", Rows)
        return mean_frame(root, (DEPTH_KEY,))[DEPTH_KEY]
