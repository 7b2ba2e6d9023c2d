"""Where an iteration of DPPO spends its time, beside the environment alone.

    python scripts/profile_finetuning.py --device=cuda --worlds='[1024, 4096]'

The tuned policy that comes with the package plays its own task; --policy takes another checkpoint. An
earlier commit is measured by its own copy of this script:

    git worktree add /tmp/before COMMIT
    PYTHONPATH=/tmp/before python /tmp/before/scripts/profile_finetuning.py --device=cuda

"environment" is an episode of holding still in all worlds, with every frame read at every control step. Parts
are measured in a further rollout that waits for the device before and after each: they add up to more than a
rollout.
"""

import argparse
import functools
import json
import time
from collections import defaultdict
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

import lerobot_vtrefine
from lerobot_vtrefine.cli.arguments import CommandParser, ListAction, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_file
from lerobot_vtrefine.envs.decisions import LeRobotDecisionEnv
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.config import TrustRegionDppo
from lerobot_vtrefine.finetune.pipeline import load_practice
from lerobot_vtrefine.finetune.protocols import Agent

ROOT = Path(__file__).parents[1]
POLICY = ROOT / "lerobot_vtrefine" / "assets" / "policies" / "square_grasped_1mm"
TASK = ROOT / "configs" / "env" / "square_grasped_1mm.yaml"
PARTS: tuple[tuple[str, Any, str], ...] = (
    ("reset", Episodes, "reset"),
    ("control steps", Episodes, "step"),
    ("of these, sensors", Episodes, "read"),
    ("windows", LeRobotDecisionEnv, "_push"),
    ("preprocessing", LeRobotDecisionEnv, "_update_batch"),
    ("privileged state", LeRobotDecisionEnv, "_privileged"),
    ("metrics", LeRobotDecisionEnv, "_info"),
    ("encoder", Agent, "conditions"),
    ("denoising, frozen", dppo, "denoise_prefix"),
    ("denoising, tuned", dppo, "explore"),
)


@contextmanager
def timed_parts(device: torch.device) -> Generator[dict[str, float]]:
    """Seconds of every part while this lasts."""
    seconds: dict[str, float] = defaultdict(float)

    def watched(name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(work)
        def run(*args: Any, **kwargs: Any) -> Any:
            started = now(device)
            try:
                return work(*args, **kwargs)
            finally:
                seconds[name] += now(device) - started

        return run

    originals = [(owner, name, getattr(owner, name)) for _, owner, name in PARTS]
    for (title, owner, name), (_, _, work) in zip(PARTS, originals, strict=True):
        setattr(owner, name, watched(title, work))
    try:
        yield seconds
    finally:
        for owner, name, work in originals:
            setattr(owner, name, work)


def now(device: torch.device) -> float:
    """Seconds, once the device has done all it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def environment_seconds(episodes: Episodes, device: torch.device) -> tuple[float, float]:
    """Of a reset, and of an episode in which everyone holds still."""
    started = ready = done = 0.0
    for first in (0, episodes.num_envs):  # the first round compiles and records
        started = now(device)
        episodes.reset(episodes.ids, first + episodes.ids)
        ready = now(device)
        hold = episodes.sim.command_targets()
        for _ in range(episodes.sim.episode_steps):
            episodes.step(hold)
        done = now(device)
    return ready - started, done - ready


def profile(args: argparse.Namespace, worlds: int) -> dict[str, Any]:
    """One row."""
    device = torch.device(args.device)
    cfg = TrustRegionDppo(num_envs=worlds, encoder="frozen", critic_warmup=0, decisions=args.decisions)
    policy, agent, env, _ = load_practice(
        args.policy, args.task, cfg, args.device, backend="warp", timestep_s=args.timestep_s
    )
    reset_s, env_s = environment_seconds(env.episodes, device)
    state = dppo.TrainState.create(agent, cfg, env.privileged_dim, seed=0)
    rollouts, updates, steps, count = [], [], [], 0
    for iteration in range(args.iterations + 1):
        first = iteration * worlds
        started = now(device)
        rollout = dppo.collect(env, agent, cfg, state.generator, range(first, first + worlds))
        collected = now(device)
        state.critic.update_moments(rollout.privileged[:-1][rollout.active])
        count = int(dppo.update(rollout, agent, state, cfg)["updates"])
        updates.append(now(device) - collected)
        rollouts.append(collected - started)
        steps.append(float(rollout.active.sum()) * policy.config.n_action_steps)
        state.iteration += 1
    fresh = range((args.iterations + 1) * worlds, (args.iterations + 2) * worlds)
    with timed_parts(device) as parts:
        dppo.collect(env, agent, cfg, state.generator, fresh)
    if silent := [title for title, _, _ in PARTS if title not in parts]:
        raise RuntimeError(f"nobody called what PARTS times as {silent}")
    rollout_s, update_s = (float(np.median(times[1:])) for times in (rollouts, updates))
    return {
        "worlds": worlds,
        "environment_s": env_s,
        "environment_reset_s": reset_s,
        "rollout_s": rollout_s,
        "update_s": update_s,
        "updates": count,
        "iteration_s": rollout_s + update_s,
        "valid_steps_per_s": float(np.median(steps[1:])) / (rollout_s + update_s),
        "success": float(rollout.success.float().mean()),
        "parts_s": {title: round(parts[title], 3) for title, _, _ in PARTS},
    }


@run_cli
def main() -> None:
    """Prints a JSON object per number of worlds."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--device", default="cpu", help="of simulation and policy: cpu or cuda")
    parser.add_argument(
        "--worlds", action=ListAction, kind=at_least(1), default=[1024, 4096], help="numbers of worlds"
    )
    parser.add_argument("--iterations", type=at_least(1), default=4, help="measured, after one to warm up")
    parser.add_argument("--decisions", type=at_least(0), default=0, help="of a rollout; 0: whole episodes")
    parser.add_argument("--policy", type=Path, default=POLICY, help="a vt_dp3 checkpoint's folder")
    parser.add_argument("--task", type=Path, default=TASK, help="a file as in configs/env")
    parser.add_argument("--timestep_s", type=float, help="longest physics step [s], default: the task's")
    parser.add_argument("--json", type=Path, help="where to write the rows, too")
    args = parser.parse_args()
    if args.json is not None:
        check_file("--json", args.json)
    print(f"measuring {Path(lerobot_vtrefine.__file__).parent}", flush=True)
    rows = []
    for worlds in args.worlds:
        rows.append(profile(args, worlds))
        print(json.dumps(rows[-1], indent=2), flush=True)
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
