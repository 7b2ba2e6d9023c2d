"""What the rig's operator did: sites, depth profiles, slides, clocks. Lengths in metres, times in seconds."""

import numpy as np

DT = 0.005  # internal grid
T_BEFORE = 0.6  # the internal grid starts this long before the trial's first frame

PROFILES = ("indent", "harder", "staircase", "cyclic", "taps", "slide", "slow", "again")


def _profile(rng, kind, dmax, fast):
    """Waypoints (t, z) of the depth, and the times at which a slide starts and ends (or None)."""
    t, z = [0.0], [-rng.uniform(0.4e-3, 1.2e-3)]
    up = z[0]

    def hold(s):
        t.append(t[-1] + s)
        z.append(z[-1])

    def go(target, v):
        t.append(t[-1] + max(abs(target - z[-1]) / v, 0.06))
        z.append(target)

    def speed():
        return np.exp(rng.uniform(np.log(2e-3), np.log(12e-3))) * (2.0 if fast else 1.0)

    slide = None
    top = dmax * rng.uniform(0.8, 1.0)
    hold(rng.uniform(0.45, 0.9))
    if kind == "indent":
        go(top * rng.uniform(0.6, 1), speed())
        hold(rng.uniform(1.0, 2.5))
        go(up, speed())
    elif kind == "harder":
        d1 = top * rng.uniform(0.45, 0.7)
        go(d1, speed())
        hold(rng.uniform(0.5, 1.4))
        go(d1 * rng.uniform(0.25, 0.65), speed())
        hold(rng.uniform(0.3, 0.9))
        go(top, speed())
        hold(rng.uniform(0.5, 1.5))
        go(up, speed())
    elif kind == "staircase":
        n = int(rng.integers(3, 5))
        for i in range(n):
            go(top * (i + 1) / n, speed())
            hold(rng.uniform(0.35, 0.8))
        if rng.random() < 0.7:
            go(top * rng.uniform(0.35, 0.6), speed())
            hold(rng.uniform(0.4, 0.8))
        go(up, speed())
    elif kind == "cyclic":
        mid, amp, f = top * 0.62, top * rng.uniform(0.22, 0.38), rng.uniform(0.4, 1.6)
        go(mid, speed())
        hold(0.2)
        n = int(rng.integers(3, 6))
        for u in np.arange(1, n * 24 + 1) / 24:
            t.append(t[-1] + 1 / (24 * f))
            z.append(mid + amp * np.sin(2 * np.pi * u))
        hold(0.3)
        go(up, speed())
    elif kind == "taps":
        for _ in range(int(rng.integers(3, 5))):
            go(top * rng.uniform(0.55, 1), speed() * 1.8)
            hold(rng.uniform(0.15, 0.4))
            go(up, speed() * 1.8)
            hold(rng.uniform(0.25, 0.5))
    elif kind == "slide":
        d1 = top * rng.uniform(0.55, 0.85)
        go(d1, speed())
        hold(rng.uniform(0.4, 0.9))
        a = t[-1]
        hold(rng.uniform(1.2, 3.0))
        slide = (a, t[-1])
        hold(rng.uniform(0.3, 0.6))
        go(up, speed())
    elif kind == "slow":
        v = rng.uniform(0.5e-3, 1.0e-3)
        go(0.0, speed())
        go(top, v)
        hold(rng.uniform(0.3, 1.0))
        go(top * 0.3, v * 1.5)
        go(up, speed())
    elif kind == "again":
        go(top * rng.uniform(0.5, 0.75), speed())
        hold(rng.uniform(0.6, 1.2))
        go(up, speed())
        hold(rng.uniform(0.4, 1.2))
        go(top, speed())
        hold(rng.uniform(0.6, 1.2))
        go(up, speed())
    hold(rng.uniform(0.4, 0.9))
    t, z = np.array(t), np.array(z)
    if t[-1] > 9.8:
        scale = 9.8 / t[-1]
        t = t * scale
        slide = None if slide is None else (slide[0] * scale, slide[1] * scale)
    elif t[-1] < 5.0:
        t[-1] = 5.0 + rng.uniform(0, 0.5)
    return t, z, slide


