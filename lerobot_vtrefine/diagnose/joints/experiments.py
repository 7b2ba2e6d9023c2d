"""What to record next, so that two explanations come apart: protocols tried on both, the widest gap wins."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.core.suspicion import Alarm
from lerobot_vtrefine.diagnose.joints.batch import frame_s, make_batch
from lerobot_vtrefine.diagnose.joints.candidates import PLAIN, told_by_load
from lerobot_vtrefine.diagnose.joints.gravity import is_gripper, is_sliding
from lerobot_vtrefine.diagnose.joints.rules import ENOUGH_TRIALS, TELLING
from lerobot_vtrefine.diagnose.joints.servo_trials import ServoTrials
from lerobot_vtrefine.diagnose.recordings import RobotTrial
from lerobot_vtrefine.wording import plural

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.joints.problem import Selected

Array = np.ndarray

_SECONDS = 8.0
PROTOCOLS = {
    "slow reversals": "a triangle at 0.1 rad/s (2 mm/s for a gripper) over a tenth of the range",
    "fast reversals": "a triangle at 1 rad/s (20 mm/s) over a tenth of the range",
    "steps": "steps of a tenth of the range up and down, 1 s apart",
    "postures": "eight postures over the joint's whole range, each held for 1 s",
}


def for_rivals(selection: "Selected", rivals: Sequence[Rival[Any, Any]]) -> dict[str, Any]:
    """The protocol that separates the strongest tie best, of names first: the verdict's `next_experiment`."""
    rival = max(rivals, key=lambda item: (not item.candidate.clue, item.p_value))
    decides = [rival.cause] if rival.candidate.clue else [rival.cause, rival.name]
    gaps = {name: _gap(selection, rival, name) for name in PROTOCOLS}
    best = max(gaps, key=lambda name: gaps[name])
    where = ", ".join(selection.problem.names[joint] for joint in rival.channels)
    protocol: dict[str, Any] = {
        "joints": [selection.problem.names[joint] for joint in rival.channels],
        "command": best,
        "trials": ENOUGH_TRIALS,
        "seconds": _SECONDS,
        "predicted_gap_in_noise": round(gaps[best], 2),
    }
    text = f"Record {ENOUGH_TRIALS} trials of {where}: {PROTOCOLS[best]}."
    both = [PLAIN.get(name, rival.candidate) for name in (rival.cause, rival.name)]
    more = next((item.decided_by for item in both if item.decided_by), "")
    if told_by_load(*both) and selection.problem.batch.load is None:
        protocol["columns"] = ["load"]
        text += " Record the servos' torque or current as `load`: friction takes torque, play takes none."
    elif more:
        text += f" {more}"
    elif gaps[best] < TELLING:
        text += " Commands and encoders hardly distinguish these: measure the joint from outside, too."
    return {"decides": decides, "text": text, "protocol": protocol}


def for_alarm(selection: "Selected", alarm: Alarm) -> dict[str, Any]:
    """How to find out more about an unknown cause."""
    name = selection.problem.names[alarm.channel]
    if "closes on something" in alarm.clue:
        text = (
            f"Close {name} on nothing in eight trials, and on a block of known width in eight more, with the "
            "servo's force as `load`."
        )
        protocol = {"joints": [name], "columns": ["load"], "command": "slow reversals", "trials": 16}
    else:
        text = (
            f"Repeat one command of {name} eight times, spread over the session, and eight times with every "
            f"other joint at rest: {alarm.clue}."
        )
        protocol = {"joints": [name], "command": "steps", "trials": 16, "others_at_rest": True}
    return {"decides": [], "text": text, "protocol": protocol}


def for_little_data(selection: "Selected", detectable: dict[str, float]) -> dict[str, Any] | None:
    """What these trials cannot show at all, if they are few or slow; None where nothing is lacking."""
    problem = selection.problem
    trials = problem.batch.trials
    if trials < ENOUGH_TRIALS - 2:
        few = f"{plural(trials, 'trial')}, too few to judge by"
        text = f"{few}: record six commands twice each, in random order."
        return {"decides": [], "text": text, "protocol": {"command": "steps", "trials": 12}}
    delay = detectable.get("control_latency")
    if delay is None or delay > 2 * frame_s(problem.batch):
        text = "A delay would not show at these speeds: record steps, and reversals at two speeds."
        return {
            "decides": ["control_latency"],
            "text": text,
            "protocol": {"command": "fast reversals", "trials": 8},
        }
    return None


def _gap(selection: "Selected", rival: Rival[Any, Any], name: str) -> float:
    """Distance between both models' predictions of a protocol, root mean square, in units of the noise."""
    problem = selection.problem
    frame = frame_s(problem.batch)
    time_s = np.arange(0.0, _SECONDS, frame)
    low, high = problem.batch.command.min((0, 1)), problem.batch.command.max((0, 1))
    middle = np.median(problem.batch.command.reshape(-1, problem.batch.joints), 0)
    command = np.repeat(middle[None], len(time_s), 0)
    for joint in rival.channels:
        bounded = is_sliding(problem.names[joint]) or is_gripper(problem.names[joint])
        wide = (low[joint], high[joint]) if bounded else (-1.2, 1.2)
        command[:, joint] = _drive(name, time_s, low[joint], high[joint], wide, problem.names[joint])
    trial = RobotTrial("", "", 0, 0.0, time_s, command, command[:1].repeat(len(time_s), 0), None)
    there = ServoTrials.of(problem.names, make_batch([trial]))
    difference = there.predict(selection.fit.point) - there.predict(rival.fit.point)
    joints = list(rival.channels)
    noise = np.sqrt(selection.fit.total[joints]).clip(1e-9)
    return float((np.sqrt(np.square(difference[:, 0, joints]).mean(0)) / noise).max())


def _drive(name: str, t: Array, low: float, high: float, wide: tuple[float, float], joint: str) -> Array:
    middle, swing = (low + high) / 2, max(0.05 * (high - low), 1e-6)
    unit = 0.02 if is_sliding(joint) else 1.0
    if name == "postures":
        return np.linspace(*wide, 8)[np.minimum((t / t[-1] * 8).astype(int), 7)]
    if name == "steps":
        return middle + swing * (1 - 2 * (t.astype(int) % 2))
    speed = (0.1 if name == "slow reversals" else 1.0) * unit
    phase = (t * speed / swing / 4) % 1
    return middle + swing * (4 * np.abs(phase - 0.5) - 1)
