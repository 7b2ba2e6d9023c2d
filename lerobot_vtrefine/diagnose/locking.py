"""Which recordings are locked away for the final number before anything is fitted."""

import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

SHARE = 0.25
MIN_DISCOVERY = 3
WHOLE_FROM = 6
"""Number of conditions from which on whole conditions are locked as well."""


def lock(conditions: Sequence[str], seed: int) -> list[int]:
    """Numbers of the locked recordings: at least a quarter, about half of them from conditions that discovery
    does not see, the others replicates of conditions that it does. Empty if too few would be left.

    Args:
        conditions: condition of every recording.
    """
    count = len(conditions)
    wanted = math.ceil(SHARE * count)
    if count - wanted < MIN_DISCOVERY:
        wanted = max(count - MIN_DISCOVERY, 0)
    rng = np.random.default_rng([seed, 0])
    groups: dict[str, list[int]] = defaultdict(list)
    for index, name in enumerate(conditions):
        groups[name].append(index)
    names = [sorted(groups)[i] for i in rng.permutation(len(groups))]
    locked: list[int] = []
    if len(groups) >= WHOLE_FROM:
        for name in names:
            if len(locked) + len(groups[name]) <= max(wanted // 2, 1):
                locked += groups.pop(name)
    while len(locked) < wanted:
        # From the condition with most recordings left, so that each keeps one for as long as possible.
        name = max((n for n in names if groups.get(n)), key=lambda n: len(groups[n]))
        locked.append(groups[name].pop(int(rng.integers(len(groups[name])))))
    return sorted(locked)
