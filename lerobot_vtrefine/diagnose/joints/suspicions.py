"""What may be left on a joint: it repeats with the command, or does not; it follows the order of the trials,
or something else that the model does not know (time, other joints, a load); it rings; it stands still.

Shapes: N frames, T trials, J joints.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import LEAST_UNKNOWN, REPEATS, REPEATS_ALL
from lerobot_vtrefine.diagnose.core.search import ALL
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.joints.batch import frame_s
from lerobot_vtrefine.diagnose.joints.candidates import PLAIN
from lerobot_vtrefine.diagnose.joints.fitting import derivatives
from lerobot_vtrefine.diagnose.joints.gravity import is_gripper
from lerobot_vtrefine.diagnose.joints.repeatability import (
    Scatter,
    beyond_noise,
    common_part,
    repeated,
    scatter,
)
from lerobot_vtrefine.diagnose.joints.rules import (
    FEW_REPEATED,
    FOLLOWS,
    FOLLOWS_IF_OWNED,
    LEAST_EFFECT_RAD,
    MIN_REPEATED,
    NEARLY_ALL,
    RESTING_SHAPES_DIFFER,
    RINGS,
    SERVOS_DIFFER,
    SHAPES_DIFFER,
    STANDS_STILL,
    WITH_MOTION,
    ZEROS_DIFFER,
)
from lerobot_vtrefine.diagnose.joints.session_trends import trends
from lerobot_vtrefine.diagnose.joints.timing import mirrored

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.joints.problem import Selected

Array = np.ndarray


def suspicions(selection: "Selected") -> list[Suspicion]:
    """All of them; each must account for what is worth speaking of."""
    found = _stopped(selection)
    found += _repeating(selection)
    found += not_repeating(selection)
    found += _unrepeated(selection)
    found += _through_the_session(selection)
    found += _following(selection)
    found += _ringing(selection)
    least = worth_speaking_of(selection)
    return [replace(item, least=max(item.least, float(least[item.channel]))) for item in found]


def worth_speaking_of(selection: "Selected") -> Array:
    """(J,) part of what is left that is: enough of the baseline's error, and more than encoders' steps."""
    problem, left = selection.problem, selection.fit.total.clip(1e-300)
    floor = max(LEAST_EFFECT_RAD, problem.floor)
    size = np.array([floor * (0.1 if is_gripper(name) else 1.0) for name in problem.names])
    size = np.maximum(size, 0.5 * problem.batch.resolution)
    return np.maximum(size**2, LEAST_UNKNOWN * selection.baseline.total) / left


def _repeating(selection: "Selected") -> list[Suspicion]:
    """Residuals of trials of one condition, multiplied frame by frame: noise cancels, causes do not."""
    batch = selection.problem.batch
    rows, squares = common_part(batch, selection.fit.residual)
    if len(rows) < FEW_REPEATED:
        return []
    scores = np.zeros((batch.trials, batch.joints))
    scores[[pairs[0][0] for pairs in repeated(batch)]] = rows
    # Of what those trials leave: others, whose command came once, say nothing about it.
    shares = np.mean(rows, 0) / np.mean(squares, 0).clip(1e-300)
    alone = REPEATS_ALL if len(rows) >= MIN_REPEATED else NEARLY_ALL
    clue = "what is left repeats when the command is repeated"
    return [
        Suspicion(joint, clue, float(share), alone)
        if share > alone and rows[:, joint].min() > 0
        else Suspicion(joint, clue, float(share), REPEATS, scores[:, joint])
        for joint, share in enumerate(shares)
    ]


def not_repeating(selection: "Selected") -> list[Suspicion]:
    """Trials of one command that differ by far more than their encoders scatter: what no command sets."""
    problem, fitted = selection.problem, selection.fit
    if problem.delay_spread_s:  # which is a difference of that kind
        return []
    seen = scatter(problem.batch, fitted.residual, derivatives(problem, fitted).columns)
    if seen is None:
        return []
    white = np.maximum(seen.white, 0.5 * problem.batch.resolution)
    return _far(selection, seen, white, "trials of one command differ by far more than the encoder scatters")


def _unrepeated(selection: "Selected") -> list[Suspicion]:
    """Errors far beyond the encoder's scatter, where no command came twice: they repeat or they do not, and
    neither is asked anywhere else. A model may be off by what trials of a sound robot may differ by."""
    problem, fitted = selection.problem, selection.fit
    if repeated(problem.batch) or problem.delay_spread_s:
        return []
    seen = beyond_noise(problem.batch, fitted.residual, derivatives(problem, fitted).columns)
    # Replays in coarse steps are off by themselves.
    own = np.maximum(problem.floor, problem.misfit * np.sqrt(selection.baseline.total))
    white = np.maximum(np.maximum(seen.white, 0.5 * problem.batch.resolution), own)
    clue = "far more is left than the encoder scatters, and no command came twice to tell whether it repeats"
    return _far(selection, seen, white, clue)


def _far(selection: "Selected", seen: Scatter, white: Array, clue: str) -> list[Suspicion]:
    """One for every joint that differs by more than sound robots do, beside a scatter from frame to frame."""
    with_motion = seen.shape > WITH_MOTION * np.maximum(seen.resting, white)
    shapes = seen.shape > np.where(with_motion, SHAPES_DIFFER, RESTING_SHAPES_DIFFER) * white
    servos = (seen.servo > SERVOS_DIFFER) & (seen.servo_effect > SHAPES_DIFFER * white)
    zeros = seen.zero > ZEROS_DIFFER * white
    # What differs in shape has a mean and a likeness to slower servos, too.
    servos, zeros = servos & (seen.servo_effect > seen.shape), zeros & (seen.zero > seen.shape)
    least, total = worth_speaking_of(selection), selection.fit.total.clip(1e-300)
    found = []
    for joint in range(len(total)):
        for size, far in ((seen.shape, shapes), (seen.servo_effect, servos), (seen.zero, zeros)):
            share = float(min(size[joint] ** 2 / total[joint], 1.0))
            if far[joint] and share > max(REPEATS, least[joint]):
                found.append(Suspicion(joint, clue, share, REPEATS))
                break
    return found


def _through_the_session(selection: "Selected") -> list[Suspicion]:
    """A joint's zero, scale, servo or delay that follows the order of the trials."""
    problem, fitted = selection.problem, selection.fit
    later = derivatives(problem, replace(fitted, tau_free=True))
    assert later.tau is not None
    return trends(problem.batch, fitted.residual, later.columns, later.tau)


