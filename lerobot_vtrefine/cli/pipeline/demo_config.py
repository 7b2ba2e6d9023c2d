"""The demo's recipe: every number it uses."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.cli.pipeline.stages import trained_policy
from lerobot_vtrefine.embodiments import DEFAULT_BODY
from lerobot_vtrefine.finetune.seeds import TRAINING_SEEDS

REPO_ID = "local/vtrefine_demo"
POLICIES = ("pretrain", "finetune")
ABLATIONS = ("touch", "vision")

# Environment seeds of demonstrations, fine-tuning and evaluation never overlap; also of scripts that compare.
SEED_STRIDE = 10_000_000
TRAIN_SEED_OFFSET = 1_000_000
EVAL_SEED_OFFSET = 8_000_000
LARGEST_SEED = 2**32 // SEED_STRIDE - 1  # NumPy's generators take seeds below 2**32
TRAIN_SEEDS = EVAL_SEED_OFFSET - TRAIN_SEED_OFFSET - TRAINING_SEEDS

LOWEST = {
    "num_demos": 1,
    "demo_envs": 1,
    "pretrain_steps": 1,
    "pretrain_batch": 1,
    "eval_episodes": 1,
    "eval_envs": 1,
    "ablation_episodes": 0,
    "videos": 0,
    "finetune_iterations": 1,
    "finetune_envs": 1,
}

QUICK = (
    "--output_dir=outputs/demo_quick",
    "--num_demos=4",
    "--demo_envs=4",
    "--pretrain_steps=20",
    "--pretrain_batch=16",
    "--eval_episodes=8",
    "--eval_envs=8",
    "--videos=1",
    "--ablation_episodes=0",
    "--finetune_iterations=2",
    "--finetune_envs=8",
)


def default_env() -> dict[str, Any]:
    """The demo's task."""
    return {"pair": "round", "clearance_m": 0.002, "start": "grasped"}


def default_degradation() -> dict[str, Any]:
    """The expert's imperfections: they leave imitation room for improvement."""
    return {
        "lateral_std_m": 0.0008,
        "tilt_std_rad": 0.0175,
        "tremor_std_m": 0.0002,
        "pace_std": 0.1,
    }


RECIPES: dict[str, dict[str, Any]] = {
    "pads": {
        "policy": {
            "preset": "small",
            "fusion": "pads",
            "freeze_encoder": True,
            "n_action_steps": 4,
            "horizon": 8,
        },
        "dppo": {"type": "small", "encoder": "frozen"},
        "finetune_iterations": 20,
    },
    "cloud": {
        "policy": {"preset": "small", "n_action_steps": 8},
        "dppo": {"type": "small"},
        "finetune_iterations": 30,
    },
}
"""What is trained, in minutes on two cores. ``pads``: a network that has learnt to see and feel in simulation
beforehand. ``cloud``: the paper's, learnt from demonstrations alone, for any body."""
ENCODERS = {"aloha": "vtrefine:round_grasped", "kinova": "vtrefine:kinova_round_grasped"}
"""What ``pads`` starts from: encoders that come with the package, each trained with its own robot."""


