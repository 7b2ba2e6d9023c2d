"""The reference's DPPO on Hopper; actor and critic see the scaled observation.

Hyper-parameters are those of ``cfg/gym/finetune/hopper-v2/ft_ppo_diffusion_mlp.yaml`` of the checkout.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_vtrefine.cli.pipeline.demo_config import SEED_STRIDE
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS
from reference.checkout import Reference, Settings
from reference.hopper.curves import Curve
from reference.hopper.network import DENOISING_STEPS, TUNED_STEPS, fresh
from reference.hopper.standin import Scales
from reference.hopper.worlds import (
    ACTION_DIM,
    CHUNK,
    MAX_STEPS,
    N_STEPS,
    NUM_ENVS,
    OBS_DIM,
    Array,
    SpreadWorlds,
    Worlds,
)


class Steps(Tensor):
    """Denoising steps that are gone through as numbers.

    The reference's loss goes through them in Python, which of tensors on a GPU waits for it at every one.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # ty: ignore[incompatible-method-override]

    def __iter__(self) -> Any:
        return iter(self.tolist())


VARIANTS: dict[str, frozenset[str]] = {
    "reference": frozenset(),
    "reference_quiet": frozenset({"quiet"}),
    "reference_critic": frozenset({"critic"}),
    "reference_quiet_critic": frozenset({"quiet", "critic"}),
}
"""By name: what the reference takes over from ours. ``quiet``: untuned denoising steps without noise;
``critic``: the critic's input is standardised.
"""
NOISE_CLIP = 3.0


def quiet_prefix(model: Any, x: Tensor, t: Tensor, mean: Tensor) -> Tensor:
    """The DDIM step with eta = 0 in place of the DDPM posterior's ``mean`` (B, H, D).

    x (B, H, D) at the same step t (B,) for all; ``model`` holds the reference's schedule.
    """
    a, b = model.ddpm_mu_coef1[t[0]], model.ddpm_mu_coef2[t[0]]
    here, after = model.alphas_cumprod[t[0]], model.alphas_cumprod_prev[t[0]]
    clean = (mean - b * x) / a
    return after.sqrt() * clean + (1 - after).sqrt() * (x - here.sqrt() * clean) / (1 - here).sqrt()


def standardised(critic: Any, episodes: Path) -> Any:
    """The reference's critic with its scaled observation standardised by that of recorded episodes."""
    with np.load(episodes) as recorded:
        obs = Scales.of(episodes).scaled_obs(recorded["obs"])

    class Standardised(critic):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self.register_buffer("mean", torch.from_numpy(obs.mean(0)))
            self.register_buffer("std", torch.from_numpy(obs.std(0)))

        def forward(self, cond: Any) -> Tensor:
            state = cond["state"].flatten(1)
            return super().forward((state - self.mean) / self.std)

    return Standardised


def model_to_tune(reference: Reference, folder: Path, device: str, variant: frozenset[str]) -> nn.Module:
    """Its ``PPODiffusion`` from the checkpoint of a folder."""

    class Model(reference.Model):
        def p_mean_var(self, x: Tensor, t: Tensor, *args: Any, **kwargs: Any) -> Any:
            mean, *rest = super().p_mean_var(x, t, *args, **kwargs)
            if "quiet" in variant:
                untuned = int(t[0]) >= self.ft_denoising_steps  # steps of one call are all of one kind
                self.randn_clip_value = 0.0 if untuned else NOISE_CLIP
                mean = quiet_prefix(self, x, t, mean) if untuned else mean
            return mean, *rest

        def loss(
            self, obs: Any, before: Tensor, after: Tensor, steps: Tensor, *rest: Any, **more: Any
        ) -> Any:
            return super().loss(obs, before, after, steps.as_subclass(Steps), *rest, **more)

    critic = reference.Critic
    if "critic" in variant:
        critic = standardised(critic, folder / "episodes.npz")
    return Model(
        actor=fresh(reference),
        critic=critic(OBS_DIM, [256, 256, 256], activation_type="Mish", residual_style=True),
        network_path=str(folder / "pretrained.pt"),
        gamma_denoising=0.99,
        clip_ploss_coef=0.01,
        clip_ploss_coef_base=0.01,
        clip_ploss_coef_rate=3,
        randn_clip_value=NOISE_CLIP,
        min_sampling_denoising_std=0.1,
        min_logprob_denoising_std=0.1,
        ft_denoising_steps=TUNED_STEPS,
        denoising_steps=DENOISING_STEPS,
        horizon_steps=CHUNK,
        obs_dim=OBS_DIM,
        action_dim=ACTION_DIM,
        device=device,
    )


