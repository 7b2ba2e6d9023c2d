"""Every recording with its own delay: where starts deviate, a latency that differs may be why.

Beside the mean delay some recordings are early, so their scores share no sign, and what is left in the others
passes for something else. So every recording is moved to when its readings say that it was made, and causes
are looked for once more (`review`). A latency that is found then is one of all recordings; where none is, the
starts keep their alarm.

Only the choice of causes and their sizes know the recordings' own delays. Users get the mean one, and what
it gains is measured on recordings as they are. Shapes: K recordings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.gain_drift import standardised
from lerobot_vtrefine.diagnose.pad.motion import motion, resampled
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.rules import DELAY_COURSE, MIN_RECORDINGS
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights
from lerobot_vtrefine.diagnose.verdict import Parameter
from lerobot_vtrefine.tactile.layout import PadLayout

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

TURNS = 3
"""Steps from the recorded clock, and again from the delays under what was then found."""
FARTHEST_S = 0.02
"""Change of a recording's delay in one step, up to which its tangent is believed."""
WIDEST_S = 0.1
"""Prior deviation of delays: a recording that tells nothing of its own has the mean one [s]."""


def timed(problem: "PadProblem", fitted: Fit) -> tuple["PadProblem", Fit]:
    """Recordings moved to their most probable clocks under a model, and its fit there."""
    for _ in range(TURNS):
        late = later_by(problem.presses, fitted, problem.weights)
        known = np.array(problem.presses.delays_s or np.zeros(len(late)))
        problem, fitted = problem.with_delays(known + late).fitted_as(fitted.model)
    return problem, fitted


def later_by(presses: PressSet, fitted: Fit, weights: Sequence[TrialWeights]) -> np.ndarray:
    """How much later than all on average every recording was read (K,) [s], one step on."""
    found = []
    for press, signal, weight in zip(presses.presses, fitted.signals, weights, strict=True):
        step = np.maximum(np.gradient(press.time_s), 1e-6)[:, None]
        images = (-np.gradient(signal, axis=0) / step, press.signal - signal)
        gram = weight.gram(weight.whiten(np.stack(images)))
        found.append(gram[0, 1] / (gram[0, 0] + WIDEST_S**-2))
    return np.clip(found - np.mean(found), -FARTHEST_S, FARTHEST_S)


def moved(presses: PressSet, delays_s: np.ndarray) -> PressSet:
    """The presses, each made as much later as its readings (K,) are than those of all on average [s]."""
    delays_s = delays_s - delays_s.mean()
    every = zip(presses.presses, delays_s, strict=True)
    each = tuple(_moved(press, float(delay_s)) for press, delay_s in every)
    return replace(presses, presses=each, delays_s=tuple(delays_s.tolist()))


def _moved(press: Press, delay_s: float) -> Press:
    trial, layout = press.trial, press.layout
    made = resampled(trial, trial.time_s - delay_s)
    made = replace(made, time_s=trial.time_s, temperature_c=trial.temperature_c, raw=trial.raw)
    if press.loaded:
        # Shares of a load need the whole pad.
        whole = PadLayout(layout.full_rows, layout.full_cols, layout.pitch_m)
        drive, rate = (layout.cut(image) for image in motion(made, whole, made.time_s))
    else:
        drive, rate = motion(made, layout, made.time_s)
    return replace(press, trial=made, drive=drive, rate=rate)


def follow_session(presses: PressSet) -> Suspicion | None:
    """Whether recordings' own delays rise or fall through the session: then they are not drawn by chance, and
    their mean is not the next recording's.

    Order is what is permuted. Conditions have no part in a delay, so every recording counts by itself.
    """
    course = standardised(np.array([press.trial.start_s for press in presses.presses]))
    if len(presses.delays_s) < MIN_RECORDINGS or not course.any():
        return None
    delays_s = np.array(presses.delays_s) - np.mean(presses.delays_s)
    slope_s = float(delays_s @ course) / len(course)
    share = slope_s**2 / max(float(np.mean(delays_s**2)), 1e-18)
    way = "later and later" if slope_s > 0 else "earlier and earlier"
    change_ms = 1e3 * abs(slope_s) * float(np.ptp(course))
    clue = f"readings come {way} through the session, by {change_ms:.0f} ms in all"
    return Suspicion(0, clue, share, DELAY_COURSE, delays_s, True, course, family="delays")


def with_spread(found: Mapping[str, Parameter], delays_s: Sequence[float]) -> dict[str, Parameter]:
    """A latency's parameters with the spread of delays, by which their mean is known less well."""
    count, spread_s = len(delays_s), float(np.std(delays_s, ddof=1))
    low, high = (spread_s * float(np.sqrt((count - 1) / chi2.ppf(q, count - 1))) for q in (0.975, 0.025))
    spread = Parameter(spread_s, (low, high), "s")
    mean = found["tau_s"]
    if isinstance(mean.ci95, tuple) and isinstance(mean.value, float):
        error, value = 1.96 * spread_s / np.sqrt(count), mean.value
        low, high = (float(np.hypot(end - value, error)) for end in mean.ci95)
        mean = replace(mean, ci95=(max(value - low, 0.0), value + high))
    return {**found, "tau_s": mean, "spread_s": spread}
