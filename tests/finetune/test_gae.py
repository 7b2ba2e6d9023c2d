import numpy as np
import pytest
import torch

from lerobot_vtrefine.finetune.gae import RewardScaler, generalised_advantages

GAMMA, LAMBDA = 0.9, 0.8


def gae(reward, values, terminated, truncated, active):
    columns = [torch.tensor(a, dtype=torch.float64).unsqueeze(1) for a in (reward, values)]
    flags = [torch.tensor(a, dtype=torch.bool).unsqueeze(1) for a in (terminated, truncated, active)]
    advantages, targets = generalised_advantages(*columns, *flags, gamma=GAMMA, gae_lambda=LAMBDA)
    return advantages.squeeze(1).numpy(), targets.squeeze(1).numpy()


def test_termination_has_no_future_value():
    advantages, targets = gae([0, 1], [0.5, 0.25, 9.0], [0, 1], [0, 0], [1, 1])
    last = 1 - 0.25
    first = 0 + GAMMA * 0.25 - 0.5 + GAMMA * LAMBDA * last
    np.testing.assert_allclose(advantages, [first, last])
    np.testing.assert_allclose(targets, [first + 0.5, 1.0])


def test_truncation_keeps_the_value_of_the_final_state():
    advantages, _ = gae([0, 1], [0.5, 0.25, 9.0], [0, 0], [0, 1], [1, 1])
    np.testing.assert_allclose(advantages[1], 1 + GAMMA * 9.0 - 0.25)


def test_end_of_segment_keeps_the_value_too():
    cut, _ = gae([0, 1], [0.5, 0.25, 9.0], [0, 0], [0, 0], [1, 1])
    np.testing.assert_allclose(cut[1], 1 + GAMMA * 9.0 - 0.25)


def test_nothing_leaks_back_from_idle_steps():
    """After an end, neither rewards nor values of the idle environment matter."""
    no, yes = [0, 0, 0], [1, 0, 0]
    for ended in ({"terminated": yes, "truncated": no}, {"terminated": no, "truncated": yes}):
        quiet = gae([1, 0, 0], [0.5, 0.2, 0, 0], active=[1, 0, 0], **ended)
        loud = gae([1, 7, -7], [0.5, 0.2, 33, 44], active=[1, 0, 0], **ended)
        np.testing.assert_allclose(quiet, loud)
        assert (loud[0][1:] == 0).all()


def test_lambda_one_gives_discounted_returns():
    rng = np.random.default_rng(0)
    reward, values = rng.normal(size=6), rng.normal(size=7)
    _, targets = generalised_advantages(
        torch.tensor(reward).unsqueeze(1),
        torch.tensor(values).unsqueeze(1),
        *[torch.zeros(6, 1, dtype=torch.bool)] * 2,
        torch.ones(6, 1, dtype=torch.bool),
        gamma=GAMMA,
        gae_lambda=1.0,
    )
    returns = values[6]
    for step in range(5, -1, -1):
        returns = reward[step] + GAMMA * returns
        np.testing.assert_allclose(targets[step, 0], returns)


def test_reward_scale_is_the_deviation_of_the_discounted_return():
    rng = np.random.default_rng(0)
    scaler, seen = RewardScaler(), []
    for _ in range(3):  # statistics persist over iterations
        reward = rng.normal(3.0, 2.0, size=(20, 50))
        active = rng.random((20, 50)) < 0.9
        running = np.zeros(50)
        for step in range(20):
            running = scaler.DISCOUNT * running + reward[step]
            seen.extend(running[active[step]])
        scaled = scaler(torch.tensor(reward), torch.tensor(active))
        np.testing.assert_allclose(scaled, (reward / np.std(seen)).clip(-10, 10), rtol=1e-6)


def test_reward_scale_survives_saving_and_no_data():
    scaler = RewardScaler()
    scaler(torch.ones(2, 2), torch.zeros(2, 2, dtype=torch.bool))
    assert scaler.count == 0
    scaler(torch.randn(5, 4), torch.ones(5, 4, dtype=torch.bool))
    other = RewardScaler()
    other.load_state_dict(scaler.state_dict())
    reward, active = torch.randn(3, 4), torch.ones(3, 4, dtype=torch.bool)
    assert torch.equal(scaler(reward, active), other(reward, active))


@pytest.mark.parametrize("size", [1.0, 1e4])
def test_rare_rewards_are_clipped(size):
    reward = torch.zeros(30, 1000)
    reward[3, 4] = size
    assert RewardScaler()(reward, torch.ones_like(reward, dtype=torch.bool)).max() <= 10