class ReferenceHoppers:
    """Hopper as the reference's agent steps it; episodes go on over iterations. Keeps the learning curve.

    Where the agent evaluates, the first episode of every world is a held-out one; these are the evaluation.
    """

    def __init__(
        self,
        worlds: Worlds | SpreadWorlds,
        scales: Scales,
        curve: Curve,
        *,
        num_envs: int,
        n_steps: int,
        val_freq: int,
        first_seed: int,
    ) -> None:
        self.worlds, self.scales, self.curve = worlds, scales, curve
        self.num_envs, self.n_steps, self.val_freq = num_envs, n_steps, val_freq
        self.next_seed = TRAINING_SEEDS + first_seed
        self.decisions = 0
        self.totals = np.zeros(num_envs)
        self.lengths = np.zeros(num_envs)
        self.ended: list[tuple[int, float, float]] = []  # world, return, decisions

    def seed(self, seeds: Sequence[int]) -> None:
        """Every reset names its own."""

    def reset_arg(self, options_list: object) -> dict[str, Array]:
        """New episodes in all worlds: held-out ones where the agent evaluates."""
        ids = np.arange(self.num_envs)
        seeds = EVALUATION_SEEDS + ids if self._evaluates else self._fresh(self.num_envs)
        self.totals[:] = self.lengths[:] = 0
        return self._state(self.worlds.reset(ids, seeds))

    def step(self, actions: Array) -> tuple[Any, ...]:
        """Executes scaled chunks (n, Ta, 3); where an episode ended, a new one has begun."""
        ids = np.arange(self.num_envs)
        obs, reward, terminated, truncated = self.worlds.step(ids, self.scales.raw_actions(actions))
        self.totals += reward
        self.lengths += 1
        over = np.flatnonzero(terminated | truncated)
        if len(over):
            self.ended += [(int(i), self.totals[i], self.lengths[i]) for i in over]
            self.totals[over] = self.lengths[over] = 0
            obs[over] = self.worlds.reset(over, self._fresh(len(over)))
        self.decisions += 1
        if self.decisions % self.n_steps == 0:
            self._note(self.decisions // self.n_steps - 1)
        return self._state(obs), reward, terminated, truncated, [{}] * self.num_envs

    @property
    def _evaluates(self) -> bool:
        return self.decisions // self.n_steps % self.val_freq == 0

    def _fresh(self, number: int) -> Array:
        self.next_seed += number
        return np.arange(self.next_seed - number, self.next_seed)

    def _note(self, iteration: int) -> None:
        """A line of the curve, of an iteration that ends here."""
        trained = iteration - iteration // self.val_freq
        if iteration % self.val_freq == 0:
            firsts: dict[int, tuple[float, float]] = {}
            for world, total, length in self.ended:
                firsts.setdefault(world, (total, length))
            name, episodes = "eval_return", list(firsts.values())
        else:
            name, episodes = "return", [(total, length) for _, total, length in self.ended]
        self.ended = []
        total, length = np.mean(episodes, axis=0) if episodes else (np.nan, np.nan)
        numbers = {name: float(total), "episodes": len(episodes), "decisions": float(length)}
        self.curve.add(trained, trained * self.n_steps * self.num_envs * CHUNK, **numbers)

    def _state(self, obs: Array) -> dict[str, Array]:
        return {"state": self.scales.scaled_obs(obs)[:, None]}


def train_reference(args: argparse.Namespace, worlds: Worlds | SpreadWorlds, curve: Curve) -> None:
    """Its agent's own run of so many iterations, besides the evaluations."""
    envs = ReferenceHoppers(
        worlds,
        Scales.of(args.folder / "scales.npz"),
        curve,
        num_envs=NUM_ENVS,
        n_steps=N_STEPS,
        val_freq=args.every + 1,
        first_seed=args.seed * SEED_STRIDE,
    )
    reference = Reference(args.reference)
    torch.manual_seed(args.seed)
    schedule = {"first_cycle_steps": 1000, "warmup_steps": 10}
    reference.run(
        device=args.device,
        seed=args.seed,
        env=Settings(
            name=envs,
            n_envs=NUM_ENVS,
            max_episode_steps=MAX_STEPS,
            reset_at_iteration=False,
            best_reward_threshold_for_success=3,
        ),
        obs_dim=OBS_DIM,
        action_dim=ACTION_DIM,
        horizon_steps=CHUNK,
        act_steps=CHUNK,
        model=model_to_tune(reference, args.folder, args.device, VARIANTS[args.by]),
        train=Settings(
            batch_size=50000,
            n_train_itr=args.iterations + args.iterations // args.every + 1,
            n_critic_warmup_itr=0,
            n_steps=N_STEPS,
            val_freq=envs.val_freq,
            save_model_freq=10**9,
            render=Settings(freq=1, num=0),
            gamma=0.99,
            gae_lambda=0.95,
            actor_lr=1e-4,
            actor_weight_decay=0,
            actor_lr_scheduler=Settings(schedule, min_lr=1e-4),
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