def descriptors(selection: "Selected", joint: int) -> dict[str, Array]:
    """What an unknown cause may follow: name -> (N, T). Positions are the model's own, not measured ones."""
    problem, left = selection.problem, selection.fit.residual
    batch = problem.batch
    model = np.where(batch.valid[..., None], batch.position - left, 0.0)
    frame = frame_s(batch)
    speed = np.gradient(model, axis=0) / frame if len(model) > 1 else np.zeros_like(model)
    acceleration = np.gradient(speed, axis=0) / frame if len(model) > 1 else np.zeros_like(model)
    q, v = model[..., joint], speed[..., joint]
    typical = np.sqrt(np.mean(v[batch.valid] ** 2)) + 1e-12
    session = batch.start_s + batch.time_s
    session = session - session[batch.valid].mean()
    elapsed = batch.time_s - batch.time_s[0]
    out = {
        "speed": v,
        "direction": np.tanh(v / (0.2 * typical)),
        "squared speed": v**2,
        "absolute speed": np.abs(v),
        "acceleration": acceleration[..., joint],
        "position": q,
        "squared position": q**2,
        "speed x position": v * q,
        "time in the trial": elapsed,
        "session time": session,
        "position x session time": q * session,
        "speed x session time": v * session,
    }
    if batch.load is not None:
        out["load"] = batch.load[..., joint]
    for other in range(batch.joints):
        if other != joint and not mirrored(batch.command, joint, other):
            name = problem.names[other]
            out[f"position of {name}"] = model[..., other]
            out[f"squared speed of {name}"] = speed[..., other] ** 2
            out[f"speed of {name}"] = speed[..., other]
    return out


