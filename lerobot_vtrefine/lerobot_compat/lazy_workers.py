"""LeRobot's stand-in for a vector environment whose worker processes start at the first reset."""

from lerobot.envs.utils import _LazyAsyncVectorEnv as LazyAsyncVectorEnv

__all__ = ["LazyAsyncVectorEnv"]
