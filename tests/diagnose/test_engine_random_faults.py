"""Alarms for what comes at random: in moments, in single recordings, or in each by another amount."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from test_engine_error_level import COUNT, fires, fitted, load_of, nothing
from test_engine_pad import COLS, ROWS

from lerobot_vtrefine.diagnose.core.resampling import Hypothesis, jointly_adjusted
from lerobot_vtrefine.diagnose.core.rules import FLIPS, SUSPICION_ALPHA
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion, confirmed
from lerobot_vtrefine.diagnose.pad.failing_taxels import failing_taxel
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.recording_scatter import own_deviations, recording_scatter
from lerobot_vtrefine.diagnose.pad.shared_errors import noise_in_bursts, shared_errors
from lerobot_vtrefine.diagnose.pad.taxel_maps import with_map
from lerobot_vtrefine.diagnose.recordings import Trial

OTHERS = 30
"""Suspicions without anything to find that share the error rate, as on a pad."""


def raised(found: Sequence[Suspicion]) -> list[str]:
    """Clues of those that are alarms among others."""
    noise = np.random.default_rng(1).standard_normal((OTHERS, len(found[0].scores)))
    asked = [Hypothesis(scores, either_sign=True) for scores in noise]
    asked += [Hypothesis(item.scores, drawn=item.drawn) for item in found]
    sure = jointly_adjusted(asked, 0)[OTHERS:] < SUSPICION_ALPHA
    return [item.clue for item, yes in zip(found, sure, strict=True) if yes and fires(item)]


def moments(trial: Trial) -> np.ndarray:
    """Half a second here and there (T, 1), elsewhere in every recording."""
    rng = np.random.default_rng([8, trial.order])
    starts = rng.uniform(0.5, 5.0, 3)
    return np.any((trial.time_s[:, None] > starts) & (trial.time_s[:, None] < starts + 0.5), axis=1)[:, None]


def dips(trial: Trial) -> np.ndarray:
    return -0.15 * moments(trial) * (trial.raw - np.median(trial.raw, axis=0))


def pulses(trial: Trial) -> np.ndarray:
    return 3.0 * moments(trial) * np.ones(trial.raw.shape)


def wandering(trial: Trial) -> np.ndarray:
    rng = np.random.default_rng([9, trial.order])
    return lfilter([0.5], [1.0, -0.9], rng.standard_t(3, trial.raw.shape), axis=0)


@pytest.mark.parametrize(
    ("added", "expected"),
    [(nothing, None), (wandering, None), (dips, "in proportion"), (pulses, "all taxels")],
)
def test_what_all_taxels_do_at_once_is_told_from_noise_that_wanders(added, expected) -> None:
    presses, baseline = fitted(added)
    left = own_deviations(presses, baseline.fitted).left
    found = shared_errors(presses, left, baseline.fitted, baseline.weights, 0)
    clues = raised(found)
    assert bool(clues) == (expected is not None)
    named = SimpleNamespace(signals=baseline.fitted.signals, model=SimpleNamespace(families=("hysteresis",)))
    strict = shared_errors(presses, left, named, baseline.weights, 0)
    assert strict[0].least > 2 * found[0].least  # forms that are not quite right err in all loaded taxels
    assert expected is None or any(expected in clue for clue in clues)


def bursts(trial: Trial) -> np.ndarray:
    """White noise of every taxel's own, now and then."""
    return 3.0 * moments(trial) * np.random.default_rng([10, trial.order]).standard_normal(trial.raw.shape)


@pytest.mark.parametrize(
    ("added", "expected"), [(nothing, False), (wandering, False), (dips, False), (bursts, True)]
)
def test_noise_that_grows_in_all_taxels_at_once_is_a_cable(added, expected) -> None:
    presses, baseline = fitted(added)
    left = own_deviations(presses, baseline.fitted).left
    assert bool(raised(noise_in_bursts(presses, left, baseline.fitted, baseline.weights, 0))) == expected
    held = SimpleNamespace(
        signals=baseline.fitted.signals, model=SimpleNamespace(families=("sample_and_hold",))
    )
    assert not noise_in_bursts(presses, left, held, baseline.weights, 0)


def bad_joint(trial: Trial) -> np.ndarray:
    """The taxel beside the middle loses a third of its signal for moments."""
    return -0.35 * moments(trial) * (np.arange(ROWS * COLS) == 5) * (trial.raw - np.median(trial.raw, axis=0))


def bent(trial: Trial) -> np.ndarray:
    """The same taxel has a law of its own, in all recordings."""
    return -0.35 * load_of(trial) * (np.arange(ROWS * COLS) == 5) * (trial.raw - np.median(trial.raw, axis=0))


@pytest.mark.parametrize(
    ("added", "expected"), [(nothing, False), (wandering, False), (bent, False), (bad_joint, True)]
)
def test_a_taxel_that_fails_for_moments_is_told_from_one_with_a_law_of_its_own(added, expected) -> None:
    presses, baseline = fitted(added)
    problem = PadProblem(presses, weights=baseline.weights, noise=baseline.noise)
    now = problem.settled(with_map(baseline.fitted, presses, baseline.weights))
    left = own_deviations(presses, now).left
    found = failing_taxel(presses, left, now, baseline.weights, 0)
    assert found is not None
    assert bool(raised([found])) == expected
    assert not expected or "(1, 1)" in found.clue
    names = [replace(press.trial, condition=press.trial.file) for press in presses.presses]
    alone = replace(
        presses, presses=tuple(replace(p, trial=t) for p, t in zip(presses.presses, names, strict=True))
    )
    assert failing_taxel(alone, left, now, baseline.weights, 0) is None


