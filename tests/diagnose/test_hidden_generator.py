"""The generator itself, against facts that need no simulation."""

import ast
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hidden import cases, mechanics, oracle
from hidden.catalogue import CAUSES, FORMS, visible
from hidden.corrupt import CORRUPTIONS
from hidden.noise import Noise, frame_noise
from hidden.protocol import standard
from hidden.rig import FLAT, PUNCH, RIGS, SPHERE, Rig, height_rate, surface
from hidden.session import Spec, run_session
from hidden.table import quantile_interval, wilson
from hidden.writer import truth_of, write_set

HIDDEN = Path(__file__).parent / "hidden"
QUIET = Rig(4, 4, (SPHERE,), conditions=4, replicates=1)


def session_of(*effects, noise="none", seed=5001, **changes):
    changes = {"conditions": 4, "replicates": 1, **changes}
    return run_session(Spec("4x4", effects, noise=noise, changes=tuple(changes.items())), seed)[0]


def first_effect(family, form, size=1.0, **changes):
    return session_of((family, form, size), **changes).effects[0]


def test_it_shares_no_code_with_the_engine():
    for path in HIDDEN.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.startswith(("lerobot", "torch")) for name in names), path


def test_sphere_reaches_below_the_face_by_a_circle():
    dx, _, height = surface(QUIET, SPHERE, np.zeros(1), np.zeros(1), np.full(1, 1e-3))
    x, y = QUIET.taxels_m()
    rho2 = x**2 + y**2
    rise = 1e-3 - height[0]
    assert (0.010 - rise) ** 2 + rho2 == pytest.approx(0.010**2)
    assert dx[0] == pytest.approx(x)


@pytest.mark.parametrize(("indenter", "count"), [(FLAT, 16), (PUNCH, 12)])
def test_punches_have_a_rim(indenter, count):
    height = surface(QUIET, indenter, np.zeros(1), np.zeros(1), np.full(1, 2e-4))[2]
    assert np.isfinite(height).sum() == count
    assert height[np.isfinite(height)] == pytest.approx(2e-4)


def test_rates_are_the_derivative_of_heights():
    time = np.linspace(0.0, 0.1, 201)
    motion = (1e-3 * np.sin(20 * time), 5e-4 * time, 8e-4 * time)
    speed = [np.gradient(m, time) for m in motion]
    dx, dy, height = surface(QUIET, SPHERE, *motion)
    found = height_rate(SPHERE, dx, dy, *speed)
    assert found[5:-5] == pytest.approx(np.gradient(height, time, axis=0)[5:-5], abs=2e-5)


def test_clean_readings_follow_the_papers_law_exactly():
    session = session_of()
    pad = session.pad
    for recording in session.recordings:
        force = np.maximum(pad.k_n * recording.depth_m + pad.k_d * recording.rate, 0.0)
        law = pad.gain * np.where(recording.depth_m > 0, force, 0.0)
        edge = np.abs(recording.depth_m) < 1e-4  # the fine grid brackets the step at touch
        assert recording.expected[~edge] == pytest.approx(law[~edge], abs=0.02 * pad.peak)
        assert recording.raw == pytest.approx(recording.expected + pad.idle, abs=1e-9)


def test_motions_start_clear_of_the_pad_and_fill_the_trial():
    for motion in standard(RIGS["8x8"], np.random.default_rng(5002)):
        position, speed = motion.sample(np.linspace(0, 0.6, 50))
        assert (position[:, 2] < 0).all()
        assert np.abs(speed[:20]).max() < 1e-9
        assert motion.times_s[-1] < RIGS["8x8"].duration_s + 0.3
        assert motion.points_m[:, 2].max() > 0.2 * RIGS["8x8"].reach_m


