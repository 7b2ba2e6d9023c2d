"""EnvHub entry point: upload this file as `env.py` of a Hub repository, and LeRobot makes the environment.

    from lerobot.envs.factory import make_env
    envs = make_env("USER/REPOSITORY", n_envs=4, trust_remote_code=True)

It needs `pip install 'lerobot_policy_vtrefine[sim]'`. Change `settings` for another pair or start.
"""

from typing import Any

from lerobot_vtrefine.envs import VtRefineEnvConfig


def settings() -> VtRefineEnvConfig:
    """What this repository's environment is."""
    return VtRefineEnvConfig(pair="round", clearance_m=0.002, start="grasped")


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> dict[str, dict[int, Any]]:
    """LeRobot's {suite: {task: vector environment}}; `cfg` is used where it is one of this package."""
    config = cfg if isinstance(cfg, VtRefineEnvConfig) else settings()
    return config.create_envs(n_envs, use_async_envs)
