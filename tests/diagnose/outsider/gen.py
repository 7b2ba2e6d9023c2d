"""Simulated recordings of a tactile pad with one hidden effect (or two, or none): `plan`, then `make`."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from outsider import fx_electric, fx_geometry, fx_material, fx_time
from outsider.core import World
from outsider.outside2 import OUTSIDE
from outsider.signal_path import achieved, calibrate, elastic

CATALOGUE = {
    n: getattr(m, n)
    for m, names in (
        (
            fx_material,
            ("nonlinear_stiffness", "viscoelastic_relaxation", "hysteresis", "first_load_softening"),
        ),
        (
            fx_geometry,
            ("contact_offset", "pad_tilt", "mechanical_spreading", "taxel_gain_spread", "dead_taxels"),
        ),
        (fx_electric, ("saturation", "row_sharing", "crosstalk", "supply_droop")),
        (fx_time, ("baseline_drift", "latency", "scan_skew", "sample_and_hold")),
    )
    for n in names
}
GAINS = (0.1, 0.2, 0.4, 0.7)
# pairs nobody could call two causes: the same thing twice
NO_PAIR = [{"row_sharing", "supply_droop"}, {"latency", "sample_and_hold"}]


def make(seed, kind, effect, gain, folder, small=None, form=None):
    """kind: single (plain form) | other | pair | outside | clean | nasty. `effect` None: drawn from the seed;
    `form`: number of the form among the effect's forms (for checks)."""
    folder = Path(folder)
    rng = np.random.default_rng([seed, 7])
    if effect is None and kind in ("single", "other"):
        effect = str(rng.choice(sorted(CATALOGUE)))
    elif effect is None and kind == "outside":
        effect = str(rng.choice(sorted(OUTSIDE)))
    elif effect is None and kind == "pair":
        effect = _draw_pair(rng)
    names = (effect,) if isinstance(effect, str) else tuple(effect or ())
    w = World(
        seed,
        small=small,
        nasty=kind == "nasty",
        slides=3 if "slide_direction" in names else None,
        fast=bool({"latency", "scan_skew"} & set(names)) and rng.random() < 0.6,
        rate=float(rng.uniform(22, 33))
        if "scan_skew" in names and rng.random() < 0.85
        else float(rng.uniform(88, 122))
        if "sample_and_hold" in names and rng.random() < 0.5
        else None,
    )
    effects = []
    for i, n in enumerate(names):
        r = np.random.default_rng([seed, 11, i])
        forms = (OUTSIDE if kind == "outside" else CATALOGUE)[n](w, r)
        if form is not None:
            e = forms[form]
        elif kind == "outside":
            e = forms[int(r.integers(len(forms)))]
        elif kind == "single" or (kind == "pair" and r.random() < 0.5):
            e = forms[0]
        else:
            e = forms[1 + int(r.integers(len(forms) - 1))]
        effects.append(e)
    note = []
    each = None
    w.effects = effects
    if len(effects) == 1:
        _calibrate_one(w, effects[0], gain)
    elif len(effects) == 2:
        each = []
        share = float(rng.uniform(0.4, 0.6))
        for e, part in zip(effects, (share, 1 - share)):  # parts of the signal-to-noise g / (1 - g)
            w.effects = [e]
            snr = gain / (1 - gain) * part
            _calibrate_one(w, e, snr / (1 + snr))
        w.effects = effects
        base = [e.s for e in effects]

        def together(lam):
            for e, s in zip(effects, base):
                e.s = s if e.discrete else min(s * lam, e.smax)

        calibrate(w, together, 4.0, gain, tries=8)
    got, data, detail = achieved(w, effects, detail=True)
    if len(effects) == 2:
        for e in effects:  # what each takes away alone, and what is lost without it
            each.append({"effect": e.name, "loss_without_it": round(got - _without(w, effects, e), 4)})
        if min(v["loss_without_it"] for v in each) < 0.03:
            note.append("one of the two hardly matters: see gain_each")
    if gain and abs(got - gain) > 0.03:
        note.append(
            "gain not reached within the physical limit of the effect"
            if got < gain
            else "gain above the request: the effect comes in steps"
        )
    note += [e.note for e in effects if e.note]
    note += ["noise: " + ", ".join(w.nasty)] if w.nasty else []
    _write(w, data, folder, rng)
    params = {e.name: e.params(e.s) for e in effects}
    truth = {
        "seed": seed,
        "kind": kind,
        "effect": names[0] if len(names) == 1 else (list(names) or None),
        "form": "; ".join(e.form for e in effects),
        "plain": bool(effects) and all(e.plain for e in effects),
        "params": params[names[0]] if len(names) == 1 else params,
        "gain": round(got, 4),
        "gain_requested": gain,
        "rows": w.rows,
        "cols": w.cols,
        "rate_hz": round(w.rate, 2),
        "note": "; ".join(note),
        "name": folder.name,
        "forms": [e.form for e in effects],
        "plains": [e.plain for e in effects],
        "strengths": [e.s for e in effects],
        "gain_each": each,
        **detail,
        "full_scale": w.fs,
        "quantised": w.quantised,
        "base": {
            "k_n": w.k_n,
            "k_d": w.k_n * w.tau_d,
            "gain_counts_per_n": w.k / w.k_n,
            "k_counts_per_m": w.k,
            "kd_over_kn_s": w.tau_d,
        },
        "noise": w.noise_params,
        "temperature_logged": w.log_temperature,
        "force_logged": w.log_force,
        "conditions": [c["kind"] for c in w.conds],
    }
    truth = _plain(truth)
    (folder.parent / f"{folder.name}.truth.json").write_text(json.dumps(truth, indent=1))
    return truth


