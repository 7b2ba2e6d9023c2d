"""``vtrefine-record-starts``: make a bank of states with both parts in hand, for DPPO to start from.

example:
  vtrefine-record-starts --config_path=vtrefine:round_table --path=outputs/starts.npz \\
      --policy.path=outputs/pretrain/checkpoints/last/pretrained_model
  vtrefine-finetune --config_path=vtrefine:round_table --env.start_bank=outputs/starts.npz ...

The states are taken from episodes from the table, each as soon as both parts are grasped and lifted: from the
policy's own, and from the scripted expert's where the policy grasps too seldom, or none is named.
"""

import math
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.configs.default import EvalConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.utils import init_logging
from tqdm import tqdm

from lerobot_vtrefine.choices import check_seed
from lerobot_vtrefine.cli.errors import after_interrupt, run_cli
from lerobot_vtrefine.cli.outputs import OVERWRITE, check_new_file
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.config import checked_env
from lerobot_vtrefine.envs.grasps import ExpertPlayer, Player, grasp_states
from lerobot_vtrefine.envs.start_bank import StartBank, bank_settings
from lerobot_vtrefine.sim.demonstrations import Degradation

FEWEST = 2
"""One state to practise on, and one that is held out."""


@dataclass
class GraspingPolicy:
    """A trained ``vt_dp3`` policy."""

    path: str | None = None
    """Its checkpoint: a folder, vtrefine:NAME for one that comes with the package, or a name on the Hub."""
    device: str = "cpu"
    """Where it runs: cpu or cuda."""


@dataclass
class RecordStartsConfig:
    """Flags of ``vtrefine-record-starts``."""

    path: Path
    """The file (.npz) to write, for --env.start_bank."""
    overwrite: bool = False
    """Replace a bank that is there already."""
    num_starts: int = 256
    """States that the bank shall hold."""
    attempts: float = 2.0
    """Episodes of each player per state that is wanted."""
    seed: int = 0
    """Seed of the first episode; choose one whose successors no evaluation uses."""
    num_envs: int = 16
    """Episodes simulated at once."""
    env: EnvConfig = field(default_factory=VtRefineEnvConfig)
    """The task, from the table."""
    policy: GraspingPolicy = field(default_factory=GraspingPolicy)
    """The policy that grasps; without one the expert does."""
    degradation: Degradation = field(default_factory=Degradation)
    """Errors of the expert; all zero is the clean one."""
    eval: EvalConfig = field(default_factory=EvalConfig)
    """Unused; lets files of configs/env serve this command too."""

    def __post_init__(self) -> None:
        for name, lowest in (("num_starts", FEWEST), ("num_envs", 1), ("attempts", 1)):
            if getattr(self, name) < lowest:
                raise ValueError(f"--{name} must be at least {lowest}, got {getattr(self, name)}")
        check_seed("--seed", self.seed)
        if checked_env(self.env).scene_config.start != "table":
            raise ValueError("parts are grasped from the table: use --env.start=table")


def record(config: RecordStartsConfig) -> dict[str, int]:
    """Write the bank; returns how many states came from whom.

    Raises:
        FileExistsError: there is a bank already, and ``overwrite`` is not set.
        ValueError: not even the expert gets hold of both parts often enough.
    """
    check_new_file("--path", config.path, overwrite=config.overwrite, how=OVERWRITE)
    env = replace(checked_env(config.env), start_bank=None, metrics_path=None)
    states: dict[int, Any] = {}
    counts: dict[str, int] = {}
    seed = config.seed
    with tqdm(total=config.num_starts, unit="state") as progress:
        for name in ["policy", "expert"] if config.policy.path else ["expert"]:
            left = config.num_starts - len(states)
            batches = math.ceil(config.attempts * left / config.num_envs)
            if left:
                for taken, state in islice(grasp_states(_player(config, env, name), seed, batches), left):
                    states[taken] = state
                    progress.update()
                counts[name] = len(states) - config.num_starts + left
            seed += batches * config.num_envs
    if len(states) < FEWEST:
        raise ValueError(
            f"both parts were in hand in {len(states)} of {seed - config.seed} episodes: use smaller"
            " --degradation.* errors"
        )
    StartBank.of_states(bank_settings(env), states).save(config.path)
    return counts


def _player(config: RecordStartsConfig, env: VtRefineEnvConfig, name: str) -> Player:
    if name == "expert":
        return ExpertPlayer(env, config.degradation, config.num_envs)
    from lerobot_vtrefine.finetune.policy_player import PolicyPlayer  # torch and LeRobot's policies: seconds

    return PolicyPlayer(Path(config.policy.path or ""), env, config.num_envs, config.policy.device)


@parser.wrap()
def _main(config: RecordStartsConfig) -> None:
    with after_interrupt("nothing was written; the same command begins anew"):
        counts = record(config)
    told = " and ".join(f"{count} by the {name}" for name, count in counts.items())
    print(f"{sum(counts.values())} states in {config.path}: {told}")
    print(f"practise from them: vtrefine-finetune --env.start_bank={config.path} ...")


@run_cli
def main() -> None:
    """Console entry point."""
    init_logging()
    _main()


if __name__ == "__main__":
    raise SystemExit(main())
