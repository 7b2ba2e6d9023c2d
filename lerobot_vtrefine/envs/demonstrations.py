"""Rollouts of the scripted expert: one episode per seed, many at a time, in the order of the seeds."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Array, Episodes, Raw
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.truth import truth

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.expert import ScriptedExpert


@dataclass
class Demonstration:
    """One finished episode of T control steps."""

    raw: Raw
    """Raw frames before each action, arrays (T, ...)."""
    actions: Array
    """(T, J) float32 absolute joint targets."""
    row: dict[str, Any]
    """Seed, steps, success and metrics."""


def expert_episodes(
    config: VtRefineEnvConfig,
    degradation: Degradation,
    num_envs: int,
    seeds: Iterable[int],
    with_truth: bool = False,
) -> Iterator[Demonstration]:
    """Expert episodes of ``seeds``, in their order; each is a pure function of its seed.

    ``with_truth``: their frames hold ``sim.truth``, too.
    """
    from lerobot_vtrefine.sim.expert import ScriptedExpert

    episodes = make_episodes(config, num_envs)
    expert = ScriptedExpert(episodes.sim, degradation)
    seeds = list(seeds) if isinstance(seeds, range) else seeds
    return in_seed_order(rollouts(episodes, expert, iter(seeds), with_truth))


def rollouts(
    episodes: Episodes, expert: "ScriptedExpert", seeds: Iterator[int], with_truth: bool = False
) -> Iterator[tuple[int, Demonstration]]:
    """(position of its seed, episode) as episodes end; their environments go on with the next seed."""
    numbered = enumerate(seeds)
    positions = np.zeros(episodes.num_envs, np.int64)
    frames: list[list[Raw]] = [[] for _ in episodes.ids]
    actions: list[list[Array]] = [[] for _ in episodes.ids]
    idle = episodes.ids
    while True:
        started = [(env, *job) for env, job in zip(idle.tolist(), numbered, strict=False)]
        if started:
            ids, places, drawn = (np.array(column) for column in zip(*started, strict=True))
            positions[ids] = places
            episodes.reset(ids, drawn)
            expert.reset(ids)
        active = episodes.active
        if len(active) == 0:
            return
        targets = np.zeros((episodes.num_envs, episodes.raw["state"].shape[1]), np.float32)
        targets[active] = expert.act(active)
        known = {"truth": truth(episodes.sim, episodes.ids)} if with_truth else {}
        seen = episodes.raw | known
        for env in active.tolist():
            frames[env].append({key: value[env].copy() for key, value in seen.items()})
            actions[env].append(targets[env])
        idle = episodes.step(targets).finished
        for env, row in zip(idle.tolist(), episodes.rows(idle), strict=True):
            raw = {key: np.stack([frame[key] for frame in frames[env]]) for key in seen}
            yield int(positions[env]), Demonstration(raw, np.stack(actions[env]), row)
            frames[env], actions[env] = [], []


def in_seed_order(ended: Iterable[tuple[int, Demonstration]]) -> Iterator[Demonstration]:
    """Hold episodes back until all earlier seeds are there."""
    waiting: dict[int, Demonstration] = {}
    position = 0
    for place, demonstration in ended:
        waiting[place] = demonstration
        while position in waiting:
            yield waiting.pop(position)
            position += 1
