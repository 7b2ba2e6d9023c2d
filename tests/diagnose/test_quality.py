"""Quality control finds every kind of broken file, says what it did, and leaves sound sets alone."""

import numpy as np
import pytest
from pad_sets import make_robot_set, make_set, write_set

from lerobot_vtrefine.diagnose.quality import check_quality, too_little
from lerobot_vtrefine.diagnose.recordings import read_recording_set

BAD = 3
FILE = f"trial_{BAD:04d}.parquet"


def checked(tmp_path, header, columns):
    recordings = read_recording_set(write_set(tmp_path / "set", header, columns))
    left, issues = check_quality(recordings)
    return recordings, left, issues


def with_fault(fault, **options):
    header, columns = make_set(**options)
    columns[BAD] = fault({name: values.copy() for name, values in columns[BAD].items()})
    return header, columns


def frames(trial, selection):
    return {name: values[selection] for name, values in trial.items()}


def shuffled(trial, change):
    return trial | {"raw": change(trial["raw"].reshape(-1, 6, 8)).reshape(len(trial["raw"]), -1)}


def swap_rows(raw):
    order = np.arange(6)
    order[[1, 4]] = order[[4, 1]]
    return raw[:, order]


def starts_loaded(trial):
    return frames(trial, slice(45, None)) | {"time_s": trial["time_s"][: len(trial["time_s"]) - 45]}


def loaded_but_tared(trial):
    """Contact from the start that the depth does not know of: readings begin high and fall."""
    raw = trial["raw"].copy()
    raw[:40, 20] += np.linspace(120, 0, 40)
    return trial | {"raw": raw}


def clock_back(trial):
    time = trial["time_s"].copy()
    time[80:] -= 0.7
    return trial | {"time_s": time}


def clock_forward(trial):
    time = trial["time_s"].copy()
    time[80:] += 3.0
    return trial | {"time_s": time}


def many_nan(trial):
    raw = trial["raw"].copy()
    raw[::4, 7] = np.nan
    return trial | {"raw": raw}


def dead_line(trial):
    raw = trial["raw"].reshape(-1, 6, 8).copy()
    pressed = np.unravel_index(np.ptp(raw, axis=0).argmax(), (6, 8))[0]
    raw[:, pressed] = raw[0, pressed]
    return trial | {"raw": raw.reshape(len(raw), -1)}


def saturated(trial):
    raw = trial["raw"].copy()
    raw[:, 11] = 255.0
    return trial | {"raw": raw}


def stalled(trial):
    raw = trial["raw"].copy()
    raw[20:90] = raw[20]
    return trial | {"raw": raw}


SET_ASIDE = {
    "starts loaded by depth": (starts_loaded, "starts loaded"),
    "starts loaded by readings": (loaded_but_tared, "starts loaded"),
    "clock back": (clock_back, "clock step"),
    "clock forward": (clock_forward, "clock step"),
    "many NaN": (many_nan, "taxel (0, 7)"),
    "rows swapped": (lambda t: shuffled(t, swap_rows), "rows 1 and 4 swapped"),
    "rows mirrored": (lambda t: shuffled(t, lambda raw: raw[:, ::-1]), "rows mirrored"),
    "columns mirrored": (lambda t: shuffled(t, lambda raw: raw[:, :, ::-1]), "columns mirrored"),
    "turned by half": (
        lambda t: shuffled(t, lambda raw: raw[:, ::-1, ::-1]),
        "rows mirrored and columns mirrored",
    ),
    "columns permuted": (
        lambda t: shuffled(t, lambda raw: raw[:, :, [3, 1, 0, 7, 5, 4, 6, 2]]),
        "columns permuted",
    ),
    "dead row": (dead_line, "dead in this trial only"),
    "no answer": (lambda t: t | {"raw": np.repeat(t["raw"][:1], len(t["raw"]), axis=0)}, "answer|stalled"),
    "stuck at full scale": (saturated, "saturated: taxel (1, 3)"),
    "stalled reader": (stalled, "stalled"),
    "too short": (lambda t: frames(t, slice(7)), "too short"),
    "normalised": (lambda t: t | {"raw": t["raw"] / 255.0}, "normalised"),
    "beyond full scale": (lambda t: t | {"raw": t["raw"] * 16.0}, "full_scale"),
    "idle removed": (lambda t: t | {"raw": t["raw"] - t["raw"].mean(axis=0)}, "idle level has been removed"),
}


