"""Robot recordings with known faults, made without any code of the engine: steps of 1 ms, in which a command
counts from when it arrives.

Commands are held between frames; a frame is recorded before its own command acts.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

ALOHA_JOINTS = [
    f"{arm}_{name}"
    for arm in ("left", "right")
    for name in (
        "waist",
        "shoulder",
        "elbow",
        "forearm_roll",
        "wrist_angle",
        "wrist_rotate",
        "left_finger",
        "right_finger",
    )
]
STRIBECK_RAD_S = 0.02


@dataclass
class Rig:
    """What is wrong with the robot, joint name -> size; SI units."""

    joints: tuple[str, ...] = ("shoulder", "elbow", "wrist_flex", "gripper")
    rate_hz: float = 30.0
    seconds: float = 8.0
    conditions: int = 12
    replicates: int = 2
    motion: str = "mixed"
    """mixed: smooth moves, steps and holds at several speeds; slow: one slow sine."""
    offset: dict = field(default_factory=dict)
    backlash: dict = field(default_factory=dict)
    slack: dict = field(default_factory=dict)
    """Play between the joint and its encoder."""
    rounding: float = 0.0
    """Of that play: its flanks give way little by little, as (1 + x)^rounding of the way across; 0: sharp."""
    latency_s: float = 0.0
    latency_spread: float = 0.0
    """Standard deviation of single commands' delays, as a part of their mean (gamma distributed)."""
    own_latency: dict = field(default_factory=dict)
    """Joint -> delay of its own [s], beside that of all."""
    filter_s: float = 0.0
    """Time constant of a low-pass through which commands reach the joints."""
    lost_every: int = 0
    """Every so many-th command never comes; 0: all come."""
    counts_every: int = 0
    """Only every so many-th command comes; 0: all do."""
    friction: dict = field(default_factory=dict)
    """As servo error [rad]."""
    stribeck: float = 0.0
    """By what part friction at rest exceeds sliding friction; falls off over `STRIBECK_RAD_S`."""
    sag: dict = field(default_factory=dict)
    sag_shape: str = "link"
    """link: cosine of the summed pitch; own: cosine of the joint's own angle; stretch: two links; upright:
    two links, the first of which stands at zero."""
    sag_where: str = "command"
    """Where gravity pulls: at the posture that is commanded, or where the joints are ("joints")."""
    compliance: dict = field(default_factory=dict)
    """Joint -> m per N; loads come with it."""
    compliance_form: str = "servo"
    """Where and how a load bends: servo: before the servo, in proportion; finger: behind it, at once; slack:
    behind it, through play that the load takes up; one_way: pulls bend three times as far as pushes; harder:
    as the load's power 0.6; between: before the servo, the load changing between frames, too."""
    holds: dict = field(default_factory=dict)
    """Gripper -> (opening at which it meets something hard, part of its way that it still goes)."""
    stiffness: dict = field(default_factory=dict)
    """Joint -> Nm/rad: makes a load column of the servo's torque."""
    unknown: dict = field(default_factory=dict)
    noise: float = 1.0
    nasty: float = 0.0
    servo_scatter: float = 0.0
    """Standard deviation of the servos' stiffness from trial to trial, as a part of it."""
    jitter: float = 0.0
    quantum: float = 2 * np.pi / 4096


def smooth_moves(rng, t, span, centre):
    """Minimum-jerk moves between random places at random speeds, with holds and a few steps."""
    out, now, k = np.empty(len(t)), centre + span * rng.uniform(-1, 1), 0
    dt = np.median(np.diff(t))
    while k < len(t):
        goal = centre + span * rng.uniform(-1, 1)
        if rng.random() < 0.2:
            goal = now + 0.15 * span * rng.choice([-1, 1])
        frames = max(1, round(rng.choice([0.08, 0.5, 1.0, 2.0]) / dt))
        hold = max(1, round(rng.uniform(0.1, 0.7) / dt))
        s = np.linspace(0, 1, frames + 1)[1:]
        path = now + (goal - now) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        piece = np.concatenate([path, np.full(hold, goal)])[: len(t) - k]
        out[k : k + len(piece)] = piece
        k, now = k + len(piece), goal
    return out


