"""Faults of a rig that all its trials share, or that only the whole set betrays, are said and mended."""

import numpy as np
import pytest
from pad_sets import RADIUS, make_robot_set, make_set, write_set

from lerobot_vtrefine.diagnose.quality import check_quality, in_si_units, too_little
from lerobot_vtrefine.diagnose.recordings import read_recording_set

BAD = 3
FILE = f"trial_{BAD:04d}.parquet"


def checked(tmp_path, header, columns):
    recordings = read_recording_set(write_set(tmp_path / "set", header, columns))
    return check_quality(recordings)


def everywhere(change):
    """Of all trials."""
    return lambda header, columns: (header, [trial | change(trial) for trial in columns])


def in_one(change):
    def apply(header, columns):
        columns[BAD] = columns[BAD] | change(columns[BAD])
        return header, columns

    return apply


def headed(**changes):
    return lambda header, columns: (header | changes, columns)


def labelled(change):
    """Entries of the trials in the header, by number."""

    def apply(header, columns):
        entries = [entry | change(k) for k, entry in enumerate(header["trials"])]
        return header | {"trials": entries}, columns

    return apply


def scaled(name, factor):
    return lambda trial: {name: trial[name] * factor}


def own_maximum(trial):
    return {"raw": trial["raw"] / trial["raw"].max(axis=1, keepdims=True)}


def spiked(trial):
    depth = trial["depth_m"].copy()
    depth[50] = 0.02
    return {"depth_m": depth}


REPAIRED = {
    "readings of 0 to 1": (everywhere(scaled("raw", 1 / 255)), "raw reaches only", {"full_scale": 1.0}),
    "readings in volts": (everywhere(scaled("raw", 3.3 / 255)), "raw reaches only", {"full_scale": 3.3}),
    "readings of 12 bits": (everywhere(scaled("raw", 16)), "above full_scale", {"full_scale": 4095.0}),
    "pitch in mm": (headed(pad={"rows": 6, "cols": 8, "pitch_m": 2.0}), "pitch_m is 2", {"pitch_m": 0.002}),
}


@pytest.mark.parametrize("name", REPAIRED)
def test_scales_that_a_whole_set_has_wrong_are_mended_once(tmp_path, name):
    fault, words, setting = REPAIRED[name]
    left, issues = checked(tmp_path, *fault(*make_set()))

    assert [(issue.trial, words in issue.problem) for issue in issues] == [(None, True)], issues
    assert issues[0].action.startswith("repaired: ")
    assert {field: getattr(left, field) for field in setting} == pytest.approx(setting)
    assert len(left.trials) == 8


def test_negative_readings_are_raised_and_it_is_said_of_each_trial(tmp_path):
    _, columns = make_set()
    left, issues = checked(tmp_path, *everywhere(lambda t: {"raw": t["raw"] - 300})(*make_set()))
    assert len(issues) == 8
    assert all("raised by" in issue.action for issue in issues)
    shift = np.array(
        [trial.raw - recorded["raw"] for trial, recorded in zip(left.trials, columns, strict=True)]
    )
    assert np.ptp(shift) == 0
    assert min(trial.raw.min() for trial in left.trials) < 20
    assert np.median([trial.raw.min() for trial in left.trials]) == 0


def test_signed_bytes_are_put_together_again(tmp_path):
    header, columns = make_set()
    sound = [trial["raw"].copy() for trial in columns]
    columns = [
        trial | {"raw": np.where(trial["raw"] > 127, trial["raw"] - 256, trial["raw"])} for trial in columns
    ]
    left, issues = checked(tmp_path, header, columns)
    assert all("signed" in issue.problem for issue in issues)
    assert len(issues) == 8
    for trial, raw in zip(left.trials, sound, strict=True):
        np.testing.assert_array_equal(trial.raw, raw)


NO_VERDICT = {
    "frames scaled to their own maximum": (everywhere(own_maximum), "own largest reading"),
    "the same in bytes": (
        everywhere(lambda t: {"raw": np.round(255 * own_maximum(t)["raw"])}),
        "own largest",
    ),
    "readings that fall under load": (everywhere(lambda t: {"raw": 255 - t["raw"]}), "readings fall"),
    "a rig's own coordinates": (
        everywhere(lambda t: {"x_m": t["x_m"] + 0.1, "y_m": t["y_m"] - 0.1}),
        "the indenter is beside the pad, at x_m",
    ),
    "depth from another zero": (
        everywhere(lambda t: {"depth_m": t["depth_m"] - 2e-3}),
        "never gets below the face",
    ),
    "pitch in km": (headed(pad={"rows": 6, "cols": 8, "pitch_m": 2e-6}), "pitch_m is 2e-06"),
}


@pytest.mark.parametrize("name", NO_VERDICT)
def test_what_cannot_be_judged_gets_no_verdict_and_the_reason(tmp_path, name):
    fault, words = NO_VERDICT[name]
    header, columns = fault(*make_set())
    recordings = read_recording_set(write_set(tmp_path / "set", header, columns))
    left, issues = check_quality(recordings)
    assert any(words in issue.problem and issue.action == "no verdict" for issue in issues), issues
    assert too_little(left, recordings) is not None


