"""The engine's statistics against tiny independent references."""

import os
import subprocess
import sys

import numpy as np
import pytest
from test_engine_forward import presses

from lerobot_vtrefine.diagnose.core.heldout import lock
from lerobot_vtrefine.diagnose.core.score_test import Probe, cleared, screen
from lerobot_vtrefine.diagnose.pad.baseline import plain_weights
from lerobot_vtrefine.diagnose.pad.noise import Noise
from lerobot_vtrefine.diagnose.pad.weights import build_weights, in_deviations


def probe(name: str, scores: np.ndarray, one_sided: bool = False) -> Probe:
    return Probe(name, None, np.ones(1), scores, np.ones(len(scores)), one_sided)


def test_flips_find_scores_that_agree_in_sign_and_no_others() -> None:
    rng = np.random.default_rng(0)
    agree, noise = 1.0 + 0.3 * rng.standard_normal(18), rng.standard_normal(18)
    found = screen([probe("a", agree), probe("b", noise)], 18, 0)
    assert found["a"].p_adjusted < 0.001
    assert found["b"].p_adjusted > 0.05


def test_one_sided_candidates_ignore_the_wrong_sign() -> None:
    scores = -1.0 - 0.1 * np.arange(12.0)
    found = screen([probe("one", scores, True), probe("two", scores)], 12, 0)
    assert found["one"].p_value > 0.99
    assert found["two"].p_value < 0.002


def test_family_wise_error_is_kept() -> None:
    rng = np.random.default_rng(1)
    wrong = 0
    for round_ in range(60):
        # Heavy tails and unequal variances, as recordings have them.
        scores = rng.standard_t(3, (8, 16)) * rng.uniform(0.2, 5.0, 16)
        found = screen([probe(str(k), row) for k, row in enumerate(scores)], 16, round_)
        wrong += min(item.p_adjusted for item in found.values()) <= 0.1
    assert wrong <= 12  # 6 expected; 12 has a chance of one percent


def test_effective_scores_do_not_move_when_own_parameters_do() -> None:
    rng = np.random.default_rng(2)
    own, change, noise = rng.standard_normal((3, 6, 50))
    total = sum(o @ o for o in own)
    along = sum(o @ c for o, c in zip(own, change, strict=True)) / total

    def scores(residual: np.ndarray) -> np.ndarray:
        columns = np.stack([own, change, residual], axis=-1)
        return cleared(np.einsum("kti,ktj->kij", columns, columns))[0]

    assert np.allclose(scores(noise), ((change - along * own) * noise).sum(axis=1))
    assert scores(noise + 3.0 * own).sum() == pytest.approx(scores(noise).sum())


def test_weights_are_the_inverse_covariance() -> None:
    rng = np.random.default_rng(3)
    signal, tangent = np.abs(rng.standard_normal((7, 1))) * 50, rng.standard_normal((7, 1)) * 1e5
    noise = Noise(floor=1.5, growth=0.02, rho=0.4, gain=0.01, offset_m=1e-5)
    weight = build_weights(noise, [signal], [tangent])[0]
    sigma = noise.sigma(signal).ravel()
    memory = 0.4 ** np.abs(np.subtract.outer(np.arange(7), np.arange(7)))
    shared = 0.01 * signal, 1e-5 * tangent
    covariance = np.outer(sigma, sigma) * memory + sum(d @ d.T for d in shared)
    images = rng.standard_normal((2, 7, 1))
    vectors = np.stack([weight.whiten(image) for image in images])
    flat = images.reshape(2, 7)
    inverse = flat @ np.linalg.inv(covariance) @ flat.T
    assert np.allclose(weight.gram(vectors), inverse)
    assert np.allclose(weight.products(vectors, vectors[0]), [*inverse[0], inverse[0, 0]])
    assert in_deviations([weight])
    assert not in_deviations(plain_weights(presses()))


@pytest.mark.parametrize(("conditions", "replicates"), [(8, 2), (12, 2), (4, 2), (24, 1), (2, 4)])
def test_a_quarter_is_locked_partly_from_conditions_never_discovered(
    conditions: int, replicates: int
) -> None:
    names = [f"c{i}" for i in range(conditions) for _ in range(replicates)]
    locked = lock(names, 7)
    assert len(names) / 4 <= len(locked) < len(names) / 2
    seen = {name for i, name in enumerate(names) if i not in locked}
    if conditions >= 8:
        assert {names[i] for i in locked} - seen
    if conditions <= 4:
        assert len(seen) == conditions
    assert lock(names, 7) == locked
    assert {tuple(lock(names, seed)) for seed in range(5)} != {tuple(locked)}


def test_few_recordings_lock_few() -> None:
    assert lock(["a", "b", "c"], 0) == []
    assert len(lock(["a", "b", "c", "d"], 0)) == 1


WITHIN = """
import numpy as np
from lerobot_vtrefine.diagnose.pad.noise import Noise, fit_repeatability

names = [f"press {k // 2}" for k in range(600)]
gains = np.random.default_rng(0).normal(size=600) * 0.03
print(fit_repeatability(Noise(1.0, 0.0, 0.5, 0.02, 1e-4), gains, 1e-4 * gains, names))
"""


def test_sums_over_conditions_do_not_depend_on_how_names_are_hashed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    other = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"
    done = subprocess.run(
        [sys.executable, "-c", WITHIN],
        env=os.environ | {"PYTHONHASHSEED": other},
        capture_output=True,
        text=True,
        check=True,
    )
    exec(WITHIN, {})
    assert capsys.readouterr().out == done.stdout