def dragged(x, width, rounding):
    """Readings (..., N) of an encoder behind play: across the play the reading gives way more and more."""
    out = np.empty_like(x)
    out[..., 0] = x[..., 0]
    for k in range(1, x.shape[-1]):
        before = out[..., k - 1]
        sharp = np.clip(before, x[..., k] - width / 2, x[..., k] + width / 2)
        if rounding:
            change = x[..., k] - x[..., k - 1]
            across = 0.5 * (1 + np.sign(change) * (x[..., k - 1] - before) / (width / 2)).clip(0, 2)
            sharp = np.clip(before + change * across.clip(0, 1) ** rounding, *_window(x[..., k], width))
        out[..., k] = sharp
    return out


def _window(x, width):
    return x - width / 2, x + width / 2


def pitch_of(joints, q, index):
    """Summed pitch of the arm up to a joint; q is (..., joints)."""
    side = joints[index].split("_")[0] if joints[index].startswith(("left", "right")) else ""
    words = ("shoulder", "elbow", "wrist_angle", "wrist_flex")
    total = 0.0
    for k in range(index + 1):
        if joints[k].startswith(side) and any(word in joints[k] for word in words):
            total = total + q[..., k]
    return total


def column(rig, sizes):
    return np.array([sizes.get(name, 0.0) for name in rig.joints])


class Robot:
    """One robot's constants, drawn once per set."""

    def __init__(self, rig, rng):
        self.rig = rig
        self.omega = rng.uniform(12, 30, len(rig.joints))
        self.zeta = rng.uniform(0.6, 1.2, len(rig.joints))

    def sag_of(self, u):
        rig = self.rig
        out = np.zeros_like(u)
        for name, size in rig.sag.items():
            k = rig.joints.index(name)
            first = pitch_of(rig.joints, u, k)
            if rig.sag_shape == "own":
                out[..., k] = size * np.cos(u[..., k])
            elif rig.sag_shape == "upright":
                out[..., k] = size * (0.6 * np.sin(first) + 0.4 * np.cos(first + u[..., k + 1]))
            elif rig.sag_shape == "stretch":
                out[..., k] = size * (0.6 * np.cos(first) + 0.4 * np.cos(first + u[..., k + 1]))
            else:
                out[..., k] = size * np.cos(first)
        return out

    def target_of(self, slack, bend_load, session_s, now, v, u, q):
        target = slack + self.sag_of(q if self.rig.sag_where == "joints" else slack) - bend_load
        for name, (opening, give) in self.rig.holds.items():
            k = self.rig.joints.index(name)
            beyond = np.minimum(target[..., k] - opening, 0.0)
            target[..., k] = np.maximum(target[..., k], opening) + give * beyond
        for kind, size in self.rig.unknown.items():
            if kind == "gain_drift":
                target = target + size * session_s / 600 * slack
            elif kind == "gain":
                target = target * (1 + size)
            elif kind == "ripple":
                target = target + size * np.sin(2 * np.pi * 1.7 * now)[:, None]
            elif kind == "coupling":
                target = target + size * np.roll(u, 1, axis=1)
            elif kind == "coriolis":
                target = target + size * np.roll(v, 1, axis=1) ** 2
        return target

    def wanted(self, arrival, command, then, h):
        """Mean command in force from `then` to `then + h`; joints may be later than all are."""
        own = column(self.rig, self.rig.own_latency)
        out = np.empty((len(arrival), len(own)))
        for late in np.unique(own):
            same = own == late
            out[:, same] = self.late(arrival + late, command[..., same], then, h)
        return out

    def late(self, arrival, command, then, h):
        """Mean command in force from `then` to `then + h`: one that arrives inside counts for its part."""
        everyone = np.arange(len(arrival))
        old, new = (np.maximum((arrival <= (w + 1e-9)[:, None]).sum(1) - 1, 0) for w in (then, then + h))
        part = np.where(new > old, (then + h - arrival[everyone, new]) / h, 1.0)[:, None]
        return part * command[everyone, new] + (1 - part) * command[everyone, old]

    def run(self, t, command, load_n, session_s, rng):
        """Encoder readings and servo torques (T, N, J) at t (T, N); session_s (T, 1)."""
        rig = self.rig
        command = lossy(rig, rng, command)
        arrival = arrivals(rig, rng, t)
        half, bend = column(rig, rig.backlash) / 2, column(rig, rig.compliance)
        behind = rig.compliance_form in ("finger", "slack")
        dry = self.omega**2 * column(rig, rig.friction)
        pull = self.omega**2 * (1 - rig.unknown.get("weak_servo", 0.0) * session_s / session_s.max())
        pull = pull * (1 + rig.servo_scatter * rng.normal(size=(len(t), 1)))
        frames = t.shape[1]
        q = command[:, 0] + self.sag_of(command[:, 0])
        v, slack, smooth = np.zeros_like(q), command[:, 0].copy(), command[:, 0].copy()
        out, torque = np.empty_like(command), np.zeros_like(command)
        steps = max(1, round(np.median(np.diff(t)) / 1e-3))
        for k in range(frames):
            out[:, k], torque[:, k] = q, slack + self.sag_of(slack) - q
            if k + 1 == frames:
                break
            h = (t[:, k + 1] - t[:, k]) / steps
            for step in range(steps):
                now = t[:, k] + step * h
                u = command[:, k]
                if rig.latency_s or rig.own_latency:
                    u = self.wanted(arrival[:, : k + 1], command[:, : k + 1], now, h)
                if rig.filter_s:
                    ahead, fade = u - smooth, np.exp(-h / rig.filter_s)[:, None]
                    smooth = u - fade * ahead
                    u = u - (1 - fade) * (rig.filter_s / h)[:, None] * ahead
                slack = np.clip(slack, u - half, u + half)
                part = step / steps if rig.compliance_form == "between" else 0.0
                force_n = (1 - part) * load_n[:, k] + part * load_n[:, k + 1]
                bent = bend * yielding(rig, force_n) * (not behind)
                target = self.target_of(slack, bent, session_s, now, v, u, q)
                force = pull * (target - q) - 2 * self.zeta * self.omega * v
                stick = dry * (1 + rig.stribeck * np.exp(-((v / STRIBECK_RAD_S) ** 2)))
                stuck = (v == 0) & (np.abs(force) <= stick)
                a = np.where(stuck, 0.0, force - stick * np.sign(np.where(v != 0, v, force)))
                new = v + a * h[:, None]
                new = np.where((new * v < 0) & (dry > 0), 0.0, new)
                q = q + 0.5 * (v + new) * h[:, None]
                v = new
        return out - bend * yielding(rig, load_n) * behind, torque


