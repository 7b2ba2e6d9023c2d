"""Directions that no name covers, each in the place of a named cause.

A name that is right predicts recordings left out better than such a direction does, whatever its form. Where
one of them predicts better, the name is borrowed: it took the part of something else's effect that it could.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.core.rules import FLIPS, SHARE_OF_GAIN, SIZE_DOUBT
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.descriptors import DESCRIPTORS, Descriptor, directions, errors_left_out
from lerobot_vtrefine.diagnose.pad.fitting import Fit, bounded_step, movable, predict
from lerobot_vtrefine.diagnose.pad.form_fitting import without
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.screening import GAIN_MAP, scorer_of
from lerobot_vtrefine.diagnose.pad.uneven_face import UnevenFace

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

Array = np.ndarray


def in_place_of_names(problem: "PadProblem", fitted: Fit) -> list[Suspicion]:
    """For every named cause the best direction in its place; one that belongs to the cause's own kind of
    effect says something about its form, not about its name."""
    found = [_in_place(problem, fitted, name) for name in fitted.model.families]
    if fitted.model.gain_map is not None:
        found.append(_in_place_of_gains(problem, fitted))
    return [item for item in found if item is not None]


def _in_place_of_gains(problem: "PadProblem", fitted: Fit) -> Suspicion | None:
    """A map of first touches in the place of one of gains: a face that is uneven, or lies on something, reads
    more or less at some taxels, too.

    Around the model that has neither, weights overrate the flanks of presses, and gains that are told there
    mislead wherever taxels are pressed deep. So both are judged by their own fits, as all names are.
    """
    if problem.presses.loaded:
        return None
    slim = without(fitted, [GAIN_MAP], problem.presses, problem.weights)
    before = out_of_fold(problem, slim, problem.folds)
    own = out_of_fold(problem, fitted, problem.folds).better_by(before)
    face = UnevenFace.told(problem, slim)
    best = face.scores() - before.scores[:, 0]
    apart = 0.0
    for weight, here, there in zip(problem.weights, fitted.signals, face.now.signals, strict=True):
        apart += float(weight.gram(weight.whiten(here - there)[None])[0, 0])
    clue = f"in the place of {GAIN_MAP}, first touches of the taxels' own predict trials left out better"
    found = _borrowed(problem, clue, best, own, apart)
    # One question about one name: among dozens that are asked of every pad, it would drown.
    return None if found is None else replace(found, family="maps")


def _borrowed(problem: "PadProblem", clue: str, best: Array, own: Array, apart: float) -> Suspicion | None:
    """A decoy's gains (K,) in log score against those of the name, if it gains anything.

    What recordings prefer together has a deviation of its own under the noise: how far apart the two predict
    (Cox 1962), `apart` being the squared distance in deviations of noise. Signs could not tell: among all
    that alarms ask about, a dozen recordings are too few even where each of them prefers the decoy, and where
    some hold nothing that tells the two apart, a little misfit of the decoy's form decides their signs.
    """
    if best.sum() <= 0:
        return None
    far = float((best - own).sum()) / np.sqrt(max(apart, 1e-12)) / SIZE_DOUBT
    drawn = np.r_[far, np.random.default_rng([problem.seed, 9]).standard_normal(FLIPS)]
    lead = 1.0 - float(own.sum() / best.sum())
    return Suspicion(0, clue, lead, 1.0 - SHARE_OF_GAIN, best - own, drawn=drawn)


def _in_place(problem: "PadProblem", fitted: Fit, name: str) -> Suspicion | None:
    slim = without(fitted, [name], problem.presses, problem.weights)
    before = out_of_fold(problem, slim, problem.folds)
    own = out_of_fold(problem, fitted, problem.folds).better_by(before)
    promising = list(_promising(problem, slim, name, SHARE_OF_GAIN * float(own.sum())))
    gains = [_left_out(problem, slim, image, grams) - before.scores[:, 0] for _, image, grams in promising]
    if not gains:
        return None
    best = _chosen_by_others(np.array(gains), problem.folds)
    descriptor, image, grams = promising[int(np.argmax(np.sum(gains, axis=1)))]
    model, much = _beside(slim, grams.sum(axis=0), movable(slim))
    decoy = zip(predict(model, problem.presses), image, strict=True)
    pairs = zip(problem.weights, decoy, fitted.signals, strict=True)
    between = [(weight, weight.whiten(one + much * along - other)) for weight, (one, along), other in pairs]
    apart = sum(float(weight.gram(distance[None])[0, 0]) for weight, distance in between)
    clue = f"in the place of {name}, {descriptor.text} predicts trials left out better"
    return _borrowed(problem, clue, best, own, apart)


def _chosen_by_others(gains: Array, folds: Array) -> Array:
    """Gain (K,) of every recording by the decoy that the other folds gain most by, of gains (D, K): one that
    it chose itself would look better than it is."""
    found = np.empty(len(folds))
    for fold in np.unique(folds):
        held = folds == fold
        found[held] = gains[gains[:, ~held].sum(axis=1).argmax(), held]
    return found


def _promising(
    problem: "PadProblem", slim: Fit, name: str, enough: float
) -> Iterator[tuple[Descriptor, list[Array], Array]]:
    """Decoys that gain enough where the model touches, with their directions and inner products.

    One that resembles a touch gains far less once every recording has its own.
    """
    scorer = scorer_of(problem, slim)
    for decoy in DESCRIPTORS:
        image = directions(decoy, problem.presses, slim)
        if image is None or name in decoy.owners:
            continue
        grams = scorer.grams(image)
        last = grams.shape[1] - 1
        less, more = (float(errors_left_out(grams, problem.folds, terms).sum()) for terms in (last - 1, last))
        if 0.5 * (less - more) > max(enough, 0.0):
            yield decoy, image, grams


def _left_out(problem: "PadProblem", slim: Fit, image: Sequence[Array], grams: Array) -> Array:
    """Log score (K,) of every recording under fits to the other folds, a direction being one more coordinate.

    Names are judged after one bounded step and at the recordings' own touches; so is what stands in for them.

    Args:
        grams: (K, q, q) inner products of the movable coordinates' tangents, the direction and the residual.
    """
    scores, free, again = np.empty(len(image)), movable(slim), problem.reweighted(slim)
    for fold in np.unique(problem.folds):
        held = problem.folds == fold
        model, much = _beside(slim, grams[~held].sum(axis=0), free)
        trials = np.flatnonzero(held)
        part = problem.presses.subset(trials.tolist())
        pressed = zip(part.presses, trials, strict=True)
        part = replace(part, presses=tuple(replace(p, signal=p.signal - much * image[k]) for p, k in pressed))
        scores[held] = again.log_scores_of(model, part, (~held).astype(float), trials)[:, 0]
    return scores


def _beside(slim: Fit, gram: Array, free: Array) -> tuple[Composite, float]:
    """The model one bounded step on with a direction beside it, and how much of the direction.

    Args:
        gram: (q, q) as in `_left_out`, of the recordings that count.
    """
    along = np.delete(gram[-2], -2)
    power = max(float(gram[-2, -2]), 1e-30)
    others = np.delete(np.delete(gram, -2, 0), -2, 1) - np.outer(along, along) / power
    model = slim.model.at(bounded_step(slim.model, others, free, 1e-6))
    return model, (along[-1] - along[:-1] @ (model.values - slim.model.values)[free]) / power
