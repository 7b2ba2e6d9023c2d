"""What a rollout holds and what a minibatch says, against plain formulas."""

from dataclasses import replace

import pytest
import torch
from test_dppo import problem, rollout_of, small_config

from lerobot_vtrefine.envs.decisions import Decision
from lerobot_vtrefine.finetune.chains import chain_log_probs
from lerobot_vtrefine.finetune.dppo import Minibatches, collect, decision_advantages
from lerobot_vtrefine.finetune.evaluation import evaluate


class Nagging:
    """Episodes of one, two and three decisions; finished worlds go on to tell of rewards and success."""

    num_envs, max_decisions, privileged_dim = 3, 5, 2
    LENGTHS = torch.tensor([1, 2, 3])

    def reset(self, seeds):
        self.decision = 0
        return {"state": torch.zeros(3, 3)}, torch.zeros(3, 2)

    def step_chunk(self, actions):
        over, before = self.decision + 1 == self.LENGTHS, self.decision >= self.LENGTHS
        self.decision += 1
        by_time = torch.tensor([False, True, False])
        info = {"success": before | (over & torch.tensor([False, False, True]))}
        reward = torch.where(before, 7.0, 1.0)
        privileged = torch.full((3, 2), float(self.decision))
        obs = {"state": torch.full((3, 3), float(self.decision))}
        return Decision(obs, privileged, reward, over & ~by_time, over & by_time, info)


def test_nothing_that_finished_worlds_say_is_listened_to():
    cfg = small_config(num_envs=3)
    _, agent, _ = problem(cfg)
    rollout = collect(Nagging(), agent, cfg, torch.Generator().manual_seed(0), range(3))
    assert list(zip(rollout.step.tolist(), rollout.env.tolist(), strict=True)) == [
        (0, 0),
        (0, 1),
        (0, 2),
        (1, 1),
        (1, 2),
        (2, 2),
    ]
    assert rollout.obs["state"][:, 0].tolist() == [0, 0, 0, 1, 1, 2]
    assert rollout.reward.tolist() == [[1, 1, 1], [0, 1, 1], [0, 0, 1]]
    assert rollout.success.tolist() == [False, False, True]
    assert rollout.info["success"].tolist() == [0, 0, 1]


def test_evaluation_counts_each_episode_up_to_its_end():
    cfg = small_config(num_envs=3)
    _, agent, _ = problem(cfg)
    found = evaluate(Nagging(), agent, 6)
    assert found["eval_return"] == pytest.approx((1 + 2 + 3) / 3)
    assert found["eval_success"] == pytest.approx(1 / 3)


def moved(weight: float = 0.1, **changes):
    """A minibatch of a whole rollout, met by an actor that has moved since."""
    cfg = small_config(critic_warmup=0, micro_batch_decisions=7, **changes)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    torch.manual_seed(1)
    with torch.no_grad():
        for parameter in agent.actor.denoiser.parameters():
            parameter += weight * torch.randn_like(parameter)
    return cfg, agent, state, Minibatches(rollout, agent, state, cfg)


def test_metrics_are_those_of_the_ratios():
    cfg, agent, _, data = moved()
    found = data.gradients(torch.arange(len(data.advantages)))
    with torch.no_grad():
        cond = agent.actor.encode(data.rollout.obs)
        now, _, _ = chain_log_probs(agent, data.rollout.latents, cond, cfg)
    ratio = (now - data.rollout.log_probs).double().exp()
    outside = (ratio < 1 - 0.02) | (ratio > 1 + 0.02)
    assert 0 < outside.double().mean() < 1, "the test needs ratios on both sides of the clip range"
    assert found["clip_fraction"] == pytest.approx(float(outside.double().mean()))
    assert found["approx_kl"] == pytest.approx(float((ratio - 1 - ratio.log()).mean()), rel=1e-4)
    assert found["log_ratio"] == pytest.approx(float(ratio.log().abs().mean()), rel=1e-4)
    gained = data.advantages.unsqueeze(1) * ratio
    clipped = data.advantages.unsqueeze(1) * ratio.clamp(0.98, 1.02)
    discount = cfg.gamma_denoising ** torch.arange(cfg.ft_denoising_steps - 1, -1, -1.0)
    expected = -(torch.minimum(gained, clipped) * discount).mean()
    assert found["policy_loss"] == pytest.approx(float(expected), rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("value_coef", [0.5, 2.0])
def test_critic_descends_half_the_mean_squared_error_times_its_coefficient(value_coef):
    _, _, state, data = moved(value_coef=value_coef)
    found = data.gradients(torch.arange(len(data.advantages)))
    error = state.critic(data.rollout.privileged[data.rollout.step, data.rollout.env]) - data.targets
    loss = (error**2).mean()
    expected = torch.autograd.grad(value_coef * 0.5 * loss, list(state.critic.parameters()))
    assert found["value_loss"] == pytest.approx(loss.item(), rel=1e-4)
    for parameter, gradient in zip(state.critic.parameters(), expected, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("reward_scaling", [False, True])
def test_advantages_are_standardised_over_the_decisions_that_were_made(reward_scaling):
    cfg = replace(small_config(), reward_scaling=reward_scaling)
    env, agent, state = problem(cfg)
    rollout = rollout_of(cfg, env, agent, state)
    advantages, targets = decision_advantages(rollout, state, cfg)
    assert advantages.shape == targets.shape == rollout.step.shape
    assert advantages.mean().item() == pytest.approx(0.0, abs=1e-5)
    assert advantages.std(correction=0).item() == pytest.approx(1.0, abs=1e-4)


def test_scaled_rewards_give_targets_in_units_of_the_returns_deviation():
    scaled = []
    for factor in (1.0, 100.0):
        cfg = small_config(reward_scaling=True)
        env, agent, state = problem(cfg)
        rollout = rollout_of(cfg, env, agent, state)
        rollout.reward = factor * (torch.rand(rollout.reward.shape, generator=state.generator) + 0.5)
        scaled.append(decision_advantages(rollout, state, cfg)[1])
    torch.testing.assert_close(*scaled, rtol=1e-4, atol=1e-4)


def test_executed_actions_alone_count_for_the_pull_towards_the_base():
    """The KL term is a mean over executed elements: half the squared shift in standard deviations."""
    cfg, agent, _, data = moved(kl_coef=1.0, gamma_denoising=1.0)
    agent.executed = slice(0, 2)
    torch.manual_seed(0)
    data.advantages = torch.zeros_like(data.advantages)
    data.gradients(torch.arange(len(data.advantages)))
    got = [parameter.grad.clone() for parameter in agent.actor.denoiser.parameters()]
    cond = agent.actor.encode(data.rollout.obs)
    _, mean, std = chain_log_probs(agent, data.rollout.latents, cond, cfg)
    shift = ((mean - data.regulariser.means) / std)[:, :, :2]
    expected = torch.autograd.grad(0.5 * (shift**2).mean(), list(agent.actor.denoiser.parameters()))
    for gradient, wanted in zip(got, expected, strict=True):
        torch.testing.assert_close(gradient, wanted, rtol=1e-3, atol=1e-6)
