"""``vtrefine-finetune``: connects DPPO to a ``vt_dp3`` checkpoint, an environment and an output folder."""

import copy
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import draccus
import torch
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.default import EvalConfig, WandBConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.envs import EnvConfig
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.random_utils import set_seed
from tqdm import tqdm

from lerobot_vtrefine.envs.config import VtRefineEnvConfig, checked_env
from lerobot_vtrefine.envs.decisions import LeRobotDecisionEnv, make_decision_env
from lerobot_vtrefine.files import read_json, read_yaml
from lerobot_vtrefine.finetune.agents import CHAIN, check_same_chain, load_policy, make_agent
from lerobot_vtrefine.finetune.checkpoint import (
    Saveable,
    claimed,
    foreign_checkpoints,
    last_checkpoint,
    load_training_state,
    save_checkpoint,
)
from lerobot_vtrefine.finetune.config import DppoConfig, PaperDppo
from lerobot_vtrefine.finetune.console import logs_above_bars
from lerobot_vtrefine.finetune.distributed import (
    check_device,
    claim_gpu,
    join_ranks,
    leave_ranks,
    max_over_ranks,
    rank_index,
)
from lerobot_vtrefine.finetune.dppo import Metrics, TrainState, train
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.logger import ProgressLog, start_wandb
from lerobot_vtrefine.finetune.protocols import Agent, DecisionEnv
from lerobot_vtrefine.interrupts import first_signal_waits, interruption
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.whole_files import whole_file

CONFIG_NAME = "finetune_config.json"
STOPPING = "this iteration is finished and saved first; Ctrl-C or SIGTERM again stops at once"
SHOWN = (
    "success",
    "eval_success",
    "return",
    "approx_kl",
    "clip_fraction",
    "explained_variance",
    "steps_per_s",
)
"""Metrics that the log tells after every iteration; progress.csv has all."""
MADE_WITH = (*CHAIN, "eta", "encoder", "critic_width", "critic_blocks", "num_envs")
"""Settings of ``dppo`` that a checkpoint's networks, and how its policy acts, were made with; and by which
episodes are counted, of which none is to come twice."""


@dataclass
class FinetunePipelineConfig:
    """Settings of ``vtrefine-finetune``; ``--policy.path`` names the checkpoint to start from.

    Checkpoints hold them as ``train_config.json``, whose ``policy`` is the one trained and whose
    ``policy.pretrained_path`` is the one that the run started from.
    """

    # Where the policy practises: --config_path=vtrefine:NAME, or --env.type=vtrefine.
    env: EnvConfig
    # The checkpoint to start from: --policy.path=FOLDER; --policy.device=cpu or cuda; its other settings too.
    policy: PreTrainedConfig | None = None
    # The update; --dppo.type=paper|trust_region|fine|small chooses a preset.
    dppo: DppoConfig = field(default_factory=PaperDppo)
    # Folder of checkpoints/, progress.csv and curves.png.
    output_dir: Path = Path("outputs/finetune")
    # Name of the run in Weights & Biases.
    job_name: str = "dppo"
    # Training episodes have the environment seeds from 1000000 + seed on; runs whose seeds are 10000000 apart
    # share no episode.
    seed: int = 0
    # Continue from the last checkpoint in output_dir; start if there is none.
    resume: bool = False
    # Evaluate the deployed sampler on eval.n_episodes held-out seeds every so many iterations; 0: never.
    eval_freq: int = 10
    # Write a checkpoint every so many iterations, and after the last.
    save_freq: int = 10
    # --eval.n_episodes counts, and --eval.batch_size with push_to_hub; the rest, which files of tasks hold,
    # is not used.
    eval: EvalConfig = field(default_factory=EvalConfig)
    # Evaluate the result by lerobot-eval and upload it to the Hugging Face Hub with a card of what was found.
    push_to_hub: bool = False
    # Its name on the Hub: USER/NAME.
    repo_id: str | None = None
    # Upload it for those only whom you invite.
    private: bool = False
    # --wandb.enable=true and its other settings, as lerobot-train takes them. Curves and settings only: no
    # artifacts are uploaded, so disable_artifact changes nothing.
    wandb: WandBConfig = field(default_factory=WandBConfig)

    def __post_init__(self) -> None:
        for name in ("seed", "eval_freq", "save_freq"):
            if getattr(self, name) < 0:
                raise ValueError(f"--{name} must not be negative, got {getattr(self, name)}")
        if self.eval_freq and self.eval.n_episodes < 1:
            raise ValueError("--eval.n_episodes must be at least 1; --eval_freq=0 evaluates nothing")

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Let LeRobot's parser take ``--policy.path``."""
        return ["policy"]

    @classmethod
    def from_pretrained(cls, path: str | Path, cli_args: Sequence[str] = ()) -> "FinetunePipelineConfig":
        """Settings from a file, or of a checkpoint's folder ``pretrained_model``, with changes from flags.

        Raises: OSError where there is none, draccus' errors for settings that cannot be.
        """
        path = Path(path)
        return draccus.parse(cls, path / TRAIN_CONFIG_NAME if path.is_dir() else path, args=list(cli_args))

    def save_pretrained(self, folder: Path) -> None:
        """Write all settings into a checkpoint's folder ``pretrained_model``."""
        write_config(self, folder / TRAIN_CONFIG_NAME)

    @property
    def start(self) -> Path | None:
        """The policy that ``--policy.path`` names, or that the settings in ``--config_path`` started from."""
        known = None if self.policy is None else self.policy.pretrained_path
        named = parser.get_path_arg("policy") or known
        return Path(named) if named else None


