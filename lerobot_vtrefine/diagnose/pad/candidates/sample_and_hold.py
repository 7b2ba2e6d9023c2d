"""sample_and_hold: the host repeats old frames until a new one arrives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.repeated_frames import Rhythm, row_groups
from lerobot_vtrefine.diagnose.pad.rules import (
    CHANCE,
    CONTRADICTED,
    HELD_ROWS,
    MANY_TAXELS,
    MIN_HELD,
    MIN_REPEATED,
    MIN_TELLING,
    RARITY,
    SURE_MOVE,
    VISIBLE,
)
from lerobot_vtrefine.tactile.stages.host import SampleAndHold

HOLD = "sample_and_hold"
TWO_COUNTS = 2.8
"""Roots of a number (1.96 times that of two) by which two counts of it differ by chance once in twenty times:
which frames contradict a free board's period depends on how well its recordings' instants are known."""
MAX_FRAMES = 12.0
"""Longest period looked for, in frames."""


def rhythms(presses: PressSet, groups: tuple[int, ...] = ()) -> list[Rhythm]:
    """When readings were new, of every press, or of every group of its rows."""
    return [part for press in presses.presses for part in press.rhythm.parts(groups)]


def repeated_share(presses: PressSet) -> float:
    """Share of frames on the pad that repeat the one before, reading for reading."""
    return _repeated(rhythms(presses))


def _repeated(known: Sequence[Rhythm]) -> float:
    repeats = sum(int((rhythm.telling & ~rhythm.fresh).sum()) for rhythm in known)
    moves = sum(int(rhythm.telling.sum()) for rhythm in known)
    return repeats / moves if moves else 0.0


def held(presses: PressSet) -> bool:
    """Whether more frames repeat the one before than noise and rounding make by chance."""
    shares = [share for press in presses.presses if (share := _repeats(press)) is not None]
    if not shares:
        return False
    seen, by_chance = np.mean(shares, axis=0)
    return bool(seen > MIN_HELD and by_chance < CHANCE * seen)


def could_be_held(presses: PressSet) -> bool:
    """Whether frames or rows repeat, or would without showing it: what never repeats is not held, however
    late it is."""
    frames = [share for press in presses.presses if (share := _repeats(press)) is not None]
    rows = [share for press in presses.presses for mask in _rows(press) if (share := _repeats(press, mask))]
    if not frames:
        return True
    seen = [float(np.mean([share for share, _ in shares])) if shares else 0.0 for shares in (frames, rows)]
    return seen[0] > MIN_HELD or seen[1] > HELD_ROWS


def shortest_period(presses: PressSet, frame_s: float) -> float | None:
    """Mean time between new readings from which on `held` sees it [s]; None where repeats tell nothing."""
    shares = [share for press in presses.presses if (share := _repeats(press)) is not None]
    if not shares:
        return None
    seen = max(MIN_HELD, float(np.mean([chance for _, chance in shares])) / CHANCE)
    return frame_s / (1.0 - seen) if seen < 1.0 else None


def held_rows(presses: PressSet) -> Suspicion | None:
    """Whether rows repeat by themselves, while others change: a board that refreshes them in turn. None where
    no row has taxels enough to tell."""
    found = [
        share
        for press in presses.presses
        for mask in _rows(press)
        if mask.sum() >= MANY_TAXELS and (share := _repeats(press, mask)) is not None
    ]
    if not found:
        return None
    seen, by_chance = np.mean(found, axis=0)
    sure = by_chance < CHANCE * seen
    text = f"rows repeat the frame before in {100 * seen:.0f} % of their frames while others change"
    return Suspicion(0, text, float(seen) if sure else 0.0, HELD_ROWS)


def _rows(press: Press) -> list[np.ndarray]:
    """Masks (n,) of the scored taxels of every row."""
    row = press.taxels // press.layout.full_cols
    return [row == number for number in np.unique(row)]


def _repeats(press: Press, taxels: np.ndarray | None = None) -> tuple[float, float] | None:
    """Share of frames under load that repeat the one before, and what share would by chance; None if unknown.

    Of all scored taxels, or of those in a mask (n,).

    By chance all taxels repeat together as often as each does while others change. Few taxels say little of
    each other: then frames count in which the motion alone changes readings by far more than noise.
    """
    press = press.whole or press
    changed = np.diff(press.signal, axis=0) != 0.0
    changed = changed if taxels is None else changed[:, taxels]
    use = press.rhythm.telling[1:] & _driven(press)
    few = changed.shape[1] < MANY_TAXELS
    if few:
        use = use & _moving(press)
    changed = changed[use]
    fresh = changed.any(axis=1)
    if len(fresh) < MIN_TELLING or not fresh.any():
        return None
    same = float(np.prod(1.0 - changed[fresh].mean(axis=0)))
    return float(1.0 - fresh.mean()), 0.0 if few else same


def _driven(press: Press) -> np.ndarray:
    """Steps (T-1,) in which some drive changes visibly: readings under a still indenter may well repeat."""
    drive = np.maximum(press.drive, 0.0)
    steps = np.abs(np.diff(drive, axis=0)).max(axis=(1, 2))
    return steps > VISIBLE * max(float(drive.max()), 1e-12)


def _moving(press: Press) -> np.ndarray:
    """Steps (T-1,) in which the drive moves so much that the reading must."""
    steps = np.abs(np.diff(np.maximum(press.drive, 0.0).sum(axis=(1, 2))))
    jumps = np.abs(np.diff(press.signal, axis=0)).max(axis=1)
    still = steps < 1e-3 * max(float(steps.max()), 1e-12)
    noise = float(np.std(jumps[still])) + float(np.mean(jumps[still])) if still.sum() > MIN_TELLING else 1.0
    fast = (
        steps > np.quantile(steps[steps > 0], 0.5) if (steps > 0).any() else np.zeros(len(steps), dtype=bool)
    )
    usual = float(np.median(jumps[fast & (jumps > 0)])) if (fast & (jumps > 0)).any() else 0.0
    return fast if usual > SURE_MOVE * max(noise, 1e-9) else np.zeros(len(steps), dtype=bool)


@dataclass(frozen=True)
class Pattern:
    """How readings repeat: seconds between new ones, and whether these come free of the trial's start."""

    period_s: float
    free: bool


