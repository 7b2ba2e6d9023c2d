"""Every recording with its own first touch: how its readings are scored, and fits for sizes and models.

Recordings of one command first touch some micrometres apart. Fits allow for that by a direction in each
recording's metric, taken where the model touches. For a kink that is not enough: a recording that touches
earlier reads something where the model and its tangents read nothing, so that fits lean towards the earliest
recordings. Here the linearisation is around each recording's most probable touch instead (first-order
conditional estimation: Lindstrom & Bates 1990, Biometrics 46, 673). Shapes: K recordings.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.pad.baseline import offset_tangents
from lerobot_vtrefine.diagnose.pad.fitting import Fit, bounded_step, predict, rest
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.noise import Noise
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights, build_weights, whiten

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

TURNS, TOUCH_STEPS = 6, 2
MOST_STEPS = 5
"""Steps from the recorded touch."""
PROMISED = 0.5
"""Decrease of a recording's squared error, in variances of noise, for which no further step is taken: models
are compared by whole units."""
STEP_M = 2e-6
"""Step of the touch's tangent, that of a contact offset's coordinate: the two are one direction."""
FARTHEST_M = 2e-5
"""Change of a recording's touch in one step, up to which its tangent is believed."""
SETTLED = 0.01
"""Squared step, in standard errors of the coordinates, at which the turns end."""
WORSE = 1.001
"""Factor by which a turn may raise the loss: kinks move, and readings near them with these."""


def with_own_touch(problem: "PadProblem", fitted: Fit) -> tuple["PadProblem", Fit]:
    """The fit, and the problem in which it stands: presses that each touch where they did, with readings as
    they would be without that.

    Both stay as they are where no depth is known, where the search's weights had to be given up, and beside
    what is told from the readings themselves.
    """
    noise, model = problem.noise, fitted.model
    observed = any(form.range is not None for form in model.forms)
    if noise is None or not allowed(problem.presses, problem.weights) or observed:
        return problem, fitted
    touches = np.zeros(len(problem.presses.presses))
    best: tuple[PadProblem, Fit] | None = None
    for _ in range(TURNS):
        for _ in range(TOUCH_STEPS):
            touches, _, _ = _step(model, problem.presses, noise, touches)
        around, now = _linearised(problem, model, noise, touches)
        if best is not None and now.loss > WORSE * best[1].loss:
            break
        best, gram = (around, now), now.grams.sum(axis=0)
        model = model.at(bounded_step(model, gram, model.free, 1e-6))
        moved = (model.values - now.model.values)[model.free]
        if moved @ gram[:-1, :-1] @ moved < SETTLED:
            break
    return best or (problem, fitted)


def allowed(presses: PressSet, weights: Sequence[TrialWeights]) -> bool:
    """Whether recordings have touches of their own: depth is known, and the weights forgive them."""
    return not presses.loaded and weights[0].nuisance.shape[1] > 1


def touches_of(model: Composite, presses: PressSet, noise: Noise) -> np.ndarray:
    """Most probable touches (K,) [m] under a model: positive where the face was met later."""
    return _most_probable(model, presses, noise)[0]


def losses_at_own_touch(model: Composite, presses: PressSet, noise: Noise) -> np.ndarray:
    """Weighted squared error of every recording (K,), the least over its own gain and touch."""
    return _most_probable(model, presses, noise)[1]


def _most_probable(model: Composite, presses: PressSet, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Every recording's touch and loss (K,).

    Readings near a touch have kinks, so that a step may lead past the least loss, and the next one back. Such
    a recording halves its way, for a loss that is not the least differs from one model to the next by more
    than models do.
    """
    there = np.zeros(len(presses.presses))
    best = np.full((3, len(there)), np.inf)
    for _ in range(MOST_STEPS):
        onward, losses, promised = _step(model, presses, noise, there)
        lower = losses < best[1]
        best = np.where(lower, [there, losses, promised], best)
        if not (best[2] > PROMISED).any():
            break
        there = np.where(lower, onward, 0.5 * (best[0] + there))
    return best[0], best[1]


def _step(
    model: Composite, presses: PressSet, noise: Noise, touches: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Touches one step on, the losses here, and by how much the step should lower them (K,)."""
    signals, slopes = _at(model, presses, touches)
    found, memory = [], noise.memory
    for press, signal, slope, touch in zip(presses.presses, signals, slopes, touches, strict=True):
        sigma, deviation = noise.sigma(signal), touch / noise.offset_m
        images = (press.signal - signal, signal * noise.gain, slope * noise.offset_m)
        left, gain, late = whiten(np.stack(images), sigma, memory)
        loss = left @ left - (gain @ left) ** 2 / (1.0 + gain @ gain) + deviation**2
        directions, left = np.stack([gain, late], axis=1), left + late * deviation
        along = directions.T @ left
        own = np.linalg.solve(np.eye(2) + directions.T @ directions, along)
        onward = np.clip(own[1] * noise.offset_m, touch - FARTHEST_M, touch + FARTHEST_M)
        found.append((onward, loss, loss - (left @ left - along @ own)))
    onward, losses, lowered = np.array(found).T
    return onward, losses, lowered


def _linearised(
    problem: "PadProblem", model: Composite, noise: Noise, touches: np.ndarray
) -> tuple["PadProblem", Fit]:
    """The problem around those touches, and the model as it stands in it."""
    signals, slopes = _at(model, problem.presses, touches)
    every = zip(problem.presses.presses, slopes, touches, strict=True)
    presses = _touching_at(
        problem.presses,
        touches,
        tuple(replace(press, signal=press.signal + slope * touch) for press, slope, touch in every),
    )
    around = replace(problem, presses=presses, weights=tuple(build_weights(noise, signals, slopes)))
    return around, rest(model, presses, around.weights)


def _at(
    model: Composite, presses: PressSet, touches: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Expected signals (T, n) of presses with their own touches, and their change per metre of touch."""
    moved = _touching_at(presses, touches, presses.presses)
    signals = predict(model, moved)
    slopes = offset_tangents(model, moved, signals, STEP_M)
    assert slopes is not None
    return signals, slopes


def _touching_at(presses: PressSet, touches: np.ndarray, adjusted: tuple[Press, ...]) -> PressSet:
    """The presses, adjusted or not, with touches of their own."""
    return replace(
        presses, presses=adjusted, recorded=presses, touches_m=tuple(touches.tolist()), face_m=None
    )
