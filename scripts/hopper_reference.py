"""The reference's diffusion network and its fine-tuning agent for Hopper, from a checkout.

Hyper-parameters are those of its ``cfg/gym/pretrain/hopper-medium-v2/pre_diffusion_mlp.yaml`` and
``cfg/gym/finetune/hopper-v2/ft_ppo_diffusion_mlp.yaml``.
"""

import contextlib
import importlib
import io
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from hopper_dppo import CHUNK, DENOISING_STEPS, HORIZON, TUNED_STEPS, ReferenceHoppers
from hopper_worlds import ACTION_DIM, MAX_STEPS, OBS_DIM
from reference_dppo import Reference, Settings
from torch import Tensor, nn

NUM_ENVS, N_STEPS, BATCH_ROWS = 40, 500, 50000
"""Worlds, decisions of each in an iteration, and rows of a minibatch: a decision's denoising step each."""


class Steps(Tensor):
    """Denoising steps that are gone through as numbers.

    The reference's loss goes through them in Python, which of tensors on a GPU waits for it at every one.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # ty: ignore[incompatible-method-override]

    def __iter__(self) -> Any:
        return iter(self.tolist())


def network(reference: Reference) -> nn.Module:
    """A fresh diffusion MLP of the reference's, as its configurations for Hopper have it."""
    return importlib.import_module("model.diffusion.mlp_diffusion").DiffusionMLP(
        action_dim=ACTION_DIM,
        horizon_steps=HORIZON,
        cond_dim=OBS_DIM,
        time_dim=16,
        mlp_dims=[512, 512, 512],
        activation_type="ReLU",
        residual_style=True,
    )


def pretrained(reference: Reference, checkpoint: Path, device: str) -> nn.Module:
    """The network of a checkpoint that ``pretrain`` made."""
    weights = torch.load(checkpoint, map_location=device, weights_only=True)["ema"]
    made = network(reference).to(device)
    made.load_state_dict({key.removeprefix("network."): value for key, value in weights.items()})
    return made


def imitation(reference: Reference, device: str) -> nn.Module:
    """Its diffusion model around a fresh network, for imitation."""
    return importlib.import_module("model.diffusion.diffusion").DiffusionModel(
        network=network(reference),
        horizon_steps=HORIZON,
        obs_dim=OBS_DIM,
        action_dim=ACTION_DIM,
        denoising_steps=DENOISING_STEPS,
        predict_epsilon=True,
        denoised_clip_value=1.0,
        device=device,
    )


def model_to_tune(reference: Reference, checkpoint: Path, device: str) -> nn.Module:
    """Its ``PPODiffusion`` from a checkpoint."""

    class Model(reference.Model):
        def loss(
            self, obs: Any, before: Tensor, after: Tensor, steps: Tensor, *rest: Any, **more: Any
        ) -> Any:
            return super().loss(obs, before, after, steps.as_subclass(Steps), *rest, **more)

    return Model(
        actor=network(reference),
        critic=reference.Critic(OBS_DIM, [256, 256, 256], activation_type="Mish", residual_style=True),
        network_path=str(checkpoint),
        gamma_denoising=0.99,
        clip_ploss_coef=0.01,
        clip_ploss_coef_base=0.01,
        clip_ploss_coef_rate=3,
        randn_clip_value=3,
        min_sampling_denoising_std=0.1,
        min_logprob_denoising_std=0.1,
        ft_denoising_steps=TUNED_STEPS,
        denoising_steps=DENOISING_STEPS,
        horizon_steps=HORIZON,
        obs_dim=OBS_DIM,
        action_dim=ACTION_DIM,
        device=device,
    )


def run_agent(
    reference: Reference, envs: ReferenceHoppers, checkpoint: Path, *, iterations: int, device: str, seed: int
) -> None:
    """Its agent's own run of so many iterations, besides the evaluations; the curve is with ``envs``."""
    torch.manual_seed(seed)
    schedule = {"first_cycle_steps": 1000, "warmup_steps": 10}
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(
            device=device,
            seed=seed,
            wandb=None,
            env=Settings(
                name=envs,
                n_envs=NUM_ENVS,
                max_episode_steps=MAX_STEPS,
                reset_at_iteration=False,
                best_reward_threshold_for_success=3,
            ),
            obs_dim=OBS_DIM,
            action_dim=ACTION_DIM,
            horizon_steps=HORIZON,
            act_steps=CHUNK,
            cond_steps=1,
            model=model_to_tune(reference, checkpoint, device),
            logdir=folder,
            train=Settings(
                batch_size=BATCH_ROWS,
                n_train_itr=iterations + iterations // (envs.val_freq - 1) + 1,
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
        agent = reference.Agent(settings)
        with contextlib.redirect_stdout(Progress()):
            agent.run()


class Progress(io.StringIO):
    """Keeps what the curve prints; the reference prints every tenth step."""

    def write(self, text: str, /) -> int:
        """To the terminal, if it is a line of the curve."""
        return sys.__stdout__.write(text + "\n") if text.startswith("{") and sys.__stdout__ else len(text)

    def flush(self) -> None:
        """Of the terminal."""
        if sys.__stdout__:
            sys.__stdout__.flush()
