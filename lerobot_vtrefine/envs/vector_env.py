"""The natively batched Gymnasium environment: one simulation object steps every world."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from lerobot_vtrefine.datasets.features import raw_to_env_observation
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Array, ControlStep, Episodes
from lerobot_vtrefine.envs.factory import check_count, make_episodes
from lerobot_vtrefine.envs.rendering import EvalFrame, FrameSource, LazyFrames, eval_frame
from lerobot_vtrefine.envs.spaces import action_space, observation_space
from lerobot_vtrefine.wording import plural

Observation = dict[str, Any]
SEED_LIMIT = 2**31


class VtRefineVectorEnv(gym.vector.VectorEnv[Observation, Array, Array]):
    """``num_envs`` insertion episodes stepped together.

    - ``reset(seed=[...])``: each episode is a pure function of its seed; ``options={"reset_mask": (n,)
      bool}`` restarts only those environments.
    - There is no autoreset: a finished environment costs nothing, repeats its last observation and flags with
      reward 0, and waits for a reset. This is what ``lerobot-eval`` needs.
    - ``info["is_success"]`` is (n,) bool; ``info["final_info"]`` appears in steps in which an episode ends
      and holds the same plus how finished episodes went: ``failure`` (n,) str names the reason, see
      ``Episodes.summary``.
    - With ``--env.shear.on=true``, ``info["shear"]`` is (n, pads, taxels, 2) float32: tangential force per
      taxel [N], of every control step.
    - Observations are those of ``datasets.features.env_observation_shapes`` with a leading ``n``.
    - A pickled or copied environment keeps its settings and its generator, and waits for a reset.

    Raises: ValueError for fewer than one environment.
    """

    def __init__(self, config: VtRefineEnvConfig, num_envs: int) -> None:
        check_count(num_envs)
        self.config = config
        self.num_envs = num_envs
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": config.fps,
            "autoreset_mode": AutoresetMode.DISABLED,
        }
        self.render_mode = "rgb_array"
        self.single_observation_space = observation_space(config)
        self.single_action_space = action_space(config)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._first_episode = -num_envs
        self._episodes: Episodes | None = None
        self._frames: FrameSource | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_episodes": None, "_frames": None}

    @property
    def episodes(self) -> Episodes:
        """The running simulation; built on first use and again after ``close``."""
        if self._episodes is None:
            self._episodes = make_episodes(self.config, self.num_envs)
            self.closed = False
        return self._episodes

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes, in all environments or in ``options["reset_mask"]``."""
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(f"reset_mask must be a bool array of shape ({self.num_envs},), got {mask.shape}")
        if self._episodes is None and not mask.all():
            raise ValueError("the first reset must restart every environment")
        ids = np.flatnonzero(mask)
        self._first_episode += self.num_envs if mask.all() else 0
        self.episodes.reset(ids, self._seeds(seed)[ids])
        return self._observation(), {"is_success": np.zeros(self.num_envs, bool), **self._shear()}

    def step(self, actions: Array) -> tuple[Observation, Array, Array, Array, dict[str, Any]]:
        """One control step with absolute joint targets (n, J) in rad and m."""
        if np.shape(actions) != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}, got {np.shape(actions)}")
        if not self.episodes.raw:
            raise gym.error.ResetNeeded("call reset() before step()")
        result = self.episodes.step(actions)
        return self._observation(), result.reward, result.terminated, result.truncated, self._info(result)

    def call(self, name: str, *args: Any, **kwargs: Any) -> Sequence[Any]:
        """Gymnasium's per-environment call; frames are for ``lerobot-eval``: drawn when indexed, and only
        those of the first ``video_episodes`` episodes (``EvalFrame``).
        """
        if name == "render":
            return LazyFrames(self._eval_frame, self.num_envs)
        return self.get_attr(name)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """One value per environment of ``task``, ``task_description``, ``_max_episode_steps``, ..."""
        values = {
            "task": self.config.task,
            "task_description": self.config.task,
            "_max_episode_steps": self.config.max_episode_steps,
        }
        value = values[name] if name in values else getattr(self, name)
        return (value,) * self.num_envs

    def render(self) -> tuple[Array, ...]:
        """A uint8 (H, W, 3) frame of every environment: the scene beside its pads."""
        return tuple(self.render_env(index) for index in range(self.num_envs))

    def render_env(self, index: int) -> Array:
        """The frame of one environment."""
        if self._frames is None:
            self._frames = FrameSource(self.episodes, self.config.menagerie_dir)
        return self._frames.frame(index)

    def _eval_frame(self, index: int) -> EvalFrame:
        wanted = self._first_episode + index < self.config.video_episodes
        return eval_frame(lambda: self.render_env(index), wanted)

    def close_extras(self, **kwargs: Any) -> None:
        """Release simulation and renderers; a later reset builds them again."""
        if self._frames is not None:
            self._frames.close()
        self._frames = None
        self._episodes = None

    def _seeds(self, seed: int | Sequence[int | None] | None) -> Array:
        if seed is None or isinstance(seed, int | np.integer):
            if seed is None:
                return self.np_random.integers(SEED_LIMIT, size=self.num_envs)
            self._np_random, self._np_random_seed = np_random(int(seed))
            return int(seed) + np.arange(self.num_envs)
        if len(seed) != self.num_envs:
            raise ValueError(f"got {plural(len(seed), 'seed')} for {plural(self.num_envs, 'environment')}")
        drawn = self.np_random.integers(SEED_LIMIT, size=self.num_envs)
        return np.array([d if s is None else s for s, d in zip(seed, drawn, strict=True)], np.int64)

    def _observation(self) -> Observation:
        # Nothing of the raw frames themselves: these change in place, and callers keep observations.
        raw = self.episodes.raw
        return _own(raw_to_env_observation(raw, self.config.body), raw)

    def _shear(self) -> dict[str, Array]:
        return {"shear": self.episodes.sim.shear()} if self.config.shear.on else {}

    def _info(self, result: ControlStep) -> dict[str, Any]:
        info: dict[str, Any] = {"is_success": result.success, **self._shear()}
        if len(result.finished):
            summary = self.episodes.summary(self.episodes.ids)
            info["final_info"] = {**summary, "is_success": result.success.copy()}
            info["_final_info"] = np.isin(np.arange(self.num_envs), result.finished)
        return info


def _own(value: Any, raw: Observation) -> Any:
    """The value, copied where it is part of a raw frame; of a dict, its values."""
    if isinstance(value, dict):
        return {key: _own(item, raw) for key, item in value.items()}
    return value.copy() if any(np.may_share_memory(value, item) for item in raw.values()) else value
