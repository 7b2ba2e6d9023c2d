import shutil
from pathlib import Path

import numpy as np
import pytest
from aloha_columns import BASELINE_KEYS, TACTILE_KEYS
from draccus.utils import ParsingError
from fake_sim import HEIGHT, WIDTH, FakeSim
from lerobot.datasets import LeRobotDataset

from lerobot_vtrefine.datasets.features import DEPTH_KEY
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs import VtRefineEnvConfig, ablation
from lerobot_vtrefine.envs.ablation import make_ablation, mean_frame
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.envs.live_world import LiveWorld

PADS = list(zip(TACTILE_KEYS, BASELINE_KEYS, strict=True))


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


@pytest.mark.parametrize("part", ["touch", "touch_other", "vision"])
def test_missing_dataset_is_named(part, tmp_path):
    with pytest.raises(FileNotFoundError, match="ablate_dataset"):
        make_ablation(part, tmp_path / "nothing", ALOHA)


@pytest.mark.parametrize("part", ["touch", "touch_other"])
def test_a_damaged_file_is_named(part, tiny_dataset: Path, tmp_path):
    damaged = shutil.copytree(tiny_dataset, tmp_path / "damaged")
    file = next((damaged / "data").rglob("*.parquet"))
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match=f"{file} cannot be read"):
        make_ablation(part, damaged, ALOHA)


def played(ablate, num_envs: int, seeds: list[int], steps: int = 8) -> tuple[list, list]:
    """What is shown where all taxels count step + 1, and what else is in the frames."""
    episodes = Episodes(FakeSim(num_envs, episode_steps=steps), ablate)
    episodes.reset(np.arange(num_envs), np.array(seeds))
    touch, rest = [], []
    for step in range(steps):
        touch.append(episodes.raw["tactile"].copy())
        rest.append({key: value.copy() for key, value in episodes.raw.items() if key != "tactile"})
        if step < steps - 1:
            episodes.step(np.zeros((num_envs, 16)))
    return touch, rest


def test_shuffled_touch_is_the_episodes_own_out_of_order():
    seeds = [1, 3]  # neither ends early
    shuffled, rest = played(make_ablation("touch_shuffled", None, ALOHA), 2, seeds)
    plain, untouched = played(None, 2, seeds)
    for step, (shown, real) in enumerate(zip(shuffled, plain, strict=True)):
        assert (shown[:, 0, 0] <= real[:, 0, 0]).all()  # nothing from the future
        assert (shown == shown[:, :1, :1]).all()  # whole frames
        assert all(np.array_equal(value, untouched[step][key]) for key, value in rest[step].items())
    order = np.array([shown[:, 0, 0] for shown in shuffled])
    assert (order != np.array([real[:, 0, 0] for real in plain])).any(0).all()
    assert (order[:, 0] != order[:, 1]).any()
    alone, _ = played(make_ablation("touch_shuffled", None, ALOHA), 1, seeds[1:])
    assert [shown[0, 0, 0] for shown in alone] == order[:, 1].tolist()  # a function of the seed


def test_shuffled_touch_forgets_the_last_episode():
    episodes = Episodes(FakeSim(1), make_ablation("touch_shuffled", None, ALOHA))
    for _ in range(2):
        episodes.reset(np.arange(1), np.array([1]))
        assert episodes.raw["tactile"].max() == 1
        for _ in range(5):
            episodes.step(np.zeros((1, 16)))


def test_touch_of_another_episode_lies_above_the_own_idle_level(tiny_dataset: Path):
    dataset = LeRobotDataset("local/tiny", root=tiny_dataset)
    items = [dataset[index] for index in range(len(dataset))]
    pressed = np.array(
        [
            [item[key].numpy().astype(int) - item[idle].numpy().astype(int) for key, idle in PADS]
            for item in items
        ]
    ).reshape(3, 12, 4, 384)
    ablate = make_ablation("touch_other", tiny_dataset, ALOHA)
    baseline = np.full((20, 4, 384), 9, np.uint8)
    ids, seeds = np.arange(20), np.arange(20)
    taken = {}
    for step in (0, 5, 30):
        raw = {"tactile": baseline + 50, "tactile_baseline": baseline, "state": np.ones(20)}
        shown = ablate(raw, ids, seeds, np.full(20, step))
        assert shown["state"] is raw["state"]
        assert shown["tactile"].dtype == np.uint8
        frames = np.clip(9 + pressed[:, min(step, 11)], 0, 255)
        same = (shown["tactile"][:, None] == frames[None]).all((2, 3))
        assert (same.sum(1) == 1).all()
        taken[step] = same.argmax(1).tolist()
    assert taken[0] == taken[5] == taken[30]  # one episode throughout
    assert set(taken[0]) == {0, 1, 2}


def test_shuffling_needs_no_dataset():
    assert VtRefineEnvConfig(ablate="touch_shuffled").ablate_dataset is None
    with pytest.raises(ParsingError, match=r"touch_other needs --env\.ablate_dataset"):
        VtRefineEnvConfig(ablate="touch_other")


def test_touch_ablation_hides_the_idle_level(monkeypatch):
    """Pads idle at different counts; what remains above the baseline must be the same for all of them."""
    means = {key: np.full(384, 30.0) for key in TACTILE_KEYS} | {
        key: np.full(384, 25.0) for key in BASELINE_KEYS
    }
    monkeypatch.setattr(ablation, "mean_frame", lambda root, keys: {key: means[key] for key in keys})
    baseline = np.stack([np.full((4, 384), level, np.uint8) for level in (10, 40)])
    ids = np.arange(2)
    raw = make_ablation("touch", Path("somewhere"), ALOHA)(
        {"tactile": baseline + 50, "tactile_baseline": baseline}, ids, ids, ids
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
        patch.setattr("lerobot_vtrefine.lerobot_compat.completeness.check_complete", lambda _: None)
        return mean_frame(root, (DEPTH_KEY,))[DEPTH_KEY]


def test_a_world_that_is_watched_shows_the_touch_that_policies_are_judged_by():
    config = VtRefineEnvConfig(start="grasped", ablate="touch_shuffled")
    watched, judged = LiveWorld(config), make_episodes(config, 1)
    watched.reset(3)
    judged.reset(judged.ids, np.array([3]))
    targets = watched.sim.command_targets()[0]
    for step in range(6):
        moved = targets + 0.02 * np.sin(step)
        watched.step(moved)
        judged.step(moved[None])
        assert np.array_equal(watched.observe()["tactile"], judged.raw["tactile"][0])
