"""Hopper as both implementations of DPPO are shown it (scripts/reference/hopper); their curves as rows."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from reference.hopper.curves import NAMES, Curve, lines_of, read_curves
from reference.hopper.network import DENOISING_STEPS, TUNED_STEPS
from reference.hopper.ours import PRESETS, SAME, HopperDecisions, hopper_agent
from reference.hopper.standin import Scales, windows
from reference.hopper.theirs import ReferenceHoppers, Steps, quiet_prefix, standardised
from reference.hopper.worlds import ACTION_DIM, CHUNK, OBS_DIM, SpreadWorlds, Step, Worlds
from torch import nn

from lerobot_vtrefine.finetune.chains import chain_log_probs, explore
from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS
from lerobot_vtrefine.policies.vt_dp3.diffusion import (
    DiffusionProcess,
    denoise_prefix,
    predictor,
    squaredcos_alpha_bar,
    step_grid,
)

ORIGIN = {"commit": None, "command": None, "machine": None}


class Countdown:
    """Worlds whose episodes last as many chunks as their seed's last digit says, one of reward each."""

    def __init__(self) -> None:
        self.seeds, self.left = [], {}

    def reset(self, ids, seeds):
        self.seeds += [int(seed) for seed in seeds]
        self.left |= {int(i): int(seed) % 10 for i, seed in zip(ids, seeds, strict=True)}
        return self._obs(ids)

    def step(self, ids, actions):
        for i in ids:
            self.left[int(i)] -= 1
        over = np.array([self.left[int(i)] == 0 for i in ids])
        return Step(self._obs(ids), np.ones(len(ids)), over, np.zeros(len(ids), bool))

    def _obs(self, ids):
        return np.array([[self.left[int(i)]] * OBS_DIM for i in ids], float)


@pytest.fixture
def scales() -> Scales:
    ones = np.ones(OBS_DIM), np.ones(ACTION_DIM)
    return Scales((-ones[0], ones[0]), (-2 * ones[1], ones[1]))


