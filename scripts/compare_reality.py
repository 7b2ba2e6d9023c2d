#!/usr/bin/env python
"""Does diagnosis pay where it matters, in the policy? Fine-tune in the plain and in the diagnosed simulator.

    .venv/bin/python scripts/compare_reality.py --seeds 0 1 2

A simulation with hidden physics stands in for reality (``--env.reality``); nothing is ever trained in it.
From one imitation-learned checkpoint DPPO runs, with the same budget and seeds, in the plain simulator and in
the one that ``vtrefine-diagnose`` made from presses of the hidden pad. All policies are then evaluated in the
stand-in reality and in their own simulator, on the same episodes. Every stage is a command that users run;
interrupted and started again, it continues. Results: ``comparison.json`` and ``comparison.md``.
"""

import argparse
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from compare_touch import interval_text, run_all, run_script, save

from lerobot_vtrefine.cli.pipeline.demo_config import (
    SEED_STRIDE,
    TRAIN_SEED_OFFSET,
    DemoConfig,
    acting_env,
    default_env,
    flags,
    pretrain_stage,
    record_stage,
)
from lerobot_vtrefine.cli.pipeline.stages import Stage, StageRunner
from lerobot_vtrefine.cli.report.statistics import proportion
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.host import Latency
from lerobot_vtrefine.tactile.stages.mechanics import Hysteresis
from lerobot_vtrefine.tactile.stages.readout import (
    Gain,
    Idle,
    Noise,
    Quantisation,
    RowSharing,
    TaxelGainSpread,
)

PLAIN = SensorModel((KelvinVoigt(400.0, 1.2), Gain(500.0), Idle(25.0, 10.0), Noise(1.0), Quantisation()))
"""The simulator before diagnosis: the paper's model in the units of the hardware."""
RESAMPLES = 10_000


def row_sharing_and_hysteresis() -> SensorModel:
    """A readout whose rows' taxels load each other, under a cover with a wide loop."""
    return PLAIN.with_stage(RowSharing(3e-3)).with_stage(Hysteresis(fraction=0.5, width_m=4e-4))


def latency_and_gain_spread() -> SensorModel:
    """Readings that arrive two control steps late, from taxels that differ by half."""
    gains = np.exp(np.random.default_rng(186).normal(0.0, 0.5, (12, 32)))
    return PLAIN.with_stage(Latency(0.2)).with_stage(TaxelGainSpread(0.5, gains.round(4).tolist()))


REALITIES = {
    "row_sharing+hysteresis": row_sharing_and_hysteresis,
    "latency+taxel_gain_spread": latency_and_gain_spread,
}


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
    env: dict[str, str]

    @property
    def checkpoint(self) -> Path:
        """The imitation-learned policy that every fine-tuning starts from."""
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
    )


def folder_name(*parts: str) -> str:
    """A name for folders and stages, from worlds."""
    return "_".join(part.replace(":", "_").replace("+", "_and_") for part in parts)


def env_flags(budget: Budget, world: str) -> list[str]:
    """Flags of a world: plain, diagnosed:NAME or real:NAME."""
    env = acting_env(recipe(budget, budget.seeds[0]))
    kind, _, name = world.partition(":")
    if kind == "diagnosed":
        env["sensor_model"] = str(budget.diagnosis(name) / "sensor_model.json")
    elif kind == "real":
        del env["sensor_model"]
        env["reality"] = str(budget.output_dir / folder_name(name) / "reality.json")
    return flags("env", {"type": "vtrefine"} | env)


def imitation_stages(budget: Budget) -> list[Stage]:
    """Demonstrations in the plain simulator, and the policy learned from them."""
    config = recipe(budget, budget.seeds[0])
    return [record_stage(config), pretrain_stage(config)]


def diagnosis_stages(budget: Budget, name: str) -> list[Stage]:
    """Presses of a hidden pad, and what diagnosis makes of them."""
    folder, output = budget.output_dir / folder_name(name), budget.diagnosis(name)
    script = os.path.relpath(Path(__file__).with_name("press_reality.py"))  # what a user would type
    press = ("python", script, f"--reality={folder / 'reality.json'}", f"--trials={budget.presses}")
    press = (*press, f"--output_dir={folder / 'presses'}")
    diagnose = ("vtrefine-diagnose", f"--recording={folder / 'presses'}", f"--output_dir={output}")
    pressed, product = f"press_{folder.name}", folder / "presses" / "recording.json"
    return [
        Stage(pressed, f"Press the pad of {name}", press, folder / "presses", product),
        Stage(output_name(name), f"Diagnose {name}", diagnose, output, output / "verdict.json", (pressed,)),
    ]


def output_name(name: str) -> str:
    """Name of a diagnosis' stage."""
    return f"diagnose_{folder_name(name)}"


def finetune_dir(budget: Budget, world: str, seed: int) -> Path:
    """Folder of one fine-tuning."""
    return budget.output_dir / folder_name("finetune", world, str(seed))