PER_TRIAL = {
    "radius in mm": (
        headed(object={"shape": "sphere", "radius_m": 1e3 * RADIUS}),
        "radius_m is 10: millimetres",
        8,
    ),
    "one radius in mm": (
        labelled(lambda k: {"object": {"shape": "sphere", "radius_m": 10.0}} if k == BAD else {}),
        "radius_m is 10: millimetres",
        1,
    ),
    "depth in micrometres": (everywhere(scaled("depth_m", 1e6)), "micrometres", 8),
    "x and y in mm": (
        everywhere(lambda t: {"x_m": 1e3 * t["x_m"], "y_m": 1e3 * t["y_m"]}),
        "millimetres",
        16,
    ),
    "time in nanoseconds": (everywhere(scaled("time_s", 1e9)), "nanoseconds", 8),
    "time in ms at 500 Hz": (everywhere(scaled("time_s", 60.0)), "milliseconds", 8),
    "time of day": (everywhere(lambda t: {"time_s": t["time_s"] + 1.7e9}), "time_s begins at", 8),
    "depth upwards": (everywhere(scaled("depth_m", -1)), "depth_m falls as the readings rise", 8),
    "depth upwards once": (in_one(scaled("depth_m", -1)), "depth_m falls as the readings rise", 1),
    "pulling load cell": (everywhere(scaled("force_n", -1)), "force_n falls as the readings rise", 8),
    "unplugged load cell": (everywhere(scaled("force_n", 0)), "force_n does not follow the press", 8),
    "load cell not set to zero": (everywhere(lambda t: {"force_n": t["force_n"] + 40.0}), "N at rest", 8),
    "depth that jumps": (in_one(spiked), "1 frame of 150 with implausible depth_m", 1),
    "kelvin": (everywhere(lambda t: {"temperature_c": np.full(150, 297.0)}), "kelvin", 8),
    "thermometer unplugged": (
        everywhere(lambda t: {"temperature_c": np.full(150, -999.0)}),
        "which is not plausible",
        8,
    ),
}


@pytest.mark.parametrize("name", PER_TRIAL)
def test_columns_that_are_wrong_in_one_or_in_all_trials_are_mended(tmp_path, name):
    fault, words, count = PER_TRIAL[name]
    _, columns = make_set()
    left, issues = checked(tmp_path, *fault(*make_set()))

    issues = [issue for issue in issues if "missing frame" not in issue.problem]
    assert all(words in issue.problem for issue in issues), issues
    assert all(issue.action.startswith("repaired: ") for issue in issues)
    assert len(issues) == count
    assert len(left.trials) == 8
    for trial, sound in zip(left.trials, columns, strict=True):
        assert trial.object["radius_m"] == pytest.approx(RADIUS)
        kept = slice(None) if len(trial.x_m) == 150 else np.arange(150) != 50
        for column in ("x_m", "y_m", "depth_m"):
            np.testing.assert_allclose(getattr(trial, column), sound[column][kept], rtol=1e-9)


SET_ASIDE = {
    "pressed beside the pad": (
        in_one(lambda t: {"x_m": t["x_m"] + 0.03}),
        "the pad responds although the indenter",
    ),
    "never touching": (in_one(lambda t: {"depth_m": np.full(150, -1e-3)}), "never gets below the face"),
    "turned readings": (in_one(lambda t: {"raw": 255 - t["raw"]}), "readings fall"),
    "overflowing readings": (in_one(lambda t: {"raw": (2.5 * t["raw"]) % 256}), "overflows"),
    "no depth": (in_one(lambda t: {"depth_m": np.full(150, np.nan)}), "depth_m holds no numbers"),
}


@pytest.mark.parametrize("name", SET_ASIDE)
def test_a_trial_that_contradicts_itself_is_set_aside(tmp_path, name):
    fault, words = SET_ASIDE[name]
    left, issues = checked(tmp_path, *fault(*make_set()))
    assert {issue.trial for issue in issues} == {FILE}, issues
    assert any(words in issue.problem and issue.action == "set aside" for issue in issues), issues
    assert len(left.trials) == 7


def test_readings_of_another_trial_are_found(tmp_path):
    header, columns = make_set()
    columns[BAD] = columns[BAD] | {"raw": columns[BAD + 2]["raw"][::-1].copy()}
    left, issues = checked(tmp_path, header, columns)
    assert {(issue.trial, issue.action) for issue in issues} == {(FILE, "set aside")}
    assert "does not follow the recorded motion" in issues[-1].problem
    assert len(left.trials) == 7


def replicated():
    """A sound set in which every motion was recorded twice."""
    header, columns = make_set()
    rng = np.random.default_rng(9)
    for k in range(4):
        raw = columns[2 * k]["raw"]
        again = np.clip(np.round(raw + rng.normal(0, 1.0, raw.shape)), 0, 255)
        columns[2 * k + 1] = columns[2 * k] | {"raw": again}
    return labelled(lambda k: {"condition": f"c{k // 2}", "replicate": k % 2})(header, columns)


