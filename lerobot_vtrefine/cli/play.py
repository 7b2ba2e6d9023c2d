"""``vtrefine-play``: show the simulation live in a browser, moved by a policy, an expert or a recording.

examples:
  vtrefine-play                                        # the trained policy that comes with the package
  vtrefine-play --viewer=none --episodes=20            # how often it succeeds
  vtrefine-play --config_path=vtrefine:round_table     # the scripted expert, both parts from the table
  vtrefine-play --config_path=vtrefine:round_grasped --policy.path=CHECKPOINT
"""

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import parser
from lerobot.configs.default import EvalConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.utils import init_logging

from lerobot_vtrefine.choices import check_choice, check_port, check_seed
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.outputs import check_folder
from lerobot_vtrefine.cli.playing.agents import Agent, PolicyAgent, recorded_agent, scripted_agent
from lerobot_vtrefine.cli.playing.session import Session
from lerobot_vtrefine.cli.report.statistics import wilson_interval
from lerobot_vtrefine.embodiments.menagerie import FLAG as LOOKS
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.config import checked_env
from lerobot_vtrefine.extras import VIEW, require
from lerobot_vtrefine.shipped import expand

SHOWN = ("--config_path=vtrefine:square_grasped_1mm", "--policy.path=vtrefine:square_grasped_1mm")
"""What is played where nothing is said about it."""
CHOICES = ("--config_path", "--env", "--agent", "--policy.path", "--dataset")
"""Flags that say what is played; how it looks (`LOOKS`) does not."""
VIEWERS = ("browser", "none")


@dataclass
class PolicySource:
    """A trained policy."""

    path: str | None = None
    """Its checkpoint: a folder, vtrefine:NAME for one that comes with the package, or a name on the Hub."""
    device: str | None = None
    """Where it runs; a GPU if there is one, by default."""


@dataclass
class EpisodeSource:
    """A recorded episode."""

    root: Path | None = None
    """The dataset's folder."""
    episode: int = 0
    """Which episode, from 0."""


@dataclass
class PlayConfig:
    """Flags of ``vtrefine-play``."""

    env: EnvConfig | None = None
    """What is played (--env.pair=square ...); by default the round pair from the table, or what the dataset
    was recorded in."""
    agent: str = "expert"
    """expert, zero (the arms hold still) or random; a policy or a dataset comes first."""
    policy: PolicySource = field(default_factory=PolicySource)
    """A trained policy that moves the arms."""
    dataset: EpisodeSource = field(default_factory=EpisodeSource)
    """A recorded episode that is played again."""
    viewer: str = "browser"
    """browser, or none: as fast as the machine can, for counting successes."""
    port: int = 8080
    """Port of the page, which only this machine can open."""
    episodes: int | None = None
    """Stop after so many; by default never with a viewer, after one without, after the dataset's episode."""
    seed: int | None = None
    """Seed of the first episode, later ones count up; by default 0, or the recorded episode's."""
    record: bool = False
    """Write a video of every episode; the page has a box for it, too."""
    video_dir: Path = Path("outputs/play")
    """Folder of these videos."""
    eval: EvalConfig = field(default_factory=EvalConfig)
    """Unused; lets files of configs/env serve this command too."""

    def __post_init__(self) -> None:
        check_choice("--viewer", self.viewer, VIEWERS)
        check_port("--port", self.port)
        if self.env is not None:
            checked_env(self.env)
        if self.episodes is not None and self.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, got {self.episodes}")
        if self.seed is not None:
            check_seed("--seed", self.seed)
        if self.policy.path is not None and self.dataset.root is not None:
            raise ValueError("give --policy.path or --dataset.root, not both")


def play(config: PlayConfig) -> list[dict]:
    """Play until everything asked for has been played; returns a row per episode, also after Ctrl-C."""
    from lerobot_vtrefine.envs.live_world import LiveWorld

    if config.viewer == "browser":
        require("the live view (--viewer=none does without)", VIEW)
    if config.record or config.video_dir != PlayConfig.video_dir:
        check_folder("--video_dir", config.video_dir)
    agent, env, seed = _choose(config)
    world = LiveWorld(env)
    world.reset(seed)
    view = None
    if config.viewer == "browser":
        from lerobot_vtrefine.view.browser import BrowserView

        view = BrowserView(world, config.port, getattr(agent, "cloud", None), controls=True)
        print(f"http://localhost:{view.port} shows it; Ctrl-C ends it", flush=True)
    if config.record or view is not None:
        asked = "of every episode" if config.record else "that you ask for on the page"
        print(f"videos {asked} go to {config.video_dir}", flush=True)
    one = config.viewer == "none" or config.dataset.root is not None
    session = Session(world, agent, view, config.video_dir, lambda line: print(line, flush=True))
    try:
        session.play(seed, config.episodes or (1 if one else None), config.record)
    except KeyboardInterrupt:
        pass
    finally:
        session.close()
        if view is not None:
            print(view.describe())
            view.close()
    print(summary(session.rows))
    return session.rows


def _choose(config: PlayConfig) -> tuple[Agent, VtRefineEnvConfig, int]:
    env = None if config.env is None else checked_env(config.env)
    if config.dataset.root is not None:
        agent, env, noted = recorded_agent(config.dataset.root, config.dataset.episode, env)
        if noted is None:
            logging.warning(
                "the dataset does not say where its parts stood: they stand where the seed puts them"
            )
        return agent, env, next(seed for seed in (config.seed, noted, 0) if seed is not None)
    env = env or VtRefineEnvConfig()
    if config.policy.path is not None:
        return PolicyAgent(config.policy.path, env, config.policy.device), env, config.seed or 0
    return scripted_agent(config.agent), env, config.seed or 0


def with_something_to_play(arguments: Sequence[str]) -> list[str]:
    """A command line that says what is played: `SHOWN` where it does not."""
    chosen = any(argument.startswith(CHOICES) and not argument.startswith(LOOKS) for argument in arguments)
    return list(arguments) if chosen else expand([*SHOWN, *arguments])


def summary(rows: list[dict]) -> str:
    """How many episodes succeeded, with the 95 % interval."""
    good = sum(bool(row["success"]) for row in rows)
    if not rows:
        return "no episode ended"
    low, high = wilson_interval(good, len(rows))
    return f"{good} of {len(rows)} succeeded ({100 * low:.0f} to {100 * high:.0f} % with 95 % confidence)"


@parser.wrap()
def _main(config: PlayConfig) -> None:
    play(config)


@run_cli
def main() -> None:
    """Console entry point."""
    init_logging()
    logging.getLogger("PIL").setLevel(logging.INFO)
    logging.getLogger("websockets").setLevel(logging.WARNING)
    sys.argv[1:] = with_something_to_play(sys.argv[1:])
    _main()


if __name__ == "__main__":
    raise SystemExit(main())