def start_path(cfg: FinetunePipelineConfig) -> tuple[Path, Path | None]:
    """The policy to load and, when resuming, the checkpoint it belongs to.

    Raises:
        ValueError: no policy was named.
        FileExistsError: output_dir holds a run that is not resumed, or another command's checkpoints.
    """
    if foreign := foreign_checkpoints(cfg.output_dir):
        raise FileExistsError(
            f"{foreign[0]} is another command's checkpoint, which this run would take the place of: choose"
            " another --output_dir"
        )
    checkpoint = last_checkpoint(cfg.output_dir)
    if checkpoint is not None:
        if not cfg.resume:
            raise FileExistsError(f"{cfg.output_dir} holds a run: add --resume=true or change --output_dir")
        return checkpoint / PRETRAINED_MODEL_DIR, checkpoint
    if cfg.start is None:
        raise ValueError("name the checkpoint to fine-tune with --policy.path=.../pretrained_model")
    return cfg.start, None


def check_resumable(cfg: FinetunePipelineConfig, checkpoint: Path) -> None:
    """Raises: ValueError for a setting that a run cannot change on its way; others hold from now on."""
    saved = read_json(checkpoint / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME)
    kept = {"seed": (saved["seed"], cfg.seed)}
    kept |= {f"dppo.{name}": (saved["dppo"][name], getattr(cfg.dppo, name)) for name in MADE_WITH}
    for name, (before, now) in kept.items():
        if before != now:
            raise ValueError(
                f"{checkpoint} was made with --{name}={before}, not {now}: resume with that, or choose"
                " another --output_dir"
            )


class Practice(NamedTuple):
    """A policy made ready for DPPO, and where it practises."""

    policy: VtDp3Policy
    agent: Agent
    env: LeRobotDecisionEnv
    processors: tuple[Any, Any]


def make_practice(policy: VtDp3Policy, path: Path, env: EnvConfig, dppo: DppoConfig) -> Practice:
    """Agent, environments of this rank and the processors that were saved beside the policy in ``path``.

    Raises: ValueError for another environment type, control rate or robot than the policy learned.
    """
    env = checked_env(env)
    config = policy.config
    config.check_fps(env.fps)
    config.check_body(env.body.name, env.body.num_joints)
    overrides = {"device_processor": {"device": config.device or "cpu"}}
    processors = make_pre_post_processors(config, str(path), preprocessor_overrides=overrides)
    agent = make_agent(policy, dppo)
    windows = config.n_obs_steps, config.n_action_steps
    return Practice(policy, agent, make_decision_env(env, dppo.num_envs, *processors, *windows), processors)


def env_of(task: Path) -> VtRefineEnvConfig:
    """The environment of a file as in configs/env. Raises: ValueError for another environment type."""
    return checked_env(draccus.decode(EnvConfig, read_yaml(task)["env"]))


def env_on(
    device: str, task: Path, backend: str | None = None, timestep_s: float | None = None, **fields: Any
) -> VtRefineEnvConfig:
    """The environment of a file as in configs/env, on ``device`` (cpu, cuda).

    ``backend`` of the simulation; default: warp, which alone runs on a GPU, or on a CPU the file's. Longest
    physics step; default: the file's. ``fields`` of the environment that differ from the file.

    Raises: ValueError for another environment type.
    """
    env = env_of(task)
    backend = backend or (env.backend if device == "cpu" else "warp")
    scene = env.scene if timestep_s is None else replace(env.scene, timestep_s=timestep_s)
    return replace(env, backend=backend, warp=replace(env.warp, device=device), scene=scene, **fields)


def load_practice(
    path: Path,
    task: Path,
    dppo: DppoConfig,
    device: str,
    backend: str | None = None,
    timestep_s: float | None = None,
    **fields: Any,
) -> Practice:
    """The same of a checkpoint's folder and a file as in configs/env; both on ``device`` (cpu, cuda).

    The rest is as of `env_on`.

    Raises: ValueError where there is no such device, and as `env_on` and `make_practice`.
    """
    check_device(device)
    env = env_on(device, task, backend, timestep_s, **fields)
    policy = VtDp3Policy.from_pretrained(path).to(device)
    policy.config.device = device
    return make_practice(policy, path, env, dppo)


