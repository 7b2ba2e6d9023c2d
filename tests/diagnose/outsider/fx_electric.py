"""Readout effects that couple taxels or bend the response: saturation, row sharing, crosstalk, supply droop."""

import numpy as np
from outsider.core import Effect
from outsider.fx_geometry import _mat
from outsider.motion import DT
from scipy.signal import lfilter


def saturation(w, rng):
    peak = w.k * w.d_ref
    mk = lambda form, plain, fn, smax=3.5: Effect(
        "saturation",
        form,
        plain,
        smax,
        lambda s: {"knee_counts": peak / s},
        {"frame": lambda s, w, k, P: fn(P, np.float32(peak / s))},
        80,
    )
    m = rng.uniform(3, 6)
    return [
        mk("tanh", True, lambda P, K: K * np.tanh(P / K)),
        mk("rational x/(1+x/K)", False, lambda P, K: P / (1 + P / K), 4.5),
        mk("hard knee", False, lambda P, K: np.minimum(P, K)),
        mk("smooth knee of order %.1f" % m, False, lambda P, K: P / (1 + (P / K) ** m) ** (1 / m)),
        mk("exponential K(1-exp(-x/K))", False, lambda P, K: -K * np.expm1(-P / K), 4.0),
        mk("logarithmic K log(1+x/K)", False, lambda P, K: K * np.log1p(P / K), 6.0),
    ]


def _rows(w, P):
    Q = P.reshape(len(P), w.rows, w.cols)
    return Q, Q.sum(2, keepdims=True)


def row_sharing(w, rng):
    peak = w.k * w.d_ref
    kap = lambda s: np.float32(s / peak)

    def plain(s, w, k, P):
        Q, S = _rows(w, P)
        return (Q / (1 + kap(s) * (S - Q))).reshape(P.shape)

    def exact(s, w, k, raw):  # raw = G / (sum of the row's G + G_ref), the idle conductances included
        Q, S = _rows(w, raw)
        rest = w.idle.reshape(w.rows, w.cols).sum(1)[None, :, None]
        return (Q * (1 + kap(s) * rest) / (1 + kap(s) * S)).astype(np.float32).reshape(raw.shape)

    def linear(s, w, k, P):
        Q, S = _rows(w, P)
        return (Q * np.maximum(1 - kap(s) * (S - Q), 0.05)).reshape(P.shape)

    def whole(s, w, k, P):
        Q, S = _rows(w, P)
        return (Q / (1 + kap(s) * S)).reshape(P.shape)

    def bridge(
        s, w, k, P
    ):  # series resistance of the row's driver: the row's voltage falls as the root of the load
        Q, S = _rows(w, P)
        return (Q * 2 / (1 + np.sqrt(1 + 4 * kap(s) * (S - Q)))).reshape(P.shape)

    mk = lambda form, plain, smax, hooks: Effect(
        "row_sharing", form, plain, smax, lambda s: {"conductance_per_count": float(kap(s))}, hooks, 50
    )
    return [
        mk("divider by the others of the row", True, 0.8, {"frame": plain}),
        mk("exact divider with reference conductance, idle included", False, 0.8, {"total": exact}),
        mk("linear loss", False, 0.35, {"frame": linear}),
        mk("divider by the whole row, the taxel included", False, 0.8, {"frame": whole}),
        mk("series resistance of the driver, square-root law", False, 1.5, {"frame": bridge}),
    ]


