"""The reference's DPPO on this package's environments, with the hyper-parameters of its furniture tasks.

What it sees as its state is the policy's condition, from an encoder that nobody tunes, and the privileged
state, standardised; its actor reads the one, its critic the other. Worlds whose episode has ended wait,
terminated and without reward, for the next iteration. Its evaluations count as iterations, as they do there:
iteration 0 is one, and the last should be.
"""

import argparse
import contextlib
import copy
import json
import sys
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_vtrefine.cli.pipeline.demo_config import SEED_STRIDE
from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.pipeline import Practice, load_practice
from lerobot_vtrefine.finetune.protocols import Agent, DecisionEnv, Observation
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS
from reference.checkout import Reference, Settings
from reference.insertion.ours import TimeIsUpError, preset

FURNITURE = {
    "gamma_denoising": 0.9,
    "clip_ploss_coef": 0.001,
    "clip_ploss_coef_base": 0.001,
    "clip_ploss_coef_rate": 3,
    "randn_clip_value": 3,
    "min_sampling_denoising_std": 0.04,
    "denoising_steps": 100,
}
"""Of its diffusion model, for the furniture tasks; with five steps of DDIM, all of them tuned."""
DDIM_STEPS = 5
CRITIC_WIDTHS = (512, 512, 512)
STATE_CLIP = 5.0


class ActorOfState(nn.Module):
    """Our denoiser as the reference calls its own: condition (B, 1, C + P) as a state."""

    def __init__(self, denoiser: nn.Module, cond_dim: int) -> None:
        super().__init__()
        self.denoiser, self.cond_dim = copy.deepcopy(denoiser).requires_grad_(True), cond_dim

    def forward(self, x: Tensor, time: Tensor, cond: dict[str, Tensor]) -> Tensor:
        """Noise (B, H, D)."""
        return self.denoiser(x, time, cond["state"][:, 0, : self.cond_dim])


class CriticOfState(nn.Module):
    """The reference's critic, on the privileged part of the state."""

    def __init__(self, critic: nn.Module, cond_dim: int) -> None:
        super().__init__()
        self.critic, self.cond_dim = critic, cond_dim

    def forward(self, cond: dict[str, Tensor]) -> Tensor:
        """Values (B, 1)."""
        return self.critic({"state": cond["state"][:, :, self.cond_dim :].contiguous()})


def model_to_tune(
    reference: Reference, agent: Agent, privileged_dim: int, cond_dim: int, **changes: Any
) -> Any:
    """Its ``PPODiffusion`` around a copy of our network."""
    horizon, action_dim = agent.action_shape
    settings = FURNITURE | {"use_ddim": True, "ddim_steps": DDIM_STEPS, "ft_denoising_steps": DDIM_STEPS}
    settings |= changes
    eta = {"eta": reference.Eta(base_eta=1, min_eta=0.1, max_eta=1.0)} if settings["use_ddim"] else {}
    critic = reference.Critic(privileged_dim, list(CRITIC_WIDTHS), residual_style=True)
    return reference.Model(
        actor=ActorOfState(agent.actor.denoiser, cond_dim),
        critic=CriticOfState(critic, cond_dim),
        horizon_steps=horizon,
        obs_dim=cond_dim + privileged_dim,
        action_dim=action_dim,
        device=str(agent.device),
        **eta,
        **settings,
    )


