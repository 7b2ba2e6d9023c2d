"""A cause has one size: what differs from recording to recording bears its name, but is something else.

A name that is not the effect's own takes of every recording what it can, and that is another part in each; in
a form that is not quite right it keeps nearly the same size.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import FLIPS
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.candidates import PLAIN
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import HOLD
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import OWN_SHARE, SIZES_DIFFER
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights
from lerobot_vtrefine.tactile.stages.host import Latency

Array = np.ndarray
DRAWN_ANEW = (Latency.name, HOLD)
"""Causes whose size may be random; how far recordings' starts scatter is asked by itself."""


def sizes_differ(
    presses: PressSet, fitted: Fit, weights: Sequence[TrialWeights], seed: int
) -> list[Suspicion]:
    """For every cause whether its size differs between recordings, beside a gain and a touch of their own.

    Maps have no size, and a latency or frames that are held may have another in each.
    """
    names = [name for name in fitted.model.families if name in PLAIN and name not in DRAWN_ANEW]
    found = [_differs(presses, fitted, weights, name, seed) for name in names]
    return [item for item in found if item is not None]


def _differs(
    presses: PressSet, fitted: Fit, weights: Sequence[TrialWeights], name: str, seed: int
) -> Suspicion | None:
    """From recordings' scores for a size of their own, which noise would give either sign in every taxel.

    None where a recording's gain and touch might be nearly all of it, for these scatter by themselves.
    """
    rng = np.random.default_rng([seed, 10])
    without = predict(fitted.model.minus(name), presses)
    drawn, scores, information = np.zeros((len(weights), FLIPS + 1)), *np.zeros((2, len(weights)))
    whole = 0.0
    pairs = zip(weights, fitted.residuals(presses), fitted.signals, without, strict=True)
    for k, (weight, residual, signal, other) in enumerate(pairs):
        effect = weight.whiten(signal - other)
        along = weight.nuisance @ (weight.coupling @ (weight.nuisance.T @ effect))
        taxels = ((effect - along) * weight.whiten(residual)).reshape(signal.shape).sum(axis=0)
        information[k] = effect @ (effect - along)
        whole += float(effect @ effect)
        signs = 2.0 * rng.integers(0, 2, (FLIPS + 1, len(taxels)), dtype=np.int8) - 1.0
        signs[0] = 1.0
        drawn[k] = signs @ taxels
    told = information > 1e-6 * information.sum()
    if told.sum() < 2 or information.sum() < OWN_SHARE * whole:
        return None
    known, sums = information[told], drawn[told]
    powers = (sums**2 / known[:, None]).sum(axis=0)
    scores[told] = sums[:, 0] ** 2 / known
    freedom = float(known.sum() - (known**2).sum() / known.sum())
    scatter = float(np.sqrt(max(powers[0] - powers[1:].mean(), 0.0) / freedom))
    clue = f"the size of {name} differs from recording to recording by {100 * scatter:.0f} %"
    return Suspicion(0, clue, scatter, SIZES_DIFFER, scores, drawn=powers)
