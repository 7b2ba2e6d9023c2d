"""Maps over taxels whose deviations are shared: by lines, by blotches, by the whole pad."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from lerobot_vtrefine.diagnose.pad.map_prior import (
    SHARES,
    covariance,
    likeliest_variances,
    log_likelihood,
    told,
)
from lerobot_vtrefine.diagnose.pad.taxel_maps import MapEvidence, solve_map

SHAPE = (8, 12)
EVERY = np.arange(SHAPE[0] * SHAPE[1])
ROWS, COLS = np.divmod(EVERY, SHAPE[1])
ERROR = 0.02
"""Standard error of a taxel's logarithm after one press."""


def evidence(log_map: np.ndarray, pressed: np.ndarray, seed: int = 1) -> MapEvidence:
    """One recording that tells the pressed taxels."""
    rng = np.random.default_rng(seed)
    information = np.where(pressed, ERROR**-2.0, 0.0)
    seen = log_map + ERROR * rng.standard_normal(len(log_map))
    none = np.zeros((0, len(log_map)))
    return MapEvidence((information * seen)[None], information[None], [none], [np.zeros((0, 0))], SHAPE)


@pytest.mark.parametrize("part", range(SHARES))
def test_the_part_that_a_map_was_drawn_from_is_found(part: int) -> None:
    only = np.zeros(SHARES)
    only[part] = 0.1**2
    root = np.linalg.cholesky(covariance(only, EVERY, EVERY, SHAPE) + 1e-8 * np.eye(len(EVERY)))
    log_map = root @ np.random.default_rng(3).standard_normal(len(EVERY))
    curvature = np.eye(len(EVERY)) / ERROR**2
    variances = likeliest_variances(curvature, curvature @ log_map, EVERY, SHAPE, np.zeros(0))
    assert variances.argmax() == part
    assert 0.05 < np.sqrt(variances[part]) < 0.2


def test_a_course_over_the_pad_is_told_where_nothing_pressed() -> None:
    log_map = 0.3 * (COLS / COLS.max() - 0.5)
    pressed = (COLS < 5) | (COLS > 9)
    draws = [solve_map(evidence(log_map, pressed, s), [0], np.zeros(len(EVERY)), ())[0] for s in range(20)]
    left = np.sqrt(np.mean([(found - log_map)[~pressed] ** 2 for found in draws]))
    level = log_map[pressed].mean()
    assert left < ERROR < 0.5 * np.sqrt(np.mean((level - log_map)[~pressed] ** 2))


def test_gains_of_single_taxels_say_nothing_about_others() -> None:
    log_map = 0.2 * np.random.default_rng(5).standard_normal(len(EVERY))
    pressed = (ROWS + COLS) % 2 == 0
    found, variances = solve_map(evidence(log_map, pressed), [0], np.zeros(len(EVERY)), ())
    assert np.isclose(np.sqrt(sum(variances)), 0.2, rtol=0.3)
    assert np.abs(found - log_map)[pressed].std() < 1.2 * ERROR
    assert found[~pressed].std() < 1e-9


def test_parts_that_no_map_has_are_seldom_found() -> None:
    rng, curvature = np.random.default_rng(8), np.eye(len(EVERY)) / ERROR**2
    maps = 0.03 * rng.standard_normal((30, len(EVERY))) + ERROR * rng.standard_normal((30, len(EVERY)))
    found = [likeliest_variances(curvature, curvature @ m, EVERY, SHAPE, np.zeros(0))[1:] for m in maps]
    assert np.mean(np.any(np.array(found) > 0, axis=1)) < 0.15


def test_the_likelihood_is_that_of_readings_whose_level_may_be_anything() -> None:
    log_map = np.random.default_rng(2).standard_normal(len(EVERY))
    curvature = np.eye(len(EVERY)) / ERROR**2
    ours, exact = [], []
    for variances in ([0.5, 0.0, 0.0, 0.0, 0.0], [0.2, 0.3, 0.0, 0.1, 0.0]):
        prior = covariance(np.array(variances), EVERY, EVERY, SHAPE)
        ours.append(log_likelihood(curvature, curvature @ log_map, prior))
        spread = prior + ERROR**2 * np.eye(len(EVERY)) + 1e4
        exact.append(multivariate_normal(cov=spread).logpdf(log_map))
    assert np.isclose(ours[1] - ours[0], exact[1] - exact[0], atol=1e-2)


def test_no_prior_shrinks_the_level() -> None:
    prior = covariance(np.full(SHARES, 0.01), EVERY, EVERY, SHAPE)
    curvature = np.eye(len(EVERY)) / ERROR**2
    level, pull, _ = told(curvature, curvature @ np.full(len(EVERY), 0.7), prior)
    assert np.isclose(level, 0.7)
    assert np.abs(prior @ pull).max() < 1e-6