class ReferenceEnvs:
    """Our environments as the reference's agent steps its own; keeps the learning curve.

    ``mean`` and ``std`` (P,) standardise the privileged state.
    """

    pairs_to_assemble = (0,)  # what counts as success: a reward of one

    def __init__(
        self, env: DecisionEnv, agent: Agent, mean: Tensor, std: Tensor, args: argparse.Namespace
    ) -> None:
        self.env, self.agent, self.mean, self.std = env, agent, mean, std
        self.first_seed = TRAINING_SEEDS + args.seed * SEED_STRIDE
        self.val_freq, self.seconds = args.val_freq, 60 * args.minutes
        self.iteration, self.env_steps, self.began = -1, 0, time.perf_counter()
        self.curve: list[dict[str, float]] = []
        self.over = self.success = np.ones(env.num_envs, bool)

    def reset_arg(self, options_list: object) -> dict[str, np.ndarray]:
        """New episodes in all worlds: held-out ones where the agent evaluates."""
        self.note()
        if time.perf_counter() - self.began > self.seconds:
            raise TimeIsUpError
        self.iteration += 1
        held_out = self.iteration % self.val_freq == 0
        worlds = self.env.num_envs
        first = EVALUATION_SEEDS if held_out else self.first_seed + self.iteration * worlds
        obs, privileged = self.env.reset(range(first, first + worlds))
        self.over, self.success = np.zeros((2, worlds), bool)
        return self._state(obs, privileged)

    def note(self) -> None:
        """Add the episodes that have ended to the curve."""
        if self.iteration < 0:
            return
        name = "eval_success" if self.iteration % self.val_freq == 0 else "success"
        row = {"iteration": float(self.iteration), "env_steps": float(self.env_steps)}
        row |= {name: float(self.success.mean()), "seconds": time.perf_counter() - self.began}
        self.curve.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        """Executes chunks (n, Ta, D); what has ended stays terminated."""
        if self.iteration % self.val_freq:
            self.env_steps += int((~self.over).sum()) * actions.shape[1]
        chunk = torch.as_tensor(actions, device=self.agent.device)
        obs, privileged, reward, terminated, truncated, info = self.env.step_chunk(chunk)
        reward = np.where(self.over, 0.0, reward.cpu().numpy())
        self.success = self.success | (info["success"].cpu().numpy().astype(bool) & ~self.over)
        self.over = self.over | (terminated | truncated).cpu().numpy()
        return self._state(obs, privileged), reward, self.over, np.zeros_like(self.over), {}

    @torch.no_grad()
    def _state(self, obs: Observation, privileged: Tensor) -> dict[str, np.ndarray]:
        device = self.agent.device
        cond = self.agent.actor.encode({key: value.to(device) for key, value in obs.items()})
        return {"state": state_of(cond, privileged.to(device), self.mean, self.std).cpu().numpy()}


def state_of(cond: Tensor, privileged: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """The reference's state (B, 1, C + P)."""
    known = ((privileged - mean) / std).clamp(-STATE_CLIP, STATE_CLIP)
    return torch.cat([cond, known], dim=1).unsqueeze(1)


def moments(rollout: dppo.Rollout) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation (P,) of the privileged states of a rollout; constant ones keep theirs."""
    states = rollout.privileged[:-1][rollout.active]
    return states.mean(0), states.std(0).clamp(min=1e-6)


def train_reference(
    args: argparse.Namespace, reference: Reference
) -> tuple[Practice, list[dict[str, float]]]:
    """The reference's agent's own run; its learning curve."""
    cfg = preset("paper", args)
    practice = load_practice(args.policy, args.task, cfg, args.device, args.backend)
    agent, env = practice.agent, practice.env
    generator = torch.Generator(agent.device).manual_seed(args.seed)
    first = TRAINING_SEEDS + args.seed * SEED_STRIDE
    seen = dppo.collect(env, agent, cfg, generator, range(first, first + args.worlds))
    mean, std = moments(seen)
    envs = ReferenceEnvs(env, agent, mean, std, args)
    cond_dim = seen.obs["cond"].shape[1]
    model = model_to_tune(reference, agent, env.privileged_dim, cond_dim)
    schedule = {"first_cycle_steps": 10000, "warmup_steps": 10}
    chunk = agent.executed.stop - agent.executed.start
    with contextlib.suppress(TimeIsUpError):
        reference.run(
            device=args.device,
            seed=args.seed,
            env=Settings(
                name=envs,
                env_type="furniture",
                n_envs=args.worlds,
                max_episode_steps=env.max_decisions * chunk,
                specific=Settings(sparse_reward=True),
            ),
            obs_dim=cond_dim + env.privileged_dim,
            action_dim=agent.action_shape[1],
            horizon_steps=agent.action_shape[0],
            act_steps=chunk,
            model=model,
            train=Settings(
                batch_size=args.batch_rows,
                n_train_itr=args.iterations,
                n_critic_warmup_itr=1,
                n_steps=env.max_decisions,
                val_freq=args.val_freq,
                save_model_freq=10**9,
                render=Settings(freq=10**9, num=0),
                logprob_batch_size=args.worlds * max(1, 10000 // args.worlds),
                gamma=0.999,
                gae_lambda=0.95,
                actor_lr=1e-5,
                actor_weight_decay=0,
                actor_lr_scheduler=Settings(schedule, min_lr=1e-6),
                critic_lr=1e-3,
                critic_weight_decay=0,
                critic_lr_scheduler=Settings(schedule, min_lr=1e-3),
                reward_scale_running=True,
                reward_scale_const=1.0,
                update_epochs=5,
                vf_coef=0.5,
                target_kl=1,
            ),
        )
        envs.note()
    return practice, envs.curve
