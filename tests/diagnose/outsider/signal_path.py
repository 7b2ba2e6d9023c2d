"""From the touched taxels to raw readings, the baseline's refit and the achievable gain."""

import numpy as np
from outsider.core import World


def _sorted(effects, hook):
    return sorted((e for e in effects if e.has(hook)), key=lambda e: e.stage)


def elastic(st, effects, electric=True):
    """Equivalent elastic depth of the touched taxels; electric=False: only what the load cell sees too."""
    E = st.D
    for e in _sorted(effects, "material"):
        if electric or e.hooks.get("mechanical", True):
            E = e("material", st, E)
    return E


def contact(w: World, st, effects, scatter):
    U = w.k * (elastic(st, effects) + w.tau_d * st.V)
    U[(U < 0) | (st.D <= 0)] = 0
    if scatter:
        U *= np.array([t.g for t in w.trials])[st.tri][None, :]
    for e in _sorted(effects, "fine"):
        U = e("fine", st, U)
    return U


def simulate(w: World, effects, scatter, per_trial):
    """Calls per_trial(k, P, raw, src): response above idle [F, n], noise-free raw [F, n] (before noise and hold),
    and the frame that each frame repeats [F], [F, n] or None."""
    st = w.stack(effects, scatter)
    U = contact(w, st, effects, scatter)
    delays, frames = _sorted(effects, "delay"), _sorted(effects, "frame")
    totals, adds, holds = _sorted(effects, "total"), _sorted(effects, "add"), _sorted(effects, "hold")
    for k, t in enumerate(w.trials):
        sl = st.sl[k]
        tax = st.tax[sl]
        when = t.time + (t.stamp if scatter else 0)
        for e in delays:
            d = e("delay", w, k)  # [F] or [F, n]
            if d.ndim == 2:
                d = d[:, tax]
                when = when if when.ndim == 2 else when[:, None]
            elif when.ndim == 2:
                d = d[:, None]
            when = when - d
        P = np.zeros((len(t.time), w.n), np.float32)
        P[:, tax] = w.at(t, U[:, sl], when)
        for e in frames:
            P = e("frame", w, k, P)
        raw = P + w.idle.astype(np.float32)
        for e in totals:
            raw = e("total", w, k, raw)
        resp = raw - w.idle.astype(np.float32) if totals else P
        for e in adds:
            raw = raw + np.asarray(e("add", w, k), np.float32)
        src = None
        for e in holds:
            s = e("hold", w, k)
            if src is None:
                src = s
            else:
                s = np.broadcast_to(s[:, None], (len(t.time), w.n)) if s.ndim == 1 else s
                src = src[s] if src.ndim == 1 else np.take_along_axis(src, s, 0)
        per_trial(k, resp, raw, src)


def hold(raw, src):
    if src is None:
        return raw
    return raw[src] if src.ndim == 1 else np.take_along_axis(raw, src, 0)


def record(w: World, effects):
    """The final readings of every trial, noise and all."""
    out = [None] * len(w.trials)
    stuck = _sorted(effects, "stuck")

    def take(k, P, raw, src):
        y = raw + w.trials[k].noise
        for e in stuck:  # taxels whose line gives one number
            y = e("stuck", w, k, y)
        y = np.clip(hold(y, src), 0, w.fs)
        out[k] = np.rint(y) if w.quantised else y

    simulate(w, effects, True, take)
    return out


def predict(w: World, effects):
    """Noise-free prediction of the true model (with the effect's own realisation), and its response above idle."""
    pred, resp = [None] * len(w.trials), [None] * len(w.trials)
    stuck = _sorted(effects, "stuck")

    def take(k, P, raw, src):
        for e in stuck:
            raw = e("stuck", w, k, raw)
        pred[k] = np.clip(hold(raw, src), 0, w.fs)
        resp[k] = np.abs(P).max(0)

    simulate(w, effects, False, take)
    return pred, resp


def nominal(w: World):
    """Column height and rate at the frames as the logged motion gives them."""
    if "nominal" not in w._cache:
        st, out = w.stack((), False), []
        for k, t in enumerate(w.trials):
            sl = st.sl[k]
            D = w.at(t, st.D[:, sl], t.time)
            V = np.where(D > 0, w.at(t, st.V[:, sl], t.time), 0)
            out.append((st.tax[sl], D, V, D.max(0) > 0, t.z[0] if not len(D) else None))
        free = [np.interp(t.time, t.tf, t.z) < -0.02e-3 for t in w.trials]
        w._cache["nominal"] = (out, free)
    return w._cache["nominal"]


