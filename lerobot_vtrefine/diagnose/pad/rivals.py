"""Rivals: causes that explain the recordings as well as the ones that were named."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from lerobot_vtrefine.diagnose.pad.crossvalidation import Score, agree
from lerobot_vtrefine.diagnose.pad.experiments import next_experiment
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.noise import Noise
from lerobot_vtrefine.diagnose.pad.parallel import on_all_cores
from lerobot_vtrefine.diagnose.pad.score_test import Probe
from lerobot_vtrefine.diagnose.pad.search import Search, all_probes
from lerobot_vtrefine.diagnose.pad.selection import (
    MAPS,
    RICH,
    add,
    coordinates_of,
    elaborate,
    scored,
    take_away,
)

TIE_P = 0.1
NEARLY = 0.6
"""Part of the named cause's gain that a rival's plain form must reach for its other forms to be tried."""


@dataclass(frozen=True)
class Rivals:
    """Groups of names that the recordings cannot tell apart, and the experiment that would."""

    groups: tuple[tuple[str, ...], ...] = ()
    experiment: dict[str, Any] | None = None


def find_ambiguities(search: Search, fitted: Fit, noise: Noise) -> Rivals:
    """Try every rival in place of every named cause; ties are those whose paired scores are not worse."""
    full = scored(search, fitted)
    groups: list[tuple[str, ...]] = []
    experiment = None
    for name in fitted.model.families:
        rivals = sorted(search.rivals.get(name, set()) - set(fitted.model.families) - set(MAPS))
        if not rivals or name in MAPS:
            continue
        slim = take_away(search, fitted, name)
        probes, less = all_probes(search, slim, rivals), scored(search, slim)
        # A rich form imitates much: a rival may have one only if what was named has.
        richest = max(coordinates_of(fitted, name), RICH)
        best = partial(_in_place, search, slim, probes, less, NEARLY * full.gain_over(less), richest)
        tied = []
        for rival, (other, score) in zip(rivals, on_all_cores(best, rivals), strict=True):
            # Weights forgive much that plain errors do not, where a model is far off: both must be as good.
            worse = (full.better_by(score), score.squares - full.squares)
            if not any(agree(differences, search.seed, TIE_P) for differences in worse):
                tied.append((rival, other))
        if tied:
            groups.append((name, *(rival for rival, _ in tied)))
            if experiment is None:
                names = (name, tied[0][0])
                experiment = next_experiment(fitted.model, tied[0][1].model, search.presses, noise, names)
    return Rivals(tuple(groups), experiment)


def _in_place(
    search: Search, slim: Fit, probes: Sequence[Probe], less: Score, needed: float, richest: int, rival: str
) -> tuple[Fit, Score]:
    """The best fit with a rival; in other forms too if the plain one gains what is needed over `less`."""
    plain = add(search, slim, rival, probes)
    if plain[1].gain_over(less) <= needed:
        return plain
    return elaborate(search, slim, rival, probes, plain, richest)
