"""Exact properties of the DPPO update, and the reference implementation's defects that it must not have."""

from dataclasses import replace

import pytest
import torch
from toy import BlindPeg, ToyActor, make_agent

from lerobot_vtrefine.envs.decisions import Decision
from lerobot_vtrefine.finetune.chains import chain_log_probs
from lerobot_vtrefine.finetune.config import DppoConfig, PaperDppo
from lerobot_vtrefine.finetune.critic import explained_variance, value_bias
from lerobot_vtrefine.finetune.dppo import (
    TrainState,
    collect,
    decision_advantages,
    policy_loss,
    train,
    update,
)
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.protocols import Agent

CHUNK = (4, 2)
SHORT = {
    "num_envs": 12,
    "iterations": 3,
    "epochs": 2,
    "minibatch_decisions": 20,
    "min_sampling_std": 0.05,
    "reward_scaling": False,
    "clip": 0.02,
    "clip_first": 0.02,
    "actor_lr": 1e-4,
    "actor_lr_final": 1e-5,
    "lr_warmup": 1,
    "max_grad_norm": 1.0,
    "critic_width": 32,
}


def small_config(**changes) -> DppoConfig:
    """The published update, without a trust region, on numbers that make a test short."""
    return replace(PaperDppo(), **{**SHORT, **changes})


def problem(cfg: DppoConfig, seed: int = 0, num_train_steps: int = 100):
    torch.manual_seed(seed)
    env = BlindPeg(cfg.num_envs, feel=True)
    agent = make_agent(ToyActor(3, *CHUNK, width=32), cfg, CHUNK, num_train_steps)
    return env, agent, TrainState.create(agent, cfg, env.privileged_dim, seed)


def rollout_of(cfg, env, agent, state, first_seed=0):
    rollout = collect(env, agent, cfg, state.generator, range(first_seed, first_seed + env.num_envs))
    state.critic.update_moments(rollout.privileged[:-1][rollout.active])
    return rollout


def weights(module: torch.nn.Module) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in module.parameters()]


def changed(before: list[torch.Tensor], module: torch.nn.Module) -> bool:
    return any(not torch.equal(a, b) for a, b in zip(before, module.parameters(), strict=True))


@pytest.mark.parametrize("sampler", ["tail", "ddim", "ddpm"])
@pytest.mark.parametrize("encoder", ["trained", "frozen"])
def test_stored_log_probabilities_are_those_of_the_update(sampler, encoder):
    cfg = small_config(sampler=sampler, encoder=encoder, sampler_steps=5, ft_denoising_steps=5)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    cond = rollout.obs["cond"] if encoder == "frozen" else agent.actor.encode(rollout.obs)
    log_probs, _, _ = chain_log_probs(agent, rollout.latents, cond, cfg)
    torch.testing.assert_close(log_probs, rollout.log_probs, atol=1e-5, rtol=0)
    metrics = update(rollout, agent, replace(state, iteration=cfg.critic_warmup), cfg)
    assert metrics["initial_log_ratio"] < 1e-6


def test_one_step_of_diffusion_is_gaussian_ppo():
    """T = K' = 1: the policy is a Gaussian with fixed deviation around the clamped network output."""
    cfg = small_config(sampler="ddpm", sampler_steps=1, ft_denoising_steps=1, min_sampling_std=0.1, clip=0.05)
    env, agent, state = problem(cfg, num_train_steps=1)
    rollout = rollout_of(cfg, env, agent, state)
    cond = agent.actor.encode(rollout.obs)
    alpha_bar = agent.process._tables(cond)[0]
    noise, chunk = rollout.latents[:, 0], rollout.latents[:, 1]
    eps = agent.actor.denoiser(noise, torch.zeros(len(noise), dtype=torch.long), cond)
    mean = ((noise - (1 - alpha_bar).sqrt() * eps) / alpha_bar.sqrt()).clamp(-1, 1)
    expected = torch.distributions.Normal(mean, 0.1).log_prob(chunk).clamp(-5, 2).mean((1, 2))
    log_probs, _, _ = chain_log_probs(agent, rollout.latents, cond, cfg)
    torch.testing.assert_close(log_probs[:, 0], expected)
    advantages = torch.randn(len(noise))
    ratio = (expected - rollout.log_probs[:, 0] + 0.03).exp()
    loss = policy_loss(log_probs - rollout.log_probs + 0.03, advantages, cfg)
    clipped = torch.maximum(-advantages * ratio, -advantages * ratio.clamp(0.95, 1.05))
    torch.testing.assert_close(loss[:, 0], clipped)
    metrics = update(rollout, agent, replace(state, iteration=cfg.critic_warmup), cfg)
    assert torch.tensor(list(metrics.values())).isfinite().all()


