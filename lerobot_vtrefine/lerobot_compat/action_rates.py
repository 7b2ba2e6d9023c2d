"""Says before LeRobot's commands begin that a policy would be played at another rate than it learned.

Its chunks would be played faster or slower than they were recorded, in simulation or by real arms, and
nothing but a low success rate would tell: ``lerobot-rollout`` takes 30 actions a second by default,
and ``lerobot-train`` evaluates at any. ``lerobot-eval`` gives the policy the environment's features, so the
policy refuses by itself there; in ``lerobot-train`` it is given the dataset's.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any

from lerobot_vtrefine.lerobot_compat.guard import is_supported

TRAINING = "lerobot.scripts.lerobot_train"
ROLLOUT = "lerobot.scripts.lerobot_rollout"
ENVIRONMENT = "vtrefine"


def install() -> None:
    """Check what ``lerobot-train`` and ``lerobot-rollout`` open in this process from now on. Idempotent."""
    _wrap(TRAINING, "make_train_eval_datasets", _checked_training)
    _wrap(ROLLOUT, "build_rollout_context", _checked_rollout)


def _wrap(command: str, name: str, checked: Callable[[Any], Any]) -> None:
    module = sys.modules.get(command)
    if module is not None and is_supported() and not hasattr(getattr(module, name), "__wrapped__"):
        setattr(module, name, checked(getattr(module, name)))


def _checked_training(stock: Any) -> Any:
    @functools.wraps(stock)
    def checked(cfg: Any) -> Any:
        found = stock(cfg)
        if cfg.env_eval_freq > 0:
            check_rate(cfg.env, found[0].meta.fps)
        return found

    return checked


def _checked_rollout(stock: Any) -> Any:
    @functools.wraps(stock)
    def checked(cfg: Any, *args: Any, **settings: Any) -> Any:
        if hasattr(cfg.policy, "check_fps"):
            try:
                cfg.policy.check_fps(cfg.fps, "--fps")
            except ValueError as error:
                raise SystemExit(f"error: {error}") from error
        return stock(cfg, *args, **settings)

    return checked


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