def yielding(rig, load_n):
    """The load that would bend a plain spring as far."""
    if rig.compliance_form == "slack":
        return load_n + 6.0 * np.sign(load_n) * (np.abs(load_n) > 0.5)
    if rig.compliance_form == "one_way":
        return np.where(load_n < 0, 3.0, 1.0) * load_n
    return (
        15.0 * (np.abs(load_n) / 15.0) ** 0.6 * np.sign(load_n) if rig.compliance_form == "harder" else load_n
    )


def arrivals(rig, rng, t):
    """When commands (T, N) reach the servo: never out of order."""
    late = np.full(t.shape, rig.latency_s)
    if rig.latency_spread:
        shape = rig.latency_spread**-2
        late = rng.gamma(shape, rig.latency_s / shape, t.shape)
    return np.maximum.accumulate(t + late, axis=1)


def lossy(rig, rng, command):
    """Commands (T, N, J) of which now and then a few in a row never come, or some in a rhythm."""
    if rig.lost_every:
        frame = np.arange(command.shape[1])
        return command[:, frame - (frame % rig.lost_every == rig.lost_every - 1)]
    if rig.counts_every:
        frame = np.arange(command.shape[1])
        return command[:, frame - frame % rig.counts_every]
    if "packet_loss" not in rig.unknown:
        return command
    lost = rng.random(command.shape[:2]) < 1 / 45
    length = round(12 * rig.unknown["packet_loss"])
    for k in range(1, length):
        lost[:, k:] |= lost[:, :-k] & (rng.random((len(lost), 1)) < 1 - k / (2 * length))
    lost[:, 0] = False
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(command.shape[1])), axis=1)
    return np.take_along_axis(command, last[..., None], 1)


