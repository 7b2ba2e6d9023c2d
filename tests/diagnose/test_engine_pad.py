"""The whole procedure on small pads whose truth is known; the presses are computed here, by hand."""

from pathlib import Path

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial

ROWS, COLS, PITCH, RADIUS = 3, 4, 0.002, 0.01
FRAMES, FRAME_S = 120, 0.05


def heights(x: float, y: float, depth: np.ndarray) -> np.ndarray:
    east = (np.arange(COLS) - 1.5) * PITCH - x
    north = (np.arange(ROWS) - 1.0)[:, None] * PITCH - y
    return depth[:, None, None] - RADIUS + np.sqrt(RADIUS**2 - east**2 - north**2)


def motion(rng: np.random.Generator) -> np.ndarray:
    peaks = rng.uniform(2e-4, 7e-4, 3)
    knots = np.array([0, 0.5, 1.2, 1.8, 2.0, 2.6, 3.4, 3.6, 4.3, 5.2, 6.0])
    low = -1.5e-4
    levels = [low, low, peaks[0], peaks[0], 0.4 * peaks[0], peaks[1], low, low, peaks[2], peaks[2], low]
    return np.interp(np.arange(FRAMES) * FRAME_S, knots, levels)


def one_trial(number: int, counts_of, seed: int, noise: float, jitter: float) -> Trial:
    condition = np.random.default_rng([seed, 1, number // 2])
    x, y = condition.uniform(-2e-3, 2e-3), condition.uniform(-1e-3, 1e-3)
    depth = motion(condition)
    rng = np.random.default_rng([seed, 2, number])
    felt = heights(x, y, depth - jitter * 10e-6 * rng.standard_normal())
    counts = counts_of(np.maximum(felt, 0.0)) * (1 + jitter * 0.01 * rng.standard_normal())
    raw = 20.0 + counts.reshape(FRAMES, -1) + noise * rng.standard_normal((FRAMES, ROWS * COLS))
    raw = np.round(raw).clip(0, 255) if noise else raw.clip(0, 255)
    zero = np.zeros(FRAMES)
    spec = {"shape": "sphere", "radius_m": RADIUS}
    return Trial(
        f"t{number:02}.parquet",
        f"c{number // 2}",
        number,
        30.0 * number,
        spec,
        np.arange(FRAMES) * FRAME_S,
        zero + x,
        zero + y,
        depth,
        zero,
        zero,
        None,
        None,
        raw,
    )


def linear(depth: np.ndarray) -> np.ndarray:
    return 2.5e5 * depth


def hardening(depth: np.ndarray) -> np.ndarray:
    return 2.5e5 * depth * (depth / 5e-4) ** 0.3


def recordings(counts_of=linear, seed: int = 0, count: int = 16, noise: float = 1.0, jitter: float = 1.0):
    trials = tuple(one_trial(number, counts_of, seed, noise, jitter) for number in range(count))
    return RecordingSet(Path(), "pad", ROWS, COLS, PITCH, 255.0, (), trials)


def names(diagnosis: Diagnosis) -> list[str]:
    return [cause.name for cause in diagnosis.verdict.causes]


@pytest.fixture(scope="module")
def hardened() -> Diagnosis:
    return diagnose_pad(recordings(hardening))


def test_a_pad_as_the_paper_has_it_is_adequate() -> None:
    found = diagnose_pad(recordings())
    assert found.verdict.status == "adequate"
    assert names(found) == []
    assert found.verdict.heldout is not None
    assert found.verdict.heldout.gain == 0.0
    assert found.baseline_model == found.extended_model
    assert found.verdict.minimum_detectable["contact_offset"] < 5e-5
    assert found.baseline_params["gain"].value * found.baseline_params["k_n"].value == pytest.approx(
        2.5e5, rel=0.02
    )


def test_hardening_is_named_with_its_exponent(hardened: Diagnosis) -> None:
    assert hardened.verdict.status == "explained"
    assert names(hardened) == ["nonlinear_stiffness"]
    exponent = hardened.verdict.causes[0].params["exponent"]
    assert exponent.value == pytest.approx(1.3, abs=0.03)
    assert exponent.ci95[0] <= 1.3 <= exponent.ci95[1]


def test_the_gain_is_what_locked_recordings_say(hardened: Diagnosis) -> None:
    held = hardened.verdict.heldout
    assert held.gain == pytest.approx(1 - held.extended**2 / held.baseline**2)
    assert held.gain > 0.5
    assert held.extended < 1.3 * held.noise_floor
    assert len(held.trials) == 4
    assert [trace.file for trace in hardened.traces] == list(held.trials)
    trace = hardened.traces[0]
    errors = [np.mean((trace.measured - other) ** 2) for other in (trace.simulated, trace.extended)]
    assert errors[1] < errors[0]


def test_every_candidate_has_a_row_of_evidence(hardened: Diagnosis) -> None:
    rows = {row.name: row for row in hardened.evidence}
    assert len(rows) == 17
    assert rows["nonlinear_stiffness"].decision == "accepted"
    assert rows["latency"].decision == "rejected"


def test_the_same_seed_gives_the_same_verdict(hardened: Diagnosis) -> None:
    again = diagnose_pad(recordings(hardening))
    assert again.verdict.causes == hardened.verdict.causes
    assert again.verdict.heldout == hardened.verdict.heldout


def test_readings_without_any_noise_do_no_harm() -> None:
    found = diagnose_pad(recordings(hardening, count=12, noise=0.0, jitter=0.0))
    assert "nonlinear_stiffness" in names(found)
    assert found.verdict.heldout.gain > 0.9


def test_three_recordings_give_a_verdict_that_says_so() -> None:
    found = diagnose_pad(recordings(hardening, count=3))
    assert found.verdict.status in ("adequate", "explained", "ambiguous", "unexplained")
    assert any("recordings" in issue.problem for issue in found.verdict.data_issues)


def test_nothing_to_fit_is_invalid() -> None:
    assert diagnose_pad(recordings(count=1)).verdict.status == "invalid_data"
    above = recordings()
    far = [t.__class__(**{**t.__dict__, "depth_m": t.depth_m - 0.01}) for t in above.trials]
    found = diagnose_pad(RecordingSet(Path(), "pad", ROWS, COLS, PITCH, 255.0, (), tuple(far)))
    assert found.verdict.status == "invalid_data"
    assert found.verdict.data_issues


def test_progress_is_told() -> None:
    told: list[float] = []
    diagnose_pad(recordings(count=6), progress=lambda text, share: told.append(share))
    assert told == sorted(told)
    assert 0 <= told[0] < told[-1] <= 1