def test_independent_taxels_share_nothing_as_often_as_said() -> None:
    """Twelve recordings of six taxels whose noise remembers seven frames and has heavy tails."""
    rng, low = np.random.default_rng(3), 0
    presses = SimpleNamespace(layout=SimpleNamespace(num_taxels=6))
    weights = [SimpleNamespace(sigma=1.0)] * 12
    signals = [np.abs(np.sin(np.linspace(0, 6, 200)))[:, None] * np.linspace(0.2, 1, 6)] * 12
    for seed in range(60):
        noise = [lfilter([1.0], [1.0, -0.87], rng.standard_t(4, (200, 6)), axis=0) for _ in range(12)]
        for item in shared_errors(
            presses,
            noise,
            SimpleNamespace(signals=signals, model=SimpleNamespace(families=())),
            weights,
            seed,
        ):
            low += np.mean(item.drawn >= item.drawn[0]) < 0.1
    assert 3 <= low <= 24  # 12 of 120 are expected


def scattered(change: Callable[[Trial, float], np.ndarray]) -> list[str]:
    """Clues where every recording's readings deviate by their own normal number."""
    numbers = np.random.default_rng(12).standard_normal(COUNT)
    presses, baseline = fitted(lambda trial: change(trial, numbers[trial.order % COUNT]) - trial.raw)
    return raised(recording_scatter(own_deviations(presses, baseline.fitted), 0))


def other_gain(size: float) -> Callable[[Trial, float], np.ndarray]:
    def change(trial: Trial, number: float) -> np.ndarray:
        idle = np.median(trial.raw, axis=0)
        return idle + (trial.raw - idle) * (1 + size * number)

    return change


def other_start(trial: Trial, number: float) -> np.ndarray:
    late = trial.time_s - 0.03 * number
    return np.stack([np.interp(late, trial.time_s, column) for column in trial.raw.T], axis=1)


def test_recordings_may_differ_as_those_of_a_sound_rig_and_no_further() -> None:
    assert not scattered(lambda trial, number: trial.raw)
    assert not scattered(other_gain(0.015))
    assert any(clue.startswith("gains of recordings") for clue in scattered(other_gain(0.06)))
    assert any(clue.startswith("starts of recordings") for clue in scattered(other_start))


def shifted(to: Callable[[int], float]) -> Callable[[Trial], np.ndarray]:
    """Readings of a sphere that lands beside its place along the row, by `to` of the recording [m]."""

    def added(trial: Trial) -> np.ndarray:
        east = (np.arange(COLS) - 1.5) * 2e-3 - trial.x_m[0]
        deeper = to(trial.order) * np.tile(east, ROWS) / 1e-2
        return 2.5e5 * deeper * (trial.raw - np.median(trial.raw, axis=0) > 8)

    return added


@pytest.mark.parametrize("alike", [True, False])
def test_an_indenter_that_lands_beside_its_place_is_seen(alike) -> None:
    numbers = np.ones(COUNT) if alike else np.random.default_rng(13).standard_normal(COUNT)
    presses, baseline = fitted(shifted(lambda order: 1e-4 * numbers[order % COUNT]))
    clues = raised(recording_scatter(own_deviations(presses, baseline.fitted), 0))
    assert any("along the row" in clue for clue in clues)
    assert not any("along the column" in clue for clue in clues)


def failing(trial: Trial) -> np.ndarray:
    """The taxel beside the middle does not answer in the last recording."""
    gone = (np.arange(ROWS * COLS) == 5) * (trial.file == f"t{COUNT - 1:02}.parquet")
    return -1.0 * gone * (trial.raw - np.median(trial.raw, axis=0))


@pytest.mark.parametrize(("added", "expected"), [(nothing, False), (failing, True)])
def test_a_taxel_that_fails_in_a_locked_recording_alone_is_an_alarm(added, expected) -> None:
    presses, _ = fitted(added)
    whole = PadProblem(presses)
    seen, locked = whole.subset(np.arange(COUNT - 4)), whole.subset(np.arange(COUNT - 4, COUNT))
    problem, now = seen.weighed(None)
    alarms = confirmed(problem.surprises(now, locked), 0)
    assert bool(alarms) == expected
    mapped = replace(now, model=replace(now.model, gain_map=np.ones((ROWS, COLS))))
    # A map may not know what they press.
    assert not any("taxel" in item.clue for item in problem.surprises(mapped, locked))
    if expected:
        assert alarms[0].clue.startswith(f"errors of taxel (1, 1) in t{COUNT - 1:02}.parquet")


def test_a_null_of_its_own_shares_the_error_rate() -> None:
    rng = np.random.default_rng(2)
    scores = rng.standard_normal((3, 16))
    values = rng.chisquare(12, FLIPS)

    def p_of(quantile: float) -> float:
        drawn = np.concatenate([[np.quantile(values, quantile)], values])
        return jointly_adjusted([*map(Hypothesis, scores), Hypothesis(scores[0], drawn=drawn)], 0)[-1]

    assert p_of(0.99999) < 0.002
    assert 0.01 < p_of(0.99) < 0.1  # four hypotheses, not one
    assert p_of(0.5) > 0.5