def pattern(presses: PressSet, frame_s: float) -> Pattern | None:
    """The rhythm in which readings repeat bit for bit; None where none explains the repeats.

    Readings with noise do not repeat by chance, and where a single quiet taxel's do, not in step.
    """
    known = rhythms(presses)
    return next((found for free in (False, True) if (found := _pattern(known, frame_s, free))), None)


def _pattern(known: Sequence[Rhythm], frame_s: float, free: bool) -> Pattern | None:
    if _repeated(known) < MIN_REPEATED:
        return None
    period_s = float(np.mean(_best(known, frame_s, free)))
    return Pattern(period_s, free) if contradicted(known, period_s, free) < CONTRADICTED else None


def groups_apart(presses: PressSet, frame_s: float) -> tuple[int, ...]:
    """Number of every row's group where groups repeat apart, all with one period but each from an instant of
    its own; none where whole frames repeat with it, or none explains what rows do."""
    shares = [share for press in presses.presses for mask in _rows(press) if (share := _repeats(press, mask))]
    seen, by_chance = np.mean(shares, axis=0) if shares else (0.0, 0.0)
    if seen < MIN_REPEATED or by_chance > CHANCE * seen:
        return ()
    whole, groups = rhythms(presses), row_groups(rhythms(presses))
    found = _pattern(rhythms(presses, groups), frame_s, True) if max(groups, default=0) > 0 else None
    return groups if found and contradicted(whole, found.period_s, True) > CONTRADICTED else ()


def _best(known: Sequence[Rhythm], frame_s: float, free: bool) -> tuple[float, float]:
    """Ends of the periods, about as long as new readings are rare, that are contradicted least [s]."""
    guess = frame_s / max(1.0 - _repeated(known), 1.0 / MAX_FRAMES)
    grid = guess * np.exp(np.linspace(-RARITY, RARITY, 160))
    wrong = [contradicted(known, float(period), free) for period in grid]
    finer = grid[int(np.argmin(wrong))] * np.exp(np.linspace(-0.004, 0.004, 61))
    return alike(known, finer, free)


