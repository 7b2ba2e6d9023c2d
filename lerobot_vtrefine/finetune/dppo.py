"""Diffusion Policy Policy Optimization (Ren et al. 2024) in one file.

Two nested decision processes: each decision t of the environment is a chain of denoising steps, of which
the last K' (the tuned ones) form a Gaussian policy. Every tuned step of a decision shares the decision's
advantage. What runs here, in order: ``collect`` episodes with the noisy sampler, values and advantages over
decisions, ``update`` with PPO's clipped objective on (decision, tuned step) rows.

Differences from the reference implementation, all deliberate: K'=1 works; critic-only iterations really
happen; values of final states are never mixed with those of the next episode; the observation is encoded
once per decision, not once per denoising step; minibatches hold whole decisions and none is dropped;
log-probabilities are stored while sampling; finished environments idle and their steps are left out of the
batch.

Shapes: E environments, S decisions, N valid decisions, K' tuned steps, H horizon, D action dimension.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from lerobot_vtrefine.finetune.chains import Regulariser, chain_log_probs, decision_kl, explore
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.critic import Critic, explained_variance, value_bias
from lerobot_vtrefine.finetune.distributed import (
    max_over_ranks,
    mean_over_ranks,
    num_ranks,
    rank_index,
    sum_gradients,
    sum_over_ranks,
    total_over_ranks,
)
from lerobot_vtrefine.finetune.gae import RewardScaler, generalised_advantages
from lerobot_vtrefine.finetune.gpu_memory import give_back_unused, memory_taken
from lerobot_vtrefine.finetune.noise import forked_rng, policy_noise
from lerobot_vtrefine.finetune.protocols import (
    Agent,
    DecisionEnv,
    Observation,
    concatenate,
    execute,
    latest,
    select,
    start,
)
from lerobot_vtrefine.finetune.seeds import TRAINING_SEEDS
from lerobot_vtrefine.finetune.trust_region import TrustRegion
from lerobot_vtrefine.finetune.undo import Undo
from lerobot_vtrefine.policies.vt_dp3.diffusion import denoise_prefix, predictor

Metrics = dict[str, float]
MINIBATCH_METRICS = ("value_loss", "policy_loss", "approx_kl", "clip_fraction", "log_ratio", "decision_kl")


@dataclass
class TrainState:
    """Everything that changes during training, apart from the actor's weights."""

    critic: Critic
    actor_optimizer: torch.optim.AdamW
    critic_optimizer: torch.optim.AdamW
    reward_scaler: RewardScaler
    generator: torch.Generator
    trust_region: TrustRegion
    undo: Undo
    iteration: int = 0
    env_steps: int = 0
    """Of practice, in whole chunks: also what is left of one when its episode has ended."""

    @classmethod
    def create(cls, agent: Agent, cfg: DppoConfig, privileged_dim: int, seed: int) -> "TrainState":
        """Fresh state on the actor's device; ranks differ only in their exploration noise."""
        device = agent.device
        with forked_rng(device):
            torch.manual_seed(seed)
            critic = Critic(privileged_dim, cfg.critic_width, cfg.critic_blocks).to(device)
        adamw = partial(torch.optim.AdamW, weight_decay=cfg.weight_decay, fused=device.type == "cuda")
        return cls(
            critic,
            adamw(agent.trained_parameters(), lr=cfg.actor_lr),
            adamw(critic.parameters(), lr=cfg.critic_lr),
            RewardScaler(),
            policy_noise(device, seed, rank_index()),
            TrustRegion(cfg),
            Undo(cfg),
        )


@dataclass
class Rollout:
    """One segment of experience. Flat tensors hold the N valid decisions; grids are (S, E)."""

    obs: Observation  # (N, ...) policy input, or {"cond": (N, C)} with a frozen encoder
    latents: Tensor  # (N, K'+1, H, D)
    log_probs: Tensor  # (N, K') under the sampling policy
    means: Tensor  # (N, K', H, D) of the sampling policy's steps
    step: Tensor  # (N,) decision index
    env: Tensor  # (N,) environment index
    privileged: Tensor  # (S+1, E, P)
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    active: Tensor
    success: Tensor  # (E,)
    info: dict[str, Tensor]  # (E,) episode metrics


