"""LeFlexiTac datasets: raw counts come back, everything else stays as it was."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_vtrefine.cli.import_dataset import ImportConfig, import_dataset
from lerobot_vtrefine.datasets.importers.flexitac_counts import (
    HostRule,
    UnknownRuleError,
    recover_counts,
)
from lerobot_vtrefine.datasets.importers.leflexitac import is_leflexitac

SHAPE = (12, 32)
THRESHOLD, SCALE = 25.0, 30.0


def press(rng: np.random.Generator, peak: float, width: float = 2.0) -> np.ndarray:
    """Whole counts above idle of a round contact, (12, 32)."""
    row, col = rng.uniform(3, 9), rng.uniform(5, 27)
    r, c = np.mgrid[:12, :32]
    return np.rint(peak * np.exp(-((r - row) ** 2 + (c - col) ** 2) / (2 * width**2)))


def host_frame(raw: np.ndarray, baseline: np.ndarray) -> np.ndarray:
    """What LeFlexiTac's driver stores (its rule, written down from the notes)."""
    s = np.clip(raw.astype(np.float32) - baseline.astype(np.float32) - THRESHOLD, 0, 100)
    return (s / SCALE if s.max() < THRESHOLD else s / s.max()).astype(np.float32)


def recording(rng: np.random.Generator, frames: int, halves: bool) -> tuple[np.ndarray, np.ndarray]:
    """Raw counts (T, 12, 32) and the baseline that the host took."""
    baseline = rng.integers(10, 40, SHAPE).astype(float) + (0.5 * rng.integers(0, 2, SHAPE) if halves else 0)
    raw = np.stack([np.floor(baseline) + press(rng, peak) for peak in rng.uniform(0, 180, frames)])
    return raw.clip(0, 255), baseline


@pytest.mark.parametrize("halves", [False, True])
def test_counts_come_back_where_the_host_kept_them(halves: bool) -> None:
    rng = np.random.default_rng(3)
    raw, baseline = recording(rng, 150, halves)
    frames = np.stack([host_frame(frame, baseline) for frame in raw])
    found = recover_counts(frames, HostRule(THRESHOLD, SCALE, baseline))
    above = raw - baseline - THRESHOLD
    kept = (above > 0) & (above < 100)
    wrong = [bool((found.counts[i][kept[i]] != raw[i][kept[i]]).any()) for i in range(len(raw))]
    assert set(np.flatnonzero(wrong)) <= set(found.ambiguous)  # all others are exact
    assert len(found.ambiguous) < 20  # a contact of few taxels may fit several scales
    untouched = above <= 0
    np.testing.assert_array_equal(found.counts[untouched], np.rint(np.tile(baseline, (150, 1, 1))[untouched]))


def test_frames_that_are_wrong_are_among_those_listed() -> None:
    """Contacts of one or two taxels, the worst case: wrong ones are found nowhere but in the list."""
    rng = np.random.default_rng(11)
    baseline = rng.integers(10, 40, SHAPE).astype(float)
    raw = np.stack([baseline + press(rng, peak, width=0.6) for peak in rng.uniform(0, 180, 300)]).clip(0, 255)
    frames = np.stack([host_frame(frame, baseline) for frame in raw])
    found = recover_counts(frames, HostRule(THRESHOLD, SCALE, baseline))
    kept = (raw - baseline - THRESHOLD > 0) & (raw - baseline - THRESHOLD < 100)
    wrong = [i for i in range(len(raw)) if (found.counts[i][kept[i]] != raw[i][kept[i]]).any()]
    assert wrong
    assert set(wrong) <= set(found.ambiguous)
    assert len(found.ambiguous) < 150
    weaker = [found.counts[i].astype(int).max() <= raw[i].max() for i in found.ambiguous]
    assert all(weaker)


def test_the_host_software_itself_follows_the_rule() -> None:
    flexitac = pytest.importorskip("flexitac", reason="needs the PyPI package flexitac")
    rng = np.random.default_rng(12)
    raw, baseline = recording(rng, 60, halves=True)
    host = flexitac.FlexiTacSensor("none", rows=12, cols=32, threshold=THRESHOLD, noise_scale=SCALE)
    host._baseline = baseline.astype(np.float32)
    theirs = np.stack([host._normalize(frame.astype(np.uint8)) for frame in raw])
    ours = np.stack([host_frame(frame, baseline) for frame in raw])
    np.testing.assert_allclose(theirs, ours, atol=1e-6)
    rule = HostRule(THRESHOLD, SCALE, baseline)
    np.testing.assert_array_equal(recover_counts(theirs, rule).counts, recover_counts(ours, rule).counts)