def test_a_trial_that_reads_half_as_much_is_set_aside(tmp_path):
    left, issues = checked(tmp_path, *in_one(scaled("raw", 0.5))(*replicated()))
    assert [(issue.trial, issue.action) for issue in issues] == [(FILE, "set aside")]
    assert "of what other trials of the same motion read" in issues[0].problem
    assert len(left.trials) == 7


@pytest.mark.parametrize("spread", [0.0, 0.1, 0.25])
def test_gains_that_differ_between_recordings_are_no_fault_of_single_ones(tmp_path, spread):
    header, columns = replicated()
    for k, trial in enumerate(columns):
        trial["raw"] = np.clip(np.round(trial["raw"] * (1 - spread * k / 7)), 0, 255)
    _, issues = checked(tmp_path, header, columns)
    assert issues == []


SESSION = {
    "no start": (lambda k: {"start_s": 0.0}, "start_s is missing"),
    "starts too close": (lambda k: {"start_s": 1.0 * k}, "start_s or time_s is in another unit"),
    "one start missing": (lambda k: {"start_s": 0.0} if k == BAD else {}, "starts before"),
    "starts in ms": (lambda k: {"start_s": 2e4 * k}, "start every 5.56 h"),
    "order repeats": (lambda k: {"order": 0}, "order does not number"),
    "order turned": (lambda k: {"order": 9 - k}, "order does not number"),
}


@pytest.mark.parametrize("name", SESSION)
def test_what_a_session_lacks_is_said_and_kept(tmp_path, name):
    change, words = SESSION[name]
    left, issues = checked(tmp_path, *labelled(change)(*make_set()))
    assert any(words in issue.problem + issue.action for issue in issues), issues
    assert all(issue.trial is None and issue.action.startswith("kept") for issue in issues)
    assert len(left.trials) == 8


def test_idle_levels_taken_away_are_said(tmp_path):
    taken = everywhere(lambda t: {"raw": t["raw"] - np.round(t["raw"][:8].mean(axis=0))})
    _, issues = checked(tmp_path, *taken(*make_set()))
    assert [(issue.trial, "falls below 0" in issue.problem) for issue in issues] == [(None, True)]


@pytest.mark.parametrize("make", [make_set, make_robot_set])
def test_trials_of_one_condition_that_were_driven_in_other_ways_are_told_apart(tmp_path, make):
    header, columns = make()
    columns[1] = {name: values + 0.0 for name, values in columns[0].items()}
    name = "raw" if make is make_set else "position"
    columns[1][name] = columns[1][name] + 1e-3
    header, columns = labelled(lambda k: {"condition": "same" if k < 4 else f"c{k}"})(header, columns)
    left, issues = checked(tmp_path, header, columns)
    assert [issue.trial for issue in issues] == ["trial_0002.parquet", "trial_0003.parquet"]
    assert all("is not driven in the same way as trial_0000.parquet" in issue.problem for issue in issues)
    assert [trial.condition for trial in left.trials][:4] == ["same", "same", "same (2)", "same (3)"]


def test_a_light_load_alone_does_not_tell_which_taxels_are_pressed(tmp_path):
    """Under a sphere the load is shared by the whole outline, whose rim nothing presses."""
    header, columns = make_set()
    for trial in columns:
        del trial["depth_m"]
    _, issues = checked(tmp_path, header, columns)
    assert issues == []


def test_units_are_mended_without_readings(tmp_path):
    header, columns = headed(object={"shape": "sphere", "radius_m": 10.0})(*make_set())
    columns = [trial | {"depth_m": 1e3 * trial["depth_m"]} for trial in columns]
    for trial in columns:
        del trial["raw"]
    blind = read_recording_set(write_set(tmp_path / "set", header, columns), measured=False)
    mended, repairs = in_si_units(blind)
    assert len(repairs) == 16
    assert all(trial.object["radius_m"] == 0.01 for trial in mended.trials)
    np.testing.assert_allclose(mended.trials[0].depth_m, make_set()[1][0]["depth_m"])


def test_a_byte_order_mark_does_no_harm(tmp_path):
    folder = write_set(tmp_path / "set", *make_set(trials=1))
    header = folder / "recording.json"
    header.write_bytes(b"\xef\xbb\xbf" + header.read_bytes())
    assert len(read_recording_set(folder).trials) == 1


@pytest.mark.parametrize(
    "entry", [{"condition": None}, {"condition": ["a"]}, {"order": 1.5}, {"replicate": "b"}]
)
def test_labels_of_other_kinds_are_refused(tmp_path, entry):
    header, columns = labelled(lambda k: entry if k == BAD else {})(*make_set())
    with pytest.raises(ValueError, match=rf"recording\.json: trials\[{BAD}\]\.{next(iter(entry))} must be"):
        read_recording_set(write_set(tmp_path / "set", header, columns))
