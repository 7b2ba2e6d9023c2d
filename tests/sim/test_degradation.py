"""Errors of human-like demonstrations: functions of the seed, of the size asked for, refused if nonsense."""

import numpy as np
import pytest

from lerobot_vtrefine.sim.demonstrations import Degradation, EpisodeErrors


def test_clean_expert_has_no_errors() -> None:
    errors = EpisodeErrors(Degradation(), 3, 10.0)
    ids = np.arange(3)
    errors.draw(ids, ids)
    for value in (errors.lateral_m, errors.tilt_rad, errors.grasp_m, errors.tremor_m(ids, ids)):
        np.testing.assert_array_equal(value, 0)
    np.testing.assert_array_equal(errors.pace, 1)
    assert not errors.paused(ids, ids).any()


def test_errors_follow_the_seed_not_the_environment() -> None:
    first, second = (EpisodeErrors(Degradation.human_like(), 4, 10.0) for _ in range(2))
    first.draw(np.array([0, 3]), np.array([11, 12]))
    second.draw(np.array([2]), np.array([12]))
    np.testing.assert_array_equal(first.lateral_m[3], second.lateral_m[2])
    steps = np.array([17])
    np.testing.assert_array_equal(first.tremor_m(np.array([3]), steps), second.tremor_m(np.array([2]), steps))
    assert np.abs(first.lateral_m[0] - first.lateral_m[3]).max() > 0


def test_sizes_are_as_asked() -> None:
    size = Degradation(lateral_std_m=1e-3, tilt_std_rad=0.02, tremor_std_m=2e-4, pause_probability=0.05)
    errors = EpisodeErrors(size, 2000, 10.0)
    ids = np.arange(2000)
    errors.draw(ids, ids)
    assert errors.lateral_m.std() == pytest.approx(1e-3, rel=0.05)
    assert errors.tilt_rad.std() == pytest.approx(0.02, rel=0.05)
    tremor = np.stack([errors.tremor_m(ids, np.full(2000, step)) for step in range(0, 200, 20)])
    assert tremor.std() == pytest.approx(2e-4, rel=0.1)
    paused = np.mean([errors.paused(ids, np.full(2000, step)).mean() for step in range(50, 100)])
    assert paused == pytest.approx(1 - 0.95**4, rel=0.1)


def test_tremor_is_slow() -> None:
    errors = EpisodeErrors(Degradation(tremor_std_m=1e-3), 1, 10.0)
    errors.draw(np.array([0]), np.array([5]))
    path = np.array([errors.tremor_m(np.array([0]), np.array([step]))[0] for step in range(100)])
    assert np.abs(np.diff(path, axis=0)).max() < 1e-3


@pytest.mark.parametrize(
    ("field", "value"), [("lateral_std_m", -1e-3), ("tilt_std_rad", float("nan")), ("pause_probability", 1.0)]
)
def test_nonsense_is_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"degradation.{field} must be"):
        Degradation(**{field: value})  # ty: ignore[invalid-argument-type]
