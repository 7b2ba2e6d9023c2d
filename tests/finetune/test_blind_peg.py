"""The paper's claim in miniature: from demonstrations without search, DPPO learns to search by touch."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from toy import BlindPeg, ToyActor, blind_peg_demonstrations, clone_behaviour, make_agent

from lerobot_vtrefine.finetune.config import SmallDppo
from lerobot_vtrefine.finetune.dppo import TrainState, train
from lerobot_vtrefine.finetune.evaluation import evaluate

CFG = SmallDppo(
    iterations=15,
    num_envs=192,
    minibatch_decisions=400,
    actor_lr=3e-4,
    actor_lr_final=3e-4,
    min_sampling_std=0.1,
    clip=0.01,
    clip_first=0.01,
    encoder="trained",
    critic_width=128,
)


LEAPS = replace(
    CFG,
    iterations=30,
    num_envs=512,
    kl_per_decision=256.0,
    kl_per_decision_final=64.0,
    clip=0.5,
    clip_first=0.5,
)
"""Steps that nothing but the rate's limit holds back."""


@cache
def success_before_and_after(feel: bool, seed: int, cfg: SmallDppo = CFG) -> tuple[float, float]:
    """Deployed success on held-out seeds; without ``feel`` the contact channel is always zero."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    states, chunks = blind_peg_demonstrations(600, seed)
    if not feel:
        states[:, 2] = 0
    actor = ToyActor(3, BlindPeg.CHUNK, BlindPeg.ACTION_DIM)
    clone_behaviour(actor, states, chunks, steps=1500, seed=seed)
    env = BlindPeg(cfg.num_envs, feel=feel)
    agent = make_agent(actor, cfg, (BlindPeg.CHUNK, BlindPeg.ACTION_DIM))
    state = TrainState.create(agent, cfg, env.privileged_dim, seed)
    before = evaluate(env, agent, 576)["eval_success"]
    train(env, agent, state, cfg, seed=seed, after_iteration=lambda *_: None)
    return before, evaluate(env, agent, 576)["eval_success"]


def test_search_is_learnt_when_the_rim_can_be_felt():
    before, after = success_before_and_after(feel=True, seed=0)
    assert 0.35 < before < 0.70
    assert after > 0.78
    assert after > before + 0.15


@pytest.mark.slow
def test_touch_is_what_makes_the_difference():
    _, felt = success_before_and_after(feel=True, seed=0)
    before, blind = success_before_and_after(feel=False, seed=0)
    assert 0.35 < before < 0.70
    assert felt > blind + 0.2


@pytest.mark.slow
def test_a_run_that_falls_recovers_where_falls_are_undone():
    """Of ten seeds (docs/learning-tried.md) this is the one that ends lowest in leaps."""
    _, fallen = success_before_and_after(feel=True, seed=900, cfg=LEAPS)
    _, recovered = success_before_and_after(feel=True, seed=900, cfg=replace(LEAPS, undo_falls=3.0))
    assert fallen < 0.7
    assert recovered > 0.9
