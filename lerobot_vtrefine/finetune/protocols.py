"""What DPPO needs from a network and from an environment, and nothing more.

Shapes: ``n`` environments, ``H`` horizon of a predicted chunk, ``Ta`` executed actions of it, ``D`` action
dimension, ``C`` condition, ``P`` privileged state.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from lerobot_vtrefine.envs.decisions import Decision
from lerobot_vtrefine.policies.vt_dp3.diffusion import DiffusionProcess

Observation = dict[str, Tensor]
"""A preprocessed policy batch; every tensor starts with the environment axis."""


class Actor(Protocol):
    """A diffusion policy's network: an ``nn.Module`` with two stages."""

    denoiser: nn.Module
    """``(x (B, H, D), t (B,) long, cond (b, C)) -> eps (B, H, D)``; B / b neighbours share a condition."""

    def encode(self, batch: Observation, /) -> Tensor:
        """Condition (B, C) of an observation: once per decision."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]:
        """As of ``nn.Module``."""
        ...


@dataclass
class Agent:
    """A diffusion policy being fine-tuned.

    ``base`` denoises down to the last ``num_tuned`` steps and stays frozen; ``actor`` does these steps.
    ``executed`` is the part of the horizon that reaches the environment. ``frozen_encoder``: the actor's
    encoder is not trained and is the base's, so conditions are computed once and kept. ``deploy_eta``:
    stochasticity of the tuned steps in deployment, which has no exploration noise; ``deploy_correlation`` of
    that noise from one action to the next.
    """

    actor: Actor
    base: Actor
    process: DiffusionProcess
    num_tuned: int
    action_shape: tuple[int, int]  # (H, D)
    executed: slice
    frozen_encoder: bool
    deploy_eta: float
    deploy_correlation: float = 0.0

    @property
    def device(self) -> torch.device:
        """Where the networks are."""
        return next(self.actor.parameters()).device

    def trained_parameters(self) -> list[nn.Parameter]:
        """What the actor's optimiser owns."""
        parameters = self.actor.denoiser.parameters() if self.frozen_encoder else self.actor.parameters()
        return [parameter for parameter in parameters if parameter.requires_grad]

    def conditions(self, obs: Observation) -> tuple[Tensor, Tensor]:
        """Conditions (B, C) for the actor and for the base."""
        cond = self.actor.encode(obs)
        return cond, (cond if self.frozen_encoder else self.base.encode(obs))

    def kept_condition(self, network: Actor, obs: Observation) -> Tensor:
        """Condition (B, C) of what a rollout keeps: observations, or with a frozen encoder conditions."""
        return obs["cond"] if self.frozen_encoder else network.encode(obs)


class DecisionEnv(Protocol):
    """Environments that take one action chunk per decision and pause once finished, until the next reset.

    What a decision tells of those that had finished before it may be anything finite. Of ``Decision.info``,
    "success" must be there; episodes that are "void" at the end are left out of what is learnt from.
    """

    @property
    def num_envs(self) -> int:
        """n."""
        ...

    @property
    def max_decisions(self) -> int:
        """Decisions in the longest possible episode."""
        ...

    @property
    def privileged_dim(self) -> int:
        """P."""
        ...

    def reset(self, seeds: Sequence[int]) -> tuple[Observation, Tensor]:
        """Start all environments, each from its own seed. Returns observation and privileged state (n, P)."""
        ...

    def step_chunk(self, actions: Tensor) -> Decision:
        """Execute (n, Ta, D) normalised actions, as the policy predicts them."""
        ...


def select(obs: Observation, index: Tensor) -> Observation:
    """Rows of an observation."""
    return {key: value[index] for key, value in obs.items()}


def concatenate(parts: list[Observation]) -> Observation:
    """Join observations along the first axis."""
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


def start(env: DecisionEnv, seeds: Sequence[int], device: torch.device) -> tuple[Observation, Tensor]:
    """Reset all environments; everything on the policy's device."""
    obs, privileged = env.reset(seeds)
    return {key: value.to(device) for key, value in obs.items()}, privileged.to(device)


def execute(env: DecisionEnv, chunks: Tensor, ids: Tensor) -> Decision:
    """Step environments ``ids`` with chunks (len(ids), Ta, D); the others receive ignored zeros."""
    actions = chunks.new_zeros((env.num_envs, *chunks.shape[1:]))
    actions[ids] = chunks
    obs, privileged, reward, terminated, truncated, info = env.step_chunk(actions)
    device = chunks.device
    return Decision(
        {key: value.to(device) for key, value in obs.items()},
        privileged.to(device),
        reward.to(device, torch.float32),
        terminated.to(device),
        truncated.to(device),
        {key: value.to(device) for key, value in info.items()},
    )


def latest(info: dict[str, Tensor], news: dict[str, Tensor], running: Tensor) -> dict[str, Tensor]:
    """Episode metrics (n,), kept as they were where an environment had already finished."""
    values = {key: value.to(torch.float32) for key, value in news.items()}
    return {key: torch.where(running, value, info.get(key, value)) for key, value in values.items()}
