"""Which causes could be there: effective scores of whole recordings, tested by flipping their signs.

A score is the inner product of a candidate's tangent, cleared of what the present model's parameters can do,
with the residual (Hemerik, Goeman & Finos 2020). Under the null it is as often positive as negative in every
recording, whatever the noise inside it looks like; all candidates are judged together by the smallest p
(Westfall & Young 1993).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict
from lerobot_vtrefine.diagnose.pad.forward_model.run import Prefix
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

FLIPS = 9999
ALPHA = 0.05
"""Chance that any candidate passes the screening where none is there; it must then predict better, too."""
FEW = 10
"""With fewer recordings than this, signs alone cannot reach significance: size counts as well."""
DOUBT = 2.0
"""Factor by which scores may stray more than the fitted noise says, where their size counts."""
SHARES = {"scores": 0.7, "products": 0.2, "order": 0.1}
"""Parts of the error rate that kinds of tests get; where one is missing, the others share its part."""


@dataclass(frozen=True)
class Probe:
    """A guess of an effect near its null, with the scores that recordings give it.

    Attributes:
        scores: (K,) effective score of every recording.
        information: (K,) effective information: the score that the probe itself would give.
        products: (K, K) products between recordings, whose sum is the statistic where it is quadratic in the
            signs; None where the sum of the scores is.
        products_scatter: standard deviation of that sum without an effect, as the fitted noise has it.
        permuted: p-value found by permuting the session's order, in place of flips.
        observed: seen in the readings themselves: nothing is tested, so there is no p-value.
    """

    name: str
    form: Form | None
    values: np.ndarray
    scores: np.ndarray
    information: np.ndarray
    one_sided: bool
    permuted: float | None = None
    observed: bool = False
    products: np.ndarray | None = None
    products_scatter: float = 0.0

    @property
    def size(self) -> float:
        """Estimated size in units of the probe."""
        total = float(self.information.sum())
        return float(self.scores.sum()) / total if total > 0 else 0.0

    @property
    def explained(self) -> float:
        """Decrease of the loss that the tangent promises."""
        total = float(self.information.sum())
        gain = float(self.scores.sum()) ** 2 / total if total > 0 else 0.0
        return 0.0 if self.one_sided and self.scores.sum() < 0 else gain


@dataclass(frozen=True)
class Screened:
    """A candidate's best probe with its p-value and the one adjusted over all candidates.

    Both are None for what is observed rather than tested.
    """

    probe: Probe
    p_value: float | None
    p_adjusted: float | None

    @property
    def passed(self) -> bool:
        """Whether it is to be refitted."""
        return self.p_adjusted is None or self.p_adjusted <= ALPHA


def cleared(grams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From inner products of (own tangents..., change, residual) to effective scores and information (K,)."""
    total = grams.sum(axis=0)
    own = slice(0, total.shape[0] - 2)
    scale = np.sqrt(np.diag(total)[own].clip(min=1e-30))
    block = total[own, own] / np.outer(scale, scale)
    along = np.linalg.lstsq(block, total[own, -2] / scale, rcond=1e-9)[0] / scale
    scores = grams[:, -2, -1] - grams[:, own, -1] @ along
    information = (
        grams[:, -2, -2]
        - 2 * grams[:, own, -2] @ along
        + np.einsum("i,kij,j->k", along, grams[:, own, own], along)
    )
    return scores, np.maximum(information, 0.0)


