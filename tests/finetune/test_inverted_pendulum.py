"""A third-party environment: balancing, from a noisy linear controller's data (minutes, marked slow)."""

from collections.abc import Sequence

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor
from toy import ToyActor, clone_behaviour, make_agent

from lerobot_vtrefine.envs.decisions import Decision
from lerobot_vtrefine.finetune.config import SmallDppo
from lerobot_vtrefine.finetune.dppo import TrainState, train
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.protocols import Observation

pytest.importorskip("imageio", reason="Gymnasium's MuJoCo environments import it")

HORIZON, CHUNK, SCALE = 4, 2, 3.0
GAIN = np.array([0.5, 8.0, 0.6, 1.5])  # stabilises the pole; the demonstrator adds noise and holds its action


class Pendulum:
    """Gymnasium's InvertedPendulum-v5, 1 per step, 1000 at most; normalised actions are forces / 3."""

    privileged_dim = 4

    def __init__(self, num_envs: int, max_decisions: int) -> None:
        self.num_envs, self.max_decisions = num_envs, max_decisions
        self.envs = [gym.make("InvertedPendulum-v5") for _ in range(num_envs)]

    def reset(self, seeds: Sequence[int]) -> tuple[Observation, Tensor]:
        rows = [env.reset(seed=int(seed))[0] for env, seed in zip(self.envs, seeds, strict=True)]
        self.rows = np.stack(rows)
        self.done = np.zeros(self.num_envs, bool)
        return self.observe()

    def observe(self) -> tuple[Observation, Tensor]:
        state = torch.tensor(self.rows, dtype=torch.float32)
        return {"state": state}, state

    def step_chunk(self, actions: Tensor) -> Decision:
        reward, ended, over = (np.zeros(self.num_envs) for _ in range(3))
        for index in np.flatnonzero(~self.done):
            for action in actions[index].numpy() * SCALE:
                self.rows[index], gain, terminated, truncated, _ = self.envs[index].step(action.clip(-3, 3))
                reward[index] += gain
                ended[index], over[index] = terminated, truncated
                if terminated or truncated:
                    self.done[index] = True
                    break
        obs, privileged = self.observe()
        flags = (torch.tensor(ended > 0), torch.tensor((over > 0) & (ended == 0)))
        return Decision(obs, privileged, torch.tensor(reward), *flags, {"success": flags[1]})


def demonstrations(episodes: int, seed: int) -> tuple[Tensor, Tensor]:
    """States (N, 4) and chunks (N, 4, 1) of a controller with strong action noise."""
    rng, env = np.random.default_rng(seed), gym.make("InvertedPendulum-v5")
    states, chunks = [], []
    for episode in range(episodes):
        row, _ = env.reset(seed=seed + episode)
        rows, actions, over = [], [], False
        while not over and len(rows) < 150:
            action = float(np.clip(GAIN @ row + rng.normal(0, 1.5), -3, 3))
            rows.append(row)
            actions.append(action / SCALE)
            row, _, terminated, truncated, _ = env.step([action])
            over = terminated or truncated
        actions += actions[-1:] * HORIZON
        states += rows
        chunks += [actions[i : i + HORIZON] for i in range(len(rows))]
    return torch.tensor(np.array(states), dtype=torch.float32), torch.tensor(chunks).unsqueeze(-1).float()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_balancing_improves_to_the_ceiling():
    torch.set_num_threads(1)
    torch.manual_seed(0)
    cfg = SmallDppo(
        iterations=60,
        num_envs=40,
        decisions=60,
        sampler="ddpm",
        ft_denoising_steps=10,
        timeout="bootstrap",
        reward_scaling=True,
        minibatch_decisions=500,
        actor_lr=3e-4,
        actor_lr_final=3e-4,
        clip=0.01,
        clip_first=0.01,
        encoder="trained",
    )
    states, chunks = demonstrations(20, seed=0)
    actor = ToyActor(4, HORIZON, 1)
    clone_behaviour(actor, states, chunks, steps=3000, seed=0, num_train_steps=20)
    agent = make_agent(actor, cfg, (HORIZON, 1), num_train_steps=20)
    agent.executed = slice(0, CHUNK)
    training, testing = Pendulum(cfg.num_envs, 500), Pendulum(10, 500)
    returns = [evaluate(testing, agent, 10)["eval_return"]]

    def watch(state: TrainState, metrics: dict[str, float]) -> None:
        if state.iteration % 5 == 0:
            returns.append(evaluate(testing, agent, 10)["eval_return"])
            print(state.iteration, returns[-1], metrics["return"], metrics["explained_variance"])

    state = TrainState.create(agent, cfg, training.privileged_dim, seed=0)
    train(training, agent, state, cfg, seed=0, after_iteration=watch)
    assert returns[5] >= 2 * returns[0] or returns[0] > 450
    assert max(returns) >= 900