@pytest.mark.parametrize("name", SET_ASIDE)
def test_a_broken_trial_is_set_aside_with_the_reason(tmp_path, name):
    fault, words = SET_ASIDE[name]
    _, left, issues = checked(tmp_path, *with_fault(fault))

    assert {issue.trial for issue in issues} == {FILE}, issues
    assert any(word in issue.problem for issue in issues for word in words.split("|")), issues
    assert issues[-1].action == "set aside"
    assert FILE not in [trial.file for trial in left.trials]
    assert len(left.trials) == 7


def some_nan(trial):
    depth, raw = trial["depth_m"].copy(), trial["raw"].copy()
    depth[60], raw[90, 5] = np.nan, np.inf
    return trial | {"depth_m": depth, "raw": raw}


def with_holes(trial):
    """A thermometer that is read every second frame, and a load cell that failed once."""
    force = trial["force_n"].copy()
    force[3] = np.nan
    return trial | {"force_n": force, "temperature_c": np.where(np.arange(150) % 2, np.nan, 25.0)}


REPAIRED = {
    "duplicated frames": (lambda t: frames(t, np.sort(np.r_[np.arange(150), [20, 20, 77]])), "3 duplicated"),
    "duplicated block": (lambda t: frames(t, np.r_[np.arange(100), np.arange(90, 150)]), "10 duplicated"),
    "few NaN": (some_nan, "2 frames of 150 without a number in depth_m and raw (taxel (0, 5))"),
    "holes in optional columns": (with_holes, "75 frames without a number in force_n and temperature_c"),
    "force in grams": (lambda t: t | {"force_n": t["force_n"] * 101.97}, "grams"),
    "depth in mm": (lambda t: t | {"depth_m": t["depth_m"] * 1e3}, "millimetres"),
    "x in mm": (lambda t: t | {"x_m": t["x_m"] * 1e3}, "x_m reaches"),
    "time in ms": (lambda t: t | {"time_s": t["time_s"] * 1e3}, "milliseconds"),
}


@pytest.mark.parametrize("name", REPAIRED)
def test_what_can_be_repaired_is_and_says_so(tmp_path, name):
    fault, words = REPAIRED[name]
    _, left, issues = checked(tmp_path, *with_fault(fault))
    sound = read_recording_set(write_set(tmp_path / "sound", *make_set())).trials[BAD]

    assert [issue.trial for issue in issues] == [FILE]
    assert words in issues[0].problem
    assert issues[0].action.startswith("repaired: ")
    repaired = next(trial for trial in left.trials if trial.file == FILE)
    at = np.isin(np.round(sound.time_s, 6), np.round(repaired.time_s, 6))
    assert at.sum() == len(repaired.time_s) >= 148
    for column in ("time_s", "x_m", "depth_m", "raw"):
        np.testing.assert_allclose(getattr(repaired, column), getattr(sound, column)[at], rtol=1e-12)
    np.testing.assert_allclose(repaired.force_n, sound.force_n[at], rtol=1e-4, atol=0.05)


def test_lost_frames_are_counted_and_kept(tmp_path):
    gone = np.setdiff1d(np.arange(150), [40, 41, 90])
    _, left, issues = checked(tmp_path, *with_fault(lambda trial: frames(trial, gone)))
    assert [(issue.trial, issue.problem[:31]) for issue in issues] == [
        (FILE, "3 missing frames of 150: the lo")
    ]
    assert issues[0].action.startswith("kept")
    assert len(left.trials) == 8


