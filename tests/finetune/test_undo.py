"""Going back to the best policy where success falls."""

from dataclasses import replace

import pytest
import torch
from test_dppo import problem, small_config, weights

from lerobot_vtrefine.finetune.config import SmallDppo
from lerobot_vtrefine.finetune.dppo import train
from lerobot_vtrefine.finetune.state_file import load_state, save_state
from lerobot_vtrefine.finetune.trust_region import TrustRegion
from lerobot_vtrefine.finetune.undo import Undo, fell

CFG = small_config(undo_falls=3.0)


class Walk:
    """A policy of one weight, and its optimiser, moved by hand."""

    def __init__(self, cfg=CFG) -> None:
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.optimizer = torch.optim.AdamW([self.weight], lr=0.1)
        self.undo = Undo(cfg)

    def step(self) -> float:
        self.weight.grad = torch.ones(1)
        self.optimizer.step()
        return self.weight.item()

    def judge(self, successes: int, episodes: int = 1000, broken: int = 0) -> bool:
        success = torch.arange(episodes + broken) < successes + broken  # broken ones seem to succeed
        counted = torch.arange(episodes + broken) >= broken
        return self.undo.judge(success, counted, [self.weight], self.optimizer)


def test_a_fall_is_told_by_the_standard_error_of_the_difference():
    """Of 500 and 440 of 1000, pooled .47: 60 points a thousand are 2.69 errors of 22.3."""
    assert fell(500, 1000, 440, 1000, 2.6)
    assert not fell(500, 1000, 440, 1000, 2.8)
    assert not fell(440, 1000, 500, 1000, 0.1)
    assert not fell(0, 0, 1, 1000, 3)
    assert not fell(9, 10, 0, 0, 3)
    assert not fell(10, 10, 10, 10, 3)


def test_training_goes_back_to_the_weights_and_momentum_that_succeeded_most_often():
    walk = Walk()
    assert not walk.judge(500)
    best = walk.step()
    assert not walk.judge(600)
    momentum = walk.optimizer.state[walk.weight]["exp_avg"].item()
    walk.step()
    assert not walk.judge(590)  # no better, and no clear fall
    walk.step()
    assert walk.judge(500)
    assert walk.weight.item() == best
    assert walk.optimizer.state[walk.weight]["exp_avg"].item() == pytest.approx(momentum)


def test_a_lucky_measurement_does_not_last():
    """The kept policy is measured again, and both measurements count from then on."""
    walk = Walk()
    walk.judge(600)
    walk.step()
    assert walk.judge(520)
    assert walk.undo.holds(0)
    assert not walk.judge(520)  # its own, this time
    assert not walk.undo.holds(0)
    walk.step()
    assert not walk.judge(520)  # 56 % of 2000: no clear fall


def test_episodes_whose_simulation_broke_do_not_count():
    walk = Walk()
    walk.judge(500)
    walk.step()
    assert walk.judge(400, broken=300)


def test_without_the_setting_nothing_is_kept():
    walk = Walk(replace(CFG, undo_falls=0.0))
    walk.judge(900)
    moved = walk.step()
    assert not walk.judge(0)
    assert walk.weight.item() == moved
    assert not walk.undo.weights
    assert not walk.undo.holds(CFG.iterations - 1)


def test_steps_are_half_as_large_afterwards_also_in_a_resumed_run():
    region = TrustRegion(SmallDppo(kl_per_decision=8.0, kl_per_decision_final=2.0, actor_lr=1e-4))
    region.shrink()
    again = TrustRegion(region.cfg)
    again.load_state_dict(region.state_dict())
    for found in (region, again):
        assert found.target(0) == pytest.approx(4.0)
        assert found.actor_lr(0) == pytest.approx(1e-4 / 2**0.5)
    scheduled = TrustRegion(small_config())
    before = scheduled.actor_lr(2)
    scheduled.shrink()
    assert scheduled.actor_lr(2) == pytest.approx(before / 2**0.5)


def test_what_is_kept_goes_through_a_checkpoint(tmp_path):
    walk = Walk()
    walk.judge(500)
    best = walk.step()
    walk.judge(600)
    walk.step()
    save_state(walk.undo.state_dict(), tmp_path / "state.safetensors")
    walk.undo = Undo(CFG)
    walk.undo.load_state_dict(load_state(tmp_path / "state.safetensors"))
    assert walk.judge(400)
    assert walk.weight.item() == best
    without = Undo(
        replace(CFG, undo_falls=0.0)
    )  # a run may be resumed without it, also where it just went back
    without.load_state_dict(walk.undo.state_dict())
    assert not without.holds(0)


def test_a_run_ends_with_the_best_policy_where_the_last_update_is_bad(monkeypatch):
    """Steps so large that success falls are undone, and the last iteration judges the update before it."""
    cfg = replace(CFG, iterations=6, critic_warmup=1, actor_lr=1e-4)
    env, agent, state = problem(cfg)
    told, seen = [], []
    shares = iter((0.5, 0.5, 0.75, 0.25, 0.75, 0.25))
    judge = state.undo.judge

    def of_given_success(success, counted, parameters, optimizer):
        count = 4000
        given = torch.arange(count) < next(shares) * count
        return judge(given, torch.ones(count, dtype=torch.bool), parameters, optimizer)

    monkeypatch.setattr(state.undo, "judge", of_given_success)

    def after(state, metrics):
        told.append(metrics["undone"])
        seen.append(weights(agent.actor))

    train(env, agent, state, cfg, seed=0, after_iteration=after)
    assert told == [0, 0, 0, 1, 0, 1]
    same = [all(torch.equal(a, b) for a, b in zip(seen[1], other, strict=True)) for other in seen]
    assert same == [False, True, False, True, False, True]
    assert state.trust_region.scale == 0.25
