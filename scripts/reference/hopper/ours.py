"""This package's DPPO on Hopper, from a pre-trained network of the reference's.

Actor and critic see the scaled observation. An iteration has as many worlds as make the decisions of one of
the reference's, by the mean length of the episodes before.
"""

import argparse
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_vtrefine.cli.pipeline.demo_config import SEED_STRIDE
from lerobot_vtrefine.envs.decisions import Decision
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.protocols import Agent, Observation
from lerobot_vtrefine.policies.vt_dp3.diffusion import DiffusionProcess, step_grid
from reference.checkout import Reference
from reference.hopper.curves import Curve
from reference.hopper.network import DENOISING_STEPS, TUNED_STEPS, pretrained
from reference.hopper.standin import Scales
from reference.hopper.worlds import (
    ACTION_DIM,
    CHUNK,
    MAX_STEPS,
    N_STEPS,
    NUM_ENVS,
    OBS_DIM,
    SpreadWorlds,
    Worlds,
)

MAX_DECISIONS = MAX_STEPS // CHUNK
FEWEST, MOST = 8, 800
"""Worlds of an iteration."""
SAME = {"gamma": 0.99, "timeout": "bootstrap", "encoder": "frozen", "reward_scaling": True}
"""Of every preset: the task's discount and time limit, and rewards that are not a success."""
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "ft_denoising_steps": TUNED_STEPS,
        "min_sampling_std": 0.1,
        "min_log_prob_std": 0.1,
        "gae_lambda": 0.95,
        "gamma_denoising": 0.99,
        "clip": 0.01,
        "clip_first": 0.01,
        "target_kl": 1.0,
        "epochs": 5,
        "minibatches": 4,
        "critic_warmup": 0,
        "actor_lr": 1e-4,
        "actor_lr_final": 1e-4,
        "critic_lr": 1e-3,
        "critic_lr_final": 1e-3,
        "lr_warmup": 0,
        "critic_width": 256,
        "critic_blocks": 1,
    },
    "trust_region": {"ft_denoising_steps": TUNED_STEPS},
}


class HopperDecisions:
    """Hopper as our DPPO sees it: whole episodes in ``num_envs`` worlds, a number that may change."""

    max_decisions = MAX_DECISIONS
    privileged_dim = OBS_DIM

    def __init__(self, worlds: Worlds | SpreadWorlds, scales: Scales, num_envs: int) -> None:
        self.worlds, self.scales, self.num_envs = worlds, scales, num_envs
        self._obs = np.zeros((0, OBS_DIM), np.float32)
        self._decisions = np.zeros(0, np.int64)
        self._over = np.zeros((2, 0), bool)  # terminated, truncated

    def reset(self, seeds: Sequence[int]) -> tuple[Observation, Tensor]:
        """Observation {"state": (n, 11)} and the critic's (n, 11), which is the same."""
        self._obs = self.scales.scaled_obs(self.worlds.reset(np.arange(len(seeds)), np.array(seeds)))
        self._decisions = np.zeros(len(seeds), np.int64)
        self._over = np.zeros((2, len(seeds)), bool)
        state = torch.from_numpy(self._obs)
        return {"state": state}, state

    def step_chunk(self, actions: Tensor) -> Decision:
        """Execute scaled chunks (n, Ta, 3) where the episode goes on."""
        ids = np.flatnonzero(~self._over.any(0))
        chunks = self.scales.raw_actions(actions.cpu().numpy()[ids])
        obs, chunk_reward, *over = self.worlds.step(ids, chunks)
        # Copies: what was handed out before must not change.
        self._obs, self._over, self._decisions = self._obs.copy(), self._over.copy(), self._decisions.copy()
        self._obs[ids] = self.scales.scaled_obs(obs)
        self._over[:, ids] = over
        self._decisions[ids] += 1
        reward = np.zeros(len(self._obs), np.float32)
        reward[ids] = chunk_reward
        state = torch.from_numpy(self._obs)
        info = {
            "success": torch.zeros(len(self._obs), dtype=torch.bool),
            "decisions": torch.from_numpy(self._decisions),
        }
        terminated, truncated = torch.from_numpy(self._over)
        return Decision({"state": state}, state, torch.from_numpy(reward), terminated, truncated, info)

    def fill(self, decisions: int, per_episode: float) -> None:
        """As many worlds from now on as make so many decisions, if episodes keep their mean length."""
        self.num_envs = int(np.clip(round(decisions / max(per_episode, 1.0)), FEWEST, MOST))


class StateActor(nn.Module):
    """A diffusion network of the reference's as our ``Actor``: the condition is the scaled observation."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.denoiser: nn.Module = StateDenoiser(network)

    def encode(self, batch: Observation, /) -> Tensor:
        """Condition (B, 11)."""
        return batch["state"]


class StateDenoiser(nn.Module):
    """Calls the network as the reference does, with one condition for B / b neighbours."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor, time: Tensor, cond: Tensor) -> Tensor:
        """x (B, H, 3), time (B,) long, cond (b, 11) -> noise (B, H, 3)."""
        state = cond.repeat_interleave(len(x) // len(cond), dim=0)
        return self.network(x, time, cond={"state": state.unsqueeze(1)})


def hopper_agent(tuned: nn.Module, base: nn.Module, deploy_eta: float) -> Agent:
    """Our agent around two copies of the pre-trained network."""
    grid = step_grid("ddpm", DENOISING_STEPS, DENOISING_STEPS)
    return Agent(
        actor=StateActor(tuned),
        base=StateActor(base).requires_grad_(False).eval(),
        process=DiffusionProcess(DENOISING_STEPS, grid),
        num_tuned=TUNED_STEPS,
        action_shape=(CHUNK, ACTION_DIM),
        executed=slice(0, CHUNK),
        frozen_encoder=True,
        deploy_eta=deploy_eta,
    )


def train_ours(args: argparse.Namespace, worlds: Worlds | SpreadWorlds, curve: Curve) -> None:
    """This package's loop with a preset."""
    cfg = dataclasses.replace(
        DppoConfig.get_choice_class(args.by)(), iterations=args.iterations, **SAME, **PRESETS[args.by]
    )
    reference, scales = Reference(args.reference), Scales.of(args.folder / "scales.npz")
    tuned, base = (pretrained(reference, args.folder / "pretrained.pt", args.device) for _ in range(2))
    agent = hopper_agent(tuned, base, cfg.deploy_eta)
    practice, held_out = (HopperDecisions(worlds, scales, NUM_ENVS) for _ in range(2))
    state = dppo.TrainState.create(agent, cfg, OBS_DIM, args.seed)

    def note(state: dppo.TrainState, metrics: dppo.Metrics) -> None:
        if metrics:
            told = {name: metrics[name] for name in ("return", "decisions", "decision_kl", "rollout_s")}
            curve.add(state.iteration, state.env_steps, **told, episodes=practice.num_envs)
        length = metrics.get("decisions", 0.0)
        if state.iteration % args.every == 0:
            found = evaluate(held_out, agent, NUM_ENVS)
            told = {"eval_return": found["eval_return"], "decisions": found["eval_decisions"]}
            curve.add(state.iteration, state.env_steps, **told, episodes=NUM_ENVS)
            length = length or told["decisions"]
        practice.fill(NUM_ENVS * N_STEPS, length)

    note(state, {})
    dppo.train(practice, agent, state, cfg, seed=args.seed * SEED_STRIDE, after_iteration=note)