def test_worlds_in_several_processes_are_the_same_worlds() -> None:
    ids, seeds = np.array([3, 0, 5]), np.array([7, 8, 9])
    actions = np.random.default_rng(0).normal(size=(3, CHUNK, ACTION_DIM))
    found = []
    for worlds in (Worlds(), SpreadWorlds(2)):
        first = worlds.reset(ids, seeds)
        found.append([first, *worlds.step(ids, actions)])
    for one, two in zip(*found, strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_chunk_ends_with_its_episode() -> None:
    worlds = Worlds()
    worlds.reset(np.array([0]), np.array([0]))
    push = np.ones((1, 1000, ACTION_DIM))
    step = worlds.step(np.array([0]), push)
    assert step.terminated.all()
    assert not step.truncated.any()
    assert 0 < step.reward[0] < 500


def test_finished_episodes_pause_and_what_was_handed_out_stays(scales: Scales) -> None:
    worlds = Countdown()
    env = HopperDecisions(worlds, scales, 3)
    obs, _ = env.reset([2, 1, 3])
    before = obs["state"].clone()
    actions = torch.zeros(3, CHUNK, ACTION_DIM)
    decisions = [env.step_chunk(actions) for _ in range(3)]
    torch.testing.assert_close(obs["state"], before)
    assert [decision.terminated.tolist() for decision in decisions] == [
        [False, True, False],
        [True, True, False],
        [True, True, True],
    ]
    assert [decision.reward.tolist() for decision in decisions] == [[1, 1, 1], [1, 0, 1], [0, 0, 1]]
    assert decisions[-1].info["decisions"].tolist() == [2, 1, 3]
    np.testing.assert_array_equal(decisions[-1].privileged[1], decisions[0].privileged[1])


def test_an_iteration_has_as_many_worlds_as_fill_it(scales: Scales) -> None:
    env = HopperDecisions(Countdown(), scales, 40)
    env.fill(20_000, 100.0)
    assert env.num_envs == 200
    env.fill(20_000, 0.0)
    assert env.num_envs == 800


def test_the_first_episode_of_every_world_is_the_evaluation(scales: Scales, tmp_path) -> None:
    curve = Curve(tmp_path / "curve.jsonl", by="reference", seed=1)
    worlds = Countdown()
    envs = ReferenceHoppers(worlds, scales, curve, num_envs=3, n_steps=4, val_freq=2, first_seed=1)
    seen = []
    for iteration in range(3):
        if iteration != 1:  # the agent goes on after an evaluation
            envs.reset_arg(None)
            worlds.left = {0: 1, 1: 2, 2: 3}
        for _ in range(4):
            envs.step(np.zeros((3, CHUNK, ACTION_DIM)))
        seen.append(list(worlds.seeds))
    held_out = [EVALUATION_SEEDS + i for i in range(3)]
    assert seen[0][:3] == held_out
    assert seen[0][3] == TRAINING_SEEDS + 1
    assert seen[2][len(seen[1]) :][:3] == held_out
    lines = [json.loads(line) for line in curve.path.read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [0, 1, 1]
    assert [line["env_steps"] for line in lines] == [0, 48, 48]
    assert [line.get("eval_return") for line in lines] == [2.0, None, 2.0]
    assert "return" in lines[1]


class Shrink(nn.Module):
    """A network of the reference's signature."""

    def __init__(self) -> None:
        super().__init__()
        self.share = nn.Parameter(torch.tensor(0.3))

    def forward(self, x, time, cond):
        state = cond["state"][:, 0, :ACTION_DIM].unsqueeze(1)
        return self.share * x + 0.1 * state + 0.01 * time.view(-1, 1, 1)


def test_chains_have_the_densities_of_ddpm() -> None:
    cfg = replace(DppoConfig.get_choice_class("paper")(), **SAME, **PRESETS["paper"])
    agent = hopper_agent(Shrink(), Shrink(), cfg.deploy_eta)
    generator = torch.Generator().manual_seed(0)
    cond = torch.randn(5, OBS_DIM, generator=generator)
    noise = torch.randn((5, *agent.action_shape), generator=generator)
    start = denoise_prefix(agent.process, predictor(agent.base.denoiser, cond), noise, TUNED_STEPS)
    chain = explore(agent, predictor(agent.actor.denoiser, cond), start, cfg, generator)
    ours, _, _ = chain_log_probs(agent, chain.latents, cond, cfg)
    torch.testing.assert_close(ours, chain.log_probs)

    angle = (np.linspace(0, 1, DENOISING_STEPS + 1) + 0.008) / 1.008 * np.pi / 2
    bars = np.cos(angle) ** 2 / np.cos(angle[0]) ** 2
    betas = np.clip(1 - bars[1:] / bars[:-1], 0, 0.999)
    alphas = np.cumprod(1 - betas)
    for position, t in enumerate(range(TUNED_STEPS - 1, -1, -1)):
        here, before = alphas[t], alphas[t - 1] if t else 1.0
        x = chain.latents[:, position]
        noise = agent.actor.denoiser(x, torch.full((5,), t), cond)
        clean = ((x - (1 - here) ** 0.5 * noise) / here**0.5).clamp(-1, 1)
        mean = betas[t] * before**0.5 / (1 - here) * clean
        mean = mean + (1 - before) * (1 - betas[t]) ** 0.5 / (1 - here) * x
        std = max(0.1, (betas[t] * (1 - before) / (1 - here)) ** 0.5)
        density = torch.distributions.Normal(mean, std).log_prob(chain.latents[:, position + 1])
        torch.testing.assert_close(ours[:, position], density.clamp(-5, 2).mean((1, 2)), rtol=1e-4, atol=1e-4)


def test_neighbours_share_a_condition() -> None:
    agent = hopper_agent(Shrink(), Shrink(), 1.0)
    x, time = torch.zeros(4, 4, ACTION_DIM), torch.zeros(4, dtype=torch.long)
    found = agent.actor.denoiser(x, time, torch.arange(2.0).view(2, 1).expand(2, OBS_DIM))
    np.testing.assert_allclose(found[:, 0, 0].detach(), [0.0, 0.0, 0.1, 0.1])


def test_steps_are_gone_through_as_numbers() -> None:
    steps = torch.tensor([3, 1]).as_subclass(Steps)
    assert list(steps) == [3, 1]
    assert type(torch.arange(5)[steps]) is torch.Tensor


def test_an_untuned_step_without_noise_is_ours() -> None:
    process = DiffusionProcess(DENOISING_STEPS, step_grid("ddpm", DENOISING_STEPS, DENOISING_STEPS))
    bars = squaredcos_alpha_bar(DENOISING_STEPS)
    before = torch.cat([torch.ones(1), bars[:-1]]).double()
    betas = 1 - bars / before

    class Theirs(nn.Module):  # the schedule as the reference keeps it
        alphas_cumprod, alphas_cumprod_prev = bars, before
        ddpm_mu_coef1 = betas * before.sqrt() / (1 - bars)
        ddpm_mu_coef2 = (1 - before) * (1 - betas).sqrt() / (1 - bars)

    generator = torch.Generator().manual_seed(0)
    x, eps = torch.randn(2, 5, CHUNK, ACTION_DIM, dtype=torch.float64, generator=generator)
    position = 3
    t = torch.full((5,), DENOISING_STEPS - 1 - position)
    mean, _ = process.step(lambda *_: eps, x, position, eta=1.0)
    quiet, _ = process.step(lambda *_: eps, x, position, eta=0.0)
    torch.testing.assert_close(quiet_prefix(Theirs(), x, t, mean), quiet)


def test_a_standardised_critic_sees_deviations_of_the_recorded_episodes(tmp_path) -> None:
    obs = np.random.default_rng(0).normal(3.0, 2.0, (1000, OBS_DIM)).astype(np.float32)
    np.savez(tmp_path / "episodes.npz", obs=obs, actions=np.eye(ACTION_DIM, dtype=np.float32))

    class Echo(nn.Module):
        def forward(self, state):
            return state

    critic = standardised(Echo, tmp_path / "episodes.npz")()
    state = torch.from_numpy(Scales.of(tmp_path / "episodes.npz").scaled_obs(obs))
    seen = critic({"state": state.unsqueeze(1)})
    torch.testing.assert_close(seen.mean(0), torch.zeros(OBS_DIM), atol=1e-3, rtol=0)
    torch.testing.assert_close(seen.std(0), torch.ones(OBS_DIM), atol=2e-3, rtol=0)


def test_scaled_actions_become_the_environments_again(scales: Scales, tmp_path) -> None:
    scales.save(tmp_path / "scales.npz")
    raw = np.array([-2.0, 0.3, 1.0])
    again = Scales.of(tmp_path / "scales.npz").raw_actions(scales.scaled_actions(raw))
    np.testing.assert_allclose(again, raw, atol=1e-5)


def test_chunks_stay_within_episodes(tmp_path) -> None:
    count = np.arange(7.0)
    obs, actions = np.outer(count, np.ones(OBS_DIM)), np.outer(count, np.ones(ACTION_DIM))
    np.savez(tmp_path / "episodes.npz", obs=obs, actions=actions, lengths=[3, 4])
    states, chunks = windows(tmp_path / "episodes.npz", 3)
    np.testing.assert_allclose(3 * (states[:, 0] + 1), [0, 3, 4], atol=1e-5)
    np.testing.assert_allclose(3 * (chunks[:, :, 0] + 1), [[0, 1, 2], [3, 4, 5], [4, 5, 6]], atol=1e-5)


def test_curves_become_rows_at_the_same_steps(tmp_path) -> None:
    for by, seed, last in (("reference", 1, 300.0), ("reference", 2, 500.0), ("paper", 1, 600.0)):
        curve = Curve(tmp_path / f"{by}_{seed}.jsonl", by=by, seed=seed)
        curve.add(0, 0, eval_return=100.0)
        curve.add(1, 100_000, **{"return": 5.0})
        curve.add(2, 204_000, **{"return": 7.0})
        curve.add(2, 200_000, eval_return=last)
    rows = lines_of(read_curves(tmp_path), 100_000.0, "A", **ORIGIN)
    found = [row.cells for row in rows]
    ours = NAMES["paper"]
    assert [cells["imitation, fine-tuned by"] for cells in found] == [
        f"A: {NAMES['reference']}",
        f"A: {ours}",
        f"A: {ours} minus the reference",
    ]
    assert [list(cells.values())[1:] for cells in found] == [
        [
            "2",
            "100 [100, 100] (100, 100)",
            "250 [-385, 885] (200, 300)",
            "400 [-871, 1671] (300, 500)",
            "5 [5, 5] (5, 5)",
            "7 [7, 7] (7, 7)",
        ],
        ["1", "100", "350", "600", "5", "7"],
        ["1", "+0", "+150", "+300", "+0", "+0"],
    ]
