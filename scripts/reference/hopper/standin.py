"""What stands in for D4RL's hopper-medium-v2: a mediocre controller, its episodes, an imitation of them.

The controller is linear, found by augmented random search (Mania et al. 2018, V2-t) that stops early.
Episodes carry Gaussian noise on their actions. Observations (11) and actions (3) are scaled to -1 ... 1 by
their extremes in the episodes.
"""

import copy
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from torch import nn

from reference.hopper.worlds import ACTION_DIM, MAX_STEPS, OBS_DIM, Array, make_env

DIRECTIONS, KEPT, STEP, SPREAD = 8, 4, 0.02, 0.025
"""Of the search: directions of a round, the best of them, step size, and how far a direction is followed."""
JUDGED_EVERY, JUDGED_EPISODES, FIRST_JUDGED = 20, 20, 1_000_000


@dataclass(frozen=True)
class Controller:
    """Actions from standardised observations."""

    gains: Array
    """(3, 11)"""
    mean: Array
    """(11,)"""
    std: Array
    """(11,)"""

    def __call__(self, obs: Array) -> Array:
        """(11,) -> (3,)."""
        return self.gains @ ((obs - self.mean) / self.std)


class Moments:
    """Running mean and deviation of observations (Welford 1962)."""

    def __init__(self) -> None:
        self.count, self.mean, self._squares = 0, np.zeros(OBS_DIM), np.zeros(OBS_DIM)

    def add(self, obs: Array) -> None:
        """One observation (11,)."""
        self.count += 1
        shift = obs - self.mean
        self.mean = self.mean + shift / self.count
        self._squares = self._squares + shift * (obs - self.mean)

    @property
    def std(self) -> Array:
        """(11,); ones before the second observation."""
        if self.count < 2:
            return np.ones(OBS_DIM)
        return np.sqrt(self._squares / (self.count - 1)) + 1e-7


class Episode(NamedTuple):
    """One episode of T steps."""

    obs: list[Array]
    """T of (11,)"""
    actions: list[Array]
    """T of (3,)"""
    rewards: list[float]


def play(env: gymnasium.Env, controller: Controller, seed: int, noise: Array) -> Episode:
    """One episode, with noise (1000, 3) on the actions."""
    obs, _ = env.reset(seed=seed)
    episode = Episode([], [], [])
    for disturbance in noise:
        action = np.clip(controller(obs) + disturbance, -1, 1)
        episode.obs.append(obs)
        episode.actions.append(action)
        obs, reward, terminated, truncated, _ = env.step(action)
        episode.rewards.append(float(reward))
        if terminated or truncated:
            break
    return episode


def find_controller(goal: float, noise: float, seed: int) -> Controller:
    """The first judged controller whose mean return with noise on its actions reaches ``goal``.

    Roundings grow over hundreds of rounds: elsewhere the same seed may find another one.
    """
    rng, env, moments = np.random.default_rng(seed), make_env(), Moments()
    gains, quiet, found, rounds = np.zeros((ACTION_DIM, OBS_DIM)), np.zeros((MAX_STEPS, ACTION_DIM)), 0.0, 0
    while found < goal:
        directions = rng.normal(size=(DIRECTIONS, *gains.shape))
        mean, std = moments.mean, moments.std
        episodes = [
            play(env, Controller(gains + way, mean, std), int(rng.integers(2**31)), quiet)
            for direction in directions
            for way in (SPREAD * direction, -SPREAD * direction)
        ]
        for obs in (obs for episode in episodes for obs in episode.obs):
            moments.add(obs)
        # Without the reward for being upright, so that standing still is no way out.
        progress = np.array([sum(reward - 1.0 for reward in episode.rewards) for episode in episodes])
        pairs = progress.reshape(DIRECTIONS, 2)
        best = np.argsort(-pairs.max(1))[:KEPT]
        slope = np.einsum("k,kij->ij", pairs[best, 0] - pairs[best, 1], directions[best])
        gains = gains + STEP / (KEPT * (pairs[best].std() + 1e-6)) * slope
        rounds += 1
        if rounds % JUDGED_EVERY == 0:
            judged = Controller(gains, moments.mean, moments.std)
            shaken = noise * np.random.default_rng(rounds).normal(size=(JUDGED_EPISODES, *quiet.shape))
            episodes = [play(env, judged, FIRST_JUDGED + i, rows) for i, rows in enumerate(shaken)]
            found = float(np.mean([sum(episode.rewards) for episode in episodes]))
            told = f"search: round {rounds}, {moments.count} steps, return {found:.0f}"
            print(told, file=sys.stderr, flush=True)
    return Controller(gains, moments.mean, moments.std)


