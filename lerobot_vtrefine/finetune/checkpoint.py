"""LeRobot checkpoints of a fine-tuning run, from which it continues exactly.

``checkpoints/NNNNNN/pretrained_model`` is a policy that ``lerobot-eval`` loads, with its processors and the
run's settings (``train_config.json``); ``training_state`` holds the critic, both optimisers, the reward
scale, and every rank's random states.
"""

import shutil
from collections.abc import Generator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch.distributed as dist
from lerobot.common.train_utils import get_step_checkpoint_dir
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)
from lerobot.utils.random_utils import deserialize_rng_state, serialize_rng_state

from lerobot_vtrefine.files.weights import naming_full_disk
from lerobot_vtrefine.finetune.distributed import barrier, num_ranks, rank_index
from lerobot_vtrefine.finetune.dppo import TrainState
from lerobot_vtrefine.finetune.state_file import load_state, save_state
from lerobot_vtrefine.folders import flush, sync
from lerobot_vtrefine.lerobot_compat.claim import Claim
from lerobot_vtrefine.wording import plural

STATE_NAME = "dppo_state.safetensors"
PARTS = ("critic", "actor_optimizer", "critic_optimizer", "reward_scaler", "trust_region", "undo")
"""Of `TrainState`: what has a ``state_dict``."""


@dataclass
class Saveable:
    """What a checkpoint contains besides the training state; each has LeRobot's ``save_pretrained``."""

    policy: Any
    preprocessor: Any
    postprocessor: Any
    config: Any

    def save(self, folder: Path) -> None:
        """Write everything to ``pretrained_model``.

        Raises: OSError where the disk is full; names the folder, or the file.
        """
        with naming_full_disk(folder):
            for part in (self.policy, self.preprocessor, self.postprocessor, self.config):
                part.save_pretrained(folder)


def last_checkpoint(output_dir: Path) -> Path | None:
    """The newest complete checkpoint of a run, if there is one; whether or not ``last`` points to it yet."""
    steps = output_dir.resolve().glob(f"{CHECKPOINTS_DIR}/*/{TRAINING_STATE_DIR}/{STATE_NAME}")
    complete = [path.parents[1] for path in steps if path.parents[1].name.isdigit()]
    return max(complete, key=lambda path: int(path.name), default=None)


def foreign_checkpoints(output_dir: Path) -> list[Path]:
    """Checkpoints in a folder that are no fine-tuning run's, such as `lerobot-train`'s."""
    steps = (output_dir / CHECKPOINTS_DIR).glob("*/")
    named = [path for path in steps if path.name.isdigit()]
    return sorted(path for path in named if not (path / TRAINING_STATE_DIR / STATE_NAME).is_file())


@contextmanager
def claimed(output_dir: Path) -> Generator[None]:
    """Make a run's folder, and keep other runs out of it: their curves and checkpoints would be mixed.

    Raises: ValueError where another run goes on in it.
    """
    output_dir.mkdir(parents=True, exist_ok=True)
    if rank_index() > 0:  # the first rank speaks for all
        yield
        return
    with closing(Claim(output_dir, "run", "--output_dir")):
        yield


def point_last_at(checkpoint: Path) -> None:
    """Let ``last`` name this checkpoint; at no moment is there no ``last`` when there was one before."""
    link = checkpoint.with_name(LAST_CHECKPOINT_LINK)
    fresh = link.with_name(f"{LAST_CHECKPOINT_LINK}.partial")
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(checkpoint.name)
    fresh.replace(link)


def save_checkpoint(output_dir: Path, saveable: Saveable, state: TrainState, total: int) -> None:
    """Write a checkpoint after ``state.iteration`` of ``total`` iterations; all ranks take part.

    It is written beside its place and moved there when complete and on the disk, so an interrupted run, or a
    machine that stops, never leaves half of one.
    """
    ranks: list[Any] = [_random_states(state)]
    if num_ranks() > 1:
        ranks = [None] * num_ranks()
        dist.all_gather_object(ranks, _random_states(state))
    if rank_index() == 0:
        final = get_step_checkpoint_dir(output_dir, total, state.iteration)
        partial = final.with_name(f"{final.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        saveable.save(partial / PRETRAINED_MODEL_DIR)
        (partial / TRAINING_STATE_DIR).mkdir()
        parts = {part: getattr(state, part).state_dict() for part in PARTS}
        counts = {"iteration": state.iteration, "env_steps": state.env_steps}
        save_state({**parts, **counts, "ranks": ranks}, partial / TRAINING_STATE_DIR / STATE_NAME)
        flush(partial)  # or a power failure could leave the name and empty files
        shutil.rmtree(final, ignore_errors=True)
        partial.rename(final)
        sync(final.parent)
        point_last_at(final)
    barrier()


def load_training_state(checkpoint: Path, state: TrainState) -> None:
    """Restore everything but the policy's weights; the run's ``last`` names this checkpoint from now on.

    Raises:
        FileNotFoundError: the checkpoint has no DPPO training state.
        ValueError: it is damaged, or was written by another number of ranks.
    """
    path = checkpoint / TRAINING_STATE_DIR / STATE_NAME
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: this is not a checkpoint of this vtrefine-finetune")
    saved = load_state(path)
    if len(saved["ranks"]) != num_ranks():
        raise ValueError(
            f"{checkpoint} was written by {plural(len(saved['ranks']), 'process')}: resume with as many"
        )
    saved.setdefault("undo", {})  # not in checkpoints of earlier versions
    for part in PARTS:
        getattr(state, part).load_state_dict(saved[part])
    state.iteration, state.env_steps = saved["iteration"], saved["env_steps"]
    if rank_index() == 0:
        point_last_at(checkpoint)
    own = saved["ranks"][rank_index()]
    state.generator.set_state(own["generator"])
    deserialize_rng_state(own["global"])


def _random_states(state: TrainState) -> dict[str, Any]:
    return {"generator": state.generator.get_state(), "global": serialize_rng_state()}
