"""Material effects: stiffness, relaxation, hysteresis, first-load softening. Each factory returns plain first, then others.
E, D: equivalent elastic depth [T, M] in metres; strength s in [0, smax]."""

import numpy as np
from outsider.core import Effect
from outsider.motion import DT
from scipy.signal import fftconvolve, lfilter
from scipy.special import erf


def nonlinear_stiffness(w, rng):
    d0 = w.d_ref
    mech = bool(rng.random() < 0.6)
    up = 1 if rng.random() < 0.65 else -1
    mk = lambda form, plain, smax, fn, par, note="": Effect(
        "nonlinear_stiffness",
        form,
        plain,
        smax,
        par,
        {"material": fn, "mechanical": mech},
        10,
        note + (" in the foam" if mech else " in the piezoresistive layer"),
    )
    lim = 1.3 if up > 0 else 0.65
    knee = rng.uniform(0.35, 0.65) * d0
    dens = rng.uniform(2.0, 4.0)

    def foam(s, st, E):  # plateau by buckling, then densification
        a = 3 * s
        u = E / d0
        return d0 * (u / (1 + a * u) + s * u**4)

    return [
        mk(
            "power law",
            True,
            lim,
            lambda s, st, E: d0 * (E / d0) ** (1 + up * s),
            lambda s: {"exponent": 1 + up * s},
        ),
        mk("quadratic", False, 2.5, lambda s, st, E: E * (1 + s * E / d0), lambda s: {"b_per_m": s / d0}),
        mk(
            "exponential (Fung)",
            False,
            3.0,
            lambda s, st, E: d0 / s * np.expm1(s * E / d0),
            lambda s: {"a": s / d0},
        ),
        mk(
            "bilinear densification",
            False,
            4.0,
            lambda s, st, E: E + s * np.maximum(E - knee, 0),
            lambda s: {"knee_m": knee, "extra_slope": s},
        ),
        mk("buckling foam: plateau, then densification", False, 1.2, foam, lambda s: {"s": s}),
        mk(
            "softening x/(1+ax)",
            False,
            3.0,
            lambda s, st, E: E / (1 + s * E / d0),
            lambda s: {"a_per_m": s / d0},
        ),
    ][:6]


def _branch(E, tau):  # Maxwell branch of unit stiffness
    a = np.exp(-DT / tau)
    b = (1 - a) * tau / DT
    return lfilter([b, -b], [1, -a], E, axis=0)


def _hereditary(E, kernel):  # integral of kernel(t - u) dE(u)
    dE = np.diff(E, axis=0, prepend=E[:1])
    T = len(E)
    return fftconvolve(dE, kernel(DT * np.arange(T))[:, None], axes=0)[:T]


def viscoelastic_relaxation(w, rng):
    tau = float(np.exp(rng.uniform(np.log(0.15), np.log(3.0))))
    t1, t2, split = rng.uniform(0.08, 0.4), rng.uniform(1.5, 6.0), rng.uniform(0.35, 0.65)
    t0, al = 10 ** rng.uniform(-2, -0.8), rng.uniform(0.2, 0.5)
    off = rng.uniform(2.0, 4.0)
    mech = bool(rng.random() < 0.7)
    mk = lambda form, plain, smax, fn, par: Effect(
        "viscoelastic_relaxation", form, plain, smax, par, {"material": fn, "mechanical": mech}, 30
    )

    def one(s, st, E):
        return (1 - s) * E + s * st.memo(("mx", tau), E, lambda e: _branch(e, tau))

    def two(s, st, E):
        q = st.memo(("mx2", t1, t2), E, lambda e: split * _branch(e, t1) + (1 - split) * _branch(e, t2))
        return (1 - s) * E + s * q

    def log(s, st, E):
        return E - s * st.memo(("log", t0), E, lambda e: _hereditary(e, lambda t: np.log10(1 + t / t0)))

    def power(s, st, E):
        q = st.memo(("pow", t0, al), E, lambda e: _hereditary(e, lambda t: 1 - (1 + t / t0) ** -al))
        return E - s * q

    def asym(s, st, E):
        def run(e):
            c, out = np.zeros(e.shape[1]), np.empty_like(e)
            for i, x in enumerate(e):
                d = x - c
                c = c + d * np.where(d > 0, DT / tau, DT / (tau * off))
                out[i] = c
            return out

        return E - s * st.memo(("asym", tau, off), E, run)

    return [
        mk(
            "one exponential (standard linear solid)",
            True,
            0.75,
            one,
            lambda s: {"tau_s": tau, "fraction": s},
        ),
        mk(
            "two exponentials",
            False,
            0.75,
            two,
            lambda s: {"tau_s": [t1, t2], "fraction": [s * split, s * (1 - split)]},
        ),
        mk("logarithmic, per decade", False, 0.28, log, lambda s: {"fraction_per_decade": s, "tau0_s": t0}),
        mk("power law", False, 0.9, power, lambda s: {"fraction": s, "tau0_s": t0, "alpha": al}),
        mk(
            "creep fast on load, slow on recovery",
            False,
            0.75,
            asym,
            lambda s: {"tau_s": tau, "recovery_tau_s": tau * off, "fraction": s},
        ),
    ]


