"""Episodes from the table up to the moment at which the hands have both parts: what banks of starts hold."""

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Array, Episodes
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.sim.demonstrations import Degradation


class Player(Protocol):
    """What moves the arms of a simulation."""

    @property
    def episodes(self) -> Episodes:
        """The running simulation."""
        ...

    def start(self, seeds: Array) -> None:
        """Start an episode in every environment (n,)."""
        ...

    def move(self) -> None:
        """Move unfinished environments on, by an action or a chunk of them."""
        ...


class ExpertPlayer:
    """The scripted expert."""

    def __init__(self, config: VtRefineEnvConfig, degradation: Degradation, num_envs: int) -> None:
        from lerobot_vtrefine.sim.expert import ScriptedExpert

        self.episodes = make_episodes(config, num_envs)
        self._expert = ScriptedExpert(self.episodes.sim, degradation)

    def start(self, seeds: Array) -> None:
        """As of ``Player``."""
        self.episodes.reset(self.episodes.ids, seeds)
        self._expert.reset(self.episodes.ids)

    def move(self) -> None:
        """As of ``Player``; nobody reads the sensors."""
        active = self.episodes.active
        targets = np.zeros((self.episodes.num_envs, self.episodes.body.num_joints))
        targets[active] = self._expert.act(active)
        self.episodes.step(targets, reads=False)


def grasp_states(player: Player, first_seed: int, batches: int) -> Iterator[tuple[int, dict[str, Any]]]:
    """Seed and state (``InsertionSim.get_state``) of the episodes ``first_seed``, ``first_seed`` + 1, ..., in
    ``batches`` of as many as there are environments, after the first move that leaves both parts in hand.
    What would follow is not simulated.
    """
    episodes = player.episodes
    for first in first_seed + episodes.num_envs * np.arange(batches):
        player.start(first + episodes.ids)
        states: dict[int, dict[str, Any]] = {}
        while len(episodes.active):
            player.move()
            running = episodes.active
            ready = running[episodes.sim.in_hand[running]]
            states |= {int(first) + env: episodes.sim.get_state(env) for env in ready.tolist()}
            episodes.leave(ready)
        yield from sorted(states.items())
