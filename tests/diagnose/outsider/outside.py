"""Causes that are not in the catalogue. Each factory returns its forms (the first is drawn most often)."""

import numpy as np
from outsider.core import Effect
from outsider.motion import DT


def _temperature(w, rng):
    T, tau = w.session, rng.uniform(0.15, 0.5) * w.session
    a, b, per, ph = (
        rng.uniform(3, 8) * rng.choice([1, 1, -1]),
        rng.uniform(0.3, 1.5),
        rng.uniform(0.3, 0.9) * w.session,
        rng.uniform(0, 6),
    )
    return lambda t: 23 + a * (1 - np.exp(-t / tau)) + b * np.sin(2 * np.pi * t / per + ph)


def _temp_gain(logged):
    def make(w, rng):
        temp = _temperature(w, rng)
        mid = float(np.mean([temp(t.start) for t in w.trials]))
        swing = max(abs(temp(t.start) - mid) for t in w.trials)

        def frame(s, w, k, P):
            t = w.trials[k]
            return P * (1 + s / swing * (temp(t.start + t.time) - mid)).astype(np.float32)[:, None]

        def arrhenius(s, w, k, P):
            t = w.trials[k]
            return P * np.exp(s / swing * (temp(t.start + t.time) - mid) * 1.0).astype(np.float32)[:, None]

        w.temperature = temp
        name = "temperature_gain_logged" if logged else "temperature_gain_unlogged"
        par = lambda s: {"per_kelvin": s / swing, "reference_c": mid}
        return [
            Effect(name, "gain linear in temperature", False, 0.3, par, {"frame": frame}),
            Effect(name, "gain exponential in temperature", False, 0.3, par, {"frame": arrhenius}),
        ]

    return make


def slide_direction(w, rng):
    ang, v0 = rng.choice([0, np.pi / 2, np.pi, -np.pi / 2]), rng.uniform(1e-3, 4e-3)
    ex, ey = np.cos(ang), np.sin(ang)

    def velocity(w, k):
        t = w.trials[k]
        return np.gradient(t.x, DT), np.gradient(t.y, DT)

    def whole(s, st, U):  # the pad's grain: stronger one way, weaker the other
        U = U.copy()
        for k, sl in enumerate(st.sl):
            vx, vy = velocity(st.world, k)
            U[: len(vx), sl] *= (1 + s * np.tanh((vx * ex + vy * ey) / v0))[:, None]
        return U

    def leading(s, st, U):  # friction tips the load towards the leading edge
        U = U.copy()
        w = st.world
        for k, sl in enumerate(st.sl):
            t, (vx, vy) = w.trials[k], velocity(w, k)
            v = np.hypot(vx, vy)
            a = np.tanh(v / v0) / (v + 1e-9)
            tax = st.tax[sl]
            lever = (
                (w.tx[tax] - t.x[:, None]) * (a * vx)[:, None]
                + (w.ty[tax] - t.y[:, None]) * (a * vy)[:, None]
            ) / 5e-3
            U[: len(vx), sl] *= np.clip(1 + s * lever, 0.1, 2)
        return U

    par = lambda s: {"fraction": s, "v0_m_per_s": v0, "direction_rad": float(ang)}
    return [
        Effect("slide_direction", "whole contact, one way stronger", False, 0.7, par, {"fine": whole}),
        Effect("slide_direction", "load tips to the leading edge", False, 0.9, par, {"fine": leading}),
    ]


def column_loading(w, rng):
    peak = w.k * w.d_ref

    def frame(s, w, k, P):
        Q = P.reshape(len(P), w.rows, w.cols)
        return (Q / (1 + np.float32(s / peak) * (Q.sum(1, keepdims=True) - Q))).reshape(P.shape)

    return [
        Effect(
            "column_loading",
            "divider by the others of the column",
            False,
            1.0,
            lambda s: {"conductance_per_count": s / peak},
            {"frame": frame},
        )
    ]