@torch.no_grad()
def collect(
    env: DecisionEnv, agent: Agent, cfg: DppoConfig, generator: torch.Generator, seeds: Sequence[int]
) -> Rollout:
    """One episode (or its first ``cfg.decisions`` decisions) in every environment, with exploration noise."""
    device = agent.device
    obs, privileged = start(env, seeds, device)
    running = torch.ones(env.num_envs, dtype=torch.bool, device=device)
    success = torch.zeros_like(running)
    kept, chains, index, states, transitions, active = [], [], [], [privileged], [], []
    info: dict[str, Tensor] = {}
    for step in range(cfg.decisions or env.max_decisions):
        ids = running.nonzero().squeeze(1)
        obs = select(obs, ids)
        cond, cond_base = agent.conditions(obs)
        noise = torch.randn((len(ids), *agent.action_shape), generator=generator, device=device)
        base, actor = predictor(agent.base.denoiser, cond_base), predictor(agent.actor.denoiser, cond)
        latent = denoise_prefix(agent.process, base, noise, agent.num_tuned)
        chain = explore(agent, actor, latent, cfg, generator)
        transition = execute(env, chain.latents[:, -1, agent.executed], ids)
        kept.append({"cond": cond} if agent.frozen_encoder else obs)
        chains.append(chain)
        index.append(torch.stack([torch.full_like(ids, step), ids]))
        active.append(running)
        transitions.append(transition)
        states.append(transition.privileged)
        info = latest(info, transition.info, running)
        success = success | (transition.info["success"] & running)
        running = running & ~transition.terminated & ~transition.truncated
        obs = transition.obs
        if not running.any():
            break
    step_index, env_index = torch.cat(index, dim=1)
    return _without_void(
        Rollout(
            obs=concatenate(kept),
            latents=torch.cat([chain.latents for chain in chains]),
            log_probs=torch.cat([chain.log_probs for chain in chains]),
            means=torch.cat([chain.means for chain in chains]),
            step=step_index,
            env=env_index,
            privileged=torch.stack(states),
            reward=torch.stack([t.reward * a for t, a in zip(transitions, active, strict=True)]),
            terminated=torch.stack([t.terminated for t in transitions]),
            truncated=torch.stack([t.truncated for t in transitions]),
            active=torch.stack(active),
            success=success,
            info=info,
        )
    )


def _without_void(rollout: Rollout) -> Rollout:
    """Leave out the episodes whose simulation broke: what happened there is no one's doing."""
    void = rollout.info.get("void", torch.zeros_like(rollout.success)).bool()
    if not void.any():
        return rollout
    rows = ~void[rollout.env]
    kept = {name: getattr(rollout, name)[rows] for name in ("latents", "log_probs", "means", "step", "env")}
    return replace(rollout, obs=select(rollout.obs, rows), active=rollout.active & ~void, **kept)


@torch.no_grad()
def decision_advantages(rollout: Rollout, state: TrainState, cfg: DppoConfig) -> tuple[Tensor, Tensor]:
    """Normalised advantages and value targets (N,) of the valid decisions."""
    reward = state.reward_scaler(rollout.reward, rollout.active) if cfg.reward_scaling else rollout.reward
    timeout_is_end = cfg.timeout == "terminal"
    advantages, targets = generalised_advantages(
        reward,
        state.critic(rollout.privileged),
        rollout.terminated | (rollout.truncated & timeout_is_end),
        rollout.truncated,
        rollout.active,
        gamma=cfg.gamma,
        gae_lambda=cfg.gae_lambda,
    )
    advantages, targets = advantages[rollout.step, rollout.env], targets[rollout.step, rollout.env]
    moments = torch.stack([torch.ones_like(advantages), advantages, advantages**2]).double().sum(1)
    count, total, squares = sum_over_ranks(moments).tolist()
    mean = total / count
    std = max(squares / count - mean**2, 0.0) ** 0.5
    return (advantages - mean) / (std + 1e-8), targets


def clip_ranges(like: Tensor, cfg: DppoConfig) -> Tensor:
    """(K',) clip range of every tuned step; device and type as of ``like``."""
    return like.new_tensor([cfg.clip_range(step) for step in range(cfg.ft_denoising_steps)])


def policy_loss(log_ratio: Tensor, advantages: Tensor, cfg: DppoConfig) -> Tensor:
    """PPO's clipped loss per row. log_ratio (B, K'), advantages (B,) -> (B, K')."""
    steps_left = range(cfg.ft_denoising_steps - 1, -1, -1)
    discount = log_ratio.new_tensor([cfg.gamma_denoising**left for left in steps_left])
    advantages = advantages.unsqueeze(1) * discount
    ratio, clip = log_ratio.exp(), clip_ranges(log_ratio, cfg)
    clipped = ratio.clamp(1 - clip, 1 + clip)
    return torch.maximum(-advantages * ratio, -advantages * clipped)


