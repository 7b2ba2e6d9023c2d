"""Many control steps in many worlds: how often does the simulation itself fail?

    python scripts/soak_worlds.py --worlds=1024 --control_steps=10000000 --minutes=9 --rows=outputs/soak.jsonl

Random targets, a trained policy with DPPO's exploration noise, or the scripted expert's targets with noise,
over pairs and starts. Every pair and start gets its share of --control_steps, for each kind of actions. A row
of JSON is added to --rows whenever one of them ends or the --minutes are over; the same command again goes on
from there. Prints the sum of all rows. Status 1 where an exception ended a run or something other than a
number came out, 3 where the time was over before the steps were.
"""

import argparse
import dataclasses
import gc
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_file
from lerobot_vtrefine.embodiments.embodiment import STARTS
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.files import read_json_lines
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.config import TrustRegionDppo
from lerobot_vtrefine.finetune.pipeline import Practice, make_practice
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.shipped import policies
from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS, SceneConfig, WarpConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.task import FAILURES

ACTIONS = ("random", "trained", "expert")
COUNTS = ("control_steps", "episodes", "success", *FAILURES[1:], "time_out", "not_finite", "exceptions")
OWN = ("unstable", "overflow", "not_finite", "exceptions")
"""What the simulation has to answer for: rates per control step."""
RANDOM_RAD = 0.003, 0.1
"""Half range of random changes of the targets, of the gentlest and the wildest episode: wild ones drop the
parts within seconds, gentle ones jam them.
"""
NOISE_RAD = 0.003
"""Standard deviation of the noise on the expert's targets."""
READ_EVERY = 8
SCALE = np.tile([1.0] * 6 + [0.1] * 2, 2)
"""Of changes, by joint: fingers move in metres, ten times less, so that parts mostly stay in hand a while."""
TUNED = "square_grasped_1mm"
"""The shipped policy: it knows one of the pairs, and does what it can with the others."""

Row = dict[str, Any]


@run_cli
def main() -> int:
    """Goes on where the rows end."""
    options = parse()
    kinds = options.actions.split(",")
    for kind in kinds:
        check_choice("--actions", kind, ACTIONS)
    check_file("--rows", options.rows)
    places = [(pair, start) for pair in options.pairs.split(",") for start in options.starts.split(",")]
    share = options.control_steps / len(places)
    rows, deadline = read(options.rows), time.perf_counter() + 60 * options.minutes
    for pair, start in places:
        missing = {kind: share - done(rows, pair, start, kind) for kind in kinds}
        if max(missing.values()) <= 0 or time.perf_counter() > deadline:
            continue
        for row in soak(pair, start, missing, deadline, options):
            rows.append(row)
            print(json.dumps(row), file=sys.stderr, flush=True)
            with options.rows.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
    print(
        json.dumps({kind: total([row for row in rows if row["actions"] == kind]) for kind in kinds}, indent=2)
    )
    if any(row["exceptions"] or row["not_finite"] for row in rows):
        return 1
    left = any(done(rows, *place, kind) < share for place in places for kind in kinds)
    return 3 if left else 0