def test_a_copied_trial_is_set_aside(tmp_path):
    header, columns = make_set()
    columns[5] = columns[2]
    _, left, issues = checked(tmp_path, header, columns)
    assert [(issue.trial, issue.problem) for issue in issues] == [
        ("trial_0005.parquet", "is a copy of trial_0002.parquet")
    ]
    assert len(left.trials) == 7


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"drift_per_trial": 2.5},
        {"spread": 0.4},
        {"idle_spread": 0.0},
        {"rows": 12, "cols": 32, "trials": 6},
    ],
    ids=str,
)
def test_sound_sets_are_left_alone(tmp_path, seed, options):
    recordings, left, issues = checked(tmp_path, *make_set(seed, **options))
    assert issues == []
    assert left.trials == recordings.trials
    assert too_little(left, recordings) is None


def test_dead_taxels_of_the_whole_set_are_a_cause_and_no_data_issue(tmp_path):
    header, columns = make_set()
    for trial in columns:
        trial["raw"][:, [9, 10, 30]] = 20.0
    _, left, issues = checked(tmp_path, header, columns)
    assert issues == []
    assert len(left.trials) == 8


def test_jitter_of_the_clock_and_sample_and_hold_are_no_data_issues(tmp_path):
    header, columns = make_set()
    rng = np.random.default_rng(1)
    for trial in columns:
        trial["time_s"] = np.sort(trial["time_s"] + rng.normal(0, 0.004, 150))
        trial["raw"] = trial["raw"][np.arange(150) // 4 * 4]
    _, _, issues = checked(tmp_path, header, columns)
    assert issues == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda raw: raw[:, ::-1], "rows mirrored"),
        (lambda raw: raw[:, :, ::-1], "columns mirrored"),
        (lambda raw: raw[:, ::-1, ::-1], "rows mirrored and columns mirrored"),
        (swap_rows, "rows 1 and 4 swapped"),
    ],
)
def test_wiring_that_is_wrong_in_every_trial_is_reported_once(tmp_path, change, words):
    header, columns = make_set()
    _, left, issues = checked(tmp_path, header, [shuffled(trial, change) for trial in columns])
    assert [issue.trial for issue in issues] == [None]
    assert words in issues[0].problem
    assert len(left.trials) == 8


def test_swapped_rows_are_seen_without_idle_differences(tmp_path):
    """With one idle level for all taxels only the footprint can tell; a press far from both rows cannot."""
    found = 0
    for seed in range(6):
        header, columns = with_fault(lambda t: shuffled(t, swap_rows), seed=seed, idle_spread=0.0)
        _, _, issues = checked(tmp_path / str(seed), header, columns)
        assert {issue.trial for issue in issues} <= {FILE}
        found += bool(issues)
    assert found >= 4


def test_when_all_trials_start_loaded_none_is_set_aside(tmp_path):
    header, columns = make_set()
    _, left, issues = checked(tmp_path, header, [starts_loaded(trial) for trial in columns])
    assert [issue.trial for issue in issues] == [None]
    assert "start in contact" in issues[0].problem
    assert len(left.trials) == 8


def test_too_little_left_is_no_basis(tmp_path):
    header, columns = make_set(trials=8)
    recordings, left, issues = checked(tmp_path, header, [many_nan(t) for t in columns[:5]] + columns[5:])
    assert len(issues) == 5
    assert "3 sound trials of 8" in too_little(left, recordings).problem


def test_single_taxel_driven_by_force(tmp_path):
    header, columns = make_set(rows=1, cols=1)
    for trial in columns:
        trial["x_m"][:] = trial["y_m"][:] = 0.0
        level = np.maximum(trial.pop("depth_m"), 0) * 2e4
        trial["force_n"] = level + np.random.default_rng(0).normal(0, 0.05, len(level))
        trial["raw"] = 20.0 + 8.0 * level[:, None] + np.random.default_rng(1).normal(0, 0.5, (len(level), 1))
    columns[BAD] = starts_loaded(columns[BAD])
    _, left, issues = checked(tmp_path, header, columns)
    assert [(issue.trial, issue.action) for issue in issues] == [(FILE, "set aside")]
    assert "starts loaded" in issues[0].problem
    assert len(left.trials) == 7


