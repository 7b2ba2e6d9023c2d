"""Laws of the cover, and on what part of the contact's force they act."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import torch

from lerobot_vtrefine.tactile.stages.base import Stage


@dataclass(frozen=True)
class CoverLaw(Stage):
    """Base of the laws that make another force of the contact's, taxel by taxel.

    They act on the whole force; with `elastic` on what the springs of the contact bear alone, beside which
    its dashpots push as before: k_n d becomes k_n d^p, say, and k_d d' stays; together they never pull.
    """

    domain: ClassVar[str] = "force"
    alike: ClassVar[bool] = True
    elastic: bool = field(default=False, kw_only=True)


def on_springs(stage: Stage) -> bool:
    """Whether a stage must know which part of the contact's force damping bears."""
    return isinstance(stage, CoverLaw) and stage.elastic


def passed(
    stage: Stage,
    force: torch.Tensor,
    damping: torch.Tensor | None,
    run: Callable[[torch.Tensor], torch.Tensor],
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Force and the part of it that damping bears, after a stage.

    Args:
        damping: of the force before; None where no stage asks for it.
        run: the stage's work on one of the two.
    """
    if damping is None:
        return run(force), None
    if on_springs(stage):
        return (run(force - damping) + damping).clamp(min=0.0) * (force > 0), damping
    return run(force), run(damping) if stage.spreads else damping