def test_readings_of_another_rule_are_refused() -> None:
    rng = np.random.default_rng(4)
    raw, baseline = recording(rng, 4, halves=False)
    frames = np.stack([host_frame(frame, baseline) for frame in raw])
    frames[2] = rng.uniform(0, 1, SHAPE)
    with pytest.raises(UnknownRuleError, match="frame 2 does not follow threshold 25 and scale 30"):
        recover_counts(frames, HostRule(THRESHOLD, SCALE, baseline))


def write_source(root: Path, frames_of: dict[str, np.ndarray], sensors: dict[str, Any] | None) -> np.ndarray:
    """A dataset as LeFlexiTac's recorder leaves it: two episodes, camera, 6 joints; returns the states."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = [f"joint_{i}.pos" for i in range(6)]
    features: dict[str, dict[str, Any]] = {
        key: {"dtype": "float32", "shape": (6,), "names": names} for key in ("observation.state", "action")
    }
    for name in frames_of:
        feature = {"dtype": "float32", "shape": SHAPE, "names": ["height", "width"]}
        features[f"observation.tactile.{name}".rstrip(".")] = feature
    camera = "observation.images.wrist"
    features[camera] = {"dtype": "image", "shape": (16, 24, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create("local/le", 10, features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    length = len(next(iter(frames_of.values())))
    states = rng.normal(0, 1, (length, 6)).astype(np.float32)
    for i in range(length):
        pads = {f"observation.tactile.{name}".rstrip("."): frames[i] for name, frames in frames_of.items()}
        picture = rng.integers(0, 255, (16, 24, 3), dtype=np.uint8)
        joints = {"observation.state": states[i], "action": states[i] + 1}
        dataset.add_frame({**joints, **pads, camera: picture, "task": "peg"})
        if i in (length // 3, length - 1):
            dataset.save_episode()
    dataset.finalize()
    if sensors is not None:
        path = root / "meta" / "info.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "tactile_sensors": sensors}))
    return states


def sensor(baseline: np.ndarray) -> dict[str, Any]:
    known = {"port": "/dev/ttyUSB0", "threshold": THRESHOLD, "noise_scale": SCALE, "is_calibrated": True}
    return {**known, "baseline": baseline.tolist()}


def column(dataset: Any, key: str) -> np.ndarray:
    return np.stack([np.asarray(dataset[i][key]) for i in range(len(dataset))])


def test_normalised_dataset(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    rng = np.random.default_rng(5)
    raw, baseline = recording(rng, 9, halves=False)
    frames = np.stack([host_frame(frame, baseline) for frame in raw])
    source, root = tmp_path / "le", tmp_path / "ours"
    states = write_source(
        source,
        {"primary": frames, "second": frames},
        {"primary": sensor(baseline)} | {"second": sensor(baseline)},
    )
    assert is_leflexitac(source)
    line = import_dataset(ImportConfig(source, root, pads={"primary": "left_arm_left_finger"}))
    assert "2 episodes, 9 frames" in line
    assert "recovered for left_arm_left_finger, second" in line

    ours, theirs = LeRobotDataset("local/x", root=root), LeRobotDataset("local/le", root=source)
    key = "observation.tactile.left_arm_left_finger"
    feature = ours.meta.features[key]
    assert (feature["dtype"], tuple(feature["shape"])) == ("uint8", (384,))
    assert feature["info"] == {"array_shape": [12, 32], "unit": "adc_counts"}
    expected = recover_counts(frames, HostRule(THRESHOLD, SCALE, baseline)).counts.reshape(9, 384)
    np.testing.assert_array_equal(column(ours, key), expected)
    idle = column(ours, "observation.tactile_baseline.second")
    np.testing.assert_array_equal(idle, np.tile(baseline.reshape(384), (9, 1)))
    np.testing.assert_array_equal(column(ours, "observation.state"), states)
    for same in ("observation.images.wrist", "action", "episode_index", "timestamp"):
        np.testing.assert_array_equal(column(ours, same), column(theirs, same))
    assert "observation.tactile.primary" not in ours.meta.features
    assert not {"observation.tactile.primary"} & set(ours.meta.stats)
    np.testing.assert_array_equal(ours.meta.stats[key]["max"], expected.max(axis=0))
    assert "tactile_sensors" in json.loads((root / "meta" / "import.json").read_text())


def test_the_result_can_be_edited_and_appended_to(tmp_path: Path) -> None:
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    rng = np.random.default_rng(6)
    counts = rng.integers(0, 90, (9, *SHAPE)).astype(np.float32)
    source, root = tmp_path / "le", tmp_path / "ours"
    write_source(source, {"primary": counts}, None)
    import_dataset(ImportConfig(source, root))
    dataset = LeRobotDataset("local/x", root=root)
    rest = delete_episodes(dataset, [0], output_dir=tmp_path / "rest", repo_id="local/rest")
    merged = merge_datasets([dataset, rest], output_repo_id="local/both", output_dir=tmp_path / "both")
    assert (rest.num_episodes, merged.num_episodes) == (1, 3)
    np.testing.assert_array_equal(
        column(merged, "observation.tactile.primary")[-5:], counts.reshape(9, 384)[-5:]
    )


def test_counts_without_their_idle_level(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    counts = np.random.default_rng(7).integers(0, 90, (6, *SHAPE)).astype(np.float32)
    write_source(tmp_path / "le", {"primary": counts}, None)
    line = import_dataset(ImportConfig(tmp_path / "le", tmp_path / "ours"))
    assert "primary: counts above an idle level that was not kept" in line
    ours = LeRobotDataset("local/x", root=tmp_path / "ours")
    np.testing.assert_array_equal(column(ours, "observation.tactile.primary"), counts.reshape(6, 384))
    assert not column(ours, "observation.tactile_baseline.primary").any()


def test_a_normalised_pad_that_was_never_calibrated_has_no_idle_level(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    raw, baseline = recording(np.random.default_rng(13), 8, halves=False)
    frames = np.stack([host_frame(frame, baseline) for frame in raw])
    unknown = sensor(baseline) | {"baseline": None, "is_calibrated": False}
    write_source(tmp_path / "le", {"primary": frames}, {"primary": unknown})
    line = import_dataset(ImportConfig(tmp_path / "le", tmp_path / "ours"))
    assert "primary: counts above an idle level that was not kept" in line
    ours = LeRobotDataset("local/x", root=tmp_path / "ours")
    assert not column(ours, "observation.tactile_baseline.primary").any()
    above = (raw - baseline).reshape(8, 384)
    certain = [i for i in range(8) if i not in recover_counts(frames, HostRule(25, 30, baseline)).ambiguous]
    kept = (above > THRESHOLD) & (above < THRESHOLD + 100)
    counts = column(ours, "observation.tactile.primary")
    assert (counts[certain][kept[certain]] == above[certain][kept[certain]]).all()


def test_a_single_pad_without_a_name(tmp_path: Path) -> None:
    """Earlier versions called a robot's only pad `observation.tactile`."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    counts = np.random.default_rng(14).integers(0, 90, (6, *SHAPE)).astype(np.float32)
    source, root = tmp_path / "le", tmp_path / "ours"
    write_source(source, {"": counts}, None)
    assert is_leflexitac(source)
    import_dataset(ImportConfig(source, root, pads={"primary": "thumb"}))
    ours = LeRobotDataset("local/x", root=root)
    np.testing.assert_array_equal(column(ours, "observation.tactile.thumb"), counts.reshape(6, 384))
    assert "observation.tactile" not in ours.meta.features


