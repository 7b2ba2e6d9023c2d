"""Many control steps in many worlds: how often does the simulation itself fail?

Random targets, and the scripted expert's with noise, over pairs and starts. Worlds whose episode ended begin
another one. Prints JSON: a row per pair, start and kind of actions, and their sum. Status 1 where an
exception ended a run or something that is no number came out.

    python scripts/soak_worlds.py --backend=warp --worlds=1024 --steps=500
"""

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS, STARTS, SceneConfig, WarpConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import FAILURES, InsertionSim

ACTIONS = ("random", "expert")
COUNTS = ("episodes", "success", *FAILURES[1:], "time_out", "not_finite", "exceptions")
OWN = ("unstable", "overflow", "not_finite", "exceptions")
"""What the simulation has to answer for: rates per control step."""
RANDOM_RAD, NOISE_RAD = 0.1, 0.003
"""Half range of random changes of the targets, and standard deviation of the noise on the expert's."""
READ_EVERY = 8


def main() -> int:
    """Console entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--steps", type=int, default=100, help="control steps of every combination")
    parser.add_argument("--pairs", default=",".join(PROCEDURAL_PAIRS))
    parser.add_argument("--starts", default=",".join(STARTS))
    parser.add_argument("--actions", default=",".join(ACTIONS))
    parser.add_argument("--clearance_m", type=float, default=0.002)
    parser.add_argument("--timestep_s", type=float, default=0.0025)
    parser.add_argument("--backend", default="warp")
    parser.add_argument("--device", default="auto", help="of the warp backend")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    for pair in options.pairs.split(","):
        for start in options.starts.split(","):
            scene = SceneConfig(
                pair=pair, start=start, clearance_m=options.clearance_m, timestep_s=options.timestep_s
            )
            for actions in options.actions.split(","):
                rows.append(
                    {"pair": pair, "start": start, "actions": actions, **soak(scene, actions, options)}
                )
                print(f"{pair} {start} {actions}: {rows[-1]}", file=sys.stderr, flush=True)
    names = ("control_steps", "seconds", *COUNTS)
    total = with_rates({name: sum(row[name] for row in rows) for name in names})
    print(json.dumps({"settings": vars(options), "rows": rows, "total": total}, indent=2))
    return 1 if total["exceptions"] or total["not_finite"] else 0


def soak(scene: SceneConfig, actions: str, options: argparse.Namespace) -> dict[str, Any]:
    """Counts of one combination; an exception ends it, and is counted and quoted."""
    counts, started, done, quoted = Counter[str](), time.perf_counter(), 0, None
    try:
        for news in play(scene, actions, options):
            counts.update(news)
            done += options.worlds
    except Exception as error:  # whatever it is, it would have ended a training run
        counts["exceptions"] += 1
        quoted = f"{type(error).__name__}: {error}"
    row = {name: counts[name] for name in COUNTS}
    return with_rates(
        {
            "control_steps": done,
            "seconds": round(time.perf_counter() - started, 1),
            **row,
            "exception": quoted,
        }
    )


def with_rates(row: dict[str, Any]) -> dict[str, Any]:
    """The row, with what the simulation has to answer for per control step of a world."""
    return row | {f"{name}_rate": row[name] / max(row["control_steps"], 1) for name in OWN}


def play(scene: SceneConfig, actions: str, options: argparse.Namespace) -> Iterator[Counter[str]]:
    """What happened in each control step of all worlds."""
    warp = WarpConfig(device=options.device)
    sim = InsertionSim(scene, num_envs=options.worlds, backend=options.backend, warp=warp)
    rng, seed = np.random.default_rng(options.seed), options.seed + options.worlds
    everyone = np.arange(options.worlds)
    sim.reset(everyone, options.seed + everyone)
    expert = ScriptedExpert(sim)
    expert.reset(everyone)
    for step in range(options.steps):
        if actions == "expert":
            targets = expert.act(everyone)
            targets = targets + NOISE_RAD * rng.normal(size=targets.shape) * ARM_ONLY
        else:
            targets = sim.command_targets()
            targets = targets + RANDOM_RAD * rng.uniform(-1.0, 1.0, targets.shape) * ARM_ONLY
        result = sim.step(targets)
        ended = np.flatnonzero(result.terminated | result.truncated)
        yield _counted(sim, result, ended, read=step % READ_EVERY == 0)
        if len(ended):
            sim.reset(ended, seed + np.arange(len(ended)))
            expert.reset(ended)
            seed += len(ended)


ARM_ONLY = np.tile([1.0] * 6 + [0.1] * 2, 2)
"""Fingers move in metres: ten times less than joints, so that most parts stay in hand for a while."""


def _counted(sim: InsertionSim, result: Any, ended: np.ndarray, read: bool) -> Counter[str]:
    """Ends of episodes by reason, and worlds with anything that is no finite number."""
    counts = Counter(episodes=len(ended), success=int(result.success[ended].sum()))
    failure = sim.metrics(ended)["failure"] if len(ended) else np.zeros(0, int)
    counts.update(FAILURES[code] for code in failure if code)
    counts["time_out"] = int(result.truncated.sum())
    finite = np.isfinite(sim.privileged()).all(1) & np.isfinite(result.reward)
    if read:
        finite &= np.isfinite(sim.observe()["state"]).all(1)
    counts["not_finite"] = int((~finite).sum())
    return counts


if __name__ == "__main__":
    raise SystemExit(main())
