"""Hopper for both implementations of DPPO, from one pre-trained network of the reference's.

Both see the scaled observation, for the actor and for the critic, and act in scaled chunks. Environment steps
are counted as the reference does: a chunk counts in full, also where the episode ends within it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from hopper_curves import Curve
from hopper_standin import Scales
from hopper_worlds import ACTION_DIM, MAX_STEPS, OBS_DIM, Array, SpreadWorlds, Worlds
from torch import Tensor, nn

from lerobot_vtrefine.envs.decisions import Decision
from lerobot_vtrefine.finetune.protocols import Agent, Observation, no_gradient
from lerobot_vtrefine.finetune.seeds import EVALUATION_SEEDS, TRAINING_SEEDS
from lerobot_vtrefine.policies.vt_dp3.diffusion import DiffusionProcess, step_grid

HORIZON = CHUNK = 4
"""Actions of a prediction; all are executed."""
DENOISING_STEPS, TUNED_STEPS = 20, 10
MAX_DECISIONS = MAX_STEPS // CHUNK
FEWEST, MOST = 8, 800
"""Worlds of one of our iterations."""


class HopperDecisions:
    """Hopper as our DPPO sees it: whole episodes in ``num_envs`` worlds, a number that may change."""

    max_decisions = MAX_DECISIONS
    privileged_dim = OBS_DIM

    def __init__(self, worlds: Worlds | SpreadWorlds, scales: Scales, num_envs: int) -> None:
        self.worlds, self.scales, self.num_envs = worlds, scales, num_envs
        self._obs = np.zeros((0, OBS_DIM), np.float32)
        self._decisions = np.zeros(0, np.int64)
        self._over = np.zeros((2, 0), bool)  # terminated, truncated

    def reset(self, seeds: Sequence[int]) -> tuple[Observation, Tensor]:
        """Observation {"state": (n, 11)} and the critic's (n, 11), which is the same."""
        self._obs = self.scales.scaled_obs(self.worlds.reset(np.arange(len(seeds)), np.array(seeds)))
        self._decisions = np.zeros(len(seeds), np.int64)
        self._over = np.zeros((2, len(seeds)), bool)
        state = torch.from_numpy(self._obs)
        return {"state": state}, state

    def step_chunk(self, actions: Tensor) -> Decision:
        """Execute scaled chunks (n, Ta, 3) where the episode goes on."""
        ids = np.flatnonzero(~self._over.any(0))
        chunks = self.scales.raw_actions(actions.cpu().numpy()[ids])
        obs, chunk_reward, *over = self.worlds.step(ids, chunks)
        # Copies: what was handed out before must not change.
        self._obs, self._over, self._decisions = self._obs.copy(), self._over.copy(), self._decisions.copy()
        self._obs[ids] = self.scales.scaled_obs(obs)
        self._over[:, ids] = over
        self._decisions[ids] += 1
        reward = np.zeros(len(self._obs), np.float32)
        reward[ids] = chunk_reward
        state = torch.from_numpy(self._obs)
        info = {
            "success": torch.zeros(len(self._obs), dtype=torch.bool),
            "decisions": torch.from_numpy(self._decisions),
        }
        terminated, truncated = torch.from_numpy(self._over)
        return Decision({"state": state}, state, torch.from_numpy(reward), terminated, truncated, info)

    def fill(self, decisions: int, per_episode: float) -> None:
        """As many worlds from now on as make so many decisions, if episodes keep their mean length."""
        self.num_envs = int(np.clip(round(decisions / max(per_episode, 1.0)), FEWEST, MOST))


