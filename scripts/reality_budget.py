"""What every run of ``compare_reality.py`` may spend, and the flags of the worlds that it runs in."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from realities import of_robot

from lerobot_vtrefine.cli.arguments import flags
from lerobot_vtrefine.cli.pipeline.demo_config import DemoConfig, default_degradation, default_env


@dataclass(frozen=True)
class Budget:
    """What every run may spend; the same for the plain and the diagnosed simulator."""

    output_dir: Path
    realities: tuple[str, ...]
    seeds: tuple[int, ...]
    device: str
    num_demos: int
    pretrain_steps: int
    start_iterations: int
    iterations: int
    envs: int
    eval_episodes: int
    eval_envs: int
    presses: int
    motions: int
    env: dict[str, Any]
    recipe: str = "cloud"
    policy: dict[str, Any] = field(default_factory=dict)
    dppo: dict[str, Any] = field(default_factory=dict)
    degradation: dict[str, Any] = field(default_factory=default_degradation)
    encoder_episodes: int = 6144
    encoder_steps: int = 3000

    @property
    def own_encoder(self) -> bool:
        """Whether the policy's encoder is trained first, in the plain simulator: what others have learnt was
        with other pads.
        """
        return self.recipe == "pads" and "pretrained_encoder" not in self.policy

    @property
    def encoder(self) -> Path:
        """Folder of that encoder."""
        return self.output_dir / "encoder"

    @property
    def imitation(self) -> Path:
        """The imitation-learned policy that every seed starts from."""
        return recipe(self, self.seeds[0]).checkpoint("pretrain")

    def diagnosis(self, name: str) -> Path:
        """Folder of a reality's diagnosis."""
        return self.output_dir / folder_name(name) / "diagnosis"


def recipe(budget: Budget, seed: int) -> DemoConfig:
    """The demo's recipe with this budget, in the plain simulator."""
    plain = {"sensor_model": str(budget.output_dir / "plain" / "sensor_model.json")}
    return DemoConfig(
        output_dir=budget.output_dir / "imitation",
        seed=seed,
        device=budget.device,
        num_demos=budget.num_demos,
        pretrain_steps=budget.pretrain_steps,
        finetune_iterations=budget.iterations,
        finetune_envs=budget.envs,
        eval_episodes=budget.eval_episodes,
        eval_envs=budget.eval_envs,
        env=default_env() | budget.env | plain,
        degradation=budget.degradation,
        recipe=budget.recipe,
        policy=budget.policy | ({"pretrained_encoder": str(budget.encoder)} if budget.own_encoder else {}),
        dppo=budget.dppo,
    )


def folder_name(*parts: str) -> str:
    """A name for folders and stages, from worlds."""
    return "_".join(part.replace(":", "_").replace("+", "_and_") for part in parts)


def env_flags(budget: Budget, world: str) -> list[str]:
    """Flags of a world: plain, diagnosed:NAME or real:NAME."""
    env = dict(recipe(budget, budget.seeds[0]).env)
    kind, _, name = world.partition(":")
    if kind == "diagnosed":
        env["reality" if of_robot(name) else "sensor_model"] = str(
            budget.diagnosis(name) / "sensor_model.json"
        )
    elif kind == "real":
        env = real_env(budget, name, env)
    return flags("env", {"type": "vtrefine"} | env)


def real_env(budget: Budget, name: str, env: dict[str, Any]) -> dict[str, Any]:
    """An environment's flags in a stand-in reality; its pads are the plain ones unless it hides others."""
    kept = env if of_robot(name) else {key: value for key, value in env.items() if key != "sensor_model"}
    return kept | {"reality": str(budget.output_dir / folder_name(name) / "reality.json")}
