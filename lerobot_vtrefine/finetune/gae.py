"""Advantages over decisions, and reward scaling.

Grids are (S, E): decision S of environment E. Environments finish at different times; afterwards they idle
and their entries are ignored (``active`` is False).
"""

import torch
from torch import Tensor

from lerobot_vtrefine.finetune.distributed import sum_over_ranks


def generalised_advantages(
    reward: Tensor,
    values: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    active: Tensor,
    *,
    gamma: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor]:
    """GAE (Schulman et al. 2016), discounting per decision.

    reward (S, E); values (S+1, E), where values[s + 1] belongs to the state *after* decision s (the final
    state of a finished episode, never the first of the next); terminated, truncated, active (S, E) bool.
    Termination has no future value. A truncated episode, and one cut off by the end of the segment, keeps
    the value of its last state.

    Returns: advantages and value targets (S, E), zero where inactive.
    """
    advantages = torch.zeros_like(reward)
    carry = torch.zeros_like(reward[0])
    for step in range(reward.shape[0] - 1, -1, -1):
        next_value = values[step + 1] * ~terminated[step]
        delta = reward[step] + gamma * next_value - values[step]
        ended = terminated[step] | truncated[step]
        carry = (delta + gamma * gae_lambda * carry * ~ended) * active[step]
        advantages[step] = carry
    return advantages, (advantages + values[:-1]) * active


class RewardScaler:
    """Divides rewards by the running standard deviation of the discounted return.

    The statistics persist over iterations and are shared by all ranks; scaled rewards are clipped to ±10.
    """

    DISCOUNT = 0.99
    CLIP = 10.0

    def __init__(self) -> None:
        self.count, self.mean, self.m2 = 0.0, 0.0, 0.0

    def __call__(self, reward: Tensor, active: Tensor) -> Tensor:
        """reward, active (S, E), episodes starting at step 0 -> scaled reward (S, E)."""
        returns, running = torch.zeros_like(reward), torch.zeros_like(reward[0])
        for step in range(reward.shape[0]):
            running = self.DISCOUNT * running + reward[step]
            returns[step] = running
        self._update(returns[active].double())
        variance = self.m2 / max(self.count, 1.0)
        return (reward / (variance + 1e-8) ** 0.5).clamp(-self.CLIP, self.CLIP)

    def _update(self, values: Tensor) -> None:
        """Merge a batch into the running moments (Chan et al. 1979)."""
        size = torch.full((), values.numel(), dtype=values.dtype, device=values.device)
        moments = sum_over_ranks(torch.stack([size, values.sum(), (values**2).sum()]))
        count, total, squares = moments.tolist()
        if count == 0:
            return
        mean, merged = total / count, self.count + count
        shift = mean - self.mean
        self.m2 += squares - count * mean**2 + shift**2 * self.count * count / merged
        self.mean += shift * count / merged
        self.count = merged

    def state_dict(self) -> dict[str, float]:
        """The running moments."""
        return {"count": self.count, "mean": self.mean, "m2": self.m2}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore ``state_dict``."""
        self.count, self.mean, self.m2 = state["count"], state["mean"], state["m2"]