def finetune_stage(budget: Budget, world: str, seed: int) -> Stage:
    """DPPO from the imitation-learned checkpoint in one world."""
    output, config = finetune_dir(budget, world, seed), recipe(budget, seed)
    command = [
        "vtrefine-finetune",
        f"--policy.path={budget.checkpoint}",
        f"--policy.device={budget.device}",
        *env_flags(budget, world),
        *flags("dppo", config.dppo),
        f"--dppo.iterations={budget.iterations}",
        f"--dppo.num_envs={budget.envs}",
        f"--seed={seed * SEED_STRIDE + TRAIN_SEED_OFFSET}",
        f"--output_dir={output}",
        "--resume=true",
    ]
    needs = ["pretrain", *([output_name(world.partition(":")[2])] if world != "plain" else [])]
    product = output / "checkpoints" / "last" / "pretrained_model" / "model.safetensors"
    title = f"Fine-tune in {world}, seed {seed}"
    return Stage(output.name, title, tuple(command), output, product, tuple(needs), resumable=True)


def evaluation_dir(budget: Budget, trained: str, world: str, seed: int) -> Path:
    """Where an evaluation leaves its results."""
    return budget.output_dir / folder_name("eval", trained, "in", world, str(seed))


def evaluation_stage(budget: Budget, trained: str, world: str, seed: int) -> Stage:
    """A policy, "bc" or the world that it was fine-tuned in, in a world, on this seed's episodes."""
    output, tuned = evaluation_dir(budget, trained, world, seed), finetune_dir(budget, trained, seed)
    path = budget.checkpoint if trained == "bc" else tuned / "checkpoints" / "last" / "pretrained_model"
    command = [
        "lerobot-eval",
        f"--policy.path={path}",
        f"--policy.device={budget.device}",
        *env_flags(budget, world),
        f"--env.metrics_path={output / 'episodes.jsonl'}",
        "--env.video_episodes=0",
        f"--eval.n_episodes={budget.eval_episodes}",
        f"--eval.batch_size={min(budget.eval_envs, budget.eval_episodes)}",
        f"--seed={recipe(budget, seed).eval_seed}",
        f"--output_dir={output}",
    ]
    title = f"Evaluate {trained} in {world}, seed {seed}"
    needs = ("pretrain" if trained == "bc" else tuned.name,)
    return Stage(output.name, title, tuple(command), output, output / "eval_info.json", needs)


def evaluations(budget: Budget) -> list[tuple[str, str]]:
    """Pairs (trained in, evaluated in)."""
    pairs = [("bc", "plain"), ("plain", "plain")]
    for name in budget.realities:
        pairs += [("bc", f"real:{name}"), ("plain", f"real:{name}")]
        pairs += [(f"diagnosed:{name}", f"diagnosed:{name}"), (f"diagnosed:{name}", f"real:{name}")]
    return pairs


def lanes(budget: Budget) -> tuple[dict[str, list[Stage]], dict[str, list[Stage]]]:
    """Stages that run side by side, each list in its order: preparation first, then the policies."""
    before = {"imitation": imitation_stages(budget)}
    before |= {output_name(name): diagnosis_stages(budget, name) for name in budget.realities}
    done = [stage for stages in before.values() for stage in stages]
    policies = {}
    for seed in budget.seeds:
        for trained in ("plain", *(f"diagnosed:{name}" for name in budget.realities), "bc"):
            tuning = [] if trained == "bc" else [finetune_stage(budget, trained, seed)]
            worlds = [world for policy, world in evaluations(budget) if policy == trained]
            judged = [evaluation_stage(budget, trained, world, seed) for world in worlds]
            policies[folder_name(trained, str(seed))] = [*done, *tuning, *judged]
    return before, policies


def write_worlds(budget: Budget) -> None:
    """The plain simulator's sensor model, and the files of the hidden realities."""
    (budget.output_dir / "plain").mkdir(parents=True, exist_ok=True)
    PLAIN.save(budget.output_dir / "plain" / "sensor_model.json")
    for name in budget.realities:
        folder = budget.output_dir / folder_name(name)
        folder.mkdir(parents=True, exist_ok=True)
        content = {"schema": "vtrefine/reality@1", "sensor_model": REALITIES[name]().to_dict()}
        (folder / "reality.json").write_text(json.dumps(content, indent=2), encoding="utf-8")


def successes(budget: Budget, trained: str, world: str, seed: int) -> list[bool]:
    """Outcome of every evaluation episode."""
    path = evaluation_dir(budget, trained, world, seed) / "eval_info.json"
    info = json.loads(path.read_text(encoding="utf-8"))
    return [bool(value) for value in info["per_task"][0]["metrics"]["successes"]]