class Scorer:
    """Scores any change of the expected signals against one fitted model."""

    def __init__(
        self,
        fitted: Fit,
        presses: PressSet,
        weights: Sequence[TrialWeights],
        columns: Sequence[Sequence[np.ndarray]],
    ) -> None:
        self.fitted, self.presses, self.weights = fitted, presses, weights
        self._prefix = Prefix()
        predict(fitted.model, presses, self._prefix)
        self._prefix.frozen = True
        self._fixed = []
        for k, (press, weight) in enumerate(zip(presses.presses, weights, strict=True)):
            vectors = [weight.whiten(column[k]) for column in columns]
            vectors.append(weight.whiten(press.signal - fitted.signals[k]))
            self._fixed.append(np.stack(vectors))
        self._known = [weight.gram(fixed) for weight, fixed in zip(weights, self._fixed, strict=True)]

    def change(self, form: Form, values: np.ndarray) -> list[np.ndarray]:
        """What adding a form does to the expected signals: (T, n) per recording."""
        moved = predict(self.fitted.model.plus(form, values), self.presses, self._prefix)
        return [a - b for a, b in zip(moved, self.fitted.signals, strict=True)]

    def grams(self, change: Sequence[np.ndarray]) -> np.ndarray:
        """Inner products of (own tangents, the change, residual): (K, q, q)."""
        grams = []
        for k, (fixed, known, weight) in enumerate(zip(self._fixed, self._known, self.weights, strict=True)):
            products = weight.products(fixed, weight.whiten(change[k]))
            last = len(products) - 2
            order = [*range(last), last + 1, last]
            gram = np.empty((last + 2, last + 2))
            gram[:-1, :-1] = known
            gram[-1] = gram[:, -1] = products
            grams.append(gram[np.ix_(order, order)])
        return np.array(grams)

    def score(self, change: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Effective scores and information (K,) of a change (T, n) per recording."""
        return cleared(self.grams(change))


def probe_form(form: Form, scorer: Scorer) -> list[Probe]:
    """Scores of all probes of a form."""
    probes = []
    for guess in form.probes(scorer.fitted.model.setting):
        values = np.asarray(guess, dtype=float)
        scores, information = scorer.score(scorer.change(form, values))
        probes.append(Probe(form.family, form, values, scores, information, not form.signed))
    return probes


def flip_signs(count: int, seed: int) -> np.ndarray:
    """(F, K) signs, the first row without flips: all there are, or as many at random as there may be."""
    if 2**count <= FLIPS + 1:
        return 1.0 - 2.0 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
    rng = np.random.default_rng([seed, 1])
    signs = rng.integers(0, 2, (FLIPS + 1, count)) * 2.0 - 1.0
    signs[0] = 1.0
    return signs


def flip_statistics(probes: Sequence[Probe], signs: np.ndarray) -> np.ndarray:
    """Standardised sums of scores under every flip: (F, number of probes); larger is stronger."""
    columns = []
    for probe in probes:
        if probe.products is not None:
            columns.append(((signs @ probe.products) * signs).sum(axis=1))
            continue
        length = np.sqrt(float((probe.scores**2).sum()))
        values = signs @ probe.scores / length if length > 0 else np.zeros(len(signs))
        columns.append(values if probe.one_sided else np.abs(values))
    return np.stack(columns, axis=1)


def tail_shares(statistics: np.ndarray) -> np.ndarray:
    """p-value of every entry within its own column (share of entries at least as large), same shape."""
    count = len(statistics)
    shares = np.empty_like(statistics)
    for j in range(statistics.shape[1]):
        column = np.round(statistics[:, j], 9)
        ordered = np.sort(column)
        shares[:, j] = (count - np.searchsorted(ordered, column, side="left")) / count
    return shares


def screen(probes: Sequence[Probe], count: int, seed: int) -> dict[str, Screened]:
    """The best probe of every name with its p-value adjusted over all of them.

    Tests of three kinds share the error rate by a weighted Bonferroni rule (Holm 1979), each kind by its part
    in SHARES: sums of scores under flips of the recordings' signs, judged together by the smallest p; sums of
    products under the same flips; permutations of the session's order. What is observed takes no part.
    """
    best: dict[str, Screened] = {}
    kinds: dict[str, list[Probe]] = {}
    for probe in probes:
        kinds.setdefault(_kind(probe), []).append(probe)
    observed = kinds.pop("observed", [])
    whole = sum(SHARES[kind] for kind in kinds)
    signs = flip_signs(count, seed)
    for kind, tested in kinds.items():
        names = len({probe.name for probe in tested})
        p_values, adjusted = _order_p(tested) if kind == "order" else _flip_p(tested, signs)
        for probe, p_value, together in zip(tested, p_values, adjusted, strict=True):
            if kind != "order" and count < FEW and p_value <= 2.5 * 2.0 ** (1 - count):
                together = min(together, names * size_p(probe))
            _keep(best, Screened(probe, p_value, min(1.0, together * whole / SHARES[kind])))
    for probe in observed:
        best[probe.name] = Screened(probe, None, None)
    return best


def _kind(probe: Probe) -> str:
    if probe.observed:
        return "observed"
    if probe.permuted is not None:
        return "order"
    return "scores" if probe.products is None else "products"


def _flip_p(probes: Sequence[Probe], signs: np.ndarray) -> tuple[list[float], list[float]]:
    """p-value of every probe under the same flips, and the one adjusted by the smallest of all."""
    shares = tail_shares(flip_statistics(probes, signs))
    smallest = np.sort(shares.min(axis=1))
    adjusted = np.searchsorted(smallest, shares[0], side="right") / len(smallest)
    return shares[0].tolist(), adjusted.tolist()


def _order_p(probes: Sequence[Probe]) -> tuple[list[float], list[float]]:
    """The same of probes that were permuted already, each by itself."""
    p_values = [probe.permuted for probe in probes if probe.permuted is not None]
    return p_values, [min(1.0, len(probes) * p_value) for p_value in p_values]


def size_p(probe: Probe) -> float:
    """p-value from the scores' size against the noise, with a wide margin for what the noise model misses."""
    if probe.products is not None:
        return float(norm.sf(probe.products.sum() / (DOUBT**2 * max(probe.products_scatter, 1e-12))))
    return float(2.0 * norm.sf(np.sqrt(max(probe.explained, 0.0)) / DOUBT))


def _keep(best: dict[str, Screened], found: Screened) -> None:
    held = best.get(found.probe.name)
    if held is None or _rank(found) < _rank(held):
        best[found.probe.name] = found


def _rank(item: Screened) -> tuple[float, float]:
    """Most certain first, of equals the one that explains most."""
    return (0.0 if item.p_adjusted is None else item.p_adjusted, -item.probe.explained)
