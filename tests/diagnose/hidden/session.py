"""A session at the rig: from a specification and a seed to the trials, with and without noise."""

from dataclasses import dataclass, field

import numpy as np

from hidden.catalogue import FORMS
from hidden.noise import NOISES, Noise, digitise, frame_noise
from hidden.protocol import PROTOCOLS, Motion
from hidden.rig import Rig, height_rate, rig_named, surface
from hidden.scene import Effect, Pad, Scene

FINE_S = 0.005


@dataclass(frozen=True)
class Spec:
    """What to hide. `effects` are (family, form, size); size 1 is meant to be plain to see."""

    rig: str = "4x4"
    effects: tuple[tuple[str, str, float], ...] = ()
    noise: str = "normal"
    protocol: str = "standard"
    corruption: str | None = None
    changes: tuple[tuple[str, object], ...] = ()
    """Fields of the rig to replace."""

    def make_rig(self) -> Rig:
        return rig_named(self.rig, **dict(self.changes))


@dataclass
class Recording:
    """One trial as the rig saw it, and what it would have read without noise."""

    condition: int
    replicate: int
    order: int
    start_s: float
    motion: Motion
    time_s: np.ndarray
    position_m: np.ndarray
    force_n: np.ndarray
    temperature_c: np.ndarray
    raw: np.ndarray
    expected: np.ndarray
    """Readings from everything that repeats, without idle noise and trial-to-trial scatter, (F, N)."""
    depth_m: np.ndarray
    """Column heights (F, N)."""
    rate: np.ndarray


@dataclass
class Session:
    """A pad, its effects and the recordings made of it."""

    spec: Spec
    rig: Rig
    pad: Pad
    effects: list[Effect]
    recordings: list[Recording] = field(default_factory=list)


def specimen(rig: Rig, rng: np.random.Generator) -> Pad:
    """A pad with stiffness, damping, gain and idle levels of its own."""
    k_n = 400.0 * rng.uniform(0.6, 1.6)
    peak = rig.full_scale * rng.uniform(0.5, 0.75)
    idle = rig.full_scale / 255 * rng.uniform(10.0, 40.0, rig.rows * rig.cols)
    return Pad(rig, k_n, k_n * rng.uniform(1e-3, 6e-3), peak / (k_n * rig.reach_m), idle)


def through(effects: list[Effect], stage: str, scene: Scene, x: np.ndarray) -> np.ndarray:
    for effect in effects:
        if effect.stage == stage:
            x = effect.apply(scene, x)
    return x


def contact(pad: Pad, effects: list[Effect], scene: Scene) -> np.ndarray:
    """Force per taxel at the face (T, N) [N], from column heights or, load-driven, from the load."""
    height = through(effects, "surface", scene, scene.height)
    depth = np.maximum(height, 0.0)
    if pad.rig.drive == "force":
        return pad.k_n * depth
    law = [effect for effect in effects if effect.stage == "law"]
    elastic = law[0].apply(scene, depth) if law else pad.k_n * depth
    return np.where(height > 0, np.maximum(elastic + pad.k_d * np.nan_to_num(scene.rate), 0.0), 0.0)