def _calibrate_one(w, e, gain):
    def put(s):
        e.s = float(s)

    if not e.discrete:
        return calibrate(w, put, e.smax, gain)
    odds = lambda g: np.log(np.clip(g, 0.004, 0.996) / (1 - np.clip(g, 0.004, 0.996)))
    tried, seen = {}, {}
    span = (e.smax * 2e-3, e.smax)
    for n in (16, 8):  # the effect comes in steps: a grid, then a finer one about the best
        for s in np.geomspace(*span, n):
            put(s)
            what = json.dumps(e.params(e.s)["taxels"])
            if what not in seen:
                seen[what] = tried[e.s] = abs(odds(achieved(w, w.effects)) - odds(gain))
        best = min(tried, key=tried.get)
        span = (best / 1.6, min(best * 1.6, e.smax))
    put(best)


def _without(w, effects, e):
    """Achievable gain of the model that lacks e, on the same data, its stiffness and damping refitted."""
    from outsider.signal_path import nominal, predict, record, refit

    data = record(w, effects)
    _, resp = predict(w, effects)
    nom, _ = nominal(w)
    active = []
    for k, (tax, D, V, touched, _) in enumerate(nom):
        a = resp[k] > w.threshold
        a[tax[touched]] = True
        active.append(a)
    _, base, idle = refit(w, data, active)
    model, keep = [f for f in effects if f is not e], w.tau_d

    def mse(tau_d):  # stiffness and damping are refitted, no more
        w.tau_d = float(tau_d)
        pred, _ = predict(w, model)
        num = den = 0.0
        for k, a in enumerate(active):
            p, y = pred[k][:, a] - w.idle[a], data[k][:, a] - idle[a]
            num += (p * y).sum() / p.size
            den += (p * p).sum() / p.size
        c = num / max(den, 1e-12)
        return np.mean(
            [
                ((data[k][:, a] - idle[a] - c * (pred[k][:, a] - w.idle[a])) ** 2).mean()
                for k, a in enumerate(active)
            ]
        )

    try:
        top = 3 * keep + 0.03
        grid = [(mse(t), t) for t in np.linspace(0, top, 6)]
        mid = min(grid)[1]
        low = min(min(grid)[0], *(mse(t) for t in (max(mid - top / 15, 0), mid + top / 15)), mse(keep))
    finally:
        w.tau_d = keep
    return float(1 - low / base.mean())


def _plain(x):
    if isinstance(x, dict):
        return {k: _plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(v) for v in x]
    return (
        x.item()
        if isinstance(x, (np.generic, np.ndarray)) and np.ndim(x) == 0
        else x.tolist()
        if isinstance(x, np.ndarray)
        else x
    )