def test_noise_has_the_size_that_it_says():
    noise = Noise(white=0.006, red=0.008, proportional=0.0)
    values = frame_noise(noise, np.zeros((400, 500)), 0.05, 100.0, np.random.default_rng(5003))
    assert values.std() == pytest.approx(1.0, rel=0.03)
    lag = (values[1:] * values[:-1]).mean() / (values**2).mean()
    assert lag == pytest.approx(0.64 * np.exp(-0.1), abs=0.03)


def test_relaxation_decays_to_what_its_fraction_leaves():
    step = np.ones((4000, 1))
    assert mechanics.low_pass(step, 0.5, 0.005)[-1, 0] == pytest.approx(1.0, abs=1e-6)
    assert mechanics.low_pass(step, 0.5, 0.005)[100, 0] == pytest.approx(1 - np.exp(-1.0), abs=0.01)
    assert mechanics.kernel_memory(step, 0.005, np.linspace(1, 2, 4000))[-1, 0] == pytest.approx(2.0)


def test_play_lags_by_its_half_width_and_is_free_of_rate():
    up = np.linspace(0, 1, 101)
    path = np.concatenate([up, up[::-1]])[:, None]
    out = mechanics.play(path, 0.1)[:, 0]
    assert out[90] == pytest.approx(0.8)
    assert out[100 + 50] == pytest.approx(path[150, 0] + 0.1, abs=0.011)
    slow = mechanics.play(np.repeat(path, 3, axis=0), 0.1)[::3, 0]
    assert slow == pytest.approx(out)
    assert out[-1] == 0.0  # nothing is remembered without contact


def test_full_circuit_is_the_divider_when_nothing_leaks():
    """raw = V G / (sum G + G_pd): a lone taxel's neighbours lower it, its own column does not."""
    session = session_of(("row_sharing", "divider", 1.0))
    kappa = session.effects[0].params["conductance_per_count"]
    lone, pair = np.zeros((1, 16)), np.zeros((1, 16))
    lone[0, 5], pair[0, [5, 6]] = 100.0, 100.0
    column = np.zeros((1, 16))
    column[0, [5, 9]] = 100.0

    class Flat:
        grid = staticmethod(lambda values: values.reshape(-1, 4, 4))

    apply = session.effects[0].apply
    assert apply(Flat, lone)[0, 5] == pytest.approx(100 / (1 + kappa * 100))
    assert apply(Flat, pair)[0, 5] == pytest.approx(100 / (1 + kappa * 200))
    assert apply(Flat, column)[0, 5] == pytest.approx(apply(Flat, lone)[0, 5])


def test_spreading_keeps_the_load():
    force = np.random.default_rng(5004).random((3, 16))

    class Flat:
        grid = staticmethod(lambda values: values.reshape(-1, 4, 4))

    for form in FORMS["mechanical_spreading"]:
        spread = first_effect("mechanical_spreading", form).apply(Flat, force)
        if form == "box":  # its cover reaches beyond the taxels
            assert (spread.sum(axis=1) < force.sum(axis=1)).all()
        else:
            assert spread.sum(axis=1) == pytest.approx(force.sum(axis=1)), form
        assert spread.std() < force.std()


def test_latency_and_skew_shift_the_readings():
    late = session_of(("latency", "constant", 2.0), rate_hz=100.0)
    plain = session_of(rate_hz=100.0)
    tau = late.effects[0].params["tau_s"]
    for ours, theirs in zip(late.recordings, plain.recordings, strict=True):
        shifted = np.interp(ours.time_s - tau, theirs.time_s, theirs.expected.sum(axis=1))
        assert ours.expected.sum(axis=1)[10:] == pytest.approx(shifted[10:], abs=0.05 * shifted.max())
    skewed = session_of(("scan_skew", "rows", 2.0), rate_hz=100.0)
    assert all(
        np.allclose(a.expected[5:, :4], b.expected[5:, :4])
        for a, b in zip(skewed.recordings, plain.recordings, strict=True)
    )


