"""The simulated rig: pad, indenters, session, noise, and the pipeline from motion to raw readings.

Order of things along the signal path (effects hook into it, see `Effect`):
 geometry -> column height D and rate V per taxel (internal 200 Hz grid)
 material  -> equivalent elastic depth E = op(D)               (stiffness, relaxation, hysteresis, softening ...)
 contact   U = max(0, k (E + tau_d V)) where D > 0, k = gain * k_n in counts per metre, times the trial's own gain
 fine      -> still on the internal grid (filters of the electronics)
 sampling  at time_s - delay(frame, taxel), linear interpolation
 frame     -> matrix couplings, dividers, gains per taxel, saturation (counts above idle)
 total     -> what acts on idle + response
 add       -> drift, hum, pulses;  + noise;  hold (repeated readings);  clip to [0, full scale];  counts
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from outsider.motion import DT, T_BEFORE, conditions, drive
from scipy.signal import lfilter


@dataclass
class Effect:
    name: str
    form: str
    plain: bool
    smax: float  # physical limit of the strength s
    params: Callable = lambda s: {}
    hooks: dict = field(default_factory=dict)  # name of hook -> function, first argument s
    stage: int = 50  # order among effects with the same hook
    note: str = ""
    discrete: bool = False
    s: float = 0.0

    def has(self, hook):
        return hook in self.hooks

    def __call__(self, hook, *args):
        return self.hooks[hook](self.s, *args)


class Trial:
    pass


class Stack:
    """All touched (trial, taxel) pairs side by side: D, V are [T, M]."""

    def __init__(self, world, geom_effects, offsets):
        self.world = world
        D, V, tri, tax, self.sl, m = [], [], [], [], [], 0
        T = max(len(t.tf) for t in world.trials)
        for k, t in enumerate(world.trials):
            d, v, idx = world.columns(k, geom_effects, offsets[k])
            D.append(np.pad(d, ((0, T - len(d)), (0, 0))))
            V.append(np.pad(v, ((0, T - len(v)), (0, 0))))
            tri.append(np.full(len(idx), k))
            tax.append(idx)
            self.sl.append(slice(m, m + len(idx)))
            m += len(idx)
        self.D, self.V = np.concatenate(D, 1), np.concatenate(V, 1)
        self.tri, self.tax = np.concatenate(tri), np.concatenate(tax)
        self.cache = {}

    def memo(self, key, E, fn):
        """fn(E), remembered where E is the plain column height."""
        if E is not self.D:
            return fn(E)
        if key not in self.cache:
            self.cache[key] = fn(E)
        return self.cache[key]


class World:
    def __init__(self, seed, slides=None, fast=False, rate=None, nasty=False, small=None):
        rng = self.rng = np.random.default_rng([seed, 101])
        self.seed = seed
        if small is None:
            small = rng.random() < 0.25
        self.rows, self.cols = (12, 32)
        if small:
            self.rows, self.cols = [(4, 4), (8, 8), (6, 10), (8, 16)][int(rng.integers(4))]
        self.pitch = 0.002
        self.n = self.rows * self.cols
        ii = np.arange(self.n)
        self.ir, self.ic = ii // self.cols, ii % self.cols
        self.tx = (self.ic - (self.cols - 1) / 2) * self.pitch
        self.ty = (self.ir - (self.rows - 1) / 2) * self.pitch
        self.fs = float(rng.choice([255, 255, 255, 255, 1023, 1023, 4095]))
        self.quantised = bool(rng.random() < 0.65)
        self.threshold = max(1.0, self.fs / 255)
        self.rate = rate or float(rng.uniform(27, 34) if rng.random() < 0.6 else rng.uniform(88, 122))
        self._mechanics(rng)
        self._session(rng, slides, fast)
        self._noise(rng, nasty)
        self._cache, self._stacks = {}, {}
        self.temperature = None
        self.effects = []

    # ------------------------------------------------------------------ set-up
    def _mechanics(self, rng):
        small_side = min(self.rows, self.cols) * self.pitch
        tiny = small_side < 0.012
        sphere = {
            "shape": "sphere",
            "radius_m": float(np.round(rng.uniform(4e-3, 7e-3) if tiny else rng.uniform(6e-3, 15e-3), 5)),
        }
        a = (3e-3, 5e-3) if tiny else (4e-3, 11e-3)
        flat = {
            "shape": "flat",
            "size_m": [float(np.round(rng.uniform(*a), 4)), float(np.round(rng.uniform(*a), 4))],
        }
        cyl = {
            "shape": "cylinder",
            "radius_m": float(np.round(rng.uniform(1.8e-3, 3e-3) if tiny else rng.uniform(2.5e-3, 6e-3), 5)),
        }
        first = [sphere, sphere, flat, cyl][int(rng.integers(4))]
        others = [o for o in (sphere, flat, cyl) if o is not first]
        self.objects = [first]
        if first is not sphere:
            self.objects.append(sphere)
        elif rng.random() < 0.3:
            self.objects.append(others[int(rng.integers(2))])
        dmax = rng.uniform(0.9e-3, 1.8e-3)
        self.dmax = {o["shape"]: dmax * (1.0 if o["shape"] == "sphere" else 0.8) for o in (sphere, flat, cyl)}
        self.d_ref = dmax
        self.idle = (
            np.clip(
                rng.uniform(0.03, 0.12) + rng.uniform(0.004, 0.015) * rng.standard_normal(self.n), 0.012, 0.2
            )
            * self.fs
        )
        self.k = rng.uniform(0.55, 0.78) * self.fs / dmax  # counts per metre
        self.k_n = float(np.exp(rng.uniform(np.log(120), np.log(1500))))  # N/m per taxel
        self.tau_d = float(np.exp(rng.uniform(np.log(1.5e-3), np.log(1.8e-2))))

    def _session(self, rng, slides, fast):
        slides = int(rng.integers(1, 3)) if slides is None else slides
        if self.objects[0]["shape"] != "sphere" and slides <= 2 and rng.random() < 0.4:
            slides = 0
        self.conds = conditions(
            rng, (self.rows, self.cols, self.pitch), self.objects, self.dmax, slides, fast
        )
        jitter = rng.uniform(0.02, 0.12)
        order = rng.permutation(16)
        self.trials = []
        for c, cond in enumerate(self.conds):
            for r in range(2):
                t = Trial()
                t.cond, t.rep, t.obj, t.kind = c, r, cond["obj"], cond["kind"]
                t.tf, t.x, t.y, t.z, t.time = drive(rng, cond, self.rate, jitter)
                t.time = np.round(t.time, 6)
                t.order = int(order[2 * c + r])
                self.trials.append(t)
        self.seq = sorted(range(16), key=lambda k: self.trials[k].order)
        start, gap = 0.0, rng.uniform(3, 15)
        for k in self.seq:
            t = self.trials[k]
            t.start = round(float(start), 3)
            start += (
                t.time[-1]
                + gap * rng.uniform(0.5, 1.8)
                + (rng.uniform(40, 150) if rng.random() < 0.06 else 0)
            )
        self.session = start

    def _noise(self, rng, nasty):
        fs = self.fs
        white, ar, tau = (
            rng.uniform(0.0035, 0.007),
            rng.uniform(0.0025, 0.006),
            np.exp(rng.uniform(np.log(0.08), np.log(0.8))),
        )
        rep_gain, rep_off, heavy, spikes = 0.01, 10e-6, None, 0.0
        self.nasty = []
        if nasty:
            kinds = ["heavy tails", "repeatability x2", "redder noise", "spikes"]
            self.nasty = sorted(
                str(v) for v in rng.choice(kinds, size=int(rng.integers(1, 4)), replace=False)
            )
            if "heavy tails" in self.nasty:
                heavy = rng.uniform(2.6, 4.5)
            if "repeatability x2" in self.nasty:
                rep_gain, rep_off = 0.02, 20e-6
            if "redder noise" in self.nasty:
                tau, ar = rng.uniform(2.0, 6.0), ar * rng.uniform(1.2, 1.8)
            if "spikes" in self.nasty:
                spikes = 10 ** rng.uniform(-4.5, -3.5)
        self.noise_params = dict(white=white, ar=ar, ar_tau_s=float(tau), gain=rep_gain, offset_m=rep_off)
        quick = np.random.default_rng([self.seed, 102])
        draw = lambda shape: quick.standard_normal(shape, dtype=np.float32)
        for t in self.trials:
            shape = (len(t.time), self.n)
            w = draw(shape)
            if heavy:
                w = quick.standard_t(heavy, size=shape).astype(np.float32) * np.float32(
                    np.sqrt((heavy - 2) / heavy)
                )
                w = np.clip(w, -25, 25)
            rho = np.exp(-1 / (self.rate * tau))
            e = draw(shape) * np.float32(np.sqrt(1 - rho**2))
            e[0] = draw(self.n)
            red = lfilter([1.0], [1.0, -rho], e, axis=0)
            t.noise = (fs * (white * w + ar * red)).astype(np.float32)
            if spikes:
                hit = quick.random(shape, dtype=np.float32) < spikes
                t.noise[hit] += fs * quick.uniform(0.05, 0.3, hit.sum()) * quick.choice([-1, 1], hit.sum())
                for f in np.flatnonzero(quick.random(shape[0]) < spikes * 3):  # now and then a whole row
                    t.noise[f, self.ir == quick.integers(self.rows)] += fs * quick.normal(0, 0.08)
            t.g = 1 + rep_gain * quick.standard_normal()
            t.off = rep_off * quick.standard_normal()
            t.stamp = 2e-4 * quick.standard_normal(len(t.time))  # the stamp is not the instant of the sample
            t.z_enc = 1.5e-6 * quick.standard_normal(len(t.time))
        for name in ("g", "off"):  # the nominal values are the session's mean
            mean = np.mean([getattr(t, name) for t in self.trials])
            for t in self.trials:
                setattr(t, name, getattr(t, name) - mean + (name == "g"))

    # ------------------------------------------------------------------ geometry
    def columns(self, k, geom_effects=(), offset=0.0):
        """Column height and its rate of the taxels the indenter comes near; (D, V, taxels)."""
        t = self.trials[k]
        x, y, z, bump = t.x, t.y, t.z - offset, np.zeros(self.n)
        for e in geom_effects:
            dx, dy, dz, db = e("geom", self, k)
            x, y, z, bump = x + dx, y + dy, z + dz, bump + db
        shape = t.obj["shape"]
        if shape == "sphere":
            R = t.obj["radius_m"]
            height = lambda X, Y, Z, i: (
                Z[:, None]
                - R
                + np.sqrt(
                    np.clip(
                        R * R - (self.tx[i] - X[:, None]) ** 2 - (self.ty[i] - Y[:, None]) ** 2, 1e-12, None
                    )
                )
                + bump[i]
            )
            inside = None
        else:
            height = lambda X, Y, Z, i: Z[:, None] + bump[i][None, :]
            if shape == "flat":
                a, b = np.array(t.obj["size_m"]) / 2
                inside = lambda X, Y, i: (
                    (np.abs(self.tx[i] - X[:, None]) < a) & (np.abs(self.ty[i] - Y[:, None]) < b)
                )
            else:
                a = t.obj["radius_m"]
                inside = lambda X, Y, i: (
                    (self.tx[i] - X[:, None]) ** 2 + (self.ty[i] - Y[:, None]) ** 2 < a * a
                )
        every, c = np.arange(self.n), slice(None, None, 6)
        top = height(x[c], y[c], z[c], every)
        if inside is not None:
            top = np.where(inside(x[c], y[c], every), top, -1)
        idx = np.flatnonzero(top.max(0) > -0.05e-3)
        h = height(x, y, z, idx)
        v = np.gradient(h, DT, axis=0)
        on = h > 0
        if inside is not None:
            on &= inside(x, y, idx)
        return np.where(on, h, 0.0), np.where(on, v, 0.0), idx

    def stack(self, effects, scatter):
        geoms = [e for e in effects if e.has("geom")]
        key = (scatter, tuple((id(e), e.s) for e in geoms))
        if key not in self._stacks:
            if geoms:  # keep only the plain stacks for good
                self._stacks = {q: v for q, v in self._stacks.items() if not q[1] or q[1] == key[1]}
            self._stacks[key] = Stack(self, geoms, [t.off if scatter else 0.0 for t in self.trials])
        return self._stacks[key]

    def at(self, t, U, when):
        """U [T, n] of the internal grid at times `when` [F] or [F, n]."""
        pos = np.clip((when + T_BEFORE) / DT, 0, len(U) - 1.001)
        i = pos.astype(np.int64)
        if when.ndim == 1:
            w = (pos - i)[:, None]
            return U[i] * (1 - w) + U[i + 1] * w
        w, j = pos - i, np.arange(U.shape[1])[None, :]
        return U[i, j] * (1 - w) + U[i + 1, j] * w