def conditions(rng, pad, objects, dmax, slides, fast):
    """Eight commanded motions. `pad`: (rows, cols, pitch); `objects`: list of indenters to choose from."""
    rows, cols, pitch = pad
    kinds = [
        "harder",
        "harder",
        "indent",
        "staircase",
        "again" if rng.random() < 0.5 else "harder",
        "cyclic" if rng.random() < 0.5 else "taps",
    ]
    if fast:
        kinds[1], kinds[3] = "taps", "cyclic"
    kinds = kinds[: 8 - slides] + ["slide"] * slides
    while len(kinds) < 8:
        kinds.append(str(rng.choice(["indent", "slow", "taps", "cyclic", "harder", "staircase"])))
    hx, hy = (cols - 1) / 2 * pitch, (rows - 1) / 2 * pitch
    sites = []
    out = []
    for i, kind in enumerate(rng.permutation(kinds)):
        kind = str(kind)
        if sites and rng.random() < 0.3:
            x, y = sites[int(rng.integers(len(sites)))]
            x, y = x + rng.normal(0, 3e-4), y + rng.normal(0, 3e-4)
        else:
            x, y = rng.uniform(-0.8, 0.8) * hx, rng.uniform(-0.7, 0.7) * hy
        sites.append((x, y))
        obj = objects[0]
        if len(objects) > 1 and rng.random() < 0.35:
            obj = objects[1]
        if kind == "slide" and obj["shape"] != "sphere":
            obj = next(o for o in objects if o["shape"] == "sphere")
        t, z, slide = _profile(rng, kind, dmax[obj["shape"]], fast)
        move = (0.0, 0.0)
        if slide is not None:
            length = min(rng.uniform(0.25, 0.6) * hx * 2, 0.02)
            ang = rng.choice([0, np.pi / 2, np.pi, -np.pi / 2]) + rng.normal(0, 0.2)
            mx, my = length * np.cos(ang), length * np.sin(ang) * min(1, hy / hx)
            mx = mx if abs(x + mx) < 0.95 * hx else -mx  # turn the slide towards the pad's inside
            my = my if abs(y + my) < 0.95 * hy else -my
            move = (mx, my)
        out.append(
            dict(
                kind=kind,
                obj=obj,
                x=x,
                y=y,
                t=t,
                z=z,
                slide=slide,
                move=move,
                back=bool(slide is not None and rng.random() < 0.4),
                smooth=rng.uniform(0.06, 0.14),
            )
        )
    return out


def drive(rng, cond, rate, clock_jitter):
    """One replicate of a condition: the motion on the internal grid and the frames' times."""
    stretch, shift = 1 + rng.normal(0, 0.004), rng.normal(0, 0.015)
    duration = cond["t"][-1] * stretch
    n = int(np.ceil((T_BEFORE + duration + 0.1) / DT)) + 1
    tf = -T_BEFORE + DT * np.arange(n)
    z = np.interp(tf, cond["t"] * stretch + shift, cond["z"])
    x = np.full(n, cond["x"] + rng.normal(0, 2e-5))
    y = np.full(n, cond["y"] + rng.normal(0, 2e-5))
    if cond["slide"] is not None:
        a, b = (v * stretch + shift for v in cond["slide"])
        if cond["back"]:
            s = np.interp(tf, [a, a + 0.45 * (b - a), a + 0.55 * (b - a), b], [0, 1, 1, 0])
        else:
            s = np.interp(tf, [a, b], [0, 1])
        x, y = x + s * cond["move"][0], y + s * cond["move"][1]
    w = np.hanning(int(cond["smooth"] / DT) | 1)
    w = w[1:-1] / w.sum() if len(w) > 3 else np.ones(1)
    pad = len(w) // 2
    sm = lambda v: np.convolve(np.pad(v, pad, mode="edge"), w, mode="valid")[:n]
    z, x, y = sm(z) + rng.normal(0, 2e-6), sm(x), sm(y)
    gaps = (
        1
        / rate
        * (1 + clock_jitter * np.clip(rng.standard_normal(int(duration * rate * 1.3) + 5), -2.5, 2.5))
    )
    late = rng.random(len(gaps)) < 0.004
    gaps[late] *= 2  # the host missed a frame
    times = np.concatenate([[0.0], np.cumsum(gaps)])
    times = times[times < duration]
    return tf, x, y, z, times
