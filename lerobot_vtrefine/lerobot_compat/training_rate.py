"""Says before ``lerobot-train`` begins that its evaluations would run at another rate than the dataset's.

A policy's chunks would be played faster or slower than they were recorded, in every evaluation, and nothing
but a low success rate would tell. ``lerobot-eval`` gives the policy the environment's features, so the policy
refuses by itself there; in ``lerobot-train`` it is given the dataset's.
"""

import functools
import sys
from typing import Any

from lerobot_vtrefine.lerobot_compat.guard import is_supported

TRAINING = "lerobot.scripts.lerobot_train"
ENVIRONMENT = "vtrefine"


def install() -> None:
    """Check whatever ``lerobot-train`` opens in this process from now on. Idempotent."""
    module: Any = sys.modules.get(TRAINING)
    if module is None or not is_supported() or hasattr(module.make_train_eval_datasets, "__wrapped__"):
        return
    stock = module.make_train_eval_datasets

    @functools.wraps(stock)
    def checked(cfg: Any) -> Any:
        found = stock(cfg)
        if cfg.env_eval_freq > 0:
            check_rate(cfg.env, found[0].meta.fps)
        return found

    module.make_train_eval_datasets = checked


def check_rate(env: Any, fps: int) -> None:
    """Compare an environment's configuration, or None, with a dataset's frames a second.

    Raises:
        SystemExit: it is an environment of this package and takes actions at another rate.
    """
    if env is not None and env.type == ENVIRONMENT and env.fps != fps:
        raise SystemExit(
            f"error: --env.fps={env.fps}, but the dataset holds {fps:g} actions a second: give"
            f" --env.fps={fps:g}"
        )