def contradicted(known: Sequence[Rhythm], period_s: float, free: bool) -> float:
    """Largest share in which the frames speak against a period."""
    counts = np.sum([rhythm.against(period_s, free) for rhythm in known], axis=0)
    due, changed, changes, repeats, late = np.maximum(counts, [1.0, 0.0, 1.0, 1.0, 0.0])
    return float(max(changed / due, changed / changes, late / repeats / 3.0))


def alike(
    known: Sequence[Rhythm], grid: np.ndarray, free: bool = False, scatter: float = 0.0
) -> tuple[float, float]:
    """Ends of the periods, of a rising grid, whose pattern of new readings fits the recorded one best [s], or
    is contradicted by more frames by so many roots of their number alone."""
    sums = [sum(rhythm.against(float(period), free) for rhythm in known) for period in grid]
    error = np.array([float(np.asarray(counts)[[1, 4]].sum()) for counts in sums])
    best = np.flatnonzero(error <= error.min() + 0.5 + scatter * np.sqrt(error.min()))
    spacing = grid[1] / grid[0]
    return float(grid[best].min() / spacing), float(grid[best].max() * spacing)


def periods(presses: PressSet, frame_s: float) -> list[list[float]]:
    """Periods whose pattern of new readings fits the recorded one best, and whole numbers of frames [s]."""
    plain = [[count * frame_s * 1.0001] for count in (2.0, 3.0, 4.0, 5.0)]
    if repeated_share(presses) < 0.05:
        return plain
    grid = frame_s * np.exp(np.linspace(np.log(1.05), np.log(MAX_FRAMES), 1500))
    return [*_between(*alike(rhythms(presses), grid)), *plain]


def frame_periods(presses: PressSet, frame_s: float) -> list[list[float]]:
    """The same, as close as the frames of whole recordings tell: many periods go by in one [s]."""
    coarse = periods(presses, frame_s)
    if repeated_share(presses) < MIN_HELD:
        return coarse
    guess, _ = _best(rhythms(presses), frame_s, False)
    finer = guess * np.exp(np.linspace(-0.003, 0.003, 601))
    return _between(*alike(rhythms(presses), finer))


def free_periods(presses: PressSet, frame_s: float) -> list[list[float]]:
    """Periods that fit best if new readings come free of the trials' starts [s]."""
    return _between(*_best(rhythms(presses), frame_s, True))


def periods_apart(presses: PressSet, frame_s: float) -> list[list[float]]:
    """The middle of those of groups of rows [s]."""
    groups = row_groups(rhythms(presses))
    return [[float(np.mean(_best(rhythms(presses, groups), frame_s, True)))]]


def _between(low: float, high: float) -> list[list[float]]:
    """Periods that repeat the same frames differ in when, between them, the readings were taken."""
    inside = [[float(period)] for period in np.linspace(low, high, 9)]
    whole = [[round(end, digits)] for end in (low, high) for digits in (2, 3)]
    return [*inside, *(period for period in whole if low <= period[0] <= high)]


def irregular_periods(presses: PressSet, frame_s: float) -> list[list[float]]:
    """Mean time between new readings; read at the frame, or before it [s]."""
    period_s = frame_s / max(1.0 - repeated_share(presses), 1.0 / MAX_FRAMES)
    return [[period_s, lag] for lag in (0.0, 0.5 * frame_s)]


def _mean_period(values: np.ndarray, presses: PressSet) -> dict[str, tuple[float, float]]:
    """The mean period's own scatter between recordings."""
    shares = []
    for press in presses.presses:
        telling = int(press.rhythm.telling.sum())
        if telling >= MIN_TELLING:
            shares.append(float((press.rhythm.telling & press.rhythm.fresh).sum()) / telling)
    known = np.array(shares)
    error = 1.96 * float(known.std(ddof=1)) / np.sqrt(len(known)) if len(known) > 1 else 0.5
    part = min(error / max(float(known.mean()), 1e-3), 0.9) if len(known) else 0.9
    return {"period_s": (float(values[0]) / (1.0 + part), float(values[0]) / (1.0 - part))}


