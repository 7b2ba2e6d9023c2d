"""Alarms for errors that all taxels share at one frequency."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_engine_error_level import fires, fitted, load_of, nothing
from test_engine_random_faults import dips, raised, wandering

from lerobot_vtrefine.diagnose.pad.hum import hum
from lerobot_vtrefine.diagnose.pad.recording_scatter import own_deviations
from lerobot_vtrefine.diagnose.pad.shared_errors import shared_errors
from lerobot_vtrefine.diagnose.pad.whitening import Whitener
from lerobot_vtrefine.diagnose.recordings import Trial

TAXELS, FRAMES, RECORDINGS = 20, 180, 12
HUM_HZ = 50.0


def wave(trial: Trial) -> np.ndarray:
    phase = np.random.default_rng([11, trial.order]).uniform(0.0, 2.0 * np.pi)
    return np.sin(2.0 * np.pi * 48.3 * trial.time_s + phase)[:, None]


@pytest.mark.parametrize(
    ("added", "expected"),
    [
        (nothing, None),
        (wandering, None),
        (dips, None),
        (lambda trial: 5.0 * load_of(trial) ** 2, None),
        (lambda trial: 1.0 * wave(trial), "all taxels"),
        (lambda trial: 0.05 * wave(trial) * (trial.raw - 20.0), "in proportion"),
    ],
)
def test_hum_is_told_from_noise_moments_and_another_law(added, expected) -> None:
    presses, baseline = fitted(added)
    left = own_deviations(presses, baseline.fitted).left
    clues = raised(hum(presses, left, baseline.fitted, baseline.weights, 0))
    assert bool(clues) == (expected is not None)
    assert expected is None or any(expected in clue for clue in clues)


def clocks(rng: np.random.Generator) -> list[np.ndarray]:
    """Thirty frames a second, a tenth of a frame uneven."""
    return [np.cumsum(rng.normal(1.0, 0.1, FRAMES)) / 30.0 for _ in range(RECORDINGS)]


def asked(times: list[np.ndarray], errors: list[np.ndarray]) -> tuple:
    """What suspicions need of recordings whose taxels are loaded alike."""
    presses = [SimpleNamespace(trial=SimpleNamespace(time_s=time)) for time in times]
    pad = SimpleNamespace(layout=SimpleNamespace(num_taxels=TAXELS), presses=presses)
    signals = [np.ones(error.shape) for error in errors]
    now = SimpleNamespace(signals=signals, model=SimpleNamespace(families=()))
    weights = [SimpleNamespace(sigma=np.ones(error.shape), memory=Whitener(0.0)) for error in errors]
    return pad, errors, now, weights, 0


def test_hum_is_found_at_its_own_frequency_and_size_where_frames_are_slow_and_uneven() -> None:
    rng = np.random.default_rng(5)
    times = clocks(rng)
    phases = rng.uniform(0.0, 2.0 * np.pi, RECORDINGS)
    waves = [np.sin(2.0 * np.pi * HUM_HZ * time + phase) for time, phase in zip(times, phases, strict=True)]
    errors = [0.5 * each[:, None] + rng.standard_normal((FRAMES, TAXELS)) for each in waves]
    found = hum(*asked(times, errors))[0]
    assert f"at {HUM_HZ:.1f} Hz" in found.clue
    assert found.share == pytest.approx(0.125 / 1.125, rel=0.1)
    assert fires(found)
    assert found.drawn[0] > found.drawn[1:].max()
    assert not fires(shared_errors(*asked(times, errors))[0])  # frames apart it has another phase


def test_what_is_slow_is_no_hum_and_hum_that_frames_see_as_slow_is_where_clocks_are_uneven() -> None:
    """Sixty Hz beside thirty frames a second, and a level of each recording's own."""
    rng = np.random.default_rng(6)
    noise = [rng.standard_normal((FRAMES, TAXELS)) for _ in range(RECORDINGS)]
    even = [np.arange(FRAMES) / 30.0] * RECORDINGS
    for times in (even, clocks(rng)):
        levels = [error + number for number, error in enumerate(noise)]
        assert not any(fires(item) for item in hum(*asked(times, levels)))
        hums = [
            error + np.sin(2.0 * np.pi * 60.5 * time + number)[:, None]
            for number, (error, time) in enumerate(zip(noise, times, strict=True))
        ]
        assert fires(hum(*asked(times, hums))[0]) == (times is not even)


@pytest.mark.slow
def test_taxels_of_their_own_hum_as_often_as_said() -> None:
    rng, low = np.random.default_rng(7), 0
    for seed in range(40):
        noise = [rng.standard_t(4, (FRAMES, TAXELS)) for _ in range(RECORDINGS)]
        found = hum(*asked(clocks(rng), noise)[:-1], seed)[0]
        low += np.mean(found.drawn >= found.drawn[0]) < 0.1
    assert low <= 10  # 4 are expected
