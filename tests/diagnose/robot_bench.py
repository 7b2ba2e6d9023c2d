"""Robots with hidden faults by the hundred: how often the verdict is right, per kind of fault.

    python tests/diagnose/robot_bench.py --jobs=8 --seeds=1000-1024 --output=robot_bench.jsonl

Rules were tuned on seeds below 100; report others. One line per set goes to the output, the table to stdout.
Sets that the output holds already are not run again.
"""

import argparse
import json
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from pathlib import Path

import numpy as np
from robot_rigs import Rig, make_set

from lerobot_vtrefine.diagnose.api import diagnose
from lerobot_vtrefine.embodiments import ALOHA

TABLE = ("shoulder", "elbow", "wrist_flex", "gripper")
ARM = ("left_waist", "left_shoulder", "left_elbow", "left_wrist_angle")
UNKNOWNS = ("gain", "gain_drift", "ripple", "coupling", "coriolis", "weak_servo", "packet_loss", "slip")
STRENGTH = {
    "gain_drift": 0.06,
    "ripple": 0.004,
    "coupling": 0.03,
    "weak_servo": 0.5,
    "packet_loss": 1.0,
    "slip": 0.02,
}
# A kind's place is part of its seeds: add at the end.
KINDS = (
    "clean",
    "nasty",
    "encoder_offset",
    "backlash",
    "control_latency",
    "joint_friction",
    "joint_friction+load",
    "gravity_sag",
    "gravity_sag+form",
    "gripper_compliance",
    "two causes",
    "unknown",
    "slow",
    "backlash+encoder",
    "backlash+rounded",
    "control_latency+jitter",
    "joint_friction+stribeck",
)


def case(kind, seed):
    """A rig and the names that are true of it."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    joints = TABLE if rng.random() < 0.6 else ARM
    pitch = [name for name in joints if name not in ("gripper", "left_waist")]
    one, other = rng.permutation(pitch)[:2]
    sign = rng.choice([-1, 1])
    rig = Rig(
        joints=joints,
        rate_hz=float(rng.choice([20, 30, 50])),
        seconds=6.0,
        conditions=10,
        jitter=float(rng.choice([0, 0.1])),
        noise=float(rng.uniform(0.5, 2)),
        nasty=1.0 if kind == "nasty" else 0.0,
        motion="slow" if kind == "slow" else "mixed",
    )
    size = {
        "encoder_offset": sign * rng.uniform(0.005, 0.03),
        "backlash": rng.uniform(0.006, 0.04),
        "joint_friction": rng.uniform(0.004, 0.02),
        "gravity_sag": sign * rng.uniform(0.006, 0.03),
        "control_latency": rng.uniform(0.01, 0.12),
    }
    names = {kind.split("+")[0]} & {*size, "gripper_compliance"}
    if kind == "two causes":
        names = {str(name) for name in rng.permutation(list(size))[:2]}
    if kind == "slow":
        names = {str(rng.choice(["backlash", "joint_friction", "control_latency"]))}
    places = dict(zip(sorted(names), (one, other), strict=False))
    for name in names:
        add(rig, name, str(places[name]), size)
    form(rig, kind, rng)
    if kind.endswith("load"):
        rig.stiffness = {str(one): rng.uniform(20, 200)}
    if kind == "gravity_sag+form":
        rig.joints, rig.sag, rig.sag_shape = ARM, {"left_shoulder": size["gravity_sag"]}, "stretch"
    if kind == "gripper_compliance":
        rig.joints, rig.compliance = TABLE, {"gripper": rng.uniform(4e-5, 3e-4)}
    if kind == "unknown":
        which = UNKNOWNS[seed % len(UNKNOWNS)]
        strength = {**STRENGTH, "gain": 0.03 * sign}
        rig.unknown = {which: strength.get(which, 0.015) * rng.uniform(0.7, 1.3)}
    return rig, names


def form(rig, kind, rng):
    """The same cause in another form than the engine's first."""
    if kind.startswith("backlash+"):
        rig.slack, rig.backlash = rig.backlash, {}
        rig.rounding = 3.0 if kind.endswith("rounded") else 0.0
    if kind == "control_latency+jitter":
        rig.latency_spread = rng.uniform(0.2, 0.6)
    if kind == "joint_friction+stribeck":
        rig.stribeck = rng.uniform(0.3, 0.8)


def add(rig, name, joint, size):
    if name == "control_latency":
        rig.latency_s = float(size[name])
    elif name != "gripper_compliance":
        field = {"encoder_offset": "offset", "joint_friction": "friction", "gravity_sag": "sag"}.get(
            name, name
        )
        getattr(rig, field)[joint] = float(size[name])