def refit(w: World, data, active):
    """Best k (= gain k_n) and k_d of the baseline by least squares; MSE per trial on the active taxels."""
    nom, free = nominal(w)
    total = sum(f.sum() for f in free)
    idle = sum(y[f].sum(0, dtype=np.float64) for y, f in zip(data, free)) / total
    y, d, v, wt, rest = [], [], [], [], []
    for k, (tax, D, V, touched, _) in enumerate(nom):
        act = active[k]
        use = act[tax] & touched
        cols = tax[use]
        weight = 1.0 / (len(D) * act.sum())
        y.append((data[k][:, cols] - idle[cols]).ravel())
        d.append(D[:, use].ravel())
        v.append(V[:, use].ravel())
        top = np.broadcast_to(w.fs - idle[cols], D[:, use].shape).ravel()
        wt.append((weight, top))
        other = act.copy()
        other[cols] = False
        rest.append(float(((data[k][:, other] - idle[other]) ** 2).sum()) * weight)
    sizes = [len(a) for a in y]
    y, d, v = np.concatenate(y), np.concatenate(d), np.concatenate(v)
    weight = np.concatenate([np.full(len(t), a) for a, t in wt])
    top = np.concatenate([t for _, t in wt])
    on = d > 0
    best, p = None, np.array([w.k, w.k * w.tau_d])
    for step in range(7):
        f = p[0] * d + p[1] * v
        r = y - np.clip(np.where(on, f, 0), 0, top)
        mse = float((weight * r * r).sum())
        if best is None or mse < best[0]:
            best = (mse, p, r)
        elif step > 2:
            break
        u = on & (f > 0) & (f < top)
        A = np.stack([d[u], v[u]], 1) * np.sqrt(weight[u])[:, None]
        p = np.linalg.lstsq(A, y[u] * np.sqrt(weight[u]), rcond=None)[0]
        p = np.maximum(p, [1e-9, 0.0])
    r2 = weight * best[2] ** 2
    cuts = np.cumsum([0] + sizes)
    per_trial = np.array([r2[a:b].sum() for a, b in zip(cuts[:-1], cuts[1:])]) + rest
    return best[1], per_trial, idle


def achieved(w: World, effects, detail=False):
    """1 - MSE(true model) / MSE(best refitted baseline), mean over trials of the MSE over frames and active taxels."""
    data = record(w, effects)
    pred, resp = predict(w, effects)
    nom, _ = nominal(w)
    active = []
    for k, (tax, D, V, touched, _) in enumerate(nom):
        a = resp[k] > w.threshold
        a[tax[touched]] = True
        active.append(a)
    p, base, idle = refit(w, data, active)
    true = np.array([((data[k][:, a] - pred[k][:, a]) ** 2).mean() for k, a in enumerate(active)])
    gain = float(1 - true.mean() / base.mean())
    if detail:
        return (
            gain,
            data,
            dict(
                rmse_baseline=float(np.sqrt(base.mean())),
                rmse_true=float(np.sqrt(true.mean())),
                k_refit_counts_per_m=float(p[0]),
                kd_refit_counts_s_per_m=float(p[1]),
                gain_per_trial=[round(float(1 - a / b), 4) for a, b in zip(true, base)],
            ),
        )
    return gain


def calibrate(w: World, set_strength, smax, target, tol=0.008, tries=14):
    """Strength at which the achievable gain is `target`: the squared effect grows about as s^2, with a bracket."""
    lo = hi = None  # (s, logit of the gain) below and above the target
    best, s = (9.0, 0.0, 0.0), smax * 0.15
    logit = lambda g: float(np.log(max(g, 1e-3) / max(1 - g, 1e-3)))
    for step in range(tries):
        set_strength(s)
        g = achieved_of(w)
        if abs(g - target) < best[0]:
            best = (abs(g - target), s, g)
        if best[0] < tol or (g < target and s >= smax * 0.999):
            break
        if g < target and (lo is None or s > lo[0]):
            lo = (s, logit(g))
        elif g >= target and (hi is None or s < hi[0]):
            hi = (s, logit(g))
        if lo is None or hi is None or lo[0] >= hi[0]:  # the squared effect grows about as s^2
            s = min(s * float(np.clip(np.exp((logit(target) - logit(g)) / 2), 0.2, 5)), smax)
            continue
        a, b = np.log(lo[0]), np.log(hi[0])
        frac = (logit(target) - lo[1]) / max(hi[1] - lo[1], 1e-9)
        s = float(np.exp(a + (b - a) * (0.5 if step % 4 == 3 else np.clip(frac, 0.05, 0.95))))
    set_strength(best[1])
    return best[1], best[2]


def achieved_of(w):
    return achieved(w, w.effects)
