"""Effects in time: drift, latency, skew of the scan, repeated readings."""

import numpy as np
from outsider.core import Effect


def baseline_drift(w, rng):
    T = w.session
    part = 1 + 0.25 * rng.standard_normal(w.n)  # taxels drift a little differently
    each = rng.standard_normal(w.n)
    sign = 1 if rng.random() < 0.6 else -1
    tau = rng.uniform(0.12, 0.45) * T
    grid = np.linspace(0, T, 400)
    walk = np.cumsum(rng.standard_normal(400))
    walk = (walk - walk[0]) / np.abs(walk).max()
    n = int(rng.integers(1, 4))
    at, jump = np.sort(rng.uniform(0.1, 0.9, n)) * T, rng.uniform(0.4, 1, n) * rng.choice([-1, 1], n)
    lim = 0.07 * w.fs
    sess = lambda w, k: w.trials[k].start + w.trials[k].time

    def mk(form, plain, fn, per=part, par=lambda s: {}, mx=lim):
        return Effect(
            "baseline_drift",
            form,
            plain,
            mx,
            par,
            {"add": lambda s, w, k: s * fn(k)[:, None] * per[None]},
            50,
        )

    return [
        mk(
            "linear over the session",
            True,
            lambda k: sign * sess(w, k) / T,
            par=lambda s: {"rate_counts_per_s": sign * s / T},
        ),
        mk(
            "warm-up: exponential approach",
            False,
            lambda k: sign * (1 - np.exp(-sess(w, k) / tau)),
            par=lambda s: {"rise_counts": sign * s, "tau_s": tau},
        ),
        mk(
            "random walk",
            False,
            lambda k: np.interp(sess(w, k), grid, walk),
            par=lambda s: {"span_counts": s},
        ),
        mk(
            "steps now and then",
            False,
            lambda k: sum(j * (sess(w, k) > a) for a, j in zip(at, jump)),
            par=lambda s: {"at_s": at.tolist(), "jump_counts": (s * jump).tolist()},
        ),
        mk(
            "linear, each taxel with its own rate and sign",
            False,
            lambda k: sess(w, k) / T,
            each,
            lambda s: {"rate_sigma_counts_per_s": s / T},
        ),
        mk(
            "linear within a trial, anew each time the scan is switched on",
            False,
            lambda k: sign * w.trials[k].time / 7,
            par=lambda s: {"rate_counts_per_s": sign * s / 7, "per_trial": True},
            mx=0.05 * w.fs,
        ),
    ]


def latency(w, rng):
    cv = rng.uniform(0.3, 0.6)
    draws = [rng.gamma(1 / cv**2, cv**2, len(t.time)) for t in w.trials]
    per = rng.uniform(0.2, 1.8, len(w.trials))
    grow = rng.uniform(0.15, 0.5)

    def jit(s, w, k):
        t = w.trials[k].time
        return t - np.maximum.accumulate(t - s * draws[k])

    mk = lambda form, plain, fn, par: Effect("latency", form, plain, 0.3, par, {"delay": fn}, 10)
    full = lambda k, v: np.full(len(w.trials[k].time), v)
    return [
        mk("constant", True, lambda s, w, k: full(k, s), lambda s: {"tau_s": s}),
        mk("jittered from frame to frame", False, jit, lambda s: {"tau_s": s, "cv": cv}),
        mk(
            "another one in each trial",
            False,
            lambda s, w, k: full(k, s * per[k]),
            lambda s: {"tau_s": (s * per).tolist()},
        ),
        mk(
            "a backlog that grows within the trial",
            False,
            lambda s, w, k: s * (1 + grow * (w.trials[k].time - 3)).clip(0.1),
            lambda s: {"tau_s": s, "growth_per_s": s * grow},
        ),
    ]


def scan_skew(w, rng):
    R, C = w.rows, w.cols
    r, c = w.ir / (R - 1), w.ic / (C - 1)
    lim = 0.95 / w.rate
    elem = (w.ir * C + w.ic) / (w.n - 1)
    inter = np.where(w.ir % 2 == 0, w.ir // 2, (R + 1) // 2 + w.ir // 2) / (R - 1)

    def mk(form, plain, m, par):
        return Effect(
            "scan_skew",
            form,
            plain,
            lim,
            par,
            {"delay": lambda s, w, k: np.broadcast_to(s * m[None], (len(w.trials[k].time), w.n))},
            20,
        )

    return [
        mk("row by row", True, r, lambda s: {"skew_s": s}),
        mk(
            "element by element, row-major",
            False,
            elem,
            lambda s: {"skew_s": s * (R * C - C) / (R * C - 1), "element_s": s / (w.n - 1)},
        ),
        mk(
            "row by row, last row first (stamp at the last row)",
            False,
            1 - r,
            lambda s: {"skew_s": -s, "tau_s": s},
        ),
        mk("interleaved: even rows, then odd rows", False, inter, lambda s: {"sweep_s": s}),
        mk("column by column", False, c, lambda s: {"column_skew_s": s}),
    ]


def sample_and_hold(w, rng):
    phase = rng.uniform(0, 1, (len(w.trials), 4))
    u = [rng.random(len(t.time)) for t in w.trials]
    rate_max, least = rng.uniform(0.5, 1.2), 1.25 / w.rate
    ev = []
    for t in w.trials:
        n = rng.poisson(rate_max * t.time[-1])
        ev.append((rng.uniform(0, t.time[-1], n), rng.uniform(0.3, 1.7, n)))
    groups = int(rng.integers(2, 4))
    block = np.minimum(w.ir * groups // w.rows, groups - 1) if rng.random() < 0.5 else w.ir % groups

    def ticks(s, k, j=0):  # the sensor's period is longer than the host's, else nothing would repeat
        s = least + s
        t = w.trials[k].time
        ph = phase[k, j] * s
        g = np.floor((t + ph) / s)
        lead = np.searchsorted(g, g, "left")
        return lead, t - np.maximum(g * s - ph, -0.5)

    def from_flags(keep):  # repeat the last frame not dropped
        i = np.where(keep, np.arange(len(keep)), 0)
        i[0] = 0
        return np.maximum.accumulate(i)

    def bursts(s, w, k):
        t, keep = w.trials[k].time, np.ones(len(w.trials[k].time), bool)
        for x, y in zip(*ev[k]):
            keep &= ~((t > x) & (t < x + y * s))
        keep[0] = True
        return from_flags(keep)

    def blocks(s, w, k):
        leads = np.stack([ticks(s, k, j)[0] for j in range(groups)], 1)
        return leads[:, block]

    def drop(s, w, k):
        keep = u[k] >= s
        keep[0] = True
        return from_flags(keep)

    mk = lambda form, plain, smax, hooks, par: Effect("sample_and_hold", form, plain, smax, par, hooks, 50)
    return [
        mk(
            "fixed period",
            True,
            0.7,
            {"hold": lambda s, w, k: ticks(s, k)[0], "delay": lambda s, w, k: ticks(s, k)[1]},
            lambda s: {"period_s": least + s},
        ),
        mk(
            "random drop-outs: a frame repeats the last one",
            False,
            0.93,
            {"hold": drop},
            lambda s: {"probability": s, "period_s": 1 / w.rate / (1 - s)},
        ),
        mk(
            "bursts: the stream freezes for a while",
            False,
            1.5,
            {"hold": bursts},
            lambda s: {"freezes_per_s": rate_max, "mean_freeze_s": s},
        ),
        mk(
            "blocks of rows refreshed in turn, each with the same period",
            False,
            0.7,
            {"hold": blocks},
            lambda s: {"period_s": least + s, "groups": groups},
        ),
    ]
