"""The critic's standardisation, and how well it is said to explain its targets."""

import pytest
import torch

from lerobot_vtrefine.finetune.critic import Critic, explained_variance, value_bias


def critic_of(states: torch.Tensor) -> Critic:
    """A critic with the moments of these states (B, P), given in two parts."""
    torch.manual_seed(0)
    critic = Critic(states.shape[1], 8, 1)
    critic.update_moments(states[:3])
    critic.update_moments(states[3:])
    return critic


def test_states_are_standardised_by_all_that_was_seen() -> None:
    """Metres and newtons alike; a channel that never varied says nothing, one far off is clipped."""
    torch.manual_seed(1)
    states = torch.randn(200, 3) * torch.tensor([1e-3, 1.0, 50.0]) + torch.tensor([0.2, -3.0, 10.0])
    states = torch.cat([states, torch.full((200, 1), 7.0)], dim=1)
    critic = critic_of(states)
    asked = states[:5].clone()
    asked[0, 2], asked[1, 3] = 1e6, -99.0
    plain = (asked - states.mean(0)) / states.std(0, correction=0)
    plain[:, 3] = 0.0
    plain[0, 2] = Critic.CLIP
    torch.testing.assert_close(critic(asked), critic.net(plain).squeeze(-1), rtol=1e-3, atol=1e-4)


def test_explained_variance_ignores_a_bias_and_fixed_targets() -> None:
    targets = torch.tensor([1.0, 2.0, 4.0, 9.0])
    error = torch.tensor([1.0, -1.0, 0.5, -0.5])
    expected = 1 - error.var(correction=0) / targets.var(correction=0)
    assert explained_variance(targets - error, targets) == pytest.approx(expected.item())
    assert explained_variance(targets - error + 5.0, targets) == pytest.approx(expected.item())
    assert value_bias(targets - error + 5.0, targets) == pytest.approx(5.0 - error.mean().item(), abs=1e-5)
    assert explained_variance(targets, targets) == 1.0
    assert explained_variance(torch.zeros(4), torch.ones(4)) == 0.0