def paired_difference(one: list[bool], two: list[bool]) -> dict[str, object]:
    """Mean of two minus one over the same episodes, with a bootstrap interval over episodes."""
    change = np.array(two, float) - np.array(one, float)
    picks = np.random.default_rng(0).integers(0, len(change), (RESAMPLES, len(change)))
    low, high = np.percentile(change[picks].mean(axis=1), (2.5, 97.5))
    return {"mean": round(float(change.mean()), 4), "ci95": [round(float(low), 4), round(float(high), 4)]}


def compare(budget: Budget) -> dict[str, Any]:
    """Success of every policy in every world over all seeds, and what the diagnosis said."""
    pooled = {
        pair: [success for seed in budget.seeds for success in successes(budget, *pair, seed)]
        for pair in evaluations(budget)
    }
    results = {}
    for name in budget.realities:
        real, model = f"real:{name}", f"diagnosed:{name}"
        verdict = json.loads((budget.diagnosis(name) / "verdict.json").read_text(encoding="utf-8"))
        rates = {
            "imitation in reality": ("bc", real),
            "imitation in the plain simulator": ("bc", "plain"),
            "plain in reality": ("plain", real),
            "plain in its own simulator": ("plain", "plain"),
            "diagnosed in reality": (model, real),
            "diagnosed in its own simulator": (model, model),
        }
        results[name] = {
            "verdict": {
                "status": verdict["status"],
                "causes": [cause["name"] for cause in verdict["causes"]],
                "heldout": verdict["heldout"],
            },
            **{title: proportion(sum(pooled[pair]), len(pooled[pair])) for title, pair in rates.items()},
            "per_seed_in_reality": {
                title: [float(np.mean(successes(budget, trained, real, seed))) for seed in budget.seeds]
                for title, trained in (("plain", "plain"), ("diagnosed", model))
            },
            "diagnosed_minus_plain_in_reality": paired_difference(pooled["plain", real], pooled[model, real]),
        }
    return results


def as_text(results: dict[str, Any]) -> str:
    """The comparison as a Markdown table, and a sentence per reality."""
    lines = [
        "| stand-in reality | fine-tuned in | success in reality | in its own simulator |",
        "|---|---|---|---|",
    ]
    words = []
    for name, row in results.items():
        for title, real, own in (
            ("nowhere (imitation)", "imitation in reality", "imitation in the plain simulator"),
            ("plain", "plain in reality", "plain in its own simulator"),
            ("diagnosed", "diagnosed in reality", "diagnosed in its own simulator"),
        ):
            cells = [interval_text(row[key]["rate"], row[key]["ci95"]) for key in (real, own)]
            lines.append(f"| {name} | {title} | {' | '.join(cells)} |")
        gain = row["diagnosed_minus_plain_in_reality"]
        low, high = gain["ci95"]
        effect = (
            "pays" if low > 0 else "costs" if high < 0 else "makes no difference that these episodes can show"
        )
        found = ", ".join(row["verdict"]["causes"]) or "nothing"
        episodes = row["plain in reality"]["episodes"]
        words.append(
            f"{name}: diagnosis ({row['verdict']['status']}: {found}) {effect}, "
            f"{interval_text(gain['mean'], gain['ci95'])} on the same {episodes} episodes."
        )
    return "\n".join([*lines, "", *words])


def parse() -> tuple[argparse.Namespace, Budget]:
    """Options, and the budget among them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/compare_reality"))
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1, 2], help="of fine-tuning and its episodes"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="runs side by side, each on its share of the cores"
    )
    parser.add_argument("--realities", nargs="+", choices=list(REALITIES), default=list(REALITIES))
    parser.add_argument("--device", default="cpu", help="of the networks: cpu or cuda")
    parser.add_argument("--env", type=json.loads, default={}, help="more flags of the environment, as JSON")
    for name, default in (
        ("num_demos", 80),
        ("pretrain_steps", 1000),
        ("iterations", 30),
        ("envs", 128),
        ("eval_episodes", 200),
        ("eval_envs", 50),
        ("presses", 16),
    ):
        parser.add_argument(f"--{name}", type=int, default=default, help=f"default {default}")
    parser.add_argument("--lane", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.jobs < 1:
        parser.error(f"--jobs must be at least 1, got {options.jobs}")
    fields: dict[str, Any] = {name: getattr(options, name) for name in Budget.__dataclass_fields__}
    fields["realities"], fields["seeds"] = tuple(options.realities), tuple(options.seeds)
    return options, Budget(**fields)


def main() -> None:
    """Prepare, run every policy, compare."""
    options, budget = parse()
    before, policies = lanes(budget)
    if options.lane is not None:
        StageRunner(budget.output_dir, (before | policies)[options.lane]).run()
        return
    write_worlds(budget)
    again = [sys.executable, str(Path(__file__)), *sys.argv[1:]]
    for together in (before, policies):
        run_all(
            {budget.output_dir / name: [*again, f"--lane={name}"] for name in together},
            min(options.jobs, len(together)),
        )
    results = compare(budget)
    save(budget.output_dir, results, as_text(results))


if __name__ == "__main__":
    run_script(main)
