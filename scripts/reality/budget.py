"""What every run may spend, and the worlds that it runs in: their files and flags."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot_vtrefine.cli.pipeline.demo_config import DemoConfig, default_degradation, default_env
from lerobot_vtrefine.sim.reality import SCHEMA
from reality.hidden import PLAIN, REALITIES, of_robot


@dataclass(frozen=True)
class Budget:
    """What every run may spend; the same for the plain and the diagnosed simulator."""

    output_dir: Path
    realities: tuple[str, ...]
    seeds: tuple[int, ...]
    device: str
    num_demos: int
    pretrain_steps: int
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
        """Whether every simulator trains an encoder first: what comes with the package felt other pads."""
        return self.recipe == "pads" and "pretrained_encoder" not in self.policy

    def encoder(self, world: str) -> Path:
        """Folder of that encoder."""
        return self.output_dir / folder_name("encoder", world)

    def imitation(self, world: str) -> Path:
        """The imitation-learned policy that every seed starts from."""
        return recipe(self, self.seeds[0], world).checkpoint("pretrain")

    def diagnosis(self, name: str) -> Path:
        """Folder of a reality's diagnosis."""
        return self.output_dir / folder_name(name) / "diagnosis"


def recipe(budget: Budget, seed: int, world: str = "plain") -> DemoConfig:
    """The demo's recipe with this budget, in one of the simulators; its environment is the plain one.

    A `DemoConfig` reads the files that its environment names, and a diagnosis' are not there yet when the
    stages after it are planned: these get them as flags, from `world_env`.
    """
    encoder = {"pretrained_encoder": str(budget.encoder(world))} if budget.own_encoder else {}
    return DemoConfig(
        output_dir=budget.output_dir / folder_name("imitation", world),
        seed=seed,
        device=budget.device,
        num_demos=budget.num_demos,
        pretrain_steps=budget.pretrain_steps,
        finetune_iterations=budget.iterations,
        finetune_envs=budget.envs,
        eval_episodes=budget.eval_episodes,
        eval_envs=budget.eval_envs,
        env=world_env(budget, "plain"),
        degradation=budget.degradation,
        recipe=budget.recipe,
        policy=budget.policy | encoder,
        dppo=budget.dppo,
    )


def folder_name(*parts: str) -> str:
    """A name for folders and stages, from worlds."""
    return "_".join(part.replace(":", "_").replace("+", "_and_") for part in parts)


def world_env(budget: Budget, world: str) -> dict[str, Any]:
    """An environment's flags in a world: plain, diagnosed:NAME or real:NAME.

    The pads of a reality are the plain ones unless it hides others.
    """
    plain = {"sensor_model": str(budget.output_dir / "plain" / "sensor_model.json")}
    env = default_env() | budget.env | plain
    kind, _, name = world.partition(":")
    if kind == "diagnosed":
        model = budget.diagnosis(name) / "sensor_model.json"
        env["reality" if of_robot(name) else "sensor_model"] = str(model)
    elif kind == "real":
        env["reality"] = str(budget.output_dir / folder_name(name) / "reality.json")
        if not of_robot(name):
            del env["sensor_model"]
    return env


def write_worlds(budget: Budget) -> None:
    """The plain simulator's sensor model, and the files of the hidden realities."""
    (budget.output_dir / "plain").mkdir(parents=True, exist_ok=True)
    PLAIN.save(budget.output_dir / "plain" / "sensor_model.json")
    for name in budget.realities:
        folder = budget.output_dir / folder_name(name)
        folder.mkdir(parents=True, exist_ok=True)
        content = {"schema": SCHEMA} | REALITIES[name]()
        (folder / "reality.json").write_text(json.dumps(content, indent=2), encoding="utf-8")
