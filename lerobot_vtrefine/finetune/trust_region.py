"""How far one iteration may move the policy, in units of behaviour: KL divergence per decision [nats].

Log-probabilities are averaged over all action elements, so PPO's clip range binds late; what decides before
is the learning rate, and the right one depends on batch, network and task. Here the rate follows from the
divergence that the last iteration reached, and the target falls geometrically, so that learning starts fast
and settles.

Where clipping does hold the policy nearer than the target, no rate reaches it: the rate would wind up by half
in every iteration, and shake the network without moving the policy further. ``actor_lr_max`` ends that.
"""

import math
from collections.abc import Sequence

from lerobot_vtrefine.finetune.config import DppoConfig

TOO_FAR = 2.0
"""Times the target at which an iteration's update ends."""
SLOWEST, FASTEST = 0.5, 1.5
"""Bounds of the change of the learning rate from one iteration to the next."""


class TrustRegion:
    """The actor's learning rate: the configured schedule, or what reaches ``cfg.kl_per_decision``."""

    def __init__(self, cfg: DppoConfig) -> None:
        self.cfg = cfg
        self.rate = cfg.actor_lr
        self.scale = 1.0
        """Of the aim and of the squared rate; less once steps were undone."""
        self._highest = max(cfg.actor_lr, cfg.actor_lr_max) if cfg.actor_lr_max else math.inf

    def target(self, iteration: int) -> float:
        """KL divergence per decision that this iteration aims at; 0 where the rate follows its schedule."""
        cfg = self.cfg
        progress = min(1.0, iteration / max(1, cfg.iterations - 1))
        return self.scale * cfg.kl_per_decision ** (1 - progress) * cfg.kl_per_decision_final**progress

    def actor_lr(self, iteration: int) -> float:
        """Learning rate of this iteration."""
        return self.rate if self.cfg.kl_per_decision else self.scale**0.5 * self.cfg.actor_lr_at(iteration)

    def left(self, kl: float, iteration: int) -> bool:
        """Whether a minibatch finds the policy too far from where the iteration began."""
        return self.cfg.kl_per_decision > 0 and kl > TOO_FAR * self.target(iteration)

    def adapt(self, reached: Sequence[float], stopped: bool, iteration: int) -> None:
        """Set the next iteration's rate from the divergences (m,) of this one's last epoch.

        They grow with the square of the rate. ``stopped``: the iteration left the region and went no
        further.
        """
        if not self.cfg.kl_per_decision or not (reached or stopped):
            return
        target = self.target(iteration)
        furthest = (TOO_FAR + 1) * target if stopped else max(reached)
        change = min(max((target / max(furthest, 1e-9)) ** 0.5, SLOWEST), FASTEST)
        self.rate = min(self.rate * change, self._highest)

    def shrink(self) -> None:
        """Take steps half as large [nats] from now on; they grow with the square of the rate."""
        self.scale /= 2
        self.rate /= 2**0.5

    @property
    def slower(self) -> str:
        """The flags by which a run takes smaller steps, also one that is resumed."""
        return "--dppo.actor_lr and --dppo.actor_lr_max" if self.cfg.kl_per_decision else "--dppo.actor_lr"

    def state_dict(self) -> dict[str, float]:
        """The present rate and scale."""
        return {"rate": self.rate, "scale": self.scale}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore ``state_dict``; a limit that is lower by now holds at once."""
        self.rate = min(state["rate"], self._highest)
        self.scale = state.get("scale", 1.0)  # not in checkpoints of earlier versions
