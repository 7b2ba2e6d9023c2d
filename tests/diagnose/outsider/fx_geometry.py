"""Contact geometry and static maps: offset, tilt, spreading, gain spread, dead taxels."""

import numpy as np
from outsider.core import Effect


def contact_offset(w, rng):
    d0 = w.d_ref
    face = rng.standard_normal(w.n)
    cv = rng.uniform(0.3, 0.6)
    sg = 1 if rng.random() < 0.7 else -1
    mk = lambda form, plain, smax, hooks, par, st=5: Effect(
        "contact_offset", form, plain, smax, par, hooks, st
    )
    toe = lambda s, st, E: np.maximum(E - s * (1 - np.exp(-E / max(s, 1e-9))), 0)
    return [
        mk(
            "constant, late" if sg > 0 else "constant, early",
            True,
            0.45 * d0,
            {"geom": lambda s, w, k: (0, 0, -sg * s, 0)},
            lambda s: {"offset_m": sg * s},
        ),
        mk(
            "soft toe: the offset builds up over its own length",
            False,
            0.5 * d0,
            {"material": toe},
            lambda s: {"offset_m": s},
        ),
        mk(
            "late, face uneven from taxel to taxel",
            False,
            0.4 * d0,
            {"geom": lambda s, w, k: (0, 0, 0, -s * (1 + cv * face))},
            lambda s: {"offset_m": s, "cv": cv},
        ),
        mk(
            "dead band of the readout: nothing below a threshold",
            False,
            0.4,
            {"frame": lambda s, w, k, P: np.maximum(P - np.float32(s * w.k * d0), 0)},
            lambda s: {"threshold_counts": s * w.k * d0, "offset_m": s * d0},
            90,
        ),
    ]


def pad_tilt(w, rng):
    ang = rng.uniform(0, 2 * np.pi)
    ax, ay = np.cos(ang), np.sin(ang)
    edge = int(rng.integers(4))
    hx, hy = (w.cols - 1) / 2 * w.pitch, (w.rows - 1) / 2 * w.pitch
    px, py = [(-hx, 0), (hx, 0), (0, -hy), (0, hy)][edge]
    bow = rng.uniform(0.2, 0.5) * (1 if rng.random() < 0.5 else -1)
    lim = min(0.15, 0.9e-3 / hx)
    plane = lambda s: s * (ax * w.ty - ay * w.tx)
    mk = lambda form, plain, fn, par, mx=lim: Effect(
        "pad_tilt", form, plain, mx, par, {"geom": lambda s, w, k: (0, 0, 0, fn(s))}, 5
    )
    tilt = lambda s: {"tilt_x_rad": s * ax, "tilt_y_rad": s * ay}

    def edged(s):
        return s * (ax * (w.ty - py) - ay * (w.tx - px))

    def bowed(s):
        u2 = (w.tx / hx) ** 2
        return plane(s) + bow * s * hx * (u2 - u2.mean())

    return [
        mk("about the pad's centre", True, plane, tilt),
        mk("hinged at an edge", False, edged, lambda s: {**tilt(s), "pivot_m": [px, py]}, lim * 0.8),
        mk("tilted and bowed", False, bowed, lambda s: {**tilt(s), "bow_m": bow * s * hx}),
        mk(
            "one axis only, steeper",
            False,
            lambda s: s * (w.ty if edge % 2 else -w.tx),
            lambda s: {"tilt_x_rad": s * (edge % 2), "tilt_y_rad": s * (1 - edge % 2)},
            lim * 1.3,
        ),
    ]


def _mat(effect_kernel):
    def hook(s, w, k, P):
        key = ("K", effect_kernel, s)
        if key not in w._cache:
            for q in [q for q in w._cache if q[0] == "K" and q[1] is effect_kernel]:
                del w._cache[q]
            w._cache[key] = effect_kernel(s).astype(np.float32)
        return P @ w._cache[key]

    return hook


def mechanical_spreading(w, rng):
    p = w.pitch
    r2 = (w.tx[:, None] - w.tx[None]) ** 2 + (w.ty[:, None] - w.ty[None]) ** 2
    near = r2 <= (6.5 * p) ** 2
    wide = rng.uniform(1.2, 2.2) * p
    g = np.arange(-6, 7) * p
    lattice = (g[:, None] ** 2 + g[None] ** 2).ravel()
    lattice = lattice[lattice <= (6.5 * p) ** 2]

    def kernel(fn):  # normalised on an endless lattice: what spreads beyond the rim is lost
        return np.where(near, fn(r2), 0) / fn(lattice).sum()

    def gauss(s):
        return kernel(lambda q: np.exp(-q / (2 * s * s + 1e-12)))

    def expo(s):
        return kernel(lambda q: np.exp(-np.sqrt(q) / (s + 1e-6)))

    def shear(s):  # Winkler foundation under a shear layer (Pasternak): (1 - l^2 lap) q = f, free rim
        L = np.zeros((w.n, w.n))
        for i in range(w.n):
            for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                a, b = w.ir[i] + dr, w.ic[i] + dc
                if 0 <= a < w.rows and 0 <= b < w.cols:
                    L[i, i] += 1
                    L[i, a * w.cols + b] -= 1
        return np.linalg.inv(np.eye(w.n) + (s / p) ** 2 * L).T

    def skin(s):
        return (1 - s) * np.eye(w.n) + s * gauss(wide)

    mk = lambda form, plain, smax, k, par: Effect(
        "mechanical_spreading", form, plain, smax, par, {"frame": _mat(k)}, 20
    )
    return [
        mk("Gaussian kernel", True, 2.0 * p, gauss, lambda s: {"sigma_m": s}),
        mk("exponential kernel", False, 1.3 * p, expo, lambda s: {"length_m": s}),
        mk("foundation with a shear layer", False, 2.0 * p, shear, lambda s: {"length_m": s}),
        mk(
            "thin skin: a part of the load spreads widely",
            False,
            0.7,
            skin,
            lambda s: {"fraction": s, "sigma_m": wide},
        ),
    ]


