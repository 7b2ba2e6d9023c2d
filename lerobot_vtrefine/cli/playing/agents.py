"""Who moves the arms in `vtrefine-play`. Shapes: J joints."""

import logging
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.datasets.episodes import EpisodeFolder, open_episodes
from lerobot_vtrefine.datasets.features import raw_to_env_observation
from lerobot_vtrefine.diagnose.episode_replay.twin import (
    describe_other_task,
    read_ledger,
    recorded_seeds,
    recorded_twin,
)
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.live_world import IDS, LiveWorld
from lerobot_vtrefine.lerobot_compat.registration import register
from lerobot_vtrefine.observation import VisuoTactileConfig
from lerobot_vtrefine.sim.demonstrations import Degradation

Array = np.ndarray


class Agent(Protocol):
    """Gives joint targets."""

    def reset(self, world: LiveWorld) -> None:
        """A new episode has begun."""
        ...

    def act(self, world: LiveWorld) -> Array | None:
        """Absolute joint targets (J,) for the next control step; None when it has nothing more to do."""
        ...


class ExpertAgent:
    """The scripted expert."""

    def reset(self, world: LiveWorld) -> None:
        """Begin with the parts where they are."""
        from lerobot_vtrefine.sim.expert import ScriptedExpert

        self._expert = ScriptedExpert(world.sim, Degradation())
        self._expert.reset(IDS)

    def act(self, world: LiveWorld) -> Array | None:
        """The expert's next targets."""
        return self._expert.act(IDS)[0]


class ZeroAgent:
    """Holds the arms where the episode starts."""

    def reset(self, world: LiveWorld) -> None:
        """Remember the start."""
        self._targets = world.sim.command_targets()[0].copy()

    def act(self, world: LiveWorld) -> Array | None:
        """The same targets."""
        return self._targets


class RandomAgent:
    """Targets anywhere within the joints' limits; the simulation limits their speed."""

    def reset(self, world: LiveWorld) -> None:
        """Draw from the episode's seed."""
        self._rng = np.random.default_rng(world.seed)

    def act(self, world: LiveWorld) -> Array | None:
        """Uniform targets."""
        body = world.sim.embodiment
        return self._rng.uniform(body.lower, body.upper)


class PolicyAgent:
    """Any LeRobot policy that fits the environment, through its own processors.

    Raises:
        ValueError: the checkpoint cannot be found or read, or does not fit the environment.
    """

    def __init__(self, path: str, env: VtRefineEnvConfig, device: str | None) -> None:
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.policies.factory import make_policy, make_pre_post_processors

        register()  # a checkpoint may be of this package's policy
        try:
            config = PreTrainedConfig.from_pretrained(path)
        except (OSError, ValueError, TypeError) as error:
            raise ValueError(
                f"--policy.path={path} holds no checkpoint of LeRobot (a folder with config.json and"
                f" model.safetensors, or a name on the Hub): {error}"
            ) from error
        config.pretrained_path = Path(path)
        config.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self.policy = make_policy(cfg=config, env_cfg=env)
        self.policy.eval()
        self._preprocess, self._postprocess = make_pre_post_processors(
            policy_cfg=config,
            pretrained_path=path,
            preprocessor_overrides={"device_processor": {"device": config.device}},
        )
        self.cloud: VisuoTactileConfig | None = getattr(config, "observation", None)

    def reset(self, world: LiveWorld) -> None:
        """Forget the last episode; the policy's noise then follows from the seed."""
        torch.manual_seed(world.seed)
        self.policy.reset()

    def act(self, world: LiveWorld) -> Array | None:
        """The policy's next action."""
        from lerobot.envs.utils import preprocess_observation

        batched: dict[str, Any] = {key: value[None] for key, value in world.raw.items()}
        observation = preprocess_observation(raw_to_env_observation(batched, world.config.body))
        with torch.inference_mode():
            action = self.policy.select_action(self._preprocess({**observation, "task": [world.config.task]}))
            return self._postprocess(action)[0].cpu().numpy()


class RecordedAgent:
    """The commands of a recorded episode."""

    def __init__(self, folder: EpisodeFolder, episode: int) -> None:
        self._actions = folder.read([episode])[0].action

    def reset(self, world: LiveWorld) -> None:
        """Begin with the first command."""
        self._next = iter(self._actions)

    def act(self, world: LiveWorld) -> Array | None:
        """The next command; None after the last."""
        return next(self._next, None)


def scripted_agent(name: str) -> Agent:
    """The agent of ``--agent``. Raises: ValueError for another name."""
    agents = {"expert": ExpertAgent, "zero": ZeroAgent, "random": RandomAgent}
    check_choice("--agent", name, agents)
    return agents[name]()


def recorded_agent(
    root: Path, episode: int, env: VtRefineEnvConfig | None
) -> tuple[RecordedAgent, VtRefineEnvConfig, int | None]:
    """A dataset's episode, the simulation that it plays in, and its seed where the dataset notes it.

    Raises:
        ValueError: no such episode, or a dataset of another robot or of another rate than ``env``.
        FileNotFoundError: no dataset.
    """
    folder = open_episodes(root)
    if env is not None:
        folder.check_rate(env.fps)
    agent, ledger = RecordedAgent(folder, episode), read_ledger(folder)
    if ledger is None:
        return agent, env or VtRefineEnvConfig(fps=round(folder.fps)), None
    for remark in [] if env is None else describe_other_task(ledger, env):
        logging.warning(remark)
    return agent, env or recorded_twin(ledger, folder.fps), recorded_seeds(ledger, folder)[episode]