def parse() -> argparse.Namespace:
    """The command line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--worlds", type=at_least(1), default=64, help="default %(default)s")
    parser.add_argument(
        "--control_steps", type=at_least(1), default=100_000, help="of each kind of actions, in all"
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="begin nothing new after these")
    parser.add_argument("--rows", type=Path, default=Path("outputs/soak.jsonl"), help="where rows are kept")
    parser.add_argument("--pairs", default=",".join(PROCEDURAL_PAIRS), help="default: %(default)s")
    parser.add_argument("--starts", default=",".join(STARTS), help="default: %(default)s")
    parser.add_argument("--actions", default="random,trained", help=f"of {', '.join(ACTIONS)}")
    parser.add_argument("--clearance_m", type=float, default=0.002, help="default %(default)s")
    parser.add_argument(
        "--timestep_s", type=float, default=SceneConfig.timestep_s, help="default %(default)s"
    )
    parser.add_argument("--policy", type=Path, help="a vt_dp3 checkpoint; default: the shipped one")
    parser.add_argument("--backend", default="warp", help="default: %(default)s")
    parser.add_argument("--solver", default="own", help="of the warp backend")
    parser.add_argument("--device", default="auto", help="of the warp backend and the policy")
    parser.add_argument(
        "--seed", type=at_least(0), default=0, help="of the first episode (default %(default)s)"
    )
    return parser.parse_args()


def read(path: Path) -> list[Row]:
    """Rows of earlier calls."""
    return read_json_lines(path) if path.is_file() else []


def done(rows: list[Row], pair: str, start: str, actions: str) -> int:
    """Control steps of one kind of actions in one place."""
    place = (pair, start, actions)
    return sum(row["control_steps"] for row in rows if (row["pair"], row["start"], row["actions"]) == place)


def total(rows: list[Row]) -> Row:
    """Sums, and what the simulation has to answer for per control step of a world."""
    sums: Row = {name: sum(row[name] for row in rows) for name in (*COUNTS, "seconds")}
    return sums | {f"{name}_rate": sums[name] / max(sums["control_steps"], 1) for name in OWN}


def soak(
    pair: str, start: str, missing: dict[str, float], deadline: float, options: argparse.Namespace
) -> Iterator[Row]:
    """A row for each kind of actions that lacks steps; an exception ends it, and is counted and quoted."""
    practice = prepare(pair, start, options)
    for kind, steps in missing.items():
        if steps <= 0 or time.perf_counter() > deadline:
            continue
        counts, started, quoted = Counter[str](), time.perf_counter(), None
        seed = int(options.control_steps - steps) + options.seed  # of its own in every call
        try:
            player = (
                play_policy(practice, seed) if kind == "trained" else play(practice.env.episodes, kind, seed)
            )
            for news in player:
                counts.update(news)
                if counts["control_steps"] >= steps or time.perf_counter() > deadline:
                    break
        except Exception as error:  # whatever it is, it would have ended a training run
            counts["exceptions"] += 1
            quoted = f"{type(error).__name__}: {error}"
        yield {
            "pair": pair,
            "start": start,
            "actions": kind,
            "worlds": options.worlds,
            "solver": options.solver,
            **{name: counts[name] for name in COUNTS},
            "seconds": round(time.perf_counter() - started, 1),
            "exception": quoted,
        }


def prepare(pair: str, start: str, options: argparse.Namespace) -> Practice:
    """The worlds, and the policy that plays in them."""
    warp = WarpConfig(device=options.device, solver=options.solver)
    task = VtRefineEnvConfig(
        pair=pair, start=start, clearance_m=options.clearance_m, backend=options.backend, warp=warp
    )
    task.scene = dataclasses.replace(task.scene, timestep_s=options.timestep_s)
    path = options.policy or policies()[TUNED]
    device = options.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() and options.backend == "warp" else "cpu"
    policy = VtDp3Policy.from_pretrained(path).to(device)
    policy.config.device = device
    return make_practice(policy, path, task, TrustRegionDppo(num_envs=options.worlds, encoder="frozen"))


def play(episodes: Episodes, actions: str, seed: int) -> Iterator[Counter[str]]:
    """What happened in each control step; episodes begin anew once half of the worlds have ended theirs."""
    sim, rng = episodes.sim, np.random.default_rng(seed)
    expert = ScriptedExpert(sim) if actions == "expert" else None
    reach = np.zeros((episodes.num_envs, 1))
    step = 0
    while True:
        if step == 0 or len(episodes.active) <= episodes.num_envs // 2:
            ended = np.flatnonzero(episodes.done) if step else episodes.ids
            episodes.reset(ended, seed + np.arange(len(ended)))
            reach[ended] = np.exp(rng.uniform(*np.log(RANDOM_RAD), (len(ended), 1)))
            if expert is not None:
                expert.reset(ended)
            seed += len(ended)
        active = episodes.active
        targets = np.array(sim.command_targets(), np.float64)
        if expert is not None:
            targets[active] = expert.act(active)
            targets += NOISE_RAD * rng.normal(size=targets.shape) * SCALE
        else:
            targets += reach * rng.uniform(-1.0, 1.0, targets.shape) * SCALE
        result = episodes.step(targets, reads=step % READ_EVERY == 0)
        yield counted(episodes, active, result.finished, result.reward)
        step += 1


def counted(episodes: Episodes, active: np.ndarray, finished: np.ndarray, reward: np.ndarray) -> Counter[str]:
    """Ends of episodes by reason, and worlds with anything that is not a finite number."""
    counts = Counter(control_steps=len(active), episodes=len(finished))
    counts["success"] = int(episodes.success[finished].sum())
    failure = episodes.sim.metrics(finished)["failure"] if len(finished) else np.zeros(0, int)
    counts.update(FAILURES[code] for code in failure if code)
    counts["time_out"] = int(episodes.truncated[finished].sum())
    finite = np.isfinite(episodes.sim.privileged(episodes.ids)).all(1) & np.isfinite(reward)
    finite &= np.isfinite(np.asarray(torch.as_tensor(episodes.raw["state"]).cpu())).all(1)
    counts["not_finite"] = int((~finite).sum())
    return counts


def play_policy(practice: Practice, seed: int) -> Iterator[Counter[str]]:
    """What happened in each round of whole episodes, with exploration noise."""
    env, agent = practice.env, practice.agent
    cfg = TrustRegionDppo(num_envs=env.num_envs, encoder="frozen")
    generator = torch.Generator(agent.device).manual_seed(seed)
    while True:
        rollout = dppo.collect(env, agent, cfg, generator, range(seed, seed + env.num_envs))
        seed += env.num_envs
        info = {
            name: int(values.sum()) for name, values in rollout.info.items() if name in ("steps", "success")
        }
        counts = Counter(control_steps=info["steps"], episodes=env.num_envs, success=info["success"])
        failed = {name: int(rollout.info[f"failed_{name}"].sum()) for name in FAILURES[1:]}
        counts.update(failed)
        counts["time_out"] = env.num_envs - counts["success"] - sum(failed.values())
        finite = rollout.privileged.isfinite().all(dim=2).all(dim=0)
        counts["not_finite"] = int((~finite).sum()) + int((~rollout.latents.isfinite()).any())
        yield counts


if __name__ == "__main__":
    raise SystemExit(main())
