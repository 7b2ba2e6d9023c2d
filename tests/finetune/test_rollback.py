"""A collapsed policy returns to its best weights; nothing else does."""

from dataclasses import replace

import pytest
import torch
from scipy.stats import chi2_contingency
from toy import BlindPeg, ToyActor, make_agent

from lerobot_vtrefine.finetune import dppo
from lerobot_vtrefine.finetune.config import SmallDppo
from lerobot_vtrefine.finetune.rollback import Rollback, fall

EPISODES = 128


def tracked(start: float) -> tuple[torch.nn.Parameter, torch.optim.Optimizer]:
    weight = torch.nn.Parameter(torch.full((3,), start))
    return weight, torch.optim.AdamW([weight], lr=0.1)


def step(weight: torch.nn.Parameter, optimizer: torch.optim.Optimizer) -> None:
    weight.grad = torch.ones(3)
    optimizer.step()


def run_of(rollback: Rollback, successes: list[float]) -> tuple[list[bool], list[torch.Tensor]]:
    """Weights that change by a step after every iteration without return."""
    weight, optimizer = tracked(1.0)
    returns, tried = [], []
    for success in successes:
        tried.append(weight.detach().clone())
        returns.append(rollback.watch(success, EPISODES, [weight], optimizer))
        if not returns[-1]:
            step(weight, optimizer)
    return returns, [*tried, weight.detach().clone()]


def test_returns_to_the_best_weights_once_two_iterations_are_bad() -> None:
    rollback = Rollback(3.5)
    returns, tried = run_of(rollback, [0.3, 0.5, 0.6, 0.5, 0.4, 0.3, 0.5])
    assert returns == [False, False, False, False, False, True, False]
    torch.testing.assert_close(tried[6], tried[2])  # 0.55 = (0.5 + 0.6) / 2 was the best mean
    assert rollback.lr_scale == 0.5


def test_the_optimiser_returns_too() -> None:
    """A step after the return equals the step that followed the best iteration, moments included."""
    _, tried = run_of(Rollback(3.5), [0.5, 0.6, 0.1, 0.5])
    torch.testing.assert_close(tried[3], tried[1])
    torch.testing.assert_close(tried[4], tried[2])


@pytest.mark.parametrize(("sigmas", "last"), [(0.0, 0.0), (3.5, 0.43)])
def test_noise_and_the_switched_off_guard_change_nothing(sigmas: float, last: float) -> None:
    rollback = Rollback(sigmas)
    returns, _ = run_of(rollback, [0.5, 0.6, 0.4, last, 0.5])
    assert not any(returns)
    assert rollback.lr_scale == 1.0


def test_state_survives_saving() -> None:
    rollback, again = Rollback(3.5), Rollback(3.5)
    run_of(rollback, [0.5, 0.6, 0.5])
    again.load_state_dict(rollback.state_dict(), torch.device("cpu"))
    weight, optimizer = tracked(9.0)
    step(weight, optimizer)
    assert again.watch(0.1, EPISODES, [weight], optimizer)
    torch.testing.assert_close(weight.detach(), rollback.weights[0])


def test_training_skips_the_experience_of_lost_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"iterations": 4, "num_envs": 8, "critic_warmup": 0, "critic_width": 16, "epochs": 1}
    cfg = replace(SmallDppo(), **small, rollback_sigmas=2.5)
    torch.manual_seed(0)
    env = BlindPeg(cfg.num_envs, feel=True)
    agent = make_agent(ToyActor(3, 4, 2, width=16), cfg, (4, 2))
    state = dppo.TrainState.create(agent, cfg, env.privileged_dim, seed=0)
    successes = iter([0.9, 0.9, 0.0, 0.0])
    measured = dppo.rollout_metrics
    monkeypatch.setattr(dppo, "rollout_metrics", lambda r: measured(r) | {"success": next(successes)})
    weights, flags = [], []

    def note(state: dppo.TrainState, metrics: dict[str, float]) -> None:
        weights.append([parameter.detach().clone() for parameter in agent.trained_parameters()])
        flags.append(metrics["rolled_back"])

    dppo.train(env, agent, state, cfg, seed=0, after_iteration=note)
    assert flags == [0, 0, 1, 0]
    for after_first, after_return in zip(weights[0], weights[2], strict=True):
        torch.testing.assert_close(after_first, after_return)


def test_a_fall_is_judged_by_its_significance() -> None:
    """Twenty successes lost out of twenty are a collapse, ten points less at one half are noise."""
    assert Rollback(3.5).sigmas < fall(0.15, 0.02, 2 * EPISODES)
    assert fall(0.55, 0.45, 2 * EPISODES) < 3.0
    table = [[77, 179], [31, 225]]  # successes and failures of 256 episodes, before and after
    chi_square = float(chi2_contingency(table, correction=False).statistic)
    assert fall(77 / 256, 31 / 256, 256) == pytest.approx(chi_square**0.5)
    assert fall(0.0, 0.0, 256) == fall(1.0, 1.0, 256) == 0.0


def test_a_weak_policy_that_loses_its_few_successes_returns() -> None:
    returns, tried = run_of(Rollback(3.5), [0.12, 0.13, 0.04, 0.01, 0.13])
    assert returns == [False, False, False, True, False]
    torch.testing.assert_close(tried[4], tried[1])
