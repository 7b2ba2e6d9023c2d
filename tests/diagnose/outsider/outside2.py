"""More causes that are not in the catalogue."""

import numpy as np
from outsider.core import Effect
from outsider.motion import DT
from outsider.outside import (
    _events,
    _temp_gain,
    column_loading,
    lateral_shift,
    mains_hum,
    neighbour_pulses,
    slide_direction,
    supply_dips,
)


def intermittent_taxel(w, rng):
    st = w.stack((), False)
    e = np.zeros(w.n)
    np.add.at(e, st.tax, (st.D**2).sum(0))
    strong = np.argsort(-e)[: max(4, int(0.3 * (e > 0).sum()))]
    bad = rng.permutation(strong)[: int(rng.integers(1, 5))]
    mean_bad, u = rng.uniform(0.1, 0.6), []
    for t in w.trials:  # two-state process per bad taxel
        states = []
        for _ in bad:
            x, now, on = np.zeros(len(t.time)), 0.0, rng.random() < 0.3
            while now < t.time[-1]:
                d = rng.exponential(mean_bad if on else mean_bad * 2)
                if on:
                    x[(t.time >= now) & (t.time < now + d)] = 1
                now, on = now + d, not on
            states.append(x)
        u.append(np.stack(states, 1))

    def frame(s, w, k, P):
        P = P.copy()
        P[:, bad] *= (1 - s * u[k]).astype(np.float32)
        return P

    return [
        Effect(
            "intermittent_taxel",
            "bad joints lose the signal now and then",
            False,
            1.0,
            lambda s: {"taxels": [[int(w.ir[i]), int(w.ic[i])] for i in bad], "loss": s},
            {"frame": frame},
        )
    ]


def remount_tilt(w, rng):
    n = int(rng.integers(2, 5))
    cuts = np.sort(rng.choice(np.arange(2, 15), n, replace=False))
    mount = {k: int(np.searchsorted(cuts, w.trials[k].order, "right")) for k in range(16)}
    tilts, drop = rng.standard_normal((n + 1, 2)), rng.standard_normal(n + 1) * 0.3
    hx = (w.cols - 1) / 2 * w.pitch

    def geom(s, w, k):
        m = mount[k]
        return 0, 0, s * hx * 0.3 * drop[m], s * (tilts[m, 0] * w.ty - tilts[m, 1] * w.tx)

    each = rng.standard_normal((16, 2))

    def every(s, w, k):
        return 0, 0, 0, s * (each[k, 0] * w.ty - each[k, 1] * w.tx)

    lim = min(0.1, 0.6e-3 / hx)
    return [
        Effect(
            "remount_tilt",
            "mounted anew a few times",
            False,
            lim,
            lambda s: {"sigma_rad": s, "before_order": cuts.tolist()},
            {"geom": geom},
            5,
        ),
        Effect(
            "remount_tilt",
            "another tilt in each trial",
            False,
            lim,
            lambda s: {"sigma_rad": s},
            {"geom": every},
            5,
        ),
    ]


def gain_scatter(w, rng):
    z, steps = rng.standard_normal(16), np.sort(rng.choice(np.arange(2, 15), 2, replace=False))
    lev = rng.standard_normal(3)
    blk = np.array([lev[int(np.searchsorted(steps, t.order, "right"))] for t in w.trials])
    mk = lambda form, v: Effect(
        "gain_scatter",
        form,
        False,
        0.12,
        lambda s: {"sigma": float(s * np.std(v))},
        {"frame": lambda s, w, k, P: P * np.float32(max(1 + s * v[k], 0.2))},
    )
    return [
        mk("another gain in each recording", z - z.mean()),
        mk("the gain changes twice in the session", blk - blk.mean()),
    ]


def memory_over_trials(w, rng):
    tau, fill = rng.uniform(20, 120), rng.uniform(0.5, 2.0)
    d0 = w.d_ref

    def memory(st):
        """After-effect left on each taxel when a trial starts: grows with the dwell, fades with time; {k: [n]}."""
        if "memory" not in st.cache:
            m, last, out = np.zeros(st.world.n), 0.0, {}
            for k in st.world.seq:
                t, sl = st.world.trials[k], st.sl[k]
                m = m * np.exp(-(t.start - last) / tau)
                out[k] = m.copy()
                dwell = np.bincount(st.tax[sl], st.D[:, sl].sum(0) * DT / d0, st.world.n)
                m = m + (1 - m) * (1 - np.exp(-dwell / fill))
                last = t.start + t.time[-1]
            st.cache["memory"] = out
        return st.cache["memory"]

    def gain(s, st, U):
        out, m = U.copy(), memory(st)
        for k, sl in enumerate(st.sl):
            out[:, sl] *= 1 - s * m[k][st.tax[sl]][None]
        return out

    def rest(s, w, k):  # the idle level stays up where it was pressed before
        m = memory(w.stack((), False))[k]
        t = w.trials[k].time
        return s * w.fs * np.exp(-t / tau)[:, None] * m[None]

    par = lambda s: {"fraction": s, "tau_s": tau, "fill_s": fill}
    return [
        Effect("memory_over_trials", "softer where an earlier trial dwelt", False, 0.7, par, {"fine": gain}),
        Effect(
            "memory_over_trials",
            "idle level raised where an earlier trial dwelt",
            False,
            0.15,
            par,
            {"add": rest},
        ),
    ]


