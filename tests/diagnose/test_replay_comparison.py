"""Numbers of a replay: tracking, lags, touch distributions, and the page made of them."""

from pathlib import Path

import numpy as np
import pytest
from aloha_columns import PADS

from lerobot_vtrefine.datasets.episodes import RecordedEpisode
from lerobot_vtrefine.diagnose.episode_replay.compare import Comparison, EpisodePair
from lerobot_vtrefine.diagnose.episode_replay.page import render_page
from lerobot_vtrefine.diagnose.episode_replay.touch import compare_pad, pressed, readings, telling_frames
from lerobot_vtrefine.diagnose.episode_replay.tracking import joint_tracking, lag_s

DT = 0.1
IDLE = np.full(384, 20, np.uint8)


def motion(frames: int, phase: float) -> np.ndarray:
    return 0.3 * np.sin(np.arange(frames) * DT * 1.7 + phase)


def delayed(values: np.ndarray, delay_s: float) -> np.ndarray:
    time = np.arange(len(values)) * DT
    return np.interp(time - delay_s, time, values)


def test_lag_is_found_and_absent_without_motion() -> None:
    commands = [motion(80, 0.0), motion(60, 1.0)]
    found = lag_s(commands, [delayed(item, 0.17) + 0.02 for item in commands], DT)
    assert found == pytest.approx(0.17, abs=0.011)
    assert lag_s([np.zeros(20)], [np.zeros(20)], DT) is None
    noise = np.random.default_rng(0).normal(0, 1, 50)
    assert lag_s([1e-3 * motion(50, 0.0)], [noise], DT) is None


def test_tracking_numbers() -> None:
    command = [np.stack([motion(50, phase), motion(50, 2 * phase)], 1) for phase in (0.1, 0.8, 1.9)]
    recorded = [item + np.array([0.03, 0.0]) for item in command]
    twin = [item + np.array([0.01, 0.0]) for item in command]
    first, second = joint_tracking(["left_waist", "left_left_finger"], command, recorded, twin, DT)
    assert first.rmse == pytest.approx(0.02)
    assert first.bias == pytest.approx(-0.02)
    assert first.command_rmse == pytest.approx(0.03)
    assert first.explained == pytest.approx(1 - (0.02 / 0.03) ** 2)
    assert first.rmse_ci95 == pytest.approx((0.02, 0.02))
    assert second.explained is None  # the recording is exactly its command
    assert joint_tracking(["a", "b"], command[:1], recorded[:1], twin[:1], DT)[0].rmse_ci95 is None


def pad_frames(rng: np.random.Generator, frames: int, strength: float) -> np.ndarray:
    """Raw counts (T, 384) of a round contact that comes and goes."""
    r, c = np.mgrid[:12, :32]
    shape = np.exp(-((r - 5) ** 2 + (c - 9) ** 2) / 8.0).ravel()
    force = strength * np.clip(np.sin(np.arange(frames) / frames * 2 * np.pi), 0, 1)
    return (IDLE + force[:, None] * shape + rng.uniform(0, 1.5, (frames, 384))).clip(0, 255).astype(np.uint8)


def test_equal_pads_overlap_completely_and_others_less() -> None:
    rng = np.random.default_rng(0)
    recorded = pad_frames(rng, 40, 120.0)
    same = compare_pad("pad", recorded, recorded, (IDLE, IDLE))
    assert (same.identical_frames, same.largest_difference) == (40, 0)
    assert same.overlap == pytest.approx(1.0)
    assert same.reading_distance == same.count_distance == 0.0
    assert same.total_ratio == same.total_correlation == pytest.approx(1.0)

    half = compare_pad("pad", recorded, pad_frames(rng, 40, 60.0), (IDLE, IDLE))
    assert half.total_ratio == pytest.approx(0.5, abs=0.06)
    assert half.count_distance is not None
    assert half.count_distance > 5.0
    assert half.overlap is not None
    assert half.overlap < 0.999
    assert half.total_correlation is not None
    assert half.total_correlation > 0.99


def test_an_untouched_side_has_no_distances() -> None:
    rng = np.random.default_rng(1)
    still = np.tile(IDLE, (10, 1))
    row = compare_pad("pad", pad_frames(rng, 10, 100.0), still, (IDLE, IDLE))
    assert (row.overlap, row.reading_distance, row.count_distance) == (None, None, None)
    assert row.touched[1] == 0.0
    assert row.total_correlation is None


def test_readings_follow_the_two_stage_rule() -> None:
    above = np.zeros((2, 384), np.float32)
    above[0, :2], above[1, :2] = [6.0, 3.0], [80.0, 40.0]
    values = readings(above)
    np.testing.assert_allclose(values[0, :2], [6 / 60, 3 / 60])
    np.testing.assert_allclose(values[1, :2], [1.0, 0.5])
    assert pressed(np.array([[30, 20]]), np.array([20, 20])).tolist() == [[8.0, 0.0]]


def test_frames_to_show() -> None:
    above = np.zeros((30, 4))
    above[10:20] = 1.0
    above[14] = 9.0
    chosen = telling_frames(above, 4)
    assert 14 in chosen
    assert len(chosen) <= 4
    assert all(10 <= moment < 20 for moment in chosen)
    assert telling_frames(np.zeros((5, 4)), 4) == []


def pair(index: int, with_touch: bool) -> EpisodePair:
    rng = np.random.default_rng(index)
    state = rng.normal(0, 0.1, (30, 16)).cumsum(0) / 10
    counts = {pad: pad_frames(rng, 30, 90.0) for pad in PADS} if with_touch else {}
    idle = dict.fromkeys(counts, IDLE)
    episode = RecordedEpisode(index, np.arange(30) * DT, state, state + 0.01, counts, idle)
    return EpisodePair(episode, state + 0.002, counts, idle, True if with_touch else None)


@pytest.mark.parametrize("with_touch", [True, False])
def test_page_is_whole_and_names_what_it_shows(with_touch: bool) -> None:
    from lerobot_vtrefine.diagnose.episode_replay.compare import _compare_touch

    pairs = [pair(0, with_touch), pair(4, with_touch)]
    names = [f"joint_{j}" for j in range(15)] + ["left_finger"]
    states = [item.recorded.state for item in pairs]
    tracking = joint_tracking(
        names, [item.recorded.action for item in pairs], states, [item.position for item in pairs], DT
    )
    touch = _compare_touch(pairs)
    comparison = Comparison(
        Path("data/demo"),
        10.0,
        "recorded" if with_touch else "none",
        "aloha <b>",
        tracking,
        touch,
        pairs,
        {7: "why"},
        [],
        ["The left hand hangs above the part <b>"],
    )
    page = render_page(comparison)
    assert "The left hand hangs above the part &lt;b&gt;" in page
    assert "aloha &lt;b&gt;" in page
    assert "Episode 7 was left out: why" in page
    moments = page.count("<h2>At ")
    assert 3 <= moments <= 4 if with_touch else moments == 0
    films_and_moments = 4 + moments
    assert page.count('class="scale"') == (films_and_moments if with_touch else 0)
    assert page.count("data:image/png") == (films_and_moments + 8 * moments if with_touch else 0)
    assert page.count("<svg") == 2 + 2 * 16 + (12 if with_touch else 0)  # errors, traces, touch
    assert "nan" not in page
    assert ("right arm right finger" in page) == with_touch
    assert ("Not compared: the twin replayed the arms alone" in page) != with_touch
    assert "http" not in page.replace("http-equiv", "")
    summary = comparison.summary()
    assert summary["episodes"] == [0, 4]
    assert len(summary["touch"]) == (4 if with_touch else 0)