def frames_of(rig, rng):
    t = np.arange(0, rig.seconds, 1 / rig.rate_hz)
    if rig.jitter:
        t[1:] += rng.uniform(-rig.jitter, rig.jitter, len(t) - 1) / rig.rate_hz
    return t


def commands_of(rig, rng, t):
    columns = []
    for k, name in enumerate(rig.joints):
        if "right_finger" in name:
            columns.append(-columns[-1])
            continue
        slide = any(word in name for word in ("finger", "gripper"))
        span, centre = (0.018, 0.022) if slide else (0.6, 0.1 * (k % 3))
        if rig.motion == "slow":
            columns.append(centre + span * np.sin(2 * np.pi * 0.1 * t + k))
        else:
            columns.append(smooth_moves(rng, t, span, centre))
    return np.stack(columns, 1)


def measured(rig, rng, q):
    """Noise of an encoder, and of robots that are not the same twice."""
    slide = np.array([any(word in name for word in ("finger", "gripper")) for name in rig.joints])
    unit = np.where(slide, 2e-5, 4e-4) * rig.noise
    red = np.zeros_like(q)
    for k in range(1, len(q)):
        red[k] = 0.9 * red[k - 1] + np.sqrt(1 - 0.81) * rng.normal(size=q.shape[1])
    q = q + unit * (rng.normal(size=q.shape) + red)
    q = q + unit * rng.normal(size=q.shape[1]) * (1 + 3 * rig.nasty)
    q = q * (1 + 0.002 * rig.nasty * rng.normal(size=q.shape[1]))
    quantum = np.where(slide, rig.quantum * 0.02, rig.quantum)
    return np.round(q / quantum) * quantum


def loads_of(rig, rng, t, c):
    load = np.zeros((len(t), len(rig.joints)))
    for name in rig.compliance:
        grasp = (np.sin(2 * np.pi * t / rig.seconds + c) > 0.2) * rng.uniform(5, 25)
        if rig.compliance_form == "one_way":
            grasp = grasp - (np.sin(2 * np.pi * t / rig.seconds + c) < -0.3) * rng.uniform(5, 25)
        load[:, rig.joints.index(name)] = np.convolve(grasp, np.ones(9) / 9, "same")
    return load


def make_set(rig, folder, seed):
    """Write a recording set; returns its folder."""
    rng = np.random.default_rng(seed)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    robot = Robot(rig, rng)
    plan = [(c, r) for c in range(rig.conditions) for r in range(rig.replicates)]
    order = rng.permutation(len(plan))
    times = [frames_of(rig, rng) for _ in range(rig.conditions)]
    moves = [commands_of(rig, rng, t) for t in times]
    t = np.stack([times[c] for c, _ in plan])
    u = np.stack([moves[c] for c, _ in plan])
    load = np.stack([loads_of(rig, rng, times[c], c) for c, _ in plan])
    session = 30.0 * order[:, None]
    q, torque = robot.run(t, u, load, session, np.random.default_rng([seed, 1]))
    for name, width in rig.slack.items():
        k = rig.joints.index(name)
        q[..., k] = dragged(q[..., k], width, rig.rounding)
    if "slip" in rig.unknown:
        q[..., 1] += rig.unknown["slip"] * (session > 0.5 * session.max())
    for name, k_nm in rig.stiffness.items():
        k = rig.joints.index(name)
        load[..., k] = k_nm * torque[..., k] * (1 + 0.02 * rng.normal(size=t.shape))
    q = q + column(rig, rig.offset)
    entries = []
    for place, (c, r) in enumerate(plan):
        values = {"command": u[place], "position": measured(rig, rng, q[place])}
        if rig.compliance or rig.stiffness:
            values["load"] = load[place]
        columns = {"time_s": pa.array(t[place])} | {k: pa.array(x.tolist()) for k, x in values.items()}
        file = f"trial_{place:04d}.parquet"
        pq.write_table(pa.table(columns), folder / file)
        at = {"order": int(order[place]), "start_s": float(session[place, 0])}
        entries.append({"file": file, "condition": f"c{c:02d}", "replicate": r, **at})
    header = {"schema": "vtrefine/recording-set@1", "kind": "robot", "joints": list(rig.joints)}
    (folder / "recording.json").write_text(json.dumps({**header, "trials": entries}))
    return folder
