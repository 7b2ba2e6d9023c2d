"""Return to the best weights when success has clearly collapsed.

A sparse reward gives no gradient where nothing succeeds: a policy that a few unlucky updates have led there
stays there. Not part of DPPO as published; off in the presets that reproduce it.
"""

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

WINDOW = 2
"""Iterations whose mean success is compared: one alone is too noisy."""
SLOWER = 0.5
"""Factor on the actor's learning rate after each return."""


class Rollback:
    """Remembers the best actor and its optimiser's state; decides when to return to them.

    Args:
        sigmas: how significant a fall of the success rate below the best one (both over ``WINDOW``
            iterations) triggers a return, in standard errors; 0 never returns and stores nothing.
    """

    def __init__(self, sigmas: float) -> None:
        self.sigmas = sigmas
        self.best = -1.0
        self.recent: list[float] = []
        self.lr_scale = 1.0
        self.weights: list[Tensor] = []
        self.optimizer: dict[str, Any] = {}

    @torch.no_grad()
    def watch(
        self, success: float, episodes: int, parameters: Sequence[Tensor], optimizer: torch.optim.Optimizer
    ) -> bool:
        """Note the success of the weights just tried, in so many episodes; True if it returned to the best.

        After a return the experience just collected belongs to other weights and must not be learnt from.
        """
        if self.sigmas <= 0:
            return False
        self.recent = [*self.recent, success][-WINDOW:]
        if len(self.recent) < WINDOW:
            return False
        mean = sum(self.recent) / WINDOW
        if mean > self.best:
            self.best = mean
            self.weights = [parameter.detach().clone() for parameter in parameters]
            self.optimizer = copy.deepcopy(optimizer.state_dict())
            return False
        if fall(self.best, mean, WINDOW * episodes) < self.sigmas:
            return False
        for parameter, kept in zip(parameters, self.weights, strict=True):
            parameter.copy_(kept)
        optimizer.load_state_dict(copy.deepcopy(self.optimizer))
        self.recent, self.lr_scale = [], self.lr_scale * SLOWER
        return True

    def state_dict(self) -> dict[str, Any]:
        """Everything but the setting, for exact resumption."""
        return {key: value for key, value in vars(self).items() if key != "sigmas"}

    def load_state_dict(self, saved: dict[str, Any], device: torch.device) -> None:
        """Restore what `state_dict` gave, with the weights on ``device``."""
        vars(self).update(saved)
        self.weights = [kept.to(device) for kept in self.weights]


def fall(best: float, now: float, episodes: int) -> float:
    """Fall of a success rate in standard errors: the two-proportion z statistic, pooled variance."""
    pooled = (best + now) / 2
    error = math.sqrt(2 * pooled * (1 - pooled) / episodes)
    return (best - now) / error if error > 0 else 0.0