def with_values(name, where, value):
    def change(trial):
        trial[name][where] = value
        return trial

    return change


def turned_after(trial, frame):
    """A lost turn of the first joint."""
    return 2 * np.pi * (np.arange(len(trial["time_s"])) >= frame)[:, None] * [1, 0, 0]


def test_sound_robot_set_is_left_alone(tmp_path):
    recordings, left, issues = checked(tmp_path, *make_robot_set())
    assert issues == []
    assert left.trials == recordings.trials


def test_joints_that_hold_still_are_not_told_as_swapped(tmp_path):
    """As the arm that holds the socket in an insertion: load moves it, by as much as its commands."""
    header, columns = make_robot_set()
    held = columns[BAD]["command"][:, :2] * 5e-3
    columns[BAD]["command"][:, :2] = held
    columns[BAD]["position"][:, :2] = held[:, ::-1]
    assert checked(tmp_path, header, columns)[2] == []


@pytest.mark.parametrize(
    ("change", "words", "action"),
    [
        (lambda t: t | {"position": np.degrees(t["position"] + 1.0)}, "degrees", "repaired"),
        (lambda t: t | {"position": t["position"][:, [1, 0, 2]]}, "waist and shoulder", "set aside"),
        (
            lambda t: t | {"position": t["position"] * [1, 1, 0]},
            "position stays constant: elbow",
            "set aside",
        ),
        (lambda t: frames(t, np.r_[np.arange(200), 50:60]), "10 duplicated frames", "repaired"),
        (clock_back, "clock step", "set aside"),
        (with_values("command", slice(40, 44), np.nan), "without a number in command", "repaired"),
        (with_values("command", slice(20, 150), np.inf), "without a number in command", "set aside"),
        (with_values("position", slice(0, 1), np.nan), "without a number in position", "repaired"),
        (lambda t: frames(t, np.r_[0:60, 110:200]), "missing frames", "set aside"),
        (with_values("position", (slice(60, 62), 0), 10.0), "which no known unit explains", "set aside"),
        (with_values("position", (slice(60, 62), 0), 3.0), "position jumps by", "set aside"),
        (lambda t: t | {"position": t["position"] + turned_after(t, 100)}, "jumps by 6.", "set aside"),
        (with_values("command", (slice(None), 1), 0.3), "command stays constant", "set aside"),
    ],
)
def test_broken_robot_trials(tmp_path, change, words, action):
    header, columns = make_robot_set()
    columns[BAD] = change({name: values.copy() for name, values in columns[BAD].items()})
    _, _, issues = checked(tmp_path, header, columns)
    assert [issue.trial for issue in issues] == [FILE]
    assert words in issues[0].problem
    assert issues[0].action.startswith(action)


@pytest.mark.parametrize("column", ["position", "command"])
def test_one_joint_in_degrees_leaves_the_others_alone(tmp_path, column):
    """All were divided: three sound joints had a fault that was not there."""
    header, columns = make_robot_set()
    sound = [trial[column].copy() for trial in columns]
    for trial in columns:
        trial[column] = trial[column] * [1, 1, np.degrees(1.0)]
    _, left, issues = checked(tmp_path, header, columns)
    assert len(issues) == len(columns)
    assert issues[0].problem.startswith(f"{column} of elbow reaches ")
    for trial, wanted in zip(left.trials, sound, strict=True):
        np.testing.assert_allclose(getattr(trial, column), wanted, atol=1e-12)


def test_an_encoder_in_large_steps_is_told(tmp_path):
    """Errors of half a step hid behind "adequate"."""
    header, columns = make_robot_set()
    for trial in columns:
        trial["position"][:, 1] = 0.03 * np.round(trial["position"][:, 1] / 0.03)
        trial["position"][:, 2] = 0.0015 * np.round(trial["position"][:, 2] / 0.0015)  # as usual
    _, left, issues = checked(tmp_path, header, columns)
    (issue,) = issues
    assert (issue.trial, issue.problem) == (None, "position of shoulder comes in steps of 0.03")
    assert issue.action == "kept: half a step is not judged"
    assert len(left.trials) == len(columns)