class Minibatches:
    """One iteration's data, prepared for both networks: gradients of minibatches, and the steps they make."""

    def __init__(self, rollout: Rollout, agent: Agent, state: TrainState, cfg: DppoConfig) -> None:
        self.rollout, self.agent, self.state, self.cfg = rollout, agent, state, cfg
        self.advantages, self.targets = decision_advantages(rollout, state, cfg)
        self.privileged = rollout.privileged[rollout.step, rollout.env]
        self.train_actor = state.iteration >= cfg.critic_warmup and not state.undo.holds(state.iteration)
        self.regulariser = Regulariser()
        if self.train_actor:
            self.regulariser = Regulariser.of(rollout.obs, rollout.latents, agent, cfg, state.generator)
        self.clip = clip_ranges(self.advantages, cfg)
        # Ranks own different numbers of decisions: as many minibatches everywhere, of unequal sizes.
        most = max_over_ranks(len(self.advantages), self.advantages.device)
        self.per_epoch = min(cfg.minibatches or math.ceil(most / cfg.minibatch_decisions), most)
        self.trained = [(list(state.critic.parameters()), state.critic_optimizer)]
        if self.train_actor:
            self.trained.append((agent.trained_parameters(), state.actor_optimizer))

    def epoch(self) -> Sequence[Tensor]:
        """Decisions (b,) of every minibatch, shuffled."""
        number, device = len(self.advantages), self.advantages.device
        order = torch.randperm(number, generator=self.state.generator, device=device)
        return order.tensor_split(self.per_epoch)

    def gradients(self, minibatch: Tensor) -> Metrics:
        """Both networks' gradients of this rank, and what all ranks' decisions say."""
        # Sums over ranks, divided by the number of decisions in the minibatches of all ranks.
        size = total_over_ranks(len(minibatch), self.advantages.device)
        sums = torch.zeros(len(MINIBATCH_METRICS), dtype=torch.float64, device=self.advantages.device)
        self.state.actor_optimizer.zero_grad(set_to_none=True)
        self.state.critic_optimizer.zero_grad(set_to_none=True)
        for ids in minibatch.split(self.cfg.micro_batch_decisions or max(len(minibatch), 1)):
            value_error = (self.state.critic(self.privileged[ids]) - self.targets[ids]) ** 2
            (self.cfg.value_coef * 0.5 * value_error.sum() / size).backward()
            sums[0] += value_error.detach().sum() / size
            if self.train_actor:
                sums[1:] += self._actor_gradients(ids, size)
        return dict(zip(MINIBATCH_METRICS, sum_over_ranks(sums).tolist(), strict=True))

    def _actor_gradients(self, ids: Tensor, size: int) -> Tensor:
        """Add the actor's gradients of decisions ``ids``; their share (5,) of the metrics after the first."""
        rollout, agent, cfg = self.rollout, self.agent, self.cfg
        rows = size * cfg.ft_denoising_steps
        cond = agent.kept_condition(agent.actor, select(rollout.obs, ids))
        log_probs, mean, std = chain_log_probs(agent, rollout.latents[ids], cond, cfg)
        log_ratio = log_probs - rollout.log_probs[ids]
        surrogate = policy_loss(log_ratio, self.advantages[ids], cfg).sum() / rows
        loss = surrogate
        if self.regulariser.means is not None:
            shift = ((mean - self.regulariser.means[ids]) / std)[:, :, agent.executed]
            loss = loss + cfg.kl_coef * 0.5 * (shift**2).mean(dim=(2, 3)).sum() / rows
        if self.regulariser.latents is not None:
            base_log_probs, _, _ = chain_log_probs(agent, self.regulariser.latents[ids], cond, cfg)
            loss = loss - cfg.bc_coef * base_log_probs.sum() / rows
        loss.backward()
        with torch.no_grad():
            exact = log_ratio.double()  # in float32, 1e-4's square is lost in exp's rounding
            moved = decision_kl(rollout.means[ids], mean, std, agent.executed, cfg.noise_correlation)
            sums = [
                surrogate.detach().double(),
                (exact.expm1() - exact).sum() / rows,  # Schulman's k3 estimator
                (log_ratio.expm1().abs() > self.clip).double().sum() / rows,
                log_ratio.abs().sum().double() / rows,
                moved.sum().double() / size,
            ]
        return torch.stack(sums)

    def step(self) -> list[Tensor]:
        """One step of every network that is trained; the norms of their gradients, the actor's last."""
        norms = []
        for parameters, optimizer in self.trained:
            sum_gradients(parameters)
            norms.append(clip_grad_norm_(parameters, self.cfg.max_grad_norm or math.inf))
            optimizer.step()
        return norms

    def weights_are_finite(self) -> bool:
        """Whether every weight that is trained is a number; nobody asks for the loss after the last step."""
        finite = [weight.isfinite().all() for parameters, _ in self.trained for weight in parameters]
        return bool(torch.stack(finite).all())


