"""Configuration of the simulated robot."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from draccus.utils import DraccusException
from lerobot.envs.configs import EnvConfig
from lerobot.robots.config import RobotConfig

from lerobot_vtrefine.choices import check_choice, check_port, check_seed
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.files import read_yaml
from lerobot_vtrefine.lerobot_compat.config_errors import told_by_lerobot
from lerobot_vtrefine.sim.config import check_control_rate

TYPE = "vtrefine"
VIEWS = ("none", "browser")


@RobotConfig.register_subclass("vtrefine_sim")
@dataclass(kw_only=True)
class VtRefineSimConfig(RobotConfig):
    """The simulation as a robot.

    Attributes:
        env_file: Environment file, as lerobot-eval's --config_path takes it: vtrefine:round_table, or a path.
        env: Fields of --env.type=vtrefine that win over the file's, such as "{pair: square}".
        seed: Episode i of a dataset starts from seed + i: its parts stand where this seed puts them.
        fps: Control steps and observations per simulated second, 1 to 100; the command must run at the same
            rate.
        episode_s: Time-out of an episode [s]: people take longer than what an environment gives a policy.
        end_episodes: End a recorded episode at success, failure or time-out; otherwise at LeRobot's keys and
            times only.
        pause_s: Without recording, the time between two episodes [s]: half of it the old one goes on, half of
            it the new one stands still, and commands have no effect. Give at least twice the time for which
            a policy decides at once.
        view: none, or browser: the live view of vtrefine-play.
        view_port: Port of the live view.
    """

    env_file: Path | None = None
    env: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    fps: int = 10
    episode_s: float = 60.0
    end_episodes: bool = True
    pause_s: float = 2.0
    view: str = "none"
    view_port: int = 8080

    @told_by_lerobot
    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("--robot.view", self.view, VIEWS)
        check_port("--robot.view_port", self.view_port)
        check_seed("--robot.seed", self.seed)
        check_control_rate("--robot.fps", self.fps)
        if not 1 <= self.episode_s <= 3600:
            raise ValueError(f"--robot.episode_s must lie between 1 and 3600, got {self.episode_s}")
        self.simulation()

    def simulation(self) -> VtRefineEnvConfig:
        """The environment that this robot lives in.

        Raises:
            ValueError: the file or a field is wrong.
        """
        given = {} if self.env_file is None else _env_of(self.env_file)
        steps = {"episode_steps": round(self.episode_s * self.fps)}
        values = {"type": TYPE, **steps, **given, **self.env, "fps": self.fps}
        try:
            env = draccus.decode(EnvConfig, values)
        except (DraccusException, ValueError, TypeError) as error:
            raise ValueError(f"--robot.env: {error}") from error
        if not isinstance(env, VtRefineEnvConfig):
            raise ValueError(f"--robot.env: type {env.type} is not a simulation of this package; use {TYPE}")
        return env


def _env_of(path: Path) -> dict[str, Any]:
    values = read_yaml(path)
    if not isinstance(values, dict) or not isinstance(values.get("env"), dict):
        raise ValueError(f"{path} has no part `env:`, as the files of configs/env have")
    return values["env"]