def _write(w, data, folder, rng):
    folder.mkdir(parents=True, exist_ok=True)
    w.log_force = bool(rng.random() < 0.4)
    hidden_temp = w.temperature is not None  # temperature matters: logged or not as the kind says
    w.log_temperature = (
        any(e.name == "temperature_gain_logged" for e in w.effects)
        if hidden_temp
        else bool(rng.random() < 0.25)
    )
    temp = w.temperature
    if temp is None:
        a, b = rng.normal(0, 0.6), rng.uniform(0.1, 0.5)
        temp = lambda t: 22.5 + a * t / w.session + b * np.sin(t / 90.0)
    st = w.stack([e for e in w.effects], True)
    mech = elastic(st, w.effects, electric=False) + w.tau_d * st.V
    mech[(mech < 0) | (st.D <= 0)] = 0
    cell = rng.uniform(0.003, 0.01)
    tilts, micro = rng.random() < 0.12, rng.random() < 0.4
    trials = []
    for k, t in enumerate(w.trials):
        at = lambda v: np.interp(t.time, t.tf, v)
        depth = at(t.z) + t.z_enc
        cols = {
            "time_s": t.time,
            "x_m": np.round(at(t.x), 7),
            "y_m": np.round(at(t.y), 7),
            "depth_m": np.round(depth, 6 if micro else 8),
        }
        if tilts:
            cols["tilt_x_rad"] = np.zeros(len(t.time))
            cols["tilt_y_rad"] = np.zeros(len(t.time))
        if w.log_force:
            F = w.k_n * w.at(t, mech[:, st.sl[k]].sum(1, keepdims=True), t.time)[:, 0]
            cols["force_n"] = F + cell * w.k_n * w.d_ref * rng.standard_normal(len(F))
        if w.log_temperature:
            cols["temperature_c"] = np.round(
                temp(t.start + t.time) + 0.04 * rng.standard_normal(len(t.time)), 3
            )
        raw = data[k]
        if w.quantised:
            flat = pa.array(raw.astype(np.int32 if w.fs > 255 else np.uint8).ravel())
        else:
            flat = pa.array(raw.astype(np.float32).ravel())
        table = {c: pa.array(v) for c, v in cols.items()}
        table["raw"] = pa.ListArray.from_arrays(
            pa.array(np.arange(len(t.time) + 1, dtype=np.int32) * w.n), flat
        )
        name = f"trial_{k:04d}.parquet"
        pq.write_table(pa.table(table), folder / name, compression="snappy")
        entry = {
            "file": name,
            "condition": f"c{t.cond:02d}",
            "replicate": t.rep,
            "order": t.order,
            "start_s": t.start,
        }
        if t.obj is not w.objects[0]:
            entry["object"] = t.obj
        trials.append(entry)
    doc = {
        "schema": "vtrefine/recording-set@1",
        "kind": "pad",
        "pad": {"rows": w.rows, "cols": w.cols, "pitch_m": w.pitch},
        "reading": {"unit": "adc_counts", "full_scale": w.fs},
        "object": w.objects[0],
        "trials": trials,
    }
    (folder / "recording.json").write_text(json.dumps(_plain(doc), indent=1))


def _draw_pair(rng):
    while True:
        a, b = (str(v) for v in rng.choice(sorted(CATALOGUE), 2, replace=False))
        if {a, b} not in NO_PAIR:
            return (a, b)


def plan(first, count):
    """Kinds in fixed proportions (shuffled), effects in turn so that each comes up about equally often."""
    rng = np.random.default_rng([first, count, 3])
    share = (
        ("single", 0.27),
        ("other", 0.27),
        ("pair", 0.12),
        ("outside", 0.18),
        ("clean", 0.08),
        ("nasty", 0.08),
    )
    kinds = [k for k, p in share for _ in range(int(p * count))]
    while len(kinds) < count:
        kinds.append(str(rng.choice([k for k, _ in share], p=[p for _, p in share])))
    queue = {}

    def turn(group, names):
        if not queue.get(group):
            queue[group] = [str(v) for v in rng.permutation(sorted(names))]
        return queue[group].pop()

    out = []
    for i, kind in enumerate(rng.permutation(kinds)):
        kind, seed = str(kind), first + i
        effect = None
        if kind in ("single", "other"):
            effect = turn(kind, CATALOGUE)
        elif kind == "outside":
            effect = turn(kind, OUTSIDE)
        elif kind == "pair":
            effect = list(_draw_pair(rng))
        gain = 0.0 if effect is None else float(rng.choice(GAINS if kind != "pair" else GAINS[1:]))
        out.append({"name": f"set_{seed:06d}", "seed": seed, "kind": kind, "effect": effect, "gain": gain})
    return out
