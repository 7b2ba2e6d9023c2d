"""Undo updates after which fewer episodes succeed.

A step that an iteration's episodes speak for can be wrong all the same, and the next one then starts from a
worse policy: success falls, and goes on falling. Here the policy that succeeded most often so far is kept.
Where an iteration's episodes succeed clearly less often than its own did, training goes back to it, measures
it once more, so that luck in its first measurement does not last, and goes on in steps half as large.
"""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_vtrefine.finetune.config import DppoConfig
from lerobot_vtrefine.finetune.distributed import sum_over_ranks


class Undo:
    """The policy that succeeded most often so far, and when to go back to it: ``cfg.undo_falls``."""

    def __init__(self, cfg: DppoConfig) -> None:
        self._cfg = cfg
        self.weights: list[Tensor] = []
        self.optimizer: dict[str, Any] = {}
        self.successes = self.episodes = 0.0
        """Of the kept policy while exploring, on all ranks."""
        self.again = False
        """Whether the present policy is the kept one, to be measured once more."""

    def judge(
        self,
        success: Tensor,
        counted: Tensor,
        parameters: Sequence[Tensor],
        optimizer: torch.optim.Optimizer,
    ) -> bool:
        """Learn from an iteration's episodes, before its update, how often the present policy succeeds.

        ``success`` and ``counted`` (E,), bool: of an episode, and whether the simulation held.

        Returns: whether ``parameters`` and the state of their ``optimizer`` are the kept policy's now.
        """
        if not self._cfg.undo_falls:
            return False
        counts = torch.stack([(success & counted).sum(), counted.sum()]).double()
        successes, episodes = sum_over_ranks(counts).tolist()
        if self.again:
            self.successes, self.episodes = self.successes + successes, self.episodes + episodes
            self.again = False
        elif fell(self.successes, self.episodes, successes, episodes, self._cfg.undo_falls):
            self._go_back(parameters, optimizer)
        elif successes * self.episodes >= self.successes * episodes:
            self.weights = [weight.detach().clone() for weight in parameters]
            self.optimizer = copy.deepcopy(optimizer.state_dict())
            self.successes, self.episodes = successes, episodes
        return self.again

    @torch.no_grad()
    def _go_back(self, parameters: Sequence[Tensor], optimizer: torch.optim.Optimizer) -> None:
        for weight, kept in zip(parameters, self.weights, strict=True):
            weight.copy_(kept)
        optimizer.load_state_dict(copy.deepcopy(self.optimizer))
        self.again = True

    def holds(self, iteration: int) -> bool:
        """Whether this iteration leaves the policy as it is: its episodes were another one's, or there is no
        iteration after it to judge an update."""
        last = iteration >= self._cfg.iterations - 1
        return self._cfg.undo_falls > 0 and (self.again or last)

    def state_dict(self) -> dict[str, Any]:
        """What is kept."""
        return {name: value for name, value in vars(self).items() if name != "_cfg"}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        vars(self).update(state)


def fell(successes: float, episodes: float, later: float, later_episodes: float, errors: float) -> bool:
    """Whether a later policy's share of successes is lower by more than so many standard errors of the
    difference, by the share of both together."""
    if not episodes or not later_episodes:
        return False
    share = (successes + later) / (episodes + later_episodes)
    error = (share * (1 - share) * (1 / episodes + 1 / later_episodes)) ** 0.5
    return successes / episodes - later / later_episodes > errors * error
