"""Which candidates could be there, before any is fitted: effective scores of whole trials, signs flipped.

A score is the inner product of a candidate's tangent, cleared of what the present model's parameters can do,
with the residual (Hemerik, Goeman & Finos 2020). Under the null it is as often positive as negative in every
trial, whatever the noise inside it looks like; all candidates are judged together by the smallest p
(Westfall & Young 1993). Shapes: T trials.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import norm

from lerobot_vtrefine.diagnose.core.resampling import sign_matrix
from lerobot_vtrefine.diagnose.core.rules import ALPHA, FEW_FOR_SIGNS, SCREEN_ALPHA, SCREEN_SHARES, SIZE_DOUBT

Array = np.ndarray


@dataclass(frozen=True)
class Probe:
    """A guess of an effect near its null, with the scores that trials give it.

    Attributes:
        form, values: what was guessed, as the instrument has it.
        scores: (T,) effective score of every trial.
        information: (T,) effective information: the score that the probe itself would give.
        products: (T, T) products between trials, whose sum is the statistic where it is quadratic in the
            signs; None where the sum of the scores is.
        products_scatter: standard deviation of that sum without an effect, as the fitted noise has it.
        observed: seen in the readings themselves: nothing is tested, so there is no p-value.
    """

    name: str
    form: Any
    values: Array
    scores: Array
    information: Array
    one_sided: bool
    observed: bool = False
    products: Array | None = None
    products_scatter: float = 0.0

    @property
    def size(self) -> float:
        """Estimated size in units of the probe."""
        total = float(self.information.sum())
        return float(self.scores.sum()) / total if total > 0 else 0.0

    @property
    def carriers(self) -> float:
        """How many trials of equal scores would be worth these; no bound where scores are no sum."""
        return np.inf if self.observed or self.products is not None else _effective_number(self.scores)

    @property
    def explained(self) -> float:
        """Decrease of the loss that the tangent promises; no bound for what is observed."""
        if self.observed:
            return np.inf
        total = float(self.information.sum())
        gain = float(self.scores.sum()) ** 2 / total if total > 0 else 0.0
        return 0.0 if self.one_sided and self.scores.sum() < 0 else gain


@dataclass(frozen=True)
class Tested:
    """A candidate's best probe with its p-value and the one adjusted over all candidates.

    Both are None for what is observed rather than tested.

    Attributes:
        by_size: the same by the size of its scores in their signs' place, where few of many trials carry it.
    """

    probe: Probe
    p_value: float | None
    p_adjusted: float | None
    by_size: "Tested | None" = None

    @property
    def passed(self) -> bool:
        """Whether it is to be fitted."""
        return self.p_adjusted is None or self.p_adjusted <= SCREEN_ALPHA


def cleared(grams: Array) -> tuple[Array, Array]:
    """From inner products of (own tangents..., change, residual) to effective scores and information (T,)."""
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


def flip_statistics(probes: Sequence[Probe], signs: Array) -> Array:
    """Standardised sums of scores under every flip: (B, number of probes); larger is stronger."""
    columns = []
    for probe in probes:
        if probe.products is not None:
            columns.append(((signs @ probe.products) * signs).sum(axis=1))
            continue
        length = np.sqrt(float((probe.scores**2).sum()))
        values = signs @ probe.scores / length if length > 0 else np.zeros(len(signs))
        columns.append(values if probe.one_sided else np.abs(values))
    return np.stack(columns, axis=1)


def tail_shares(statistics: Array) -> Array:
    """p-value of every entry within its own column (share of entries at least as large), same shape."""
    count = len(statistics)
    shares = np.empty_like(statistics)
    for j in range(statistics.shape[1]):
        column = np.round(statistics[:, j], 9)
        order = np.argsort(column)
        ordered = column[order]  # which are found faster in their own order than in another
        shares[order, j] = (count - np.searchsorted(ordered, ordered, side="left")) / count
    return shares


def screen(probes: Sequence[Probe], count: int, seed: int, *, sized: bool = True) -> dict[str, Tested]:
    """The best probe of every name with its p-value adjusted over all of them.

    Tests of two kinds share the error rate by a weighted Bonferroni rule (Holm 1979), each kind by its part
    in SCREEN_SHARES: sums of scores under flips of the trials' signs, judged together by the smallest p, and
    sums of products under the same flips. What is observed takes no part. Where nothing passes, sums that a
    few trials carry may do so by their size.

    Args:
        sized: whether scores are in deviations of noise; else their size tells nothing.
    """
    best: dict[str, Tested] = {}
    carried: list[tuple[Tested, bool]] = []
    kinds: dict[str, list[Probe]] = {}
    for probe in probes:
        kinds.setdefault(_kind(probe), []).append(probe)
    for probe in kinds.pop("observed", []):
        best[probe.name] = Tested(probe, None, None)
    whole = sum(SCREEN_SHARES[kind] for kind in kinds)
    signs = sign_matrix(count, seed)
    for kind, tested in kinds.items():
        names = len({probe.name for probe in tested})
        p_values, adjusted = _flip_p(tested, signs)
        for probe, p_value, together in zip(tested, p_values, adjusted, strict=True):
            least = min(together, names * size_p(probe)) if sized else together
            if too_few_agree(probe, p_value):
                together = least
            elif probe.carriers < FEW_FOR_SIGNS:
                weighty = Tested(probe, p_value, min(1.0, least * whole / SCREEN_SHARES[kind]))
                carried.append((weighty, few_carry(probe, p_value)))
            _keep(best, Tested(probe, p_value, min(1.0, together * whole / SCREEN_SHARES[kind])))
    by_size = _by_size(carried)
    best = {name: replace(item, by_size=by_size.get(name)) for name, item in best.items()}
    if not any(item.passed for item in best.values()):
        for item in by_size.values():
            _keep(best, item)
    return best


def _by_size(carried: Sequence[tuple[Tested, bool]]) -> dict[str, Tested]:
    """The best of every name by the size of what few trials carry; beside each whether its signs pass alone.

    Once one of these passes, something is there, and every other may be what it is: signs of a few trials
    cannot tell them apart, predictions can.
    """
    sure = any(item.passed for item, alone in carried if alone)
    best: dict[str, Tested] = {}
    for item, alone in carried:
        if alone or sure:
            _keep(best, item)
    return best


def _kind(probe: Probe) -> str:
    if probe.observed:
        return "observed"
    return "scores" if probe.products is None else "products"


def _flip_p(probes: Sequence[Probe], signs: Array) -> tuple[list[float], list[float]]:
    """p-value of every probe under the same flips, and the one adjusted by the smallest of all."""
    shares = tail_shares(flip_statistics(probes, signs))
    smallest = np.sort(shares.min(axis=1))
    adjusted = np.searchsorted(smallest, shares[0], side="right") / len(smallest)
    return shares[0].tolist(), adjusted.tolist()


def too_few_agree(probe: Probe, p_value: float) -> bool:
    """Whether all signs agree that a probe's statistic hangs on, and are too few to tell by themselves: those
    of all trials; where it is a sum of products, one more than there are pairs that have a say."""
    few = len(probe.scores) if probe.products is None else 1.0 + 0.5 * _effective_number(probe.products)
    return few < FEW_FOR_SIGNS and p_value <= 2.5 * 2.0 ** (1 - few)


def few_carry(probe: Probe, p_value: float) -> bool:
    """Whether a few of many trials carry a sum of scores, as where only the hardest presses show an effect.

    What the others say is next to nothing, and among many probes no flip of a few signs is rare enough. By
    itself the probe must pass all the same.
    """
    return probe.carriers < FEW_FOR_SIGNS and p_value <= ALPHA


def _effective_number(parts: Array) -> float:
    """How many equal parts a sum of such parts is worth."""
    return float(np.abs(parts).sum() ** 2 / max(np.square(parts).sum(), 1e-300))


def size_p(probe: Probe) -> float:
    """p-value from the scores' size against the noise, with a wide margin for what the noise model misses."""
    if probe.products is not None:
        return float(norm.sf(probe.products.sum() / (SIZE_DOUBT**2 * max(probe.products_scatter, 1e-12))))
    return float(2.0 * norm.sf(np.sqrt(max(probe.explained, 0.0)) / SIZE_DOUBT))


def _keep(best: dict[str, Tested], found: Tested) -> None:
    held = best.get(found.probe.name)
    if held is None or _rank(found) < _rank(held):
        best[found.probe.name] = found


def _rank(item: Tested) -> tuple[float, float]:
    """Most certain first, of equals the one that explains most."""
    return (0.0 if item.p_adjusted is None else item.p_adjusted, -item.probe.explained)
