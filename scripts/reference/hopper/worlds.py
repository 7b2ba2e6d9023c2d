"""Gymnasium's Hopper in many worlds that act in chunks, perhaps spread over processes.

``n`` worlds, of which ``m`` are named in a call; ``Ta`` actions of a chunk; 11 numbers of an observation and
3 of an action, in the environment's own units. Environment steps are counted as the reference does: a chunk
counts in full, also where the episode ends within it.
"""

import multiprocessing
from multiprocessing.connection import Connection
from typing import NamedTuple

import gymnasium
import numpy as np

NAME = "Hopper-v5"
OBS_DIM, ACTION_DIM = 11, 3
MAX_STEPS = 1000
"""Of an episode, which is truncated there."""
CHUNK = 4
"""Actions of a decision; nothing is predicted beyond them."""
NUM_ENVS, N_STEPS = 40, 500
"""Worlds of an evaluation and of the reference's iterations, and decisions of each in such an iteration."""

Array = np.ndarray


class Step(NamedTuple):
    """What a chunk led to in m worlds."""

    obs: Array
    """(m, 11); of an episode that ended within the chunk, its last."""
    reward: Array
    """(m,) sum over the executed actions."""
    terminated: Array
    """(m,) bool: fell."""
    truncated: Array
    """(m,) bool: the time was over."""


def make_env() -> gymnasium.Env:
    """One Hopper; without the checker, which warns of actions outside the box that the simulation clips."""
    return gymnasium.make(NAME, disable_env_checker=True)


class Worlds:
    """Worlds in this process, made when their number is first named."""

    def __init__(self) -> None:
        self._envs: list[gymnasium.Env] = []

    def reset(self, ids: Array, seeds: Array) -> Array:
        """First observations (m, 11) of new episodes."""
        while len(self._envs) <= ids.max():
            self._envs.append(make_env())
        return np.stack([self._envs[i].reset(seed=int(seed))[0] for i, seed in zip(ids, seeds, strict=True)])

    def step(self, ids: Array, actions: Array) -> Step:
        """Execute chunks (m, Ta, 3), each until its episode ends."""
        columns = zip(*(self._chunk(i, chunk) for i, chunk in zip(ids, actions, strict=True)), strict=True)
        return Step(*map(np.array, columns))

    def _chunk(self, world: int, chunk: Array) -> tuple[Array, float, bool, bool]:
        total = 0.0
        for action in chunk:
            obs, reward, terminated, truncated, _ = self._envs[world].step(action)
            total += float(reward)
            if terminated or truncated:
                break
        return obs, total, terminated, truncated


class SpreadWorlds:
    """``Worlds`` in several processes; world i lives in process i modulo their number.

    Make it before anything uses a GPU: the processes are forks of this one.
    """

    def __init__(self, processes: int) -> None:
        context = multiprocessing.get_context("fork")
        self._pipes: list[Connection] = []
        for _ in range(processes):
            ours, theirs = context.Pipe()
            self._pipes.append(ours)
            context.Process(target=_serve, args=(theirs, self._pipes), daemon=True).start()
            theirs.close()

    def reset(self, ids: Array, seeds: Array) -> Array:
        """As ``Worlds.reset``."""
        order, parts = self._ask("reset", ids, seeds)
        return np.concatenate(parts)[order]

    def step(self, ids: Array, actions: Array) -> Step:
        """As ``Worlds.step``."""
        order, parts = self._ask("step", ids, actions)
        return Step(*(np.concatenate(column)[order] for column in zip(*parts, strict=True)))

    def _ask(self, what: str, ids: Array, values: Array) -> tuple[Array, list]:
        """Answers of the processes, and the positions (m,) that put their rows into the order of ``ids``."""
        processes = len(self._pipes)
        rows = [np.flatnonzero(ids % processes == process) for process in range(processes)]
        asked = [(pipe, mine) for pipe, mine in zip(self._pipes, rows, strict=True) if len(mine)]
        for pipe, mine in asked:
            pipe.send((what, ids[mine] // processes, values[mine]))
        return np.argsort(np.concatenate(rows)), [pipe.recv() for pipe, _ in asked]


def _serve(pipe: Connection, inherited: list[Connection]) -> None:
    """Answer requests until the other side is gone, which shows once nobody else holds its ends."""
    for other in inherited:
        other.close()
    worlds = Worlds()
    try:
        while True:
            what, ids, values = pipe.recv()
            pipe.send(getattr(worlds, what)(ids, values))
    except (EOFError, KeyboardInterrupt):
        return


def make_worlds(processes: int) -> Worlds | SpreadWorlds:
    """In this process if it is the only one."""
    return SpreadWorlds(processes) if processes > 1 else Worlds()