def crosstalk(w, rng):
    a = rng.uniform(0.25, 1.0)
    fr, fc = (1.0, a) if rng.random() < 0.6 else (a, 1.0)
    same_row, same_col = w.ir[:, None] == w.ir[None], w.ic[:, None] == w.ic[None]
    dr, dc = np.abs(w.ir[:, None] - w.ir[None]), np.abs(w.ic[:, None] - w.ic[None])
    I = np.eye(w.n)
    length = rng.uniform(1.5, 4.0)
    near = lambda s: I + s * (fr * (same_row & (dc == 1)) + fc * (same_col & (dr == 1)))
    lines = lambda s: I + s * (fr * (same_row & (dc > 0)) + fc * (same_col & (dr > 0)))
    fade = lambda s: (
        I
        + s
        * (
            fr * same_row * (dc > 0) * np.exp(-(dc - 1) / length)
            + fc * same_col * (dr > 0) * np.exp(-(dr - 1) / length)
        )
    )
    step = (w.ic[None] - w.ic[:, None]) * same_row  # [from, to]

    def memory(s):  # the ADC keeps a part of the taxel read before, along the row
        K = (1 - s) * I + s * (step == 1)
        first = w.ic == 0
        K[first, first] = 1.0
        return K

    par = lambda s: {"row": s * fr, "col": s * fc}
    mk = lambda form, plain, smax, k, par=par: Effect(
        "crosstalk", form, plain, smax, par, {"frame": _mat(k)}, 40
    )

    right, down = same_row & (step == 1), same_col & ((w.ir[None] - w.ir[:, None]) == 1)
    lean = rng.uniform(0.1, 0.5)
    lopsided = lambda s: I + s * (fr * (right + lean * right.T) + fc * (down + lean * down.T))
    return [
        mk("nearest taxels along row and column", True, 0.3, near),
        mk("whole row and column alike", False, 0.06, lines),
        mk("along row and column, fading with distance", False, 0.2, fade),
        mk(
            "memory of the scan, along the row only",
            False,
            0.4,
            memory,
            lambda s: {"row": s, "col": 0.0, "one_sided": True},
        ),
        mk(
            "nearest taxels, stronger to one side",
            False,
            0.35,
            lopsided,
            lambda s: {**par(s), "other_side": lean},
        ),
    ]


def supply_droop(w, rng):
    st = w.stack((), False)
    load = np.stack([st.D[:, sl].sum(1) * w.k for sl in st.sl], 1)
    big = float(np.percentile(load.max(0), 75))  # load of a hard press, counts
    tau = np.exp(rng.uniform(np.log(0.04), np.log(0.3)))
    knee = rng.uniform(0.25, 0.55) * big
    kap = lambda s: np.float32(s / big)
    S = lambda P: P.sum(1, keepdims=True)
    par = lambda s: {"droop_per_count": float(kap(s))}

    def idle_too(s, w, k, raw):
        return raw * (1 + kap(s) * w.idle.sum()).astype(np.float32) / (1 + kap(s) * S(raw))

    def lagged(s, st, U):  # the regulator needs time
        a = np.exp(-DT / tau)
        out = np.empty_like(U)
        for sl in st.sl:
            f = lfilter([1 - a], [1, -a], U[:, sl].sum(1))
            out[:, sl] = U[:, sl] / (1 + kap(s) * f[:, None])
        return out

    def foldback(s, w, k, P):  # current limit: beyond the knee the supply gives way
        return P / (1 + kap(s) * np.maximum(S(P) - np.float32(knee), 0))

    mk = lambda form, plain, smax, hooks, par=par: Effect("supply_droop", form, plain, smax, par, hooks, 60)
    return [
        mk(
            "divided by 1 + load of the pad", True, 1.0, {"frame": lambda s, w, k, P: P / (1 + kap(s) * S(P))}
        ),
        mk("linear sag", False, 0.5, {"frame": lambda s, w, k, P: P * np.maximum(1 - kap(s) * S(P), 0.1)}),
        mk("sag that lags behind the load", False, 1.0, {"fine": lagged}, lambda s: {**par(s), "tau_s": tau}),
        mk(
            "current limit: sags beyond a knee",
            False,
            1.5,
            {"frame": foldback},
            lambda s: {**par(s), "knee_counts": knee},
        ),
        mk("idle level sags too", False, 1.0, {"total": idle_too}),
    ]
