"""Signs that something acts which no accepted cause accounts for.

Five of them, on what the extended model leaves: it repeats in trials of one condition; it does not, by far
more than encoders scatter; it follows the order of the trials, or something else that the model does not know
(time, other joints, a load); it rings at one frequency.
"""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.joints import flips
from lerobot_vtrefine.diagnose.joints.batch import frame_s
from lerobot_vtrefine.diagnose.joints.candidates import DECOY, LATENCY, resolution
from lerobot_vtrefine.diagnose.joints.fitting import derivatives
from lerobot_vtrefine.diagnose.joints.gravity import is_gripper
from lerobot_vtrefine.diagnose.joints.repeatability import common_part, scatter
from lerobot_vtrefine.diagnose.joints.selection import LEAST_EFFECT_RAD, LEAST_UNKNOWN, Selection
from lerobot_vtrefine.diagnose.joints.session_trends import trends
from lerobot_vtrefine.diagnose.joints.timing import mirrored

Array = np.ndarray

ALPHA = 0.01
_REPEATS, _REPEATS_ALL = 0.3, 0.6
"""Least part of what is left that must repeat; where it is this much, and in every condition, the conditions
need not be enough for a small p."""
_LEAST_CONDITIONS, _FEW_CONDITIONS = 4, 2
_NEARLY_ALL = 0.8
"""Part of what is left that must repeat in each of few conditions."""
_SHAPES_DIFFER, _FAR, _ZEROS_DIFFER = 5.0, 20.0, 12.0
"""Difference of trials of one command, in scatters from frame to frame: noise that wanders makes up to three,
a robot that is zeroed anew before every trial up to eight. Up to `_FAR`, motion must have to do with it."""
_MOVING = 1.6
"""How much larger such a difference is over all frames than over slow ones, if it comes with motion."""
_SERVOS_DIFFER = 0.04
"""Part by which a servo's frequency may differ from trial to trial: batteries and oil, no fault."""
_TREND = 0.1
"""Least part of what is left that must follow the session."""
_FOLLOWS, _FOLLOWS_IF_OWNED = 0.1, 0.4
"""Least part of what is left that must follow a descriptor; more where an accepted form may be off."""
_LINE = 0.1
FEW_TRIALS = 8
_HELPS = 0.25
_OWNED = {
    "speed": {"backlash", "joint_friction", LATENCY},
    "direction": {"backlash", "joint_friction", LATENCY},
    "acceleration": {LATENCY, "backlash", "joint_friction"},
    "position": {"gravity_sag", "encoder_offset"},
    "squared position": {"gravity_sag", "encoder_offset"},
    "load": {"gripper_compliance"},
}


@dataclass(frozen=True)
class Alarm:
    """One joint's alarm: what it follows, and how much of the remaining squared error that is."""

    joint: int
    clue: str
    share: float
    p_value: float


def raise_alarms(selection: Selection, seed: int) -> tuple[Alarm, ...]:
    """All alarms: grippers that are stopped, then the strongest first; a decoy that was accepted is one."""
    found = [
        Alarm(joint, candidate.clue, 1.0, selection.p_values.get((DECOY, joint), 0.0))
        for joint, candidates in selection.chosen.items()
        for candidate in candidates
        if candidate.cause == DECOY
    ]
    found += _repeating(selection, seed)
    found += not_repeating(selection)
    found += _through_the_session(selection, seed)
    found += _following(selection, seed)
    found += _ringing(selection)
    found.sort(key=lambda alarm: -alarm.share)
    found += [] if found or selection.causes() else _too_few(selection)
    # What stands still explains whatever else is odd about it.
    stopped = _stopped(selection)
    still = {alarm.joint for alarm in stopped}
    return (*stopped, *(alarm for alarm in found if alarm.joint not in still))


def _too_few(selection: Selection) -> list[Alarm]:
    """Something helps on trials left out, but with so few trials nothing can be significant."""
    if not 2 <= selection.problem.batch.trials < FEW_TRIALS:
        return []
    gains = {item.cause: item.gain for item in selection.first_round if item.cause != DECOY}
    out = []
    for joint in range(selection.problem.batch.joints):
        names = sorted(
            (name for name in gains if gains[name][joint] > _HELPS), key=lambda n: -gains[n][joint]
        )
        if names and _matters(selection, joint, gains[names[0]][joint]):
            clue = f"the trials are too few to say which of these it is: {', '.join(names[:3])}"
            out.append(Alarm(joint, clue, float(gains[names[0]][joint]), 1.0))
    return out


def _matters(selection: Selection, joint: int, share: float) -> bool:
    """Whether that part of what is left on a joint is worth speaking of."""
    left = selection.fit.total[joint]
    size = np.sqrt(share * left)
    least = max(0.5 * resolution(selection.problem)[joint], _least(selection, joint))
    return bool(size > least and share * left > LEAST_UNKNOWN * selection.baseline.total[joint])


def _least(selection: Selection, joint: int) -> float:
    size = max(LEAST_EFFECT_RAD, selection.problem.floor)
    return size * (0.1 if is_gripper(selection.problem.names[joint]) else 1.0)