def record(path: Path, *, goal: float, noise: float, steps: int, seed: int) -> dict[str, float]:
    """Save episodes of at least so many steps, and the scales; mean and spread of their returns."""
    controller = find_controller(goal, noise, seed)
    rng, env, episodes, recorded = np.random.default_rng(seed + 1), make_env(), [], 0
    while recorded < steps:
        disturbance = noise * rng.normal(size=(MAX_STEPS, ACTION_DIM))
        episodes.append(play(env, controller, int(rng.integers(2**31)), disturbance))
        recorded += len(episodes[-1].obs)
    totals = np.array([sum(episode.rewards) for episode in episodes])
    np.savez_compressed(
        path,
        obs=np.array([obs for episode in episodes for obs in episode.obs], np.float32),
        actions=np.array([action for episode in episodes for action in episode.actions], np.float32),
        lengths=[len(episode.obs) for episode in episodes],
        returns=totals,
    )
    found = {"episodes": len(episodes), "steps": recorded, "return": totals.mean(), "spread": totals.std()}
    return {name: float(value) for name, value in found.items()}


@dataclass(frozen=True)
class Scales:
    """Extremes of observations (11,) and actions (3,), which become -1 and 1."""

    obs: tuple[Array, Array]
    actions: tuple[Array, Array]

    @classmethod
    def of(cls, path: Path) -> "Scales":
        """Of recorded episodes, or as saved with a policy."""
        with np.load(path) as saved:
            if "obs_low" in saved:
                return cls(*((saved[f"{name}_low"], saved[f"{name}_high"]) for name in ("obs", "actions")))
            return cls(*((saved[name].min(0), saved[name].max(0)) for name in ("obs", "actions")))

    def save(self, path: Path) -> None:
        """For ``of``."""
        np.savez(
            path,
            obs_low=self.obs[0],
            obs_high=self.obs[1],
            actions_low=self.actions[0],
            actions_high=self.actions[1],
        )

    def scaled_obs(self, obs: Array) -> Array:
        """(..., 11) in units of the environment -> scaled, float32."""
        low, high = self.obs
        return (2 * (obs - low) / (high - low + 1e-6) - 1).astype(np.float32)

    def scaled_actions(self, actions: Array) -> Array:
        """(..., 3) in units of the environment -> scaled, float32."""
        low, high = self.actions
        return (2 * (actions - low) / (high - low + 1e-6) - 1).astype(np.float32)

    def raw_actions(self, actions: Array) -> Array:
        """(..., 3) scaled -> in units of the environment."""
        low, high = self.actions
        return (actions + 1) / 2 * (high - low) + low


def imitate(
    model: Any, episodes: Path, *, horizon: int, updates: int, batch: int, seed: int
) -> dict[str, torch.Tensor]:
    """Weights of a diffusion model of the reference's, by its own loss on the recorded episodes.

    AdamW, its cosine schedule and its moving average, as the reference pre-trains on hopper-medium-v2; a
    fixed number of minibatches in place of epochs, since these episodes are fewer.
    """
    device = next(model.parameters()).device
    states, chunks = (torch.from_numpy(part).to(device) for part in windows(episodes, horizon))
    generator = torch.Generator(device).manual_seed(seed)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3, weight_decay=1e-6)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates, eta_min=1e-4)
    averaged: nn.Module = copy.deepcopy(model)
    torch.manual_seed(seed)  # its loss draws from the global generator
    losses = []
    for update in range(updates):
        ids = torch.randint(len(states), (batch,), generator=generator, device=device)
        loss = model.loss(chunks[ids], {"state": states[ids].unsqueeze(1)})
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.detach())
        if update % 10 == 0:
            share = 0.005 if update > updates // 10 else 1.0
            with torch.no_grad():
                for old, new in zip(averaged.parameters(), model.parameters(), strict=True):
                    old.lerp_(new, share)
        if update % 1000 == 999:
            recent = float(torch.stack(losses[-1000:]).mean())
            print(f"imitation: update {update + 1}, loss {recent:.4f}", file=sys.stderr, flush=True)
    return averaged.state_dict()


def windows(episodes: Path, horizon: int) -> tuple[Array, Array]:
    """Scaled observations (N, 11) and the chunks (N, H, 3) of actions from there on, within episodes."""
    scales = Scales.of(episodes)
    with np.load(episodes) as saved:
        obs, actions = scales.scaled_obs(saved["obs"]), scales.scaled_actions(saved["actions"])
        lengths = saved["lengths"]
    first = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    starts = np.concatenate(
        [np.arange(at, at + length - horizon + 1) for at, length in zip(first, lengths, strict=True)]
    )
    return obs[starts], actions[starts[:, None] + np.arange(horizon)]
