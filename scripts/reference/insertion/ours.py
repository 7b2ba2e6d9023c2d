"""This package's DPPO on its own environments, with the encoder left alone, as the reference has it here."""

import argparse
import contextlib
import dataclasses
import json
import sys
import time
from typing import Any

from lerobot_vtrefine.cli.pipeline.demo_config import SEED_STRIDE
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.pipeline import Practice, load_practice


class TimeIsUpError(Exception):
    """Ends a run whose --minutes are over."""


def preset(name: str, args: argparse.Namespace, **changes: Any) -> DppoConfig:
    """A preset of ours for this comparison."""
    return dataclasses.replace(
        DppoConfig.get_choice_class(name)(),
        **{"num_envs": args.worlds, "iterations": args.our_iterations, "encoder": "frozen", **changes},
    )


def train_ours(name: str, args: argparse.Namespace) -> tuple[Practice, list[dict[str, float]]]:
    """This package's loop with a preset; its learning curve."""
    cfg = preset(name, args)
    practice = load_practice(args.policy, args.task, cfg, args.device, args.backend)
    env, agent = practice.env, practice.agent
    state = dppo.TrainState.create(agent, cfg, env.privileged_dim, args.seed)
    curve: list[dict[str, float]] = []
    began = time.perf_counter()

    def note(state: dppo.TrainState, metrics: dppo.Metrics) -> None:
        row = {"iteration": float(state.iteration), "env_steps": float(state.env_steps)}
        row |= {key: metrics[key] for key in ("success",) if key in metrics}
        over = time.perf_counter() - began > 60 * args.minutes
        if state.iteration % args.val_freq == 0 or state.iteration == cfg.iterations or over:
            row["eval_success"] = evaluate(env, agent, args.worlds)["eval_success"]
        row["seconds"] = time.perf_counter() - began
        curve.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        if over:
            raise TimeIsUpError

    note(state, {})
    with contextlib.suppress(TimeIsUpError):
        dppo.train(env, agent, state, cfg, seed=args.seed * SEED_STRIDE, after_iteration=note)
    return practice, curve