def test_gradient_of_the_loss_against_finite_differences():
    cfg = small_config(sampler_steps=3, prefix_steps=1, ft_denoising_steps=3, clip=10.0, clip_first=10.0)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    agent.actor.double()
    latents, obs = rollout.latents.double(), {key: value.double() for key, value in rollout.obs.items()}
    advantages = torch.randn(len(latents), dtype=torch.float64)

    def loss() -> torch.Tensor:
        log_probs, _, _ = chain_log_probs(agent, latents, agent.actor.encode(obs), cfg)
        return policy_loss(log_probs - rollout.log_probs.double(), advantages, cfg).mean()

    weight = agent.actor.denoiser.net[-1].weight
    (gradient,) = torch.autograd.grad(loss(), weight)
    for index in [(0, 0), (3, 7), (7, 31)]:
        with torch.no_grad():
            weight[index] += 1e-5
            above = loss()
            weight[index] -= 2e-5
            below = loss()
            weight[index] += 1e-5
        assert gradient[index].item() == pytest.approx((above - below).item() / 2e-5, rel=1e-5, abs=1e-9)


def test_denoising_discount_and_pessimistic_clip():
    cfg = small_config(ft_denoising_steps=3, sampler_steps=3, gamma_denoising=0.5, clip=0.1, clip_first=0.1)
    log_ratio = torch.log(torch.tensor([[1.5, 1.0, 0.5]]))
    gain = policy_loss(log_ratio, torch.tensor([2.0]), cfg)
    torch.testing.assert_close(gain, -2 * torch.tensor([[0.25 * 1.1, 0.5, 0.5]]))
    loss = policy_loss(log_ratio, torch.tensor([-2.0]), cfg)
    torch.testing.assert_close(loss, 2 * torch.tensor([[0.25 * 1.5, 0.5, 0.9]]))


@pytest.mark.parametrize("clip_rate", [0.0, 3.0])
def test_a_single_tuned_step_stays_finite(clip_rate):
    """The reference's clip schedule is NaN for K'=1."""
    changes = {"sampler": "ddim", "sampler_steps": 5, "ft_denoising_steps": 1, "clip_rate": clip_rate}
    cfg = small_config(critic_warmup=0, **changes)
    env, agent, state = problem(cfg)
    before = weights(agent.actor)
    train(env, agent, state, cfg, seed=0, after_iteration=lambda *_: None)
    assert changed(before, agent.actor)
    assert all(parameter.isfinite().all() for parameter in agent.actor.parameters())


def test_critic_warm_up_really_happens():
    """The reference's first warm-up iteration is an evaluation that updates nothing."""
    cfg = small_config(critic_warmup=2, iterations=3)
    env, agent, state = problem(cfg)
    base, history = weights(agent.base), []
    actor, critic = weights(agent.actor), weights(state.critic)

    def watch(state: TrainState, metrics: dict[str, float]) -> None:
        history.append((changed(actor, agent.actor), changed(critic, state.critic), metrics["updates"]))

    train(env, agent, state, cfg, seed=0, after_iteration=watch)
    assert [entry[:2] for entry in history] == [(False, True), (False, True), (True, True)]
    assert all(updates > 0 for *_, updates in history)
    assert not changed(base, agent.base)


def test_the_critic_is_judged_on_episodes_that_it_has_not_learnt_from():
    """After ten epochs over them it explained a quarter of rewards that were nothing but noise."""
    cfg = small_config(epochs=10)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    rollout.reward = torch.randn(rollout.reward.shape, generator=state.generator)
    _, targets = decision_advantages(rollout, state, cfg)
    with torch.no_grad():
        values = state.critic(rollout.privileged[rollout.step, rollout.env])
        unseen = explained_variance(values, targets), value_bias(values, targets)
    metrics = update(rollout, agent, state, cfg)
    assert (metrics["explained_variance"], metrics["value_bias"]) == unseen


def test_frozen_encoder_stays_and_encodes_once_per_decision():
    """The reference runs its encoder again at every denoising step and epoch."""
    cfg = small_config(encoder="frozen", critic_warmup=0)
    env, agent, state = problem(cfg)
    before = weights(agent.actor.encoder)
    rollout = rollout_of(cfg, env, agent, state)
    decisions = len(rollout.active)
    assert agent.actor.calls == decisions
    update(rollout, agent, state, cfg)
    assert agent.actor.calls == decisions
    assert not changed(before, agent.actor.encoder)