def _play(e, r):  # play operator; a face out of contact recovers in about 0.15 s
    p, out, keep = np.zeros(e.shape[1]), np.empty_like(e), np.exp(-DT / 0.15)
    for i, x in enumerate(e):
        p = np.where(x > 0, np.clip(p, x - r, x + r), keep * p)
        out[i] = p
    return out


def hysteresis(w, rng):
    d0 = w.d_ref
    r = rng.uniform(0.08, 0.35) * d0
    rs = np.sort(rng.uniform(0.03, 0.6, 5)) * d0
    ws = rng.dirichlet(np.ones(5) * 2)
    mech = bool(rng.random() < 0.6)
    n = rng.uniform(1.0, 2.0)
    mk = lambda form, plain, smax, fn, par: Effect(
        "hysteresis", form, plain, smax, par, {"material": fn, "mechanical": mech}, 40
    )

    def plain(s, st, E):
        return (1 - s) * E + s * (E - st.memo(("play", r), E, lambda e: _play(e, r)))

    def pi(s, st, E):
        q = st.memo(("pi", r), E, lambda e: sum(a * _play(e, b) for a, b in zip(ws, rs)))
        return E - s * q

    def duhem(s, st, E):
        def run(e):
            z, out = np.ones(e.shape[1]), np.empty_like(e)
            de = np.diff(e, axis=0, prepend=e[:1])
            for i in range(len(e)):
                sg = np.sign(de[i])
                z = sg + (z - sg) * np.exp(-np.abs(de[i]) / r)
                z[e[i] <= 0] = 1.0
                out[i] = z
            return out

        return E * (1 + s * st.memo(("duhem", r), E, run))

    def bouc(s, st, E):
        def run(e):
            z, out = np.zeros(e.shape[1]), np.empty_like(e)
            de = np.diff(e, axis=0, prepend=e[:1]) / r
            for i in range(len(e)):
                d, a = de[i], np.abs(z)
                z = np.clip(z + d - 0.6 * np.abs(d) * z * a ** (n - 1) - 0.4 * d * a**n, -1.2, 1.2)
                z = np.where(e[i] > 0, z, z * np.exp(-DT / 0.15))
                out[i] = z
            return out * r

        return (1 - s) * E + s * st.memo(("bouc", r, n), E, run)

    def preisach(s, st, E):  # generalised play, other envelopes on loading and unloading (asymmetric loop)
        def run(e):
            p, out = np.zeros(e.shape[1]), np.empty_like(e)
            lo = 0.5 * e**2 / d0
            hi = lo + (1.5 * r) * np.sqrt(np.maximum(e, 0) / d0)
            for i in range(len(e)):
                p = np.maximum(lo[i], np.minimum(hi[i], p))
                out[i] = p
            return out

        return E - s * st.memo(("gplay", r), E, run)

    return [
        mk("one play (Jenkin) element", True, 0.85, plain, lambda s: {"fraction": s, "width_m": r}),
        mk(
            "Prandtl-Ishlinskii, five plays",
            False,
            0.85,
            pi,
            lambda s: {"fraction": s, "width_m": rs.tolist(), "weights": ws.tolist()},
        ),
        mk(
            "loop proportional to the load (Duhem)",
            False,
            0.4,
            duhem,
            lambda s: {"fraction": s, "width_m": r},
        ),
        mk("Bouc-Wen", False, 0.85, bouc, lambda s: {"fraction": s, "width_m": r, "n": n}),
        mk(
            "generalised asymmetric play (Preisach class)",
            False,
            0.9,
            preisach,
            lambda s: {"fraction": s, "width_m": r},
        ),
    ]


