"""LeRobot checkpoints of a fine-tuning run, from which it continues exactly.

``checkpoints/NNNNNN/pretrained_model`` is a policy that ``lerobot-eval`` loads, with its processors;
``training_state`` holds the critic, both optimisers, the reward scale, and every rank's random states.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from lerobot.common.train_utils import get_step_checkpoint_dir, update_last_checkpoint
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)
from lerobot.utils.random_utils import deserialize_rng_state, serialize_rng_state

from lerobot_vtrefine.finetune.distributed import barrier, num_ranks, rank_index
from lerobot_vtrefine.finetune.dppo import TrainState

STATE_NAME = "dppo_state.pt"


@dataclass
class Saveable:
    """What a checkpoint contains besides the training state; each has LeRobot's ``save_pretrained``."""

    policy: Any
    preprocessor: Any
    postprocessor: Any


def last_checkpoint(output_dir: Path) -> Path | None:
    """The newest complete checkpoint of a run, if there is one."""
    path = output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK
    return path.resolve() if path.exists() else None


def save_checkpoint(output_dir: Path, saveable: Saveable, state: TrainState, total: int) -> None:
    """Write a checkpoint after ``state.iteration`` of ``total`` iterations; all ranks take part.

    It is written beside its place and moved there when complete, so an interrupted run never leaves half of
    one.
    """
    ranks: list[Any] = [_random_states(state)]
    if num_ranks() > 1:
        ranks = [None] * num_ranks()
        dist.all_gather_object(ranks, _random_states(state))
    if rank_index() == 0:
        final = get_step_checkpoint_dir(output_dir, total, state.iteration)
        partial = final.with_name(f"{final.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        for part in (saveable.policy, saveable.preprocessor, saveable.postprocessor):
            part.save_pretrained(partial / PRETRAINED_MODEL_DIR)
        (partial / TRAINING_STATE_DIR).mkdir()
        torch.save(_state_dict(state) | {"ranks": ranks}, partial / TRAINING_STATE_DIR / STATE_NAME)
        shutil.rmtree(final, ignore_errors=True)
        partial.rename(final)
        update_last_checkpoint(final)
    barrier()


def load_training_state(checkpoint: Path, state: TrainState) -> None:
    """Restore everything but the policy's weights.

    Raises:
        FileNotFoundError: the checkpoint has no DPPO training state.
        ValueError: it was written by another number of ranks.
    """
    path = checkpoint / TRAINING_STATE_DIR / STATE_NAME
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: this is not a checkpoint of vtrefine-finetune")
    saved = torch.load(path, map_location="cpu", weights_only=True)
    if len(saved["ranks"]) != num_ranks():
        raise ValueError(f"{checkpoint} was written by {len(saved['ranks'])} processes: resume with as many")
    state.critic.load_state_dict(saved["critic"])
    state.actor_optimizer.load_state_dict(saved["actor_optimizer"])
    state.critic_optimizer.load_state_dict(saved["critic_optimizer"])
    state.reward_scaler.load_state_dict(saved["reward_scaler"])
    state.trust_region.load_state_dict(saved["trust_region"])
    state.rollback.load_state_dict(saved["rollback"], state.generator.device)
    state.iteration, state.env_steps = saved["iteration"], saved["env_steps"]
    own = saved["ranks"][rank_index()]
    state.generator.set_state(own["generator"])
    deserialize_rng_state(own["global"])


def _state_dict(state: TrainState) -> dict[str, Any]:
    return {
        "critic": state.critic.state_dict(),
        "actor_optimizer": state.actor_optimizer.state_dict(),
        "critic_optimizer": state.critic_optimizer.state_dict(),
        "reward_scaler": state.reward_scaler.state_dict(),
        "rollback": state.rollback.state_dict(),
        "trust_region": state.trust_region.state_dict(),
        "iteration": state.iteration,
        "env_steps": state.env_steps,
    }


def _random_states(state: TrainState) -> dict[str, Any]:
    return {"generator": state.generator.get_state(), "global": serialize_rng_state()}