def test_wrong_sources_are_refused(tmp_path: Path) -> None:
    frames = np.random.default_rng(8).uniform(0, 1, (4, *SHAPE)).astype(np.float32)
    source = tmp_path / "le"
    write_source(source, {"primary": frames}, None)
    with pytest.raises(ValueError, match=r"observation\.tactile\.primary: frame 0 does not follow"):
        import_dataset(ImportConfig(source, tmp_path / "ours"))
    assert not (tmp_path / "ours").exists()
    with pytest.raises(ValueError, match=r"--pads names 'thumb', but .* has the pads primary"):
        import_dataset(ImportConfig(source, tmp_path / "ours", pads={"thumb": "x"}))
    info = source / "meta" / "info.json"
    info.write_text(info.read_text().replace('"v3.0"', '"v2.1"'))
    with pytest.raises(ValueError, match=r"version v2\.1 is not v3\.0; convert it first"):
        import_dataset(ImportConfig(source, tmp_path / "ours"))


def test_damaged_sources_are_refused_in_one_line(tmp_path: Path) -> None:
    counts = np.random.default_rng(9).integers(0, 90, (6, *SHAPE)).astype(np.float32)
    source, out = tmp_path / "le", tmp_path / "ours"
    write_source(source, {"primary": counts}, None)
    info = source / "meta" / "info.json"
    sound = info.read_text()

    def refuse(message: str) -> None:
        with pytest.raises(ValueError, match=message) as refused:
            import_dataset(ImportConfig(source, out))
        assert "\n" not in str(refused.value)
        assert not out.exists()

    info.write_text(sound.replace('"total_frames"', '"frames"'))
    refuse("lacks 'total_frames'")
    info.write_text(sound.replace("[12, 32]", "[16, 32]").replace("12,", "16,"))
    refuse(r"frames are not of shape \(16, 32\)")
    info.write_text("{")
    with pytest.raises(ValueError, match="no format that can be imported"):
        import_dataset(ImportConfig(source, out))
    info.write_text(sound)
    data = next((source / "data").rglob("*.parquet"))
    whole = data.read_bytes()
    data.write_bytes(whole[: len(whole) // 2])
    refuse(f"{data.name} cannot be read")
    for path in (source / "data").rglob("*.parquet"):  # one an episode, where recording safely is on
        path.unlink()
    refuse("no data files")