def mains_hum(w, rng):
    f, phases = rng.choice([50.0, 60.0]) * (1 + rng.normal(0, 2e-4)), rng.uniform(0, 2 * np.pi, 16)
    third = rng.uniform(0, 0.5)
    weight = np.clip(1 + 0.15 * rng.standard_normal(w.n), 0.3, 2)

    def add(s, w, k):
        a = 2 * np.pi * f * w.trials[k].time + phases[k]
        return s * (np.sin(a) + third * np.sin(3 * a))[:, None] * weight[None]

    def mult(s, w, k, P):  # ripple of the supply: scales the response
        a = 2 * np.pi * f * w.trials[k].time + phases[k]
        return P * (1 + s / w.fs * 4 * np.sin(a)).astype(np.float32)[:, None]

    par = lambda s: {"hz": f, "amplitude_counts": s}
    return [
        Effect("mains_hum", "additive, shared by all taxels", False, 0.06 * w.fs, par, {"add": add}),
        Effect(
            "mains_hum",
            "ripple of the supply, multiplies the response",
            False,
            0.08 * w.fs,
            par,
            {"frame": mult},
        ),
    ]


def _events(w, rng, rate, lo, hi):
    out = []
    for t in w.trials:
        n = rng.poisson(rate * t.time[-1])
        out.append(
            (
                rng.uniform(0, t.time[-1], n),
                np.exp(rng.uniform(np.log(lo), np.log(hi), n)),
                rng.uniform(0.4, 1, n),
            )
        )
    return out


def supply_dips(w, rng):
    ev, shape = _events(w, rng, rng.uniform(0.3, 0.9), 0.08, 0.5), rng.random() < 0.5

    def dip(w, k):
        t, d = w.trials[k].time, 0.0
        for a, l, h in zip(*ev[k]):
            x = t - a
            d = np.maximum(d, h * (np.exp(-x / l) if shape else (x < l)) * (x > 0))
        return np.zeros(len(t)) + d

    total = lambda s, w, k, raw: raw * (1 - s * dip(w, k)).astype(np.float32)[:, None]
    frame = lambda s, w, k, P: P * (1 - s * dip(w, k)).astype(np.float32)[:, None]
    par = lambda s: {"depth": s, "decay": bool(shape)}
    return [
        Effect("supply_dips", "raw reading dips, idle included", False, 0.6, par, {"total": total}, 70),
        Effect("supply_dips", "response dips (ratiometric idle)", False, 0.7, par, {"frame": frame}, 70),
    ]


def neighbour_pulses(w, rng):
    period, duty, ph = rng.uniform(0.5, 1.6), rng.uniform(0.15, 0.4), rng.uniform(0, 1, 16)
    ev = _events(w, rng, 0.5, 0.1, 0.6)
    side = rng.choice([-1, 1])
    fade = np.exp(-(np.abs(side * w.tx.max() - w.tx)) / rng.uniform(0.012, 0.04))
    even = np.ones(w.n)

    def regular(s, w, k):
        return s * (((w.trials[k].time / period + ph[k]) % 1) < duty)[:, None] * even[None]

    def touch(s, w, k):  # a neighbouring pad on the same board is touched: strongest at that side
        t, p = w.trials[k].time, 0.0
        for a, l, h in zip(*ev[k]):
            p = p + h * np.exp(-0.5 * ((t - a) / l) ** 2)
        return s * (np.zeros(len(t)) + p)[:, None] * fade[None]

    return [
        Effect(
            "neighbour_pulses",
            "square pulses at a steady period",
            False,
            0.12 * w.fs,
            lambda s: {"counts": s, "period_s": period, "duty": duty},
            {"add": regular},
        ),
        Effect(
            "neighbour_pulses",
            "bumps, strongest at one side",
            False,
            0.2 * w.fs,
            lambda s: {"counts": s},
            {"add": touch},
        ),
    ]


def lateral_shift(w, rng):
    ang = rng.uniform(0, 2 * np.pi)
    ex, ey, d0, tau = np.cos(ang), np.sin(ang), w.d_ref, rng.uniform(0.5, 3)

    def load(s, w, k):  # slides in proportion to the load
        a = s * np.clip(w.trials[k].z / d0, 0, None)
        return a * ex, a * ey, 0, 0

    def creep(s, w, k):  # creeps while it is pressed, comes back when free
        z, c, out = w.trials[k].z > 0, 0.0, []
        for on in z:
            c += DT * ((1 - c) / tau if on else -c / 0.2)
            out.append(c)
        a = s * np.array(out)
        return a * ex, a * ey, 0, 0

    par = lambda s: {"shift_m": [s * ex, s * ey]}
    return [
        Effect("lateral_shift", "in proportion to the depth", False, 2.5e-3, par, {"geom": load}, 5),
        Effect("lateral_shift", "creeping under load", False, 2.5e-3, par, {"geom": creep}, 5),
    ]
