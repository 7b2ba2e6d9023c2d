"""Which names survive another locked draw, and half of the recordings."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.api import diagnose
from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.recordings import RecordingSet

Diagnose = Callable[[RecordingSet, int], Diagnosis]


@dataclass(frozen=True)
class Stability:
    """In how many of `count` repetitions each name was given: those of the verdict, and others that came.

    Names count whatever their role, and so do those of a tie.
    """

    count: int
    named: tuple[str, ...]
    """By the verdict itself."""
    draws: dict[str, int]
    """With other locked recordings, folds and resampling."""
    halves: dict[str, int]
    """With a random half of the recordings."""
    statuses: tuple[str, ...]
    """Of the draws, then of the halves."""

    def line(self, title: Callable[[str], str]) -> str:
        """For people."""
        names = dict.fromkeys((*self.named, *self.draws, *self.halves))
        counts = [
            f"{title(name)}{'' if name in self.named else ' (not in the verdict)'} "
            f"{self.draws.get(name, 0)} and {self.halves.get(name, 0)}"
            for name in names
        ]
        kinds = ", ".join(f"{status} {count}" for status, count in Counter(self.statuses).items())
        counts = counts or ["no name in any"]
        return f"of {self.count} other draws and {self.count} halves: {'; '.join(counts)} ({kinds})"


def stability(
    recordings: RecordingSet, found: Diagnosis, count: int, seed: int, again: Diagnose = diagnose
) -> Stability:
    """Diagnose again: `count` times with other seeds, and `count` times with half of the recordings.

    Args:
        found: the diagnosis whose names are asked about.
        seed: that it was made with.
        again: what diagnoses.
    """
    draws = [again(recordings, seed + number) for number in range(1, count + 1)]
    halves = [again(half(recordings, seed + number), seed) for number in range(1, count + 1)]
    return Stability(
        count,
        _names(found),
        dict(Counter(name for item in draws for name in _names(item))),
        dict(Counter(name for item in halves for name in _names(item))),
        tuple(item.verdict.status for item in (*draws, *halves)),
    )


def half(recordings: RecordingSet, seed: int) -> RecordingSet:
    """Half of the recordings, in the order in which they were made."""
    total = len(recordings.trials)
    kept = np.sort(np.random.default_rng([seed, 2]).permutation(total)[: (total + 1) // 2])
    return replace(recordings, trials=tuple(recordings.trials[index] for index in kept))


def _names(found: Diagnosis) -> tuple[str, ...]:
    ties = (name for group in found.verdict.ambiguous_with for name in group)
    return tuple(dict.fromkeys((*(cause.name for cause in found.verdict.causes), *ties)))
