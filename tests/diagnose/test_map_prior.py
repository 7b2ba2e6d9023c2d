"""Maps over taxels whose deviations are shared: by lines, by blotches, by the whole pad."""

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.pad.map_prior import SHARES, covariance, likeliest_variances, told
from lerobot_vtrefine.diagnose.pad.taxel_maps import MapEvidence, solve_map

SHAPE = (8, 12)
EVERY = np.arange(SHAPE[0] * SHAPE[1])
ROWS, COLS = np.divmod(EVERY, SHAPE[1])
ERROR = 0.02
"""Standard error of a taxel's logarithm after one press."""


def evidence(log_map: np.ndarray, pressed: np.ndarray) -> MapEvidence:
    """One recording that tells the pressed taxels."""
    rng = np.random.default_rng(1)
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
    found, _ = solve_map(evidence(log_map, pressed), [0], np.zeros(len(EVERY)), ())
    left = (found - log_map)[~pressed]
    assert np.abs(left).max() < 0.02 < 0.2 * np.abs(log_map).max()


def test_gains_of_single_taxels_say_nothing_about_others() -> None:
    log_map = 0.2 * np.random.default_rng(5).standard_normal(len(EVERY))
    pressed = (ROWS + COLS) % 2 == 0
    found, variances = solve_map(evidence(log_map, pressed), [0], np.zeros(len(EVERY)), ())
    assert np.isclose(np.sqrt(sum(variances)), 0.2, rtol=0.3)
    assert np.abs(found - log_map)[pressed].std() < 1.2 * ERROR
    assert found[~pressed].std() < 0.06


def test_no_prior_shrinks_the_level() -> None:
    prior = covariance(np.full(SHARES, 0.01), EVERY, EVERY, SHAPE)
    curvature = np.eye(len(EVERY)) / ERROR**2
    level, pull, _ = told(curvature, curvature @ np.full(len(EVERY), 0.7), prior)
    assert np.isclose(level, 0.7)
    assert np.abs(prior @ pull).max() < 1e-6
