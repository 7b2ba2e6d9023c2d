"""What may be left on a servo: it repeats with the command, where commands were repeated."""

from itertools import combinations

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import LEAST_UNKNOWN, REPEATS, REPEATS_ALL
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.rules import ALARM_STEP, MIN_REPEATED

Array = np.ndarray


def repeating(bench: Bench, residual: Array, baseline_mse: float, encoder_step: float) -> list[Suspicion]:
    """Residuals (N, T) of trials of one command, frame by frame multiplied: noise cancels, causes do not."""
    scores, squares = np.zeros(len(bench.files)), []
    for pairs in repeated(bench):
        products, sizes = zip(*(_of_pair(bench, residual, *pair) for pair in pairs), strict=True)
        scores[pairs[0][0]] = np.mean(products)
        squares.append(np.mean(sizes))
    rows = scores[scores != 0]
    if len(rows) < MIN_REPEATED:
        return []
    left = float(np.mean(squares))
    share = float(rows.mean()) / max(left, 1e-300)
    worth = max((ALARM_STEP * encoder_step) ** 2, LEAST_UNKNOWN * baseline_mse) / max(left, 1e-300)
    clue = "what is left repeats when the command is repeated"
    if share > REPEATS_ALL and rows.min() > 0:
        return [Suspicion(0, clue, share, max(REPEATS_ALL, worth))]
    return [Suspicion(0, clue, share, max(REPEATS, worth), scores)]


def repeated(bench: Bench) -> list[list[tuple[int, int]]]:
    """Pairs of trials with the same setting and command, per condition that has any."""
    kinds = list(zip(bench.recorded, bench.settings, strict=True))
    found = []
    for kind in dict.fromkeys(kinds):
        trials = [trial for trial, own in enumerate(kinds) if own == kind]
        found.append([pair for pair in combinations(trials, 2) if _alike(bench, *pair)])
    return [pairs for pairs in found if pairs]


def _alike(bench: Bench, a: int, b: int) -> bool:
    both = bench.valid[:, a] & bench.valid[:, b]
    courses = (bench.time_s, bench.command, bench.torque_on)
    return bool(both.any()) and all(np.allclose(c[both, a], c[both, b], atol=1e-6) for c in courses)


def _of_pair(bench: Bench, residual: Array, a: int, b: int) -> tuple[float, float]:
    """Mean product of two trials' residuals, and their mean square."""
    both = bench.valid[:, a] & bench.valid[:, b]
    one, other = residual[both, a], residual[both, b]
    return float(np.mean(one * other)), float(np.mean(one**2 + other**2) / 2)