def taxel_gain_spread(w, rng):
    z = rng.standard_normal(w.n)
    ang = rng.uniform(0, 2 * np.pi)
    grad = np.cos(ang) * w.tx / max(np.abs(w.tx).max(), 1e-9) + np.sin(ang) * w.ty / max(
        np.abs(w.ty).max(), 1e-9
    )
    rows, cols = rng.standard_normal(w.rows), rng.standard_normal(w.cols)
    lines = rows[w.ir] if rng.random() < 0.5 else cols[w.ic]
    r2 = (w.tx[:, None] - w.tx[None]) ** 2 + (w.ty[:, None] - w.ty[None]) ** 2
    blot = np.exp(-r2 / (2 * (2.5 * w.pitch) ** 2)) @ rng.standard_normal(w.n)
    blot /= blot.std() + 1e-9
    weak = (rng.random(w.n) < rng.uniform(0.1, 0.25)).astype(float)

    def mk(form, plain, smax, gmap):
        def frame(s, w, k, P):
            return P * gmap(s).astype(np.float32)

        return Effect(
            "taxel_gain_spread",
            form,
            plain,
            smax,
            lambda s: {"sigma": float(np.std(np.log(gmap(s)))), "map": np.round(gmap(s), 4).tolist()},
            {"frame": frame},
            30,
        )

    return [
        mk("lognormal, taxel by taxel", True, 0.5, lambda s: np.exp(s * z - s * s / 2)),
        mk(
            "gradient of the lamination, and a little scatter",
            False,
            0.45,
            lambda s: np.clip(1 + s * grad + 0.15 * s * z, 0.15, 2.5),
        ),
        mk("row by row or column by column", False, 0.45, lambda s: np.exp(s * lines - s * s / 2)),
        mk("blotches some taxels wide", False, 0.45, lambda s: np.exp(s * blot - s * s / 2)),
        mk("two populations: some taxels weak", False, 0.85, lambda s: 1 - s * weak + 0.02 * s * z),
    ]


def dead_taxels(w, rng):
    st = w.stack((), False)
    e = np.zeros(w.n)
    np.add.at(e, st.tax, (st.D**2).sum(0))
    share = e / e.sum()
    perm = rng.permutation(np.flatnonzero(share > 1e-4))
    weak_gain = rng.uniform(0.05, 0.3)
    level = rng.uniform(0.0, 0.6) * w.fs
    along_row = rng.random() < 0.6
    lines = w.ir if along_row else w.ic
    pos = w.ic if along_row else w.ir
    if rng.random() < 0.5:
        pos = pos.max() - pos  # the break cuts off the other end
    weight = np.bincount(lines, share)
    order = np.argsort(-weight * rng.uniform(0.5, 1, len(weight)))

    def some(s):  # taxels holding about the share s of the energy
        got, out = 0.0, []
        for i in perm:
            if got + share[i] <= s * 1.02 and len(out) < 0.25 * len(perm):
                out.append(int(i))
                got += share[i]
        return np.array(sorted(out), int)

    def line(s):  # a broken trace: everything beyond the break
        best, err = [], 9.0
        for l in order[:4]:
            on = np.flatnonzero(lines == l)
            on = on[np.argsort(-pos[on])]
            c = np.cumsum(share[on])
            j = int(np.argmin(np.abs(c - s)))
            if abs(c[j] - s) < err - 0.1 * s:
                best, err = on[: j + 1], abs(c[j] - s)
        return np.array(sorted(best), int)

    def mk(form, plain, smax, pick, factor=0.0, stuck=False):
        memo = {}

        def sel(s):
            if s not in memo:
                memo[s] = pick(s)
            return memo[s]

        def frame(s, w, k, P):
            P = P.copy()
            P[:, sel(s)] *= np.float32(factor)
            return P

        hooks = {"frame": frame}
        if stuck:

            def pin(s, w, k, y):
                y = y.copy()
                y[:, sel(s)] = level
                return y

            hooks["stuck"] = pin
        return Effect(
            "dead_taxels",
            form,
            plain,
            smax,
            lambda s: {
                "taxels": [[int(w.ir[i]), int(w.ic[i])] for i in sel(s)],
                "remaining_gain": factor,
                **({"stuck_at_counts": level} if stuck else {}),
            },
            hooks,
            35,
            discrete=True,
        )

    return [
        mk("no response", True, 0.35, some),
        mk("stuck at one number", False, 0.35, some, stuck=True),
        mk("a broken trace: the line is dead beyond the break", False, 0.5, line),
        mk("nearly dead: little gain left", False, 0.5, some, factor=weak_gain),
    ]