def _repeating(selection: Selection, seed: int) -> list[Alarm]:
    """Residuals of trials of one condition, multiplied frame by frame: noise cancels, causes do not."""
    rows, squares = common_part(selection.problem.batch, selection.fit.residual)
    if len(rows) < _FEW_CONDITIONS:
        return []
    _, adjusted = flips.one_sided(rows, seed)
    # Of what those trials leave: others, whose command came once, say nothing about it.
    share = np.mean(rows, 0) / np.mean(squares, 0).clip(1e-300)
    alone = _REPEATS_ALL if len(rows) >= _LEAST_CONDITIONS else _NEARLY_ALL
    return [
        Alarm(joint, "what is left repeats when the command is repeated", float(share[joint]), float(p))
        for joint, p in enumerate(adjusted)
        if (p < ALPHA or (share[joint] > alone and np.min(rows, 0)[joint] > 0))
        and share[joint] > _REPEATS
        and _matters(selection, joint, share[joint])
    ]


def not_repeating(selection: Selection) -> list[Alarm]:
    """Trials of one command that differ by far more than their encoders scatter: what no command sets."""
    problem, fitted = selection.problem, selection.fit
    if selection.delay_spread_s:  # which is a difference of that kind
        return []
    seen = scatter(problem.batch, fitted.residual, derivatives(problem, fitted).columns)
    if seen is None:
        return []
    white = np.maximum(seen.white, 0.5 * resolution(problem))
    with_motion = seen.shape > _MOVING * np.maximum(seen.resting, white)
    shapes = seen.shape > np.where(with_motion, _SHAPES_DIFFER, _FAR) * white
    servos = (seen.servo > _SERVOS_DIFFER) & (seen.servo_effect > _SHAPES_DIFFER * white)
    zeros = seen.zero > _ZEROS_DIFFER * white
    # What differs in shape has a mean and a likeness to slower servos, too.
    servos, zeros = servos & (seen.servo_effect > seen.shape), zeros & (seen.zero > seen.shape)
    found = []
    for joint in range(problem.batch.joints):
        for size, far in ((seen.shape, shapes), (seen.servo_effect, servos), (seen.zero, zeros)):
            share = float(min(size[joint] ** 2 / max(fitted.total[joint], 1e-300), 1.0))
            if far[joint] and share > _REPEATS and _matters(selection, joint, share):
                clue = "trials of one command differ by far more than the encoder scatters"
                found.append(Alarm(joint, clue, share, 0.0))
                break
    return found


def _through_the_session(selection: Selection, seed: int) -> list[Alarm]:
    """A joint's zero, scale, servo or delay that follows the order of the trials."""
    problem, fitted = selection.problem, selection.fit
    later = derivatives(problem, replace(fitted, tau_free=True))
    assert later.tau is not None
    found = trends(problem.batch, fitted.residual, later.columns, later.tau, seed)
    return [
        Alarm(item.joint, f"the {item.kind} changes through the session", item.share, item.p_value)
        for item in found
        if item.p_value < ALPHA and item.share > _TREND and _matters(selection, item.joint, item.share)
    ]


def descriptors(selection: Selection, joint: int) -> dict[str, Array]:
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


def _following(selection: Selection, seed: int) -> list[Alarm]:
    """Descriptors, cleared of what the model's own parameters do, that trials agree on."""
    problem, fitted = selection.problem, selection.fit
    valid = problem.batch.valid
    derivative = derivatives(problem, fitted)
    trial = np.broadcast_to(np.arange(problem.batch.trials), valid.shape)[valid]
    names, columns, shares = [], [], []
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
        shares.append(scores.sum(0) ** 2 / np.maximum(power * (left @ left), 1e-300))
        columns.append(scores)
        names += [(joint, name) for name in items]
    _, adjusted = flips.two_sided(np.concatenate(columns, 1), seed)
    found = []
    for (joint, name), share, p in zip(names, np.concatenate(shares), adjusted, strict=True):
        here = {candidate.cause for candidate in selection.chosen.get(joint, ())}
        here |= {LATENCY} if selection.delayed else set()
        least = _FOLLOWS_IF_OWNED if _OWNED.get(name, set()) & here else _FOLLOWS
        if p < ALPHA and share > least and _matters(selection, joint, share):
            found.append(Alarm(joint, f"what is left follows {name}", float(share), float(p)))
    return found


def _ringing(selection: Selection) -> list[Alarm]:
    """A line in the mean spectrum of what is left that is no broad bump."""
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
        if sharp and share > _LINE and not driven and _matters(selection, joint, share):
            found.append(Alarm(joint, f"what is left rings at {frequency[line]:.2g} Hz", share, 0.0))
    return found


def _stopped(selection: Selection) -> list[Alarm]:
    """A gripper that stands still while its command goes on: it holds something, or is blocked."""
    found = []
    for joint, name in enumerate(selection.problem.names):
        if not is_gripper(name):
            continue
        used = {candidate.cause for candidate in selection.chosen.get(joint, ())}
        if "gripper_compliance" in used:
            continue
        share = _stopped_share(selection, joint)
        if share is not None and _matters(selection, joint, share):
            clue = "stands still while its command goes on: it closes on something"
            found.append(Alarm(joint, clue, share, 0.0))
    return found


def _stopped_share(selection: Selection, joint: int) -> float | None:
    """Part of the baseline's squared error in frames where the joint rests far from its command, if most."""
    batch = selection.problem.batch
    valid = batch.valid[1:]
    error = (batch.command - batch.position)[1:, :, joint]
    still = np.abs(np.diff(batch.position[..., joint], axis=0)) < 2e-4
    steady = np.abs(np.diff(batch.command[..., joint], axis=0)) < 5e-4
    stopped = valid & still & steady & (np.abs(error) > 2e-3)
    base = np.square(selection.baseline.residual[1:, :, joint])
    share = base[stopped].sum() / max(base[valid].sum(), 1e-300)
    trials = np.any(stopped, axis=0).mean()
    return float(share) if share > 0.4 and trials > 0.3 else None