def test_held_readings_repeat_while_time_goes_on():
    session = session_of(("sample_and_hold", "from_start", 2.0), noise="normal")
    raw, time = session.recordings[0].raw, session.recordings[0].time_s
    fresh = np.flatnonzero((np.diff(raw, axis=0) != 0).any(axis=1)) + 1
    period = session.effects[0].params["period_s"]
    assert np.diff(time[fresh]).mean() == pytest.approx(period, rel=0.1)


@pytest.mark.parametrize("family", CAUSES)
def test_every_form_acts_and_more_when_larger(family):
    """Each form's achievable gain grows with its size, and is plain to see at the largest."""
    for form in FORMS[family]:
        gains = []
        for size in (0.5, 2.0):
            spec = Spec("4x4", ((family, form, size),), changes=(("conditions", 4), ("replicates", 1)))
            gains.append(oracle.oracle_gain(*run_session(spec, 5005, locked=4))[0])
        assert gains[1] > 0.15, (form, gains)
        assert gains[1] > gains[0] - 0.02, (form, gains)


def test_files_say_what_was_recorded_and_not_what_was_hidden(tmp_path):
    spec = Spec("8x8", (("hysteresis", "play", 1.0),), changes=(("conditions", 3), ("replicates", 2)))
    truth = write_set(tmp_path / "set", spec, 5006)
    head = json.loads((tmp_path / "set" / "recording.json").read_text(encoding="utf-8"))
    assert truth.causes == ("hysteresis",)
    assert "hysteresis" not in json.dumps(head)
    assert [trial["order"] for trial in head["trials"]] == list(range(6))
    starts = [trial["start_s"] for trial in head["trials"]]
    assert starts == sorted(starts)
    assert sorted(trial["condition"] for trial in head["trials"]) == sorted(["c00", "c01", "c02"] * 2)
    table = pq.read_table(tmp_path / "set" / head["trials"][0]["file"])
    assert set(table.column_names) == {"time_s", "x_m", "y_m", "depth_m", "force_n", "raw"}
    raw = np.array(table["raw"].to_pylist())
    assert raw.shape == (320, 64)
    assert raw.min() >= 0
    assert raw.max() <= head["reading"]["full_scale"]


def test_same_seed_same_set_another_seed_another():
    spec = Spec("4x4", (("latency", "jitter", 1.0),), changes=(("conditions", 2),))
    a, b, c = (run_session(spec, seed)[0].recordings[0].raw for seed in (5007, 5007, 5008))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


@pytest.mark.parametrize("damage", CORRUPTIONS)
def test_every_damage_changes_the_files(tmp_path, damage):
    spec = Spec("4x4", changes=(("conditions", 2),))
    write_set(tmp_path / "whole", spec, 5009)
    write_set(tmp_path / "broken", Spec("4x4", corruption=damage, changes=spec.changes), 5009)
    whole, broken = ({p.name: p.read_bytes() for p in (tmp_path / k).iterdir()} for k in ("whole", "broken"))
    assert whole != broken


def test_tuning_and_reporting_never_share_a_set():
    tuned, reported = (
        {(c.name.rsplit("-", 1)[0], c.seed) for make, n in cases.GROUPS.values() for c in make(n, first)}
        for first in (cases.TUNE_SEED, cases.REPORT_SEED)
    )
    assert len(tuned) == len(reported) > 900
    assert not {seed for _, seed in tuned} & {seed for _, seed in reported}


def test_truth_knows_its_status():
    assert truth_of(session_of(), 1).status == "adequate"
    assert truth_of(session_of(("outside", "bowl", 1.0)), 1).status == "unexplained"
    assert not visible("row_sharing", "1x1")
    assert visible("saturation", "8x8_force")


def test_intervals_are_the_textbooks():
    low, high = wilson(0, 100)
    assert (low, high) == pytest.approx((0.0, 0.0370), abs=1e-4)
    assert wilson(95, 100) == pytest.approx((0.8882, 0.9785), abs=1e-4)
    value, low, high = quantile_interval(np.arange(101.0), 0.5)
    assert value == 50.0
    assert 35 < low < 50 < high < 65