def _following(selection: "Selected") -> list[Suspicion]:
    """Descriptors, cleared of what the model's own parameters do, that trials agree on."""
    problem, fitted = selection.problem, selection.fit
    valid = problem.batch.valid
    derivative = derivatives(problem, fitted)
    trial = np.broadcast_to(np.arange(problem.batch.trials), valid.shape)[valid]
    found = []
    for joint in range(problem.batch.joints):
        own = derivative.columns[joint][valid]
        if derivative.tau is not None:
            own = np.concatenate([own, derivative.tau[..., joint][valid][:, None]], 1)
        own = np.concatenate([own, np.ones((len(own), 1))], 1)
        left = fitted.residual[..., joint][valid]
        items = descriptors(selection, joint)
        z = np.stack([values[valid] for values in items.values()], 1)
        scale = np.sqrt(np.square(own).sum(0)).clip(1e-300)
        z = z - own @ (np.linalg.lstsq(own / scale, z, rcond=1e-9)[0] / scale[:, None])
        power = np.square(z).sum(0)
        z = np.where(power > 1e-12 * len(z), z, 0.0)
        scores = np.stack([np.bincount(trial, z[:, k] * left) for k in range(z.shape[1])], 1)
        shares = scores.sum(0) ** 2 / np.maximum(power * (left @ left), 1e-300)
        here = (*selection.chosen.get(joint, ()), *selection.chosen.get(ALL, ()))
        owned = {signal for item in here for signal in PLAIN[item.cause].follows}
        for k, name in enumerate(items):
            least = FOLLOWS_IF_OWNED if name in owned else FOLLOWS
            clue = f"what is left follows {name}"
            found.append(Suspicion(joint, clue, float(shares[k]), least, scores[:, k], either_sign=True))
    return found


def _ringing(selection: "Selected") -> list[Suspicion]:
    """A line in the mean spectrum of what is left that is not a broad bump."""
    batch, left = selection.problem.batch, selection.fit.residual
    frame = frame_s(batch)
    length = int(np.median(batch.frames))
    whole = np.flatnonzero(batch.frames >= length)
    dt = np.diff(batch.time_s[:length, whole], axis=0)
    if length < 40 or len(whole) < 4 or np.abs(dt - frame).max() > 0.5 * frame:
        return []
    window = np.hanning(length)[:, None, None]
    part = left[:length, whole] - left[:length, whole].mean(0)
    power = np.square(np.abs(np.fft.rfft(part * window, axis=0)))
    power = (power / power.sum(0).clip(1e-300)).mean(1)
    commanded = batch.command[:length, whole] - batch.command[:length, whole].mean(0)
    drive = np.square(np.abs(np.fft.rfft(commanded * window, axis=0))).mean(1)
    frequency = np.fft.rfftfreq(length, frame)
    found = []
    for joint in range(batch.joints):
        spectrum = power[:, joint]
        line = 4 + int(spectrum[4:-2].argmax())
        around = np.r_[spectrum[max(line - 9, 1) : line - 2], spectrum[line + 3 : line + 10]]
        share = float(spectrum[line - 2 : line + 3].sum() - 5 * np.median(around))
        driven = drive[line, joint] > 0.02 * drive[1:, joint].max()
        sharp = spectrum[line] > 6 * np.max(around) if len(around) else False
        if sharp and not driven:
            found.append(Suspicion(joint, f"what is left rings at {frequency[line]:.2g} Hz", share, RINGS))
    return found


def _stopped(selection: "Selected") -> list[Suspicion]:
    """A gripper that stands still while its command goes on: it holds something, or is blocked."""
    found = []
    for joint, name in enumerate(selection.problem.names):
        accounted = any(PLAIN[item.cause].stops for item in selection.chosen.get(joint, ()))
        if is_gripper(name) and not accounted:
            clue = "stands still while its command goes on: it closes on something"
            share = _stopped_share(selection, joint)
            found.append(Suspicion(joint, clue, share, STANDS_STILL, decisive=True))
    return found


def _stopped_share(selection: "Selected", joint: int) -> float:
    """Part of the baseline's squared error in frames where the joint rests far from its command; zero where
    few trials have such frames."""
    batch = selection.problem.batch
    valid = batch.valid[1:]
    error = (batch.command - batch.position)[1:, :, joint]
    still = np.abs(np.diff(batch.position[..., joint], axis=0)) < 2e-4
    steady = np.abs(np.diff(batch.command[..., joint], axis=0)) < 5e-4
    stopped = valid & still & steady & (np.abs(error) > 2e-3)
    base = np.square(selection.baseline.residual[1:, :, joint])
    share = base[stopped].sum() / max(base[valid].sum(), 1e-300)
    return float(share) if np.any(stopped, axis=0).mean() > 0.3 else 0.0