def undecided(
    free: bool, apart: bool = False
) -> Callable[[np.ndarray, PressSet], dict[str, tuple[float, float]]]:
    """Periods that repeat the same frames as the best one does: nothing recorded tells them apart."""

    def ends(values: np.ndarray, presses: PressSet) -> dict[str, tuple[float, float]]:
        best = float(values[0])
        reach, count = (0.003, 121) if free else (0.05, 2001)
        groups = row_groups(rhythms(presses)) if apart else ()
        grid = best * np.exp(np.linspace(-reach, reach, count))
        low, high = alike(rhythms(presses, groups), grid, free, TWO_COUNTS * free)
        return {"period_s": (min(low, best), max(high, best))}

    return ends


def _repeating(setting: Setting) -> bool:
    return setting.repeats and not setting.row_groups


def _apart(label: str, *, at_frames: bool) -> Form:
    """Groups of rows with one period, each new from an instant of its own in every recording."""
    return Form(
        HOLD,
        f"groups of rows, each free of the others, {label}",
        (Value("period_s", 1e-3, 2.0, 0.0),),
        lambda v, s: (
            SampleAndHold(
                float(v[0]), free=True, frame_s=s.frame_s if at_frames else 0.0, groups=s.row_groups
            ),
        ),
        lambda v, s: {"period_s": (float(v[0]), "s"), "groups": (float(max(s.row_groups) + 1), "1")},
        lambda s: [[2.0001 * s.frame_s]],
        amplitude=None,
        possible=lambda s: bool(s.row_groups),
        search=periods_apart,
        range=undecided(True, apart=True),
        screened=False,
        peer=True,
    )


FORMS = (
    Form(
        HOLD,
        "fixed period",
        (Value("period_s", 1e-3, 2.0, 0.0),),
        lambda v, s: (SampleAndHold(float(v[0])),),
        lambda v, s: {"period_s": (float(v[0]), "s")},
        lambda s: [[2.0001 * s.frame_s], [3.0001 * s.frame_s], [5.0001 * s.frame_s]],
        kinds=("timing",),
        needs="record every frame with its own time, moving, with readings that carry noise",
        amplitude=None,
        possible=_repeating,
        search=periods,
        range=undecided(False),
    ),
    Form(
        HOLD,
        "fixed period, free of the trial's start",
        (Value("period_s", 1e-3, 2.0, 0.0),),
        lambda v, s: (SampleAndHold(float(v[0]), free=True),),
        lambda v, s: {"period_s": (float(v[0]), "s")},
        lambda s: [[2.0001 * s.frame_s]],
        amplitude=None,
        possible=_repeating,
        search=free_periods,
        range=undecided(True),
        screened=False,
    ),
    Form(
        HOLD,
        "fixed period, read at the frames",
        (Value("period_s", 1e-3, 2.0, 0.0),),
        lambda v, s: (SampleAndHold(float(v[0]), frame_s=s.frame_s),),
        lambda v, s: {"period_s": (float(v[0]), "s")},
        lambda s: [[2.0001 * s.frame_s]],
        amplitude=None,
        possible=_repeating,
        search=frame_periods,
        range=undecided(False),
        screened=False,
    ),
    _apart("read at the frames", at_frames=True),
    _apart("read on their own clock", at_frames=False),
    Form(
        HOLD,
        "irregular periods",
        (Value("period_s", 1e-3, 2.0, 0.0), Value("lag_s", 0.0, 0.1, 1e-3)),
        lambda v, s: (SampleAndHold(float(v[0]), ages_s=s.ages_s, lag_s=max(float(v[1]), 0.0)),),
        lambda v, s: {"period_s": (float(v[0]), "s")},
        lambda s: [[2.0 * s.frame_s, 0.0]],
        amplitude=None,
        possible=_repeating,
        search=irregular_periods,
        range=_mean_period,
        screened=False,
    ),
)
