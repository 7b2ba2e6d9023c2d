"""Whether one model predicts trials left out better than another (T trials)."""

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import OutOfFold
from lerobot_vtrefine.diagnose.core.problem import FormCandidate
from lerobot_vtrefine.diagnose.core.resampling import agree
from lerobot_vtrefine.diagnose.core.rules import AGREEMENT_P, CARRIED, FORM_P, LEAST_GAIN, SIZE_DOUBT

Array = np.ndarray


def preferable(
    candidate: FormCandidate, held: OutOfFold, than: OutOfFold, seed: int, *, few: bool = False
) -> bool:
    """Whether a form is to stand in for a plainer one; a peer if it is likelier, whatever little plain errors
    say, which hang on how hard and where each recording happened to touch, or surely so (1 %).

    Args:
        few: whether few trials say so by themselves.
    """
    if candidate.peer:
        likelier = held.better_by(than)
        small = held.gain_over(than) > -LEAST_GAIN
        return float(likelier.sum()) > 0 and (small or agree(likelier, seed, FORM_P))
    return clearly_better(held, than, seed, few=few)


def better(held: OutOfFold, than: OutOfFold, needed: float = 0.0) -> bool:
    """Whether a model that is no richer has both less error and the higher log score."""
    return held.gain_over(than) > needed and float(held.better_by(than).sum()) > 0


def clearly_better(
    held: OutOfFold, than: OutOfFold, seed: int, needed: float = LEAST_GAIN, *, few: bool = False
) -> bool:
    """Whether a richer model pays: so much less error, in most trials, or in the `few` that can tell."""
    if held.gain_over(than) <= needed:
        return False
    likelier = held.better_by(than)
    return agree(likelier, seed, AGREEMENT_P) or (few and few_suffice(likelier))


def few_suffice(likelier: Array) -> bool:
    """Whether the few trials that carry nearly all of what trials left out say (T,), in nats, agree, and are
    likelier by more than chance has without the best of them, too.

    Signs of so few cannot tell. Where nothing is there a ratio of likelihoods exceeds 1 / alpha with a chance
    of alpha at most (Ville 1939); errors may stray more than the noise model says.
    """
    order = np.argsort(-np.abs(likelier))
    share = np.abs(likelier[order]).cumsum() / max(float(np.abs(likelier).sum()), 1e-300)
    carriers = likelier[order[: int(np.searchsorted(share, CARRIED)) + 1]]
    least = SIZE_DOUBT**2 * np.log(1.0 / AGREEMENT_P)
    return bool((carriers > 0).all()) and float(likelier.sum() - likelier.max()) > least