def first_load_softening(w, rng):
    d0 = w.d_ref
    tau = rng.uniform(60, 300)
    rr, mm = rng.uniform(1.2, 2.0), rng.uniform(0.2, 0.6)
    mech = bool(rng.random() < 0.7)
    mk = lambda form, plain, smax, fn, par: Effect(
        "first_load_softening", form, plain, smax, par, {"material": fn, "mechanical": mech}, 20
    )

    def largest(st, E, recover=None):
        """Largest E so far per taxel over the whole session, in recording order; [T, M]."""
        out, m, last = np.empty_like(E), np.zeros(st.world.n), 0.0
        for k in st.world.seq:
            sl, t = st.sl[k], st.world.trials[k]
            e, tax = E[:, sl], st.tax[st.sl[k]]
            now = DT * np.arange(len(e))
            if recover is None:
                cm = np.maximum(np.maximum.accumulate(e, 0), m[tax])
            else:
                m *= np.exp(-(t.start - last) / recover)
                grow = np.exp(now / recover)[:, None]
                cm = np.maximum(np.maximum.accumulate(e * grow, 0), m[tax]) / grow
                m *= np.exp(-now[-1] / recover)
                last = t.start + now[-1]
            m[tax] = cm[-1]
            out[:, sl] = cm
        return np.maximum(out, 1e-9)

    def plain(s, st, E):
        return E * (1 - s * (1 - E / st.memo("max", E, lambda e: largest(st, e))))

    def ogden(s, st, E):
        def run(e):
            W, Wm = e**2, largest(st, e) ** 2
            return erf((Wm - W) / (mm * d0**2 + 0.2 * Wm)) / rr

        return E * (1 - s * st.memo(("ogden", rr, mm), E, run))

    def damage(s, st, E):
        return E * (1 - s * st.memo("damage", E, lambda e: 1 - np.exp(-2 * largest(st, e) / d0)))

    def recover(s, st, E):
        return E * (
            1 - s * (1 - E / st.memo(("maxrec", tau), E, lambda e: np.maximum(largest(st, e, tau), e)))
        )

    def work(s, st, E):  # softening with the path gone so far
        def run(e):
            out, acc = np.empty_like(e), np.zeros(st.world.n)
            for k in st.world.seq:
                sl = st.sl[k]
                tax = st.tax[sl]
                a = acc[tax] + np.cumsum(np.maximum(np.diff(e[:, sl], axis=0, prepend=e[:1, sl]), 0), 0)
                acc[tax] = a[-1]
                out[:, sl] = 1 - np.exp(-a / (1.5 * d0))
            return out

        return E * (1 - s * st.memo("work", E, run))

    return [
        mk(
            "ideal Mullins: softer below the largest depth so far",
            True,
            0.8,
            plain,
            lambda s: {"fraction": s},
        ),
        mk("Ogden-Roxburgh", False, 0.95, ogden, lambda s: {"fraction": s / rr, "m": mm}),
        mk(
            "damage grows with the largest load, also on the virgin curve",
            False,
            0.6,
            damage,
            lambda s: {"fraction": s},
        ),
        mk("Mullins with recovery", False, 0.85, recover, lambda s: {"fraction": s, "recovery_tau_s": tau}),
        mk("damage grows with the loading path", False, 0.6, work, lambda s: {"fraction": s}),
    ]
