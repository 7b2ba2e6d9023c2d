"""What press recordings excite, and whether stiffness, damping and readout follow from them.

Shapes: K recordings.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.wording import plural

MIN_RECORDINGS = 4
"""Recordings that resampling needs to say anything about uncertainty."""
DEPTH_RATIO = 1.3
"""Peaks of the presses (or loads) must differ by this factor."""
SPEED_RATIO = 1.5
"""Slow and fast motion, each a tenth of the way travelled in contact, must differ by this factor."""
MAX_CLIPPED = 0.5
"""Share of the pressed readings that may stand at the converter's limit."""
STEADY_SPEED = 0.05
"""Below this share of the fastest motion an indenter counts as holding still."""


@dataclass(frozen=True)
class Excitation:
    """Facts about K recordings."""

    recordings: int
    loaded: bool
    """Driven by the load cell alone."""
    has_force: bool
    """Whether some recording has depth and load."""
    peaks: np.ndarray
    """Deepest penetration [m], or largest load [N], of every recording (K,)."""
    speeds_m_s: tuple[float, float]
    """Slow and fast motion in contact; zeros when driven by the load."""
    idle_frames: int
    """Frames without contact that the idle level rests on."""
    clipped: float
    """Share of the pressed readings at the converter's limit."""
    response: float
    """Correlation of the readings with the drive over all pressed taxels."""


def excitation(presses: PressSet) -> Excitation:
    """Facts about the recordings in a set."""
    every = presses.presses
    loads = [press.trial.force_n for press in every]
    if presses.loaded:
        peaks = [float(np.max(load)) if load is not None else 0.0 for load in loads]
    else:
        peaks = [float(press.drive.max()) for press in every]
    drive = np.concatenate([np.maximum(press.drive[:, press.scored], 0.0).ravel() for press in every])
    signal = np.concatenate([press.signal.ravel() for press in every])
    level = np.concatenate([np.broadcast_to(press.idle, press.signal.shape).ravel() for press in every])
    pressed = drive > 0
    clipped = (signal + level)[pressed] >= presses.full_scale - 0.5
    return Excitation(
        recordings=len(every),
        loaded=presses.loaded,
        has_force=not presses.loaded and any(load is not None and np.isfinite(load).all() for load in loads),
        peaks=np.array(peaks),
        speeds_m_s=(0.0, 0.0) if presses.loaded else _speeds(every),
        idle_frames=presses.idle.frames,
        clipped=float(clipped.mean()) if len(clipped) else 0.0,
        response=_correlation(drive, signal),
    )


def problems(found: Excitation, *, damping: bool, stiffness: bool) -> list[str]:
    """What keeps the parameters from being identified, each with what to record; empty if nothing does.

    Args:
        damping: whether k_d is to be fitted.
        stiffness: whether k_n is to be fitted, rather than given or left out.
    """
    if not (found.peaks > 0).any():
        return ["the indenter never touches the pad: check depth_m, x_m and y_m"]
    said = []
    if found.recordings < MIN_RECORDINGS:
        usable = plural(found.recordings, "usable recording")
        said.append(f"no uncertainty from {usable}: record at least {MIN_RECORDINGS}")
    if found.loaded and (damping or stiffness):
        said.append(
            "without depth_m the model's output is the load itself, so k_n and k_d do not follow: record"
            " depth_m beside force_n, or fit the path from force to reading alone with --readout_only"
        )
    if not found.loaded and stiffness and not found.has_force:
        said.append(
            "without force_n only the product gain * k_n follows: record force_n (a load cell), or give the"
            " stiffness with --k_n=VALUE"
        )
    said += _variety(found, damping)
    if found.idle_frames == 0:
        said.append(
            "no frame is without contact, so the idle level is unknown: begin every press above the pad"
        )
    if found.clipped > MAX_CLIPPED:
        said.append(
            f"{100 * found.clipped:.0f} % of the pressed readings stand at full scale: press less deep"
        )
    if not found.response > 0.1:
        said.append("the readings do not rise with the press: check the wiring and which pad was recorded")
    return said


def _variety(found: Excitation, damping: bool) -> list[str]:
    said = []
    low, high = float(found.peaks[found.peaks > 0].min()), float(found.peaks.max())
    if high < DEPTH_RATIO * low:
        what = f"reach {high:.2g} N" if found.loaded else f"reach {1e3 * high:.2f} mm"
        more = "loads" if found.loaded else "depths"
        said.append(
            f"all presses {what}, which cannot tell proportional from not: record at least three {more}"
        )
    slow, fast = found.speeds_m_s
    if damping and not found.loaded and fast < SPEED_RATIO * slow:
        said.append(
            f"all presses move at {1e3 * fast:.2g} mm/s, so k_d is not identifiable: record some at a third"
            " and some at three times that speed, or leave k_d out with --static"
        )
    return said


def _speeds(presses: tuple[Press, ...]) -> tuple[float, float]:
    """Speeds below and above which a tenth of the way in contact is travelled [m/s]."""
    speeds, ways = [], []
    for press in presses:
        deepest = press.drive.reshape(len(press.drive), -1).argmax(axis=1)
        rate = np.abs(press.rate.reshape(len(press.rate), -1)[np.arange(len(deepest)), deepest])
        rate = rate[press.touching]
        speeds.append(rate)
        ways.append(rate * np.gradient(press.trial.time_s)[press.touching] if len(rate) else rate)
    speed, way = np.concatenate(speeds), np.concatenate(ways)
    moving = speed > STEADY_SPEED * speed.max(initial=0.0)
    if not moving.any() or not way[moving].sum() > 0:
        return 0.0, 0.0
    order = np.argsort(speed[moving])
    share = np.cumsum(way[moving][order]) / way[moving].sum()
    slow, fast = (float(speed[moving][order][np.searchsorted(share, part)]) for part in (0.1, 0.9))
    return slow, fast


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if len(a) > 1 and a.std() > 0 and b.std() > 0 else 0.0