@dataclass(frozen=True)
class DemoConfig:
    """Numbers of the demo. ``env``, ``degradation``, ``policy`` and ``dppo`` are passed on as flags; the last
    two, with those of the recipe that they do not name.
    """

    output_dir: Path = Path("outputs/demo")
    """Folder of the dataset, the checkpoints, results.json and report.html."""
    seed: int = 0
    """Seed of the whole run; runs of different seeds share no episode."""
    recipe: str = "pads"
    """pads: sees and feels through an encoder that was trained in simulation, with the same robot. cloud:
    learns from the demonstrations alone, with any robot."""
    modalities: str = "visuo_tactile"
    """What the policy sees: visuo_tactile or visual."""
    device: str = "cpu"
    """Where the networks run, cpu or cuda; the simulation stays on CPU threads."""
    num_demos: int = 80
    """Successful demonstrations that are kept."""
    demo_envs: int = 32
    """Simulations that record side by side."""
    pretrain_steps: int = 1000
    """Gradient steps of imitation learning."""
    pretrain_batch: int = 128
    """Windows in a batch of imitation learning."""
    eval_episodes: int = 200
    """Episodes behind each of the two headline success rates."""
    eval_envs: int = 50
    """Simulations that evaluate side by side."""
    ablation_episodes: int = 100
    """Episodes of each test-time ablation; 0 skips them."""
    videos: int = 6
    """Episodes of each headline evaluation that are drawn; drawing without a GPU is slow."""
    finetune_iterations: int | None = None
    """DPPO iterations of one episode in every environment; by default the recipe's."""
    finetune_envs: int = 128
    """Simulations that DPPO collects from."""
    env: dict[str, Any] = field(default_factory=default_env)
    """Flags of the environment, ``--env.KEY=VALUE``."""
    degradation: dict[str, Any] = field(default_factory=default_degradation)
    """Flags of the expert's imperfections, ``--degradation.KEY=VALUE``."""
    policy: dict[str, Any] = field(default_factory=dict)
    """Flags of the policy beside the recipe's, ``--policy.KEY=VALUE``."""
    dppo: dict[str, Any] = field(default_factory=dict)
    """Flags of DPPO beside the recipe's, ``--dppo.KEY=VALUE``."""
    eval: dict[str, Any] = field(default_factory=dict)
    """Unused; lets files of configs/env serve this command too."""

    def __post_init__(self) -> None:
        self._follow_recipe()
        for name, lowest in LOWEST.items():
            if getattr(self, name) < lowest:
                raise ValueError(f"--{name} must be at least {lowest}, got {getattr(self, name)}")
        check_choice("--modalities", self.modalities, ("visuo_tactile", "visual"))
        if not 0 <= self.seed <= LARGEST_SEED:
            raise ValueError(f"--seed must lie in 0..{LARGEST_SEED}, got {self.seed}")
        assert self.finetune_iterations is not None  # the recipe's at least
        if self.finetune_iterations * self.finetune_envs > TRAIN_SEEDS:
            raise ValueError(
                f"--finetune_iterations times --finetune_envs must not exceed {TRAIN_SEEDS}:"
                " training would reach the seeds of the evaluation"
            )
        self._check_children()

    def _follow_recipe(self) -> None:
        """Fill in what the recipe says and the flags do not; the policy sees with the environment's robot."""
        check_choice("--recipe", self.recipe, RECIPES)
        recipe = RECIPES[self.recipe]
        body = (self.env.get("scene") or {}).get("embodiment", DEFAULT_BODY)
        policy = recipe["policy"] | self.policy
        if policy.get("freeze_encoder") and "pretrained_encoder" not in policy:
            if body not in ENCODERS:
                raise ValueError(
                    f"--recipe={self.recipe} has no encoder that was trained with {body}: add --recipe=cloud,"
                    " or one of your own by --policy='{pretrained_encoder: FOLDER}'"
                )
            policy["pretrained_encoder"] = ENCODERS[body]
        if body != DEFAULT_BODY:
            policy["observation"] = {"embodiment": body} | policy.get("observation", {})
        object.__setattr__(self, "policy", policy)
        object.__setattr__(self, "dppo", recipe["dppo"] | self.dppo)
        if self.finetune_iterations is None:
            object.__setattr__(self, "finetune_iterations", recipe["finetune_iterations"])

    def _check_children(self) -> None:
        """Parse what the stages will parse. Imports LeRobot, which ``--help`` can do without."""
        from lerobot_vtrefine.cli.pipeline import child_configs

        child_configs.parse_degradation(self.degradation)
        numbers = {"iterations": self.finetune_iterations, "num_envs": self.finetune_envs}
        child_configs.parse_dppo(self.dppo | numbers)
        child_configs.parse_env(self.env)
        child_configs.parse_policy(self.policy)

    @property
    def dataset_dir(self) -> Path:
        """Root of the recorded dataset."""
        return self.output_dir / "dataset"

    def checkpoint(self, policy: str) -> Path:
        """Folder of the ``pretrain`` or ``finetune`` policy, as ``--policy.path`` takes it."""
        return trained_policy(self.output_dir / policy)

    def evaluation_dir(self, policy: str, ablation: str = "none") -> Path:
        """Folder of an evaluation's eval_info.json, episodes.jsonl and videos."""
        return self.output_dir / ("eval_" + policy + ("" if ablation == "none" else f"_no_{ablation}"))

    @property
    def task(self) -> dict[str, Any]:
        """Flags of the environment that is demonstrated and judged: whole episodes, also where DPPO starts
        from a bank, all of whose states it may know.
        """
        return {name: value for name, value in self.env.items() if name != "start_bank"}

    @property
    def eval_seed(self) -> int:
        """First environment seed of every evaluation."""
        return self.seed * SEED_STRIDE + EVAL_SEED_OFFSET

    def ablations(self) -> list[tuple[str, str]]:
        """Pairs (policy, modality replaced by its mean); only modalities that the policy has."""
        if self.ablation_episodes < 1:
            return []
        modalities = ABLATIONS if self.modalities == "visuo_tactile" else ("vision",)
        return [(policy, modality) for policy in POLICIES for modality in modalities]
