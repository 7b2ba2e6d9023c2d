"""Rivals: causes that explain the recordings as well as the ones that were named."""

from dataclasses import dataclass
from typing import Any

from lerobot_vtrefine.diagnose.crossvalidation import agree
from lerobot_vtrefine.diagnose.experiments import next_experiment
from lerobot_vtrefine.diagnose.fitting import Fit
from lerobot_vtrefine.diagnose.noise import Noise
from lerobot_vtrefine.diagnose.selection import MAPS, Search, add, all_probes, elaborate, scored, take_away

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
        probes, less = all_probes(search, slim), scored(search, slim)
        tied = []
        for rival in rivals:
            other, score = add(search, slim, rival, probes)
            if score.gain_over(less) > NEARLY * full.gain_over(less):
                other, score = elaborate(search, slim, rival, probes, (other, score))
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