def run(kind, seed):
    rig, names = case(kind, seed)
    with tempfile.TemporaryDirectory() as folder:
        made = make_set(rig, folder, seed)
        begun = time.process_time()
        found = diagnose(made)
    held = found.verdict.heldout
    row = {
        "kind": kind,
        "seed": seed,
        "truth": sorted(names),
        "unknown": list(rig.unknown),
        "status": found.verdict.status,
        "found": sorted(cause.name for cause in found.verdict.causes),
        "ambiguous": found.verdict.ambiguous_with,
        "clue": found.verdict.unknown.clue,
        "rmse": [held.baseline, held.extended, held.noise_floor],
        "cpu_s": round(time.process_time() - begun, 2),
        "params": {
            f"{c.name}.{k}": (p.value, p.ci95) for c in found.verdict.causes for k, p in c.params.items()
        },
        "sizes": truths(rig),
    }
    return {"grade": grade(row), **row}


def truths(rig):
    """Parameter -> true value in the verdict's units; friction in Nm where the servo's stiffness is known."""
    out = {"control_latency.tau_s": rig.latency_s}
    for cause, sizes in (
        ("encoder_offset", rig.offset),
        ("backlash", rig.backlash | rig.slack),
        ("joint_friction", rig.friction),
        ("gravity_sag", rig.sag),
    ):
        out |= {f"{cause}.{joint}_rad": size for joint, size in sizes.items()}
    for joint, size in rig.friction.items():
        known = {f"left_{item.name}": item.stiffness for item in ALOHA.joints} | rig.stiffness
        if joint in known:
            out[f"joint_friction.{joint}_nm"] = size * known[joint]
    for size in rig.compliance.values():
        out["gripper_compliance.m_per_n"] = size
    return out


def covered(row, cause=""):
    """Whether each found parameter (of a cause) that has a true value lies in its interval."""
    return [
        low <= row["sizes"][name] <= high
        for name, (_, (low, high)) in row["params"].items()
        if row["sizes"].get(name) and name.startswith(cause)
    ]


def grade(row):
    """exact, in the set (tie that holds the truth), flagged (alarm), missed or wrong."""
    truth, found = set(row["truth"]), set(row["found"])
    tied = found | {name for names in row["ambiguous"] for name in names}
    if row["status"] == "unexplained":
        return "exact" if row["unknown"] else "flagged"
    if row["unknown"]:
        return "wrong" if found else "missed"
    if row["status"] != "ambiguous" and found == truth:
        return "exact"
    if row["status"] == "ambiguous" and truth <= tied:
        return "in the set"
    return "wrong" if found - truth else "missed"


def table(rows):
    grades = ("exact", "in the set", "flagged", "missed", "wrong")
    lines = [f"{'kind':22}" + "".join(f"{name:>12}" for name in (*grades, "sets", "cpu s"))]
    for kind in KINDS:
        mine = [row for row in rows if row["kind"] == kind]
        if mine:
            counts = [sum(grade(row) == name for row in mine) for name in grades]
            cpu = float(np.median([row["cpu_s"] for row in mine]))
            lines.append(f"{kind:22}" + "".join(f"{n:12}" for n in (*counts, len(mine))) + f"{cpu:12.1f}")
    inside = [hit for row in rows for hit in covered(row)]
    lines.append(f"95 % intervals that cover: {sum(inside)} of {len(inside)} ({np.mean(inside):.3f})")
    causes = sorted({name.split(".")[0] for row in rows for name in row["params"]})
    for cause in causes:
        hits = [hit for row in rows for hit in covered(row, cause)]
        lines.append(f"  {cause}: {sum(hits)} of {len(hits)}")
    return "\n".join(lines)


def done(path):
    """Rows of an earlier run; a line that was cut short counts for nothing."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seeds", default="0-9")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--output", type=Path, default=Path("robot_bench.jsonl"))
    options = parser.parse_args()
    low, _, high = options.seeds.partition("-")
    kinds, seeds = options.kinds.split(","), range(int(low), int(high or low) + 1)
    rows = done(options.output)
    known = {(row["kind"], row["seed"]) for row in rows}
    work = [item for item in product(kinds, seeds) if item not in known]
    with ProcessPoolExecutor(options.jobs) as pool, options.output.open("a") as out:
        for job in as_completed([pool.submit(run, *item) for item in work]):
            rows.append(json.loads(json.dumps(job.result(), default=float)))
            out.write(json.dumps(rows[-1]) + "\n")
            out.flush()
    print(table(rows))


if __name__ == "__main__":
    main()