class Recorder:
    """What happens after each iteration: evaluation, records, checkpoint, progress bar."""

    def __init__(
        self, cfg: FinetunePipelineConfig, env: DecisionEnv, agent: Agent, saveable: Saveable
    ) -> None:
        self.cfg, self.env, self.agent, self.saveable = cfg, env, agent, saveable
        self.log: ProgressLog | None = None
        self.bar = tqdm(disable=True)
        self.signals: Sequence[int] = ()
        """The one that asks this rank to stop, once it has come."""

    def start(self, state: TrainState) -> tqdm:
        """Open the records (first rank).

        Returns: the progress bar, to be closed also where training ends by an error, told below it.
        """
        cfg = self.cfg
        if rank_index() == 0:
            settings = {"dppo": asdict(cfg.dppo), "env": asdict(cfg.env), "seed": cfg.seed}
            run = start_wandb(cfg.wandb, cfg.output_dir, cfg.job_name, settings, cfg.resume)
            self.log = ProgressLog(cfg.output_dir, state.iteration, run)
            self.bar = tqdm(total=cfg.dppo.iterations, initial=state.iteration, desc="DPPO", unit="it")
        return self.bar

    def judge_start(self, state: TrainState) -> None:
        """Evaluate the policy that training starts from, if it has not begun yet.

        That is the pre-trained network behind the sampler of fine-tuning; ``lerobot-eval`` of the pre-trained
        checkpoint uses the sampler that it was saved with.
        """
        if state.iteration == 0 and self.cfg.eval_freq:
            self._record(0, evaluate(self.env, self.agent, self.cfg.eval.n_episodes))

    def __call__(self, state: TrainState, metrics: Metrics) -> None:
        """Callback of ``dppo.train``.

        Raises: KeyboardInterrupt once all is saved, where a signal asked any rank to stop.
        """
        cfg, iteration, last = self.cfg, state.iteration, self.cfg.dppo.iterations
        if cfg.eval_freq and (iteration % cfg.eval_freq == 0 or iteration == last):
            metrics |= evaluate(self.env, self.agent, cfg.eval.n_episodes)
        self._record(iteration, metrics)
        stop = max_over_ranks(self.signals[0] if self.signals else 0, self.agent.device)
        if stop or iteration == last or (cfg.save_freq and iteration % cfg.save_freq == 0):
            if self.log is not None:
                self.log.draw()
            save_checkpoint(cfg.output_dir, self.saveable, state, last)
        self.bar.update()
        if stop:
            raise interruption(stop)

    def close(self) -> None:
        """Called when training has ended."""
        if self.log is not None:
            self.log.close()

    def _record(self, iteration: int, metrics: Metrics) -> None:
        if self.log is None:
            return
        self.log.add(iteration, metrics)
        shown = ", ".join(f"{key} {metrics[key]:.3g}" for key in SHOWN if key in metrics)
        logging.info("iteration %d: %s", iteration, shown)
        if metrics.get("undone"):
            logging.info("success fell: back to the best policy so far, in steps half as large")


def save_config(cfg: FinetunePipelineConfig, policy: VtDp3Config) -> None:
    """Complete the settings by the policy's own and write them to the output folder; ``--config_path`` reads
    them again.
    """
    start, cfg.policy = cfg.start, copy.deepcopy(policy)
    cfg.policy.pretrained_path = start
    if rank_index() == 0:
        write_config(cfg, cfg.output_dir / CONFIG_NAME)


def write_config(cfg: FinetunePipelineConfig, path: Path) -> None:
    """Write all settings as JSON, complete or not at all."""
    with whole_file(path) as part, draccus.config_type("json"), part.open("w") as file:
        draccus.dump(cfg, file, indent=2)


def run(cfg: FinetunePipelineConfig) -> None:
    """Fine-tune; the result is ``output_dir/checkpoints/last/pretrained_model``.

    Raises: KeyboardInterrupt at the end of the iteration in which Ctrl-C or SIGTERM came; it is saved then.
    """
    path, checkpoint = start_path(cfg)
    if checkpoint is not None:
        check_resumable(cfg, checkpoint)
    claim_gpu()
    policy = load_policy(path)
    if checkpoint is None and policy.config.ft_denoising_steps:
        check_same_chain(cfg.dppo, policy.config)
        policy.config.ft_eta = cfg.dppo.deploy_eta
    device = torch.device(policy.config.device or "cpu")
    join_ranks(device)
    set_seed(cfg.seed + rank_index())
    policy, agent, env, processors = make_practice(policy, path, cfg.env, cfg.dppo)
    state = TrainState.create(agent, cfg.dppo, env.privileged_dim, cfg.seed)
    recorder = Recorder(cfg, env, agent, Saveable(policy, *processors, cfg))
    with claimed(cfg.output_dir), logs_above_bars():
        save_config(cfg, policy.config)
        if checkpoint is not None:
            load_training_state(checkpoint, state)
        with recorder.start(state):
            recorder.judge_start(state)  # nothing could be saved before its end
            with first_signal_waits(STOPPING) as recorder.signals:
                train(env, agent, state, cfg.dppo, seed=cfg.seed, after_iteration=recorder)
    recorder.close()
    leave_ranks()
