"""What to record next: the protocol of this rig on which two rival models differ most (T-optimal)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.pad.baseline import offset_tangents
from lerobot_vtrefine.diagnose.pad.fitting import fit, predict
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.noise import Noise
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet, synthetic_press
from lerobot_vtrefine.diagnose.pad.weights import build_weights
from lerobot_vtrefine.diagnose.recordings import Trial

REPEATS = 8
FRAMES_PER_S = 30.0


@dataclass(frozen=True)
class Protocol:
    """One press that the rig can run: way points of (time s, x m, y m, depth m or load N)."""

    name: str
    text: str
    indenter: dict[str, Any]
    waypoints: tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True)
class Rig:
    """What the recordings show that the rig can do."""

    indenters: tuple[dict[str, Any], ...]
    reach: float
    """Deepest press [m], or largest load [N]."""
    speed: float
    """Fastest change of it per second."""
    x_m: tuple[float, float]
    y_m: tuple[float, float]
    loaded: bool


def rig_of(presses: PressSet) -> Rig:
    """Limits of depth, speed and place, taken from the recordings."""
    trials = [press.trial for press in presses.presses]
    indenters: list[dict[str, Any]] = []
    for trial in trials:
        if trial.object not in indenters:
            indenters.append(trial.object)
    drives = [_drive(trial) for trial in trials]
    reach = max(float(np.max(drive)) for drive in drives)
    speeds = []
    for trial, drive in zip(trials, drives, strict=True):
        steps = np.diff(trial.time_s)
        good = steps > 0
        if good.any():
            speeds.append(float(np.quantile(np.abs(np.diff(drive)[good] / steps[good]), 0.99)))
    x = np.concatenate([trial.x_m for trial in trials])
    y = np.concatenate([trial.y_m for trial in trials])
    limits_x, limits_y = presses.layout.axes_m()
    return Rig(
        tuple(indenters),
        max(reach, 1e-6),
        max(max(speeds, default=reach), 1e-6),
        (min(float(x.min()), 0.5 * float(limits_x[0])), max(float(x.max()), 0.5 * float(limits_x[-1]))),
        (min(float(y.min()), 0.5 * float(limits_y[0])), max(float(y.max()), 0.5 * float(limits_y[-1]))),
        presses.loaded,
    )


def _drive(trial: Trial) -> np.ndarray:
    drive = trial.depth_m if trial.depth_m is not None else trial.force_n
    return np.zeros(1) if drive is None else drive


def protocols(rig: Rig) -> list[Protocol]:
    """Presses within the rig's limits: holds, ramps at several speeds, partial unloads, slides, new sites."""
    x0, y0 = 0.5 * sum(rig.x_m), 0.5 * sum(rig.y_m)
    corner = (rig.x_m[1], rig.y_m[1])
    high, low = rig.reach, 0.0 if rig.loaded else -0.2 * rig.reach
    fast = high / rig.speed
    found = []
    for indenter in rig.indenters:
        for place, (x, y) in (("at the centre", (x0, y0)), ("near a corner", corner)):
            shapes = {
                "long hold": ((0, low), (1, low), (1 + fast, high), (31, high), (31 + fast, low), (36, low)),
                "slow and fast ramps": _ramps(low, high, fast),
                "partial unloads": _partial(low, high),
                "shallow and deep": _depths(low, high, fast),
            }
            for name, points in shapes.items():
                way = tuple((float(t), x, y, float(v)) for t, v in points)
                found.append(Protocol(name, f"{name} {place}", indenter, way))
        found.append(_slide(rig, indenter, low, high, y0))
    return found


def _ramps(low: float, high: float, fast: float) -> tuple[tuple[float, float], ...]:
    points, time_s = [(0.0, low), (1.0, low)], 1.0
    for span in (fast, 3 * fast, 10 * fast):
        for value in (high, low):
            time_s += max(span, 0.05)
            points += [(time_s, value), (time_s + 0.5, value)]
            time_s += 0.5
    return tuple(points)