def fine_readings(pad: Pad, effects: list[Effect], scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Total load (T,) [N] and readings above idle (T, N) on the fine grid."""
    force = through(effects, "force", scene, contact(pad, effects, scene))
    counts = through(effects, "counts", scene, pad.gain * force)
    return force.sum(axis=1), counts + through(effects, "additive", scene, np.zeros_like(counts))


def at_times(x: np.ndarray, grid_s: np.ndarray, when_s: np.ndarray) -> np.ndarray:
    """Columns of x (T, N) at times (F, 1) or (F, N), linearly."""
    when_s = np.broadcast_to(when_s, (len(when_s), x.shape[1]))
    place = np.clip((when_s - grid_s[0]) / (grid_s[1] - grid_s[0]), 0.0, len(grid_s) - 1.001)
    low = place.astype(int)
    part, cols = place - low, np.arange(x.shape[1])[None]
    return (1 - part) * x[low, cols] + part * x[low + 1, cols]


def frame_times(rig: Rig, rng: np.random.Generator) -> np.ndarray:
    times = np.arange(round(rig.duration_s * rig.rate_hz)) / rig.rate_hz
    return np.maximum.accumulate(times + rig.clock_jitter_s * np.abs(rng.standard_normal(len(times))))


def sampled(
    pad: Pad, effects: list[Effect], scene: Scene, time_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noise-free frames above idle (F, N), the frame each was taken at (F,), and the load (F,)."""
    load, fine = fine_readings(pad, effects, scene)
    slots = through(effects, "hold", scene, time_s)
    source = np.maximum.accumulate(np.searchsorted(slots, slots, side="left"))
    frames = at_times(fine, scene.time_s, through(effects, "when", scene, slots[:, None]))
    for effect in effects:
        if effect.stage == "frame":
            frames = effect.apply(scene, frames, time_s)
    return frames, source, np.interp(time_s, scene.time_s, load)


def record(
    pad: Pad, effects: list[Effect], noise: Noise, motion: Motion, label: dict, seeds: tuple[int, ...]
) -> Recording:
    """Run one trial. `label` holds condition, replicate, order, start_s, site_gain, site_offset_m."""
    rng, rig = np.random.default_rng(seeds), pad.rig
    time_s = frame_times(rig, rng)
    fine = np.arange(-0.5, time_s[-1] + 0.3, min(FINE_S, 0.2 / rig.rate_hz))
    temperature = 22.0 + 1.5 * np.sin((label["start_s"] + fine) / 240.0 + label["phase"])

    def scene(offset_m: float) -> Scene:
        position, speed = motion.sample(fine)
        shape = rig.indenters[motion.indenter]
        dx, dy, height = surface(rig, shape, position[:, 0], position[:, 1], position[:, 2] - offset_m)
        rate = height_rate(shape, dx, dy, *speed.T)
        chance = np.random.default_rng((*seeds, 1))
        return Scene(pad, fine, label["start_s"], label["order"], speed, height, rate, temperature, chance)

    expected, _, _ = sampled(pad, effects, scene(0.0), time_s)
    jitter = noise.trial_offset_m * rng.standard_normal() + label["site_offset_m"]
    frames, source, load = sampled(pad, effects, scene(jitter), time_s)
    frames = frames * (1 + noise.trial_gain * rng.standard_normal() + label["site_gain"])
    noisy = frames + frame_noise(noise, frames, 1 / rig.rate_hz, rig.full_scale, rng)
    raw = digitise(noisy + pad.idle, noise, rig.full_scale)[source]
    position, speed = motion.sample(time_s)
    shape = rig.indenters[motion.indenter]
    dx, dy, height = surface(rig, shape, *position.T)
    cell = 1 + noise.load_cell * rng.standard_normal()
    return Recording(
        *(label[key] for key in ("condition", "replicate", "order", "start_s")),
        motion,
        time_s,
        position,
        load * cell,
        np.interp(time_s, fine, temperature),
        raw,
        expected,
        height,
        height_rate(shape, dx, dy, *speed.T),
    )


def labels(
    count: int, replicates: int, rig: Rig, noise: Noise, order0: int, phase: float, rng: np.random.Generator
) -> list[dict]:
    """Condition, replicate and place in a randomised session for every trial."""
    shared = rng.standard_normal((count, 2)) * [noise.site_gain, noise.site_offset_m]
    pairs = [(c, r) for c in range(count) for r in range(replicates)]
    orders = rng.permutation(len(pairs))
    starts = order0 * (rig.duration_s + 10.0) + np.cumsum(rig.duration_s + rng.uniform(4.0, 15.0, len(pairs)))
    return [
        {
            "motion": c,
            "replicate": r,
            "order": int(order + order0),
            "start_s": float(round(starts[order] - rig.duration_s, 3)),
            "site_gain": shared[c, 0],
            "site_offset_m": shared[c, 1],
            "phase": phase,
        }
        for (c, r), order in zip(pairs, orders, strict=True)
    ]


def name_conditions(places: list[dict], motions: list[Motion]) -> None:
    """Trials driven by the same motion are one condition, its replicates counted."""
    first = [next(j for j, other in enumerate(motions) if other is motion) for motion in motions]
    seen: dict[int, int] = {}
    for place in places:
        condition = first[place["motion"]]
        place["condition"], place["replicate"] = condition, seen.get(condition, 0)
        seen[condition] = seen.get(condition, 0) + 1


def run_session(spec: Spec, seed: int, locked: int = 0) -> tuple[Session, Session]:
    """The session to diagnose, and one of `locked` new conditions of the same pad, recorded after it."""
    rig = spec.make_rig()
    rng = np.random.default_rng((7919, seed))
    pad = specimen(rig, rng)
    # Chance of their own, so that the same seed makes the same presses whatever is hidden in them.
    chance = np.random.default_rng((7919, seed, 1))
    effects = [FORMS[family][form](pad, size, chance) for family, form, size in spec.effects]
    noise = NOISES[spec.noise]
    sessions, before, phase = [], 0, rng.uniform(0, 2 * np.pi)
    for part, (motions, repeats) in enumerate(
        [
            (PROTOCOLS[spec.protocol](rig, rng), rig.replicates),
            (PROTOCOLS["standard"](rig, rng, locked) if locked else [], 1),
        ]
    ):
        session = Session(spec, rig, pad, effects)
        places = labels(len(motions), repeats, rig, noise, before, phase, rng)
        name_conditions(places, motions)
        before = len(places)
        session.recordings = [
            record(pad, effects, noise, motions[label["motion"]], label, (seed, part, i))
            for i, label in enumerate(places)
        ]
        sessions.append(session)
    return sessions[0], sessions[1]