def rate_dependent_gain(w, rng):
    v0 = rng.uniform(0.3e-3, 2e-3)
    tau = rng.uniform(0.05, 0.3)

    def both(s, st, U):
        return U * (1 + s * np.log10(1 + np.abs(st.V) / v0))

    def press(s, st, U):  # strain hardening of the press only
        return U * (1 + s * np.maximum(st.V, 0) / (np.maximum(st.V, 0) + 4 * v0))

    par = lambda s: {"fraction": s, "v0_m_per_s": v0}
    return [
        Effect(
            "rate_dependent_gain",
            "gain rises with the log of the speed, either way",
            False,
            0.9,
            par,
            {"fine": both},
        ),
        Effect(
            "rate_dependent_gain",
            "gain rises with the speed of pressing, levels off",
            False,
            1.2,
            par,
            {"fine": press},
        ),
    ]


def debris(w, rng):
    c = w.conds[int(rng.integers(8))]
    x, y = c["x"] + rng.normal(0, 1.5e-3), c["y"] + rng.normal(0, 1.5e-3)
    wd = rng.uniform(1.0e-3, 3e-3)
    bump = np.exp(-((w.tx - x) ** 2 + (w.ty - y) ** 2) / (2 * wd**2))
    since = int(rng.integers(3, 9)) if rng.random() < 0.4 else 0

    def geom(s, w, k):
        return 0, 0, 0, s * bump * (w.trials[k].order >= since)

    return [
        Effect(
            "debris",
            "a crumb under the pad lifts its face at one spot",
            False,
            0.9e-3,
            lambda s: {"height_m": s, "at_m": [x, y], "width_m": wd, "from_order": since},
            {"geom": geom},
            5,
        )
    ]


def cable_bursts(w, rng):
    ev = _events(w, rng, rng.uniform(0.25, 0.7), 0.15, 0.8)
    st = w.stack((), False)
    pressed = np.bincount(w.ic[st.tax], (st.D**2).sum(0), w.cols)
    a = int(rng.choice(w.cols, p=pressed / pressed.sum()))
    hit = (np.abs(w.ic - a) <= int(rng.integers(1, 6))) if rng.random() < 0.6 else np.ones(w.n, bool)
    noise = []
    for t, e in zip(w.trials, ev):
        g = np.zeros(len(t.time))
        for b, l, h in zip(*e):
            g = np.maximum(g, h * ((t.time > b) & (t.time < b + l)))
        common = rng.standard_normal(len(t.time))[:, None]
        noise.append(
            (g[:, None] * (0.7 * common + 0.7 * rng.standard_normal((len(t.time), w.n))) * hit[None]).astype(
                np.float32
            )
        )
    return [
        Effect(
            "cable_bursts",
            "bursts of noise, partly common, on a few columns or all",
            False,
            0.3 * w.fs,
            lambda s: {"sigma_counts": s, "columns": sorted(set(w.ic[hit].tolist()))},
            {"add": lambda s, w, k: s * noise[k]},
        )
    ]


def rig_compliance(w, rng):
    """The arm gives way: the true depth is less than the encoder's by the total load times the compliance."""
    tables = {}

    def geom(s, w, k):
        t = w.trials[k]
        if k not in tables:  # load (in metres of column height) against depth at this site
            base = w.columns(k)[0].sum(1)
            tables[k] = np.maximum(base, 0)
        load, z = tables[k], t.z
        order = np.argsort(z)
        zs, ls = z[order], np.maximum.accumulate(load[order])
        x = z.copy()
        for _ in range(25):  # z_true = z - s * load(z_true)
            x = 0.5 * x + 0.5 * (z - s * np.interp(x, zs, ls))
        return 0, 0, np.minimum(x - z, 0), 0

    big = float(np.percentile([w.columns(k)[0].sum(1).max() for k in range(0, 16, 2)], 75))
    return [
        Effect(
            "rig_compliance",
            "the arm bends under the load",
            False,
            0.6 * w.d_ref / big,
            lambda s: {"m_per_n": s / w.k_n},
            {"geom": geom},
            5,
        )
    ]


OUTSIDE = {
    f.__name__: f
    for f in (
        slide_direction,
        column_loading,
        mains_hum,
        supply_dips,
        neighbour_pulses,
        lateral_shift,
        intermittent_taxel,
        remount_tilt,
        gain_scatter,
        memory_over_trials,
        rate_dependent_gain,
        debris,
        cable_bursts,
        rig_compliance,
    )
}
OUTSIDE["temperature_gain_unlogged"] = _temp_gain(False)
OUTSIDE["temperature_gain_logged"] = _temp_gain(True)
