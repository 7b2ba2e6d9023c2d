"""What changes from one recording to the next: faces that lie otherwise, and what a place bore before."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_engine_gain_drift import SCATTER, pressed

from lerobot_vtrefine.diagnose.core.rules import SIZE_DOUBT
from lerobot_vtrefine.diagnose.core.suspicion import confirmed
from lerobot_vtrefine.diagnose.pad.own_face import leaning_face
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.recording_scatter import Deviations, _standardised
from lerobot_vtrefine.diagnose.pad.suspicions import between_recordings


def test_noise_is_not_doubted_with_the_scatter_of_recordings() -> None:
    """Two deviations that noise tells apart badly have unit variance where a rig scatters that far."""
    rng = np.random.default_rng(1)
    gram = np.array([[1.5, 0.6], [0.6, 4.0]])
    own = SIZE_DOUBT * rng.standard_normal((20_000, 2))
    along = own @ gram + rng.standard_normal((20_000, 2)) @ np.linalg.cholesky(gram).T
    scores = np.array([_standardised(gram, one) for one in along])
    assert np.allclose(scores.std(axis=0), 1.0, atol=0.02)
    # A recording in which noise is larger than the scatter does not tell it.
    assert not _standardised(0.1 * gram, along[0])[0]


def faces(count: int = 16) -> tuple[np.ndarray, np.ndarray, SimpleNamespace]:
    """Leans of faces (K, 2) [mrad], what they make of places (K,) [10 um], and presses there."""
    rng = np.random.default_rng(2)
    places = rng.uniform(-0.02, 0.02, (count, 2))
    leans = rng.standard_normal((count, 2))
    on = np.array([True, False])
    presses = [
        SimpleNamespace(touching=on, trial=SimpleNamespace(x_m=np.array([x, 0.0]), y_m=np.array([y, 0.0])))
        for x, y in places
    ]
    return leans, (leans * places).sum(axis=1) / 0.01, SimpleNamespace(loaded=False, presses=presses)


@pytest.mark.parametrize("alike", [True, False])
def test_a_face_that_lies_otherwise_in_each_is_told_from_indenters_that_lean(alike) -> None:
    leans, expected, presses = faces()
    touches = np.random.default_rng(3).standard_normal(len(leans)) + alike * expected
    sizes = np.column_stack([np.zeros((len(leans), 2)), touches, leans])
    own = Deviations(np.zeros(sizes.shape), sizes, np.full(5, 0.2), [])
    item = leaning_face(own, presses)
    assert item is not None
    assert bool(confirmed([item], 0)) == alike
    assert leaning_face(own, SimpleNamespace(loaded=True)) is None


@pytest.mark.parametrize("softer", [True, False])
def test_a_cover_that_has_not_recovered_from_earlier_recordings_is_seen(softer) -> None:
    """Taxels read the less, the harder and the later earlier recordings pressed them."""
    presses = pressed(0.5 * SCATTER)
    changed = []
    for press in presses.presses:
        borne = press.trial.borne
        assert borne is not None
        fresh = (borne.drive / 5e-4 * np.exp(-borne.age_s / 60.0)).sum(axis=0).ravel()[press.taxels]
        changed.append(replace(press, signal=press.signal * (1.0 - softer * 0.1 * np.minimum(fresh, 1.0))))
    problem, now = PadProblem(replace(presses, presses=tuple(changed))).weighed(None)
    clues = [alarm.clue for alarm in confirmed(between_recordings(problem, now), 0)]
    assert any("earlier recordings pressed" in clue for clue in clues) == softer