def _partial(low: float, high: float) -> tuple[tuple[float, float], ...]:
    levels = [low, low, high, 0.5 * high, high, 0.2 * high, 0.8 * high, 0.4 * high, 0.7 * high, low, low]
    return tuple((1.5 * index, level) for index, level in enumerate(levels))


def _depths(low: float, high: float, fast: float) -> tuple[tuple[float, float], ...]:
    points, time_s = [(0.0, low)], 1.0
    for share in (0.1, 0.25, 0.5, 0.75, 1.0):
        points += [(time_s, low), (time_s + max(fast, 0.2), share * high), (time_s + 1.5, share * high)]
        time_s += 1.5 + max(fast, 0.2)
        points.append((time_s, low))
        time_s += 0.5
    return tuple(points)


def _slide(rig: Rig, indenter: dict[str, Any], low: float, high: float, y: float) -> Protocol:
    x0, x1 = rig.x_m
    depth = 0.7 * high
    start, end = (
        ((0.0, x0, y, low), (1.0, x0, y, low), (2.0, x0, y, depth)),
        ((7.0, x1, y, depth), (8.0, x1, y, low)),
    )
    way = (*start, *end)
    return Protocol("slide", "slide along a row", indenter, way)


def as_trial(protocol: Protocol, loaded: bool, taxels: int) -> Trial:
    """The protocol as frames, with readings of zero."""
    times, x, y, drive = np.array(protocol.waypoints).T
    time_s = np.arange(0.0, times[-1], 1.0 / FRAMES_PER_S)
    value = np.interp(time_s, times, drive)
    zero = np.zeros(len(time_s))
    return Trial(
        file=protocol.text,
        condition=protocol.text,
        order=0,
        start_s=0.0,
        object=protocol.indenter,
        time_s=time_s,
        x_m=np.interp(time_s, times, x),
        y_m=np.interp(time_s, times, y),
        depth_m=None if loaded else value,
        tilt_x_rad=zero,
        tilt_y_rad=zero,
        force_n=value if loaded else None,
        temperature_c=None,
        raw=np.zeros((len(time_s), taxels)),
    )


def distance(one: Composite, other: Composite, press: Press, presses: PressSet, noise: Noise) -> float:
    """Weighted distance of two models' readings, with the second refitted to the first [sigma]."""
    lone = replace(presses, presses=(press,))
    target = predict(one, lone)[0]
    lone = replace(lone, presses=(replace(press, signal=target),))
    signals = predict(other, lone)
    weights = build_weights(noise, [target], offset_tangents(other, lone, signals))
    fitted = fit(other, lone, weights, max_steps=2)
    return float(np.sqrt(max(fitted.loss, 0.0)))


def next_experiment(
    one: Composite, other: Composite, presses: PressSet, noise: Noise, names: Sequence[str]
) -> dict[str, Any]:
    """The protocol that distinguishes two models best, ready for JSON."""
    rig = rig_of(presses)
    best: tuple[float, Protocol] | None = None
    for protocol in protocols(rig):
        press = synthetic_press(as_trial(protocol, rig.loaded, presses.layout.num_taxels), presses)
        size = distance(one, other, press, presses, noise)
        if best is None or size > best[0]:
            best = size, protocol
    assert best is not None
    return describe_protocol(best[1], best[0], rig.loaded, names)


def describe_protocol(protocol: Protocol, size: float, loaded: bool, names: Sequence[str]) -> dict[str, Any]:
    """A protocol as the verdict file holds it."""
    drive = "force_n" if loaded else "depth_m"
    indenter = {key: list(v) if isinstance(v, tuple) else v for key, v in protocol.indenter.items()}
    return {
        "protocol": protocol.name,
        "text": f"Record {REPEATS} times, in random order with other presses: {protocol.text}, with the "
        f"{indenter['shape']} indenter. It separates {' from '.join(names)}.",
        "object": indenter,
        "columns": ["time_s", "x_m", "y_m", drive],
        "waypoints": [[round(value, 6) for value in point] for point in protocol.waypoints],
        "repeats": REPEATS,
        "decides_between": list(names),
        "expected_distance_sigma": round(size, 2),
    }