def update(rollout: Rollout, agent: Agent, state: TrainState, cfg: DppoConfig) -> Metrics:
    """All epochs over one segment. Critic-only during the first ``cfg.critic_warmup`` iterations.

    Ends early where a minibatch finds the policy too far from where the iteration began.

    Raises: FloatingPointError where the loss, or what is learnt, is not finite.
    """
    data, region = Minibatches(rollout, agent, state, cfg), state.trust_region
    actor_lr = region.actor_lr(state.iteration)
    state.actor_optimizer.param_groups[0]["lr"] = actor_lr
    state.critic_optimizer.param_groups[0]["lr"] = cfg.critic_lr_at(state.iteration)
    history: list[Metrics] = []
    grad_norms: list[Tensor] = []  # nobody waits for them before the end
    initial_log_ratio, stopped = 0.0, False
    with torch.no_grad():  # now: after the update it would know these episodes by heart
        values = state.critic(data.privileged)
        judged = {
            "explained_variance": explained_variance(values, data.targets),
            "value_bias": value_bias(values, data.targets),
        }

    for minibatch in (ids for _ in range(cfg.epochs) for ids in data.epoch()):
        found = data.gradients(minibatch)
        if not math.isfinite(found["value_loss"] + found["policy_loss"]):
            raise FloatingPointError(
                f"loss is not finite in iteration {state.iteration}: lower {region.slower}"
            )
        if not history:
            initial_log_ratio = found["log_ratio"]  # zero up to rounding, or the stored chains are wrong
        if found["approx_kl"] > cfg.target_kl or region.left(found["decision_kl"], state.iteration):
            stopped = True
            break
        grad_norms.append(data.step()[-1])
        history.append(found)
    if not data.weights_are_finite():  # now: a checkpoint of them could not be gone on from
        raise FloatingPointError(
            f"weights are not finite after iteration {state.iteration}: lower {region.slower}"
        )

    if data.train_actor:
        last_epoch = [found["decision_kl"] for found in history[-data.per_epoch :]]
        region.adapt(last_epoch, stopped, state.iteration)
    taken = max(len(history), 1)
    averages = {name: sum(found[name] for found in history) / taken for name in MINIBATCH_METRICS}
    del averages["log_ratio"]
    grad_norm = float(torch.stack(grad_norms).double().mean()) if data.train_actor and history else 0.0
    told = {
        "grad_norm": grad_norm,
        "initial_log_ratio": initial_log_ratio,
        "updates": float(len(history)),
        "stopped_early": float(stopped),
        "actor_lr": actor_lr,
    }
    return averages | judged | told


def rollout_metrics(rollout: Rollout) -> Metrics:
    """Averages over the environments of all ranks."""
    columns = {"return": rollout.reward.sum(0), "decisions": rollout.active.sum(0), **rollout.info}
    return mean_over_ranks(columns | {"success": rollout.success})


def train(
    env: DecisionEnv,
    agent: Agent,
    state: TrainState,
    cfg: DppoConfig,
    *,
    seed: int,
    after_iteration: Callable[[TrainState, Metrics], None],
) -> None:
    """Run the iterations that remain; ``after_iteration`` logs, evaluates and saves.

    Raises: FloatingPointError where the loss is not finite, or the simulation failed in every episode.
    """
    chunk = agent.executed.stop - agent.executed.start
    while state.iteration < cfg.iterations:
        started = time.perf_counter()
        first = TRAINING_SEEDS + seed + (state.iteration * num_ranks() + rank_index()) * env.num_envs
        rollout = collect(env, agent, cfg, state.generator, range(first, first + env.num_envs))
        collected = time.perf_counter()
        decisions = sum_over_ranks(rollout.active.sum().double()).item()
        if not decisions:
            raise FloatingPointError(
                f"the simulation failed in every episode of iteration {state.iteration}: the log says where"
                " contacts found no room; else shorten --env.scene.timestep_s"
            )
        state.critic.update_moments(rollout.privileged[:-1][rollout.active])
        trained = agent.trained_parameters(), state.actor_optimizer
        if undone := state.undo.judge(rollout.success, rollout.active[0], *trained):
            state.trust_region.shrink()
        metrics = rollout_metrics(rollout) | update(rollout, agent, state, cfg)
        give_back_unused(agent.device)
        state.iteration += 1
        state.env_steps += int(decisions) * chunk
        seconds = time.perf_counter() - started
        metrics |= {
            "undone": float(undone),
            "env_steps": float(state.env_steps),
            "steps_per_s": decisions * chunk / seconds,
            "seconds": seconds,
            "rollout_s": collected - started,
            **memory_taken(agent.device),
        }
        after_iteration(state, metrics)
