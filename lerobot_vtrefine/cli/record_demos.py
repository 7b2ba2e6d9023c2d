"""``vtrefine-record-demos``: record a scripted, imperfect expert's episodes as a LeRobotDataset v3.

example:
  vtrefine-record-demos --config_path=vtrefine:round_grasped --root=outputs/demos --num_episodes=60

Interrupted, the same command continues. With --push_to_hub=true --repo_id=USER/NAME the finished dataset is
uploaded, with a card of its pads, its simulation and its seeds; repeated later, the command only uploads.
"""

import errno
import logging
import os
import shlex
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.configs.default import EvalConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.utils import init_logging
from tqdm import tqdm

from lerobot_vtrefine.choices import check_seed
from lerobot_vtrefine.cli.errors import after_interrupt, run_cli
from lerobot_vtrefine.cli.hub import check_upload
from lerobot_vtrefine.cli.sharing import push_dataset
from lerobot_vtrefine.datasets.features import dataset_features
from lerobot_vtrefine.embodiments import DEFAULT_BODY
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.config import checked_env
from lerobot_vtrefine.envs.demo_dataset import DemoDataset
from lerobot_vtrefine.envs.demo_workers import demonstration_stream
from lerobot_vtrefine.envs.recording_note import simulation_settings
from lerobot_vtrefine.lerobot_compat.completeness import announced_episodes
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.truth import TRUTH_SIZE
from lerobot_vtrefine.wording import plural

HOPELESS_ATTEMPTS = 100
"""Attempts without a single success after which recording gives up."""


@dataclass
class RecordDemosConfig:
    """Flags of ``vtrefine-record-demos``."""

    root: Path
    """Folder of the dataset; an interrupted recording in it is continued."""
    repo_id: str = "local/vtrefine_demos"
    """LeRobot's name of the dataset, and its name on the Hub."""
    push_to_hub: bool = False
    """Upload the finished dataset to the Hugging Face Hub as ``repo_id``."""
    private: bool = False
    """Upload it for those only whom you invite."""
    num_episodes: int = 50
    """Episodes that the dataset shall hold."""
    seed: int = 0
    """Seed of the first attempt; attempt i has seed + i, so recordings need seeds far apart to differ."""
    num_envs: int = 16
    """Episodes simulated at once, per process."""
    num_workers: int = 0
    """Simulation processes beside the one that writes, one for each core at most; 0 simulates in this one."""
    include_failures: bool = False
    """Keep failed episodes too."""
    truth: bool = False
    """Record how the parts lie in their hands and touch, for --policy.auxiliary_weight."""
    env: EnvConfig = field(default_factory=VtRefineEnvConfig)
    """The task that the expert demonstrates."""
    degradation: Degradation = field(default_factory=Degradation)
    """Errors of the expert; all zero is the clean one."""
    eval: EvalConfig = field(default_factory=EvalConfig)
    """Unused; lets files of configs/env serve this command too."""

    def __post_init__(self) -> None:
        for name, lowest in (("num_episodes", 1), ("num_envs", 1), ("num_workers", 0)):
            if getattr(self, name) < lowest:
                raise ValueError(f"--{name} must be at least {lowest}, got {getattr(self, name)}")
        check_seed("--seed", self.seed)
        if self.push_to_hub:
            check_upload(self.repo_id)
        checked_env(self.env)

    def settings(self) -> dict[str, Any]:
        """What determines the episodes."""
        settings = simulation_settings(checked_env(self.env))
        settings |= {"truth": True} if self.truth else {}
        settings |= {"degradation": asdict(self.degradation), "seed": self.seed}
        return settings | {"include_failures": self.include_failures}


def record(config: RecordDemosConfig) -> int:
    """Simulate and save until the dataset holds ``num_episodes`` episodes; returns how many it holds.

    Raises:
        ValueError: if the first ``HOPELESS_ATTEMPTS`` attempts all fail.
        OSError: if the disk is full.
    """
    env = checked_env(config.env)
    robot = env.body
    features = dataset_features(
        *env.camera_size, robot, env.colour_size, env.limited, TRUTH_SIZE * config.truth
    )
    with DemoDataset(
        config.root,
        config.repo_id,
        env.fps,
        features,
        robot,
        env.task or "",
        config.settings(),
        config.seed,
    ) as demos:
        if demos.num_episodes >= config.num_episodes:
            return demos.num_episodes
        workers = demonstration_stream(
            env, config.degradation, config.num_envs, demos.next_seed, config.num_workers, config.truth
        )
        bar = {"total": config.num_episodes, "initial": demos.num_episodes, "unit": "episode"}
        with workers as stream, tqdm(**bar) as progress:
            for demonstration in stream:
                kept = demonstration.row["success"] or config.include_failures
                if kept:
                    demos.append(demonstration)
                else:
                    demos.skip(demonstration.row["seed"])
                attempts = demos.next_seed - config.seed
                progress.set_postfix_str(plural(attempts, "attempt"), refresh=False)
                progress.update(int(kept))
                if demos.num_episodes >= config.num_episodes:
                    break
                if demos.num_episodes == 0 and attempts >= HOPELESS_ATTEMPTS:
                    raise ValueError(
                        f"none of {attempts} attempts succeeded; watch some by vtrefine-play --agent=expert"
                        " with the same --env flags, or use smaller --degradation.* errors, a larger"
                        " clearance, or --include_failures=true"
                    )
        return demos.num_episodes


def next_steps(config: RecordDemosConfig) -> str:
    """Commands that see the dataset and learn from it."""
    env = checked_env(config.env)
    root = shlex.quote(str(config.root))
    train = f"lerobot-train --dataset.repo_id={shlex.quote(config.repo_id)} --dataset.root={root}"
    if env.scene.embodiment == DEFAULT_BODY:
        train += " --config_path=vtrefine:vt_dp3_pads"
    else:  # whose pads the shipped encoder has never felt
        train += (
            f" --config_path=vtrefine:vt_dp3_small --policy.observation.embodiment={env.scene.embodiment}"
        )
    return f"look: vtrefine-play --dataset.root={root} --dataset.episode=0\nlearn: {train}"


def _left_in(root: Path) -> str:
    """What an interrupted recording left there, and how to go on."""
    try:
        episodes = announced_episodes(root)
    except FileNotFoundError:
        return "nothing was recorded yet; the same command begins anew"
    return f"{root} keeps {plural(episodes, 'episode')}; the same command goes on"


@parser.wrap()
def _main(config: RecordDemosConfig) -> None:
    with after_interrupt(lambda: _left_in(config.root)):
        count = record(config)
    print(f"{plural(count, 'episode')} in {config.root}\n{next_steps(config)}")
    if config.push_to_hub:
        push_dataset(config.root, config.repo_id, private=config.private)
        print(f"{config.root} -> {config.repo_id}")


def _not_of_a_full_disk(record: logging.LogRecord) -> bool:
    """LeRobot tells of every image that a full disk does not take; saving the episode tells of it once."""
    return os.strerror(errno.ENOSPC) not in record.getMessage()


@run_cli
def main() -> None:
    """Console entry point."""
    init_logging()
    logging.getLogger("PIL").setLevel(logging.INFO)  # or it reports every tag of every depth image
    logging.getLogger("lerobot.datasets.image_writer").addFilter(_not_of_a_full_disk)
    _main()


if __name__ == "__main__":
    raise SystemExit(main())