def test_trained_encoder_runs_once_per_minibatch():
    cfg = small_config(critic_warmup=0, epochs=3, minibatch_decisions=10)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    before, calls = weights(agent.actor.encoder), agent.actor.calls
    metrics = update(rollout, agent, state, cfg)
    assert agent.actor.calls - calls == metrics["updates"] == 3 * -(-len(rollout.latents) // 10)
    assert changed(before, agent.actor.encoder)


def test_fewer_decisions_than_minibatches_are_one_each():
    cfg = small_config(num_envs=2, decisions=1, minibatches=4, epochs=1, critic_warmup=0)
    env, agent, state = problem(cfg)
    metrics = update(rollout_of(cfg, env, agent, state), agent, state, cfg)
    assert metrics["updates"] == 2


def test_batch_holds_exactly_the_decisions_that_were_made():
    cfg = small_config(num_envs=64)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    lengths = torch.bincount(rollout.env, minlength=64)
    assert (lengths == rollout.active.sum(0)).all()
    assert lengths.min() < lengths.max(), "the test needs episodes of different lengths"
    ended = (rollout.terminated | rollout.truncated)[lengths - 1, torch.arange(64)]
    assert ended.all()
    assert rollout.reward.sum(0).max() <= 1
    assert torch.equal(rollout.success, rollout.reward.sum(0) > 0)


def test_episodes_whose_simulation_failed_are_not_learnt_from():
    """Whatever happens in such a world, the update is the one without it."""

    class Breaking(BlindPeg):
        """World 2 breaks in its second decision, and then shows nonsense."""

        nonsense = 1e6

        def step_chunk(self, actions):
            made = super().step_chunk(actions)
            void = (torch.arange(self.num_envs) == 2) & (self.decision >= 2)
            return made._replace(
                reward=torch.where(void, self.nonsense, made.reward),
                terminated=made.terminated | void,
                truncated=made.truncated & ~void,
                info=made.info | {"void": void},
            )

    results = []
    for nonsense in (1e6, -1e6):
        cfg = small_config()
        _, agent, state = problem(cfg)
        env = Breaking(cfg.num_envs, feel=True)
        env.nonsense = nonsense
        rollout = rollout_of(cfg, env, agent, state)
        assert len(rollout.env) > 0
        assert 2 not in rollout.env
        assert not rollout.active[:, 2].any()
        assert rollout.active[:, 3].any()
        metrics = update(rollout, agent, state, cfg)
        results.append((metrics["value_loss"], metrics["policy_loss"], weights(agent.actor)))
    assert results[0][:2] == results[1][:2]
    assert all(torch.equal(one, other) for one, other in zip(results[0][2], results[1][2], strict=True))


def test_micro_batches_change_nothing_but_memory():
    results = []
    for micro in (0, 3):
        cfg = small_config(critic_warmup=0, micro_batch_decisions=micro, max_grad_norm=0.0)
        env, agent, state = problem(cfg)
        update(rollout_of(cfg, env, agent, state), agent, state, cfg)
        results.append(torch.cat([weight.flatten() for weight in weights(agent.actor)]))
    torch.testing.assert_close(*results, atol=2e-4, rtol=0)  # Adam's first steps amplify rounding


class Clock:
    """Every episode lasts one decision and ends by time-out; the critic sees a constant final state."""

    num_envs, max_decisions, privileged_dim = 4, 1, 2

    def reset(self, seeds):
        return {"state": torch.zeros(4, 3)}, torch.arange(8.0).view(4, 2)

    def step_chunk(self, actions):
        over = torch.ones(4, dtype=torch.bool)
        obs, privileged = self.reset(None)
        return Decision(obs, privileged + 100, torch.arange(4.0), ~over, over, {"success": ~over})


@pytest.mark.parametrize("timeout", ["terminal", "bootstrap"])
def test_time_outs_use_the_final_state_or_nothing(timeout):
    """The reference bootstraps from the first state of the next episode."""
    cfg = small_config(num_envs=4, timeout=timeout, gamma=0.5)
    _, agent, state = problem(cfg)
    state = TrainState.create(agent, cfg, 2, seed=0)
    rollout = rollout_of(cfg, Clock(), agent, state)
    _, targets = decision_advantages(rollout, state, cfg)
    final = state.critic(rollout.privileged[1]) if timeout == "bootstrap" else torch.zeros(4)
    torch.testing.assert_close(targets, torch.arange(4.0) + 0.5 * final.detach())


def test_early_stop_at_the_kl_limit():
    """The first minibatch meets the old policy itself; the second one that has moved by a step."""
    metrics = []
    for limit in (1.0, 1e-15):
        cfg = small_config(critic_warmup=0, target_kl=limit, epochs=5)
        env, agent, state = problem(cfg)
        metrics.append(update(rollout_of(cfg, env, agent, state), agent, state, cfg))
    assert [m["stopped_early"] for m in metrics] == [0, 1]
    assert metrics[0]["updates"] >= 5  # at least one minibatch an epoch
    assert metrics[1]["updates"] == 1


@pytest.mark.parametrize("term", ["kl_coef", "bc_coef"])
@pytest.mark.parametrize("encoder", ["trained", "frozen"])
def test_regularisation_keeps_the_actor_near_the_base(term, encoder):
    """With worthless rewards a disturbed actor returns towards the base network."""

    @torch.no_grad()
    def distance(agent: Agent, obs: dict[str, torch.Tensor]) -> float:
        x = torch.randn(200, *CHUNK, generator=torch.Generator().manual_seed(0))
        t = torch.full((200,), 5)
        cond, cond_base = agent.conditions({"state": obs["state"][:1].expand(200, -1)})
        return float((agent.actor.denoiser(x, t, cond) - agent.base.denoiser(x, t, cond_base)).abs().mean())

    distances = {}
    for weight in (0.0, 1.0):
        sampler = {"sampler": "ddim", "sampler_steps": 5, "ft_denoising_steps": 5, "encoder": encoder}
        learning = {"critic_warmup": 0, "epochs": 10, "actor_lr": 5e-3, "num_envs": 16}
        cfg = small_config(**sampler, **learning, **{term: weight})
        env, agent, state = problem(cfg)
        with torch.no_grad():
            agent.actor.denoiser.net[-1].bias += 0.3
        obs, _ = env.reset(range(16))
        rollout = rollout_of(cfg, env, agent, state)
        rollout.reward.zero_()
        with torch.no_grad():  # no values, no rewards: no advantages
            state.critic.net[-1].weight.zero_()
            state.critic.net[-1].bias.zero_()
        update(rollout, agent, state, cfg)
        distances[weight] = distance(agent, obs)
    assert distances[1.0] < 0.8 * distances[0.0]


def test_evaluation_is_repeatable_and_leaves_training_alone():
    cfg = small_config()
    env, agent, state = problem(cfg)
    before, noise = state.generator.get_state(), torch.random.get_rng_state()
    first = evaluate(env, agent, 120)
    assert first == evaluate(env, agent, 120)
    assert first["eval_success"] == first["eval_return"]
    assert torch.equal(state.generator.get_state(), before)
    assert torch.equal(torch.random.get_rng_state(), noise)
    assert evaluate(env, agent, 120, first_seed=7) != first


def test_segments_can_be_shorter_than_episodes():
    cfg = small_config(decisions=3)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    assert rollout.active.shape == (3, cfg.num_envs)
    assert rollout.privileged.shape[0] == 4


def test_loss_that_is_not_finite_is_reported():
    cfg = small_config(critic_warmup=0)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    rollout.latents[0] = torch.nan
    with pytest.raises(FloatingPointError, match="iteration 0"):
        update(rollout, agent, state, cfg)


@pytest.mark.parametrize("network", ["actor", "critic"])
def test_a_step_to_weights_that_are_not_finite_is_reported_before_anything_is_saved(network):
    cfg = small_config(critic_warmup=0, epochs=1, minibatches=1, max_grad_norm=0.0)
    env, agent, state = problem(cfg)
    tuned = {"actor": agent.actor.denoiser, "critic": state.critic}[network]
    next(tuned.parameters()).register_hook(lambda gradient: gradient * torch.inf)  # the loss is finite
    with pytest.raises(FloatingPointError, match="weights are not finite after iteration 0"):
        train(env, agent, state, cfg, seed=0, after_iteration=lambda *saved: pytest.fail("saved"))


def test_paper_preset_is_the_default():
    assert PaperDppo() == DppoConfig.get_choice_class("paper")()
    assert DppoConfig.default_choice_name() == "paper"
