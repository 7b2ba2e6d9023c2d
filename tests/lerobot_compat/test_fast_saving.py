import datasets
import numpy as np
import pytest
from lerobot.datasets import compute_stats, dataset_writer, io_utils
from PIL import Image

from lerobot_vtrefine.lerobot_compat.fast_saving import embed_images, episode_stats, fast_saving

FEATURES = {name: {"dtype": "float32"} for name in ("counts", "state", "timestamp")}


def test_statistics_agree_with_lerobots():
    rng = np.random.default_rng(0)
    episode = {
        "counts": rng.integers(0, 255, (40, 24)).astype(np.uint8),
        "state": rng.normal(size=(40, 16)).astype(np.float32),
        "timestamp": np.arange(40, dtype=np.float32),
    }
    ours, theirs = episode_stats(episode, FEATURES), compute_stats.compute_episode_stats(episode, FEATURES)
    assert list(ours) == list(theirs)
    for key, stats in theirs.items():
        assert set(ours[key]) == set(stats)
        bin_width = float(np.ptp(episode[key])) / 5000  # the resolution of LeRobot's quantiles
        for name, value in stats.items():
            assert ours[key][name].shape == value.shape, (key, name)
            assert ours[key][name] == pytest.approx(value, abs=2 * bin_width, rel=1e-5), (key, name)


def test_single_frame_episodes_fall_back_to_lerobot():
    episode = {"state": np.ones((1, 16), np.float32)}
    assert episode_stats(episode, FEATURES)["state"]["count"].tolist() == [1]


def test_images_are_embedded_as_lerobot_does(tmp_path):
    depth = np.random.default_rng(0).integers(0, 60000, (5, 6, 8)).astype(np.uint16)
    paths = [tmp_path / f"{index}.tiff" for index in range(5)]
    for image, path in zip(depth, paths, strict=True):
        Image.fromarray(image).save(path)
    table = datasets.Dataset.from_dict({"image": [str(path) for path in paths], "index": list(range(5))})
    table = table.cast_column("image", datasets.Image())
    theirs, ours = io_utils.embed_images(table), embed_images(table)
    assert ours.with_format("arrow")[:].equals(theirs.with_format("arrow")[:])
    assert ours.format == theirs.format


def test_the_writer_gets_its_own_functions_back():
    originals = (dataset_writer.compute_episode_stats, dataset_writer.embed_images)
    with fast_saving():
        assert dataset_writer.compute_episode_stats is episode_stats
        assert dataset_writer.embed_images is embed_images
    assert (dataset_writer.compute_episode_stats, dataset_writer.embed_images) == originals


def test_an_unknown_writer_is_left_alone(monkeypatch):
    monkeypatch.setattr(dataset_writer, "compute_episode_stats", len)
    with fast_saving():
        assert dataset_writer.compute_episode_stats is len
    assert dataset_writer.compute_episode_stats is len