class StateActor(nn.Module):
    """A diffusion network of the reference's as our ``Actor``: the condition is the scaled observation."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.denoiser: nn.Module = StateDenoiser(network)

    def encode(self, batch: Observation, /) -> Tensor:
        """Condition (B, 11)."""
        return batch["state"]


class StateDenoiser(nn.Module):
    """Calls the network as the reference does, with one condition for B / b neighbours."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor, time: Tensor, cond: Tensor) -> Tensor:
        """x (B, H, 3), time (B,) long, cond (b, 11) -> noise (B, H, 3)."""
        state = cond.repeat_interleave(len(x) // len(cond), dim=0)
        return self.network(x, time, cond={"state": state.unsqueeze(1)})


def hopper_agent(tuned: nn.Module, base: nn.Module, deploy_eta: float) -> Agent:
    """Our agent around two copies of the pre-trained network."""
    grid = step_grid("ddpm", DENOISING_STEPS, DENOISING_STEPS)
    return Agent(
        actor=StateActor(tuned),
        base=no_gradient(StateActor(base)),
        process=DiffusionProcess(DENOISING_STEPS, grid),
        num_tuned=TUNED_STEPS,
        action_shape=(HORIZON, ACTION_DIM),
        executed=slice(0, CHUNK),
        frozen_encoder=True,
        deploy_eta=deploy_eta,
    )


class ReferenceHoppers:
    """Hopper as the reference's agent steps it; episodes go on over iterations. Keeps the learning curve.

    Where the agent evaluates, the first episode of every world is a held-out one; these are the evaluation.
    """

    def __init__(
        self,
        worlds: Worlds | SpreadWorlds,
        scales: Scales,
        curve: Curve,
        *,
        num_envs: int,
        n_steps: int,
        val_freq: int,
        first_seed: int,
    ) -> None:
        self.worlds, self.scales, self.curve = worlds, scales, curve
        self.num_envs, self.n_steps, self.val_freq = num_envs, n_steps, val_freq
        self.next_seed = TRAINING_SEEDS + first_seed
        self.decisions = 0
        self.totals = np.zeros(num_envs)
        self.lengths = np.zeros(num_envs)
        self.ended: list[tuple[int, float, float]] = []  # world, return, decisions

    def seed(self, seeds: Sequence[int]) -> None:
        """Every reset names its own."""

    def reset_arg(self, options_list: object) -> dict[str, Array]:
        """New episodes in all worlds: held-out ones where the agent evaluates."""
        ids = np.arange(self.num_envs)
        seeds = EVALUATION_SEEDS + ids if self._evaluates else self._fresh(self.num_envs)
        self.totals[:] = self.lengths[:] = 0
        return self._state(self.worlds.reset(ids, seeds))

    def step(self, actions: Array) -> tuple[Any, ...]:
        """Executes scaled chunks (n, Ta, 3); where an episode ended, a new one has begun."""
        ids = np.arange(self.num_envs)
        obs, reward, terminated, truncated = self.worlds.step(ids, self.scales.raw_actions(actions))
        self.totals += reward
        self.lengths += 1
        over = np.flatnonzero(terminated | truncated)
        if len(over):
            self.ended += [(int(i), self.totals[i], self.lengths[i]) for i in over]
            self.totals[over] = self.lengths[over] = 0
            obs[over] = self.worlds.reset(over, self._fresh(len(over)))
        self.decisions += 1
        if self.decisions % self.n_steps == 0:
            self._note(self.decisions // self.n_steps - 1)
        return self._state(obs), reward, terminated, truncated, [{}] * self.num_envs

    @property
    def _evaluates(self) -> bool:
        return self.decisions // self.n_steps % self.val_freq == 0

    def _fresh(self, number: int) -> Array:
        self.next_seed += number
        return np.arange(self.next_seed - number, self.next_seed)

    def _note(self, iteration: int) -> None:
        """A line of the curve, of an iteration that ends here."""
        trained = iteration - iteration // self.val_freq
        if iteration % self.val_freq == 0:
            firsts: dict[int, tuple[float, float]] = {}
            for world, total, length in self.ended:
                firsts.setdefault(world, (total, length))
            name, episodes = "eval_return", list(firsts.values())
        else:
            name, episodes = "return", [(total, length) for _, total, length in self.ended]
        self.ended = []
        total, length = np.mean(episodes, axis=0) if episodes else (np.nan, np.nan)
        numbers = {name: float(total), "episodes": len(episodes), "decisions": float(length)}
        self.curve.add(trained, trained * self.n_steps * self.num_envs * CHUNK, **numbers)

    def _state(self, obs: Array) -> dict[str, Array]:
        return {"state": self.scales.scaled_obs(obs)[:, None]}
