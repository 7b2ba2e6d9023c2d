#!/usr/bin/env python
"""Does diagnosis pay where it matters, in the policy? Train in the plain and in the diagnosed simulator.

    .venv/bin/python scripts/compare_reality.py --seeds 0 1 2
    .venv/bin/python scripts/compare_reality.py --seeds 0 1 2 3 4 5 --jobs 24 --device=cuda
    .venv/bin/python scripts/compare_reality.py --task=cross_gentle --recipe=pads --num_demos=300 \\
        --realities row_sharing+hysteresis+drift --device=cuda --env='{"backend": "warp"}'

A simulation with hidden physics stands in for reality (``--env.reality``); nothing is ever trained in it. The
same recipe (an encoder where the policy has one, demonstrations by the scripted expert, imitation, DPPO) is
followed in the plain simulator and in the one that ``vtrefine-diagnose`` made from recordings: presses of the
hidden pad, or motions of the hidden robot. Budgets and seeds are the same. All policies are then evaluated
in the stand-in reality and in their own simulator, on the same episodes. Every stage is a command that users
run; interrupted and started again, it continues. With ``--jobs`` several run side by side, each on cores of
its own and on the GPUs by turns; one that fails does not stop the others, and the comparison is of the seeds
that are whole. Results: ``comparison.json`` and ``comparison.md``.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from reality.budget import Budget, folder_name, recipe, world_env
from reality.hidden import PLAIN, REALITIES, of_robot
from reality.telling import as_text
from runs.comparison import difference, save
from runs.side_by_side import run_all, run_script

from lerobot_vtrefine.cli.arguments import CommandParser, flags
from lerobot_vtrefine.cli.pipeline.demo_config import (
    RECIPES,
    SEED_STRIDE,
    TRAIN_SEED_OFFSET,
    default_degradation,
)
from lerobot_vtrefine.cli.pipeline.demo_stages import pretrain_stage, record_stage
from lerobot_vtrefine.cli.pipeline.stages import Stage, StageRunner
from lerobot_vtrefine.cli.report.statistics import proportion
from lerobot_vtrefine.cli.results.collect import Progress, last_steps, read_json
from lerobot_vtrefine.cli.results.provenance import write_provenance
from lerobot_vtrefine.cli.results.rows import Run
from lerobot_vtrefine.files import read_yaml
from lerobot_vtrefine.finetune.logger import read_progress
from lerobot_vtrefine.shipped import find
from lerobot_vtrefine.sim.reality import SCHEMA

MOTION_SEED_OFFSET = 500_000
"""Between the seeds of demonstrations and those of fine-tuning."""
MOTION_S, MOTION_HZ = 14, 10
"""Of one motion of a hidden robot."""


def env_flags(budget: Budget, world: str) -> list[str]:
    """The environment's flags of a world."""
    return flags("env", {"type": "vtrefine"} | world_env(budget, world))


def imitation_stages(budget: Budget, world: str) -> list[Stage]:
    """What fine-tuning in a simulator starts from: its encoder, demonstrations, and the policy they teach."""
    config = recipe(budget, budget.seeds[0], world)
    encoder = [encoder_stage(budget, world)] if budget.own_encoder else []
    record = record_stage(config)
    command = (*(word for word in record.command if not word.startswith("--env.")), *env_flags(budget, world))
    record = replace(
        record, name=folder_name("record", world), command=command, needs=diagnosis_needed(world)
    )
    needs = (record.name, *(stage.name for stage in encoder))
    return [
        *encoder,
        record,
        replace(pretrain_stage(config), name=folder_name("pretrain", world), needs=needs),
    ]


def diagnosis_needed(world: str) -> tuple[str, ...]:
    """The stage that makes a simulator, where one does."""
    name = world.partition(":")[2]
    return (output_name(name),) if name else ()


def encoder_stage(budget: Budget, world: str) -> Stage:
    """What the policy sees and feels with."""
    output = budget.encoder(world)
    command = (
        "vtrefine-information",
        *env_flags(budget, world),
        "--senses=[visuo_tactile]",
        f"--effort.device={budget.device}",
        f"--effort.episodes={budget.encoder_episodes}",
        f"--effort.num_envs={min(budget.envs, budget.encoder_episodes // 2)}",
        f"--effort.steps={budget.encoder_steps}",
        "--effort.history=[1]",
        "--effort.closed_loop_episodes=0",
        "--effort.tolerance_episodes=0",
        f"--output_dir={output}",
    )
    title = f"Train the encoder ({world})"
    return Stage(output.name, title, command, output, output / "information.json", diagnosis_needed(world))


def diagnosis_stages(budget: Budget, name: str) -> list[Stage]:
    """Recordings in a stand-in reality, and what diagnosis makes of them."""
    output = budget.diagnosis(name)
    recorded = motion_stage(budget, name) if of_robot(name) else press_stage(budget, name)
    source = "dataset.root" if of_robot(name) else "recording"
    diagnose = ("vtrefine-diagnose", f"--{source}={recorded.output}", f"--output_dir={output}")
    product = output / "verdict.json"
    return [
        recorded,
        Stage(output_name(name), f"Diagnose {name}", diagnose, output, product, (recorded.name,)),
    ]


def press_stage(budget: Budget, name: str) -> Stage:
    """Presses of a hidden pad."""
    folder = budget.output_dir / folder_name(name)
    press = ("vtrefine-press", f"--reality={folder / 'reality.json'}", f"--trials={budget.presses}")
    press, output = (*press, f"--output_dir={folder / 'presses'}"), folder / "presses"
    return Stage(f"press_{folder.name}", f"Press the pad of {name}", press, output, output / "recording.json")


def motion_stage(budget: Budget, name: str) -> Stage:
    """Motions of a hidden robot, recorded as a real one's are: by stock lerobot-record, in real time."""
    output = budget.output_dir / folder_name(name) / "motions"
    whole = {"start": "table", "episode_steps": MOTION_S * MOTION_HZ}  # the recorder stops where episodes end
    env = world_env(budget, f"real:{name}") | whole
    command = (
        "lerobot-record",
        "--robot.type=vtrefine_sim",
        f"--robot.env={json.dumps({key: value for key, value in env.items() if key != 'backend'})}",
        f"--robot.seed={budget.seeds[0] * SEED_STRIDE + MOTION_SEED_OFFSET}",
        "--teleop.type=vtrefine_ee",
        "--teleop.input=excitation",
        "--dataset.repo_id=local/motions",
        f"--dataset.root={output}",
        f"--dataset.num_episodes={budget.motions}",
        f"--dataset.episode_time_s={MOTION_S}",
        "--dataset.reset_time_s=0",
        f"--dataset.fps={MOTION_HZ}",
        "--dataset.single_task=move",
        "--dataset.video=false",
        "--dataset.push_to_hub=false",
        "--play_sounds=false",
    )
    stage, title = f"record_{folder_name(name)}", f"Record the robot of {name}"
    return Stage(stage, title, command, output, output / "meta" / "info.json")


def output_name(name: str) -> str:
    """Name of a diagnosis' stage."""
    return f"diagnose_{folder_name(name)}"


def finetune_dir(budget: Budget, world: str, seed: int) -> Path:
    """Folder of one fine-tuning."""
    return budget.output_dir / folder_name("finetune", world, str(seed))


def tuned_policy(budget: Budget, world: str, seed: int) -> Path:
    """The checkpoint that a fine-tuning leaves."""
    return finetune_dir(budget, world, seed) / "checkpoints" / "last" / "pretrained_model"


def finetune_stage(budget: Budget, world: str, seed: int) -> Stage:
    """DPPO in a simulator, from the imitation learned there."""
    config, output = recipe(budget, seed, world), finetune_dir(budget, world, seed)
    command = (
        "vtrefine-finetune",
        f"--policy.path={budget.imitation(world)}",
        f"--policy.device={budget.device}",
        *env_flags(budget, world),
        *flags("dppo", config.dppo),
        f"--dppo.iterations={budget.iterations}",
        f"--dppo.num_envs={budget.envs}",
        f"--seed={seed * SEED_STRIDE + TRAIN_SEED_OFFSET}",
        f"--output_dir={output}",
        "--resume=true",
    )
    product = tuned_policy(budget, world, seed) / "model.safetensors"
    title, needs = f"Fine-tune in {world}, seed {seed}", (folder_name("pretrain", world),)
    return Stage(output.name, title, command, output, product, needs, resumable=True)


def evaluation_dir(budget: Budget, trained: str, world: str, seed: int) -> Path:
    """Where an evaluation leaves its results."""
    return budget.output_dir / folder_name("eval", trained, "in", world, str(seed))


def evaluation_stage(budget: Budget, trained: str, world: str, seed: int) -> Stage:
    """A policy, the start or named by the world that it was fine-tuned in, on this seed's episodes."""
    output = evaluation_dir(budget, trained, world, seed)
    command = [
        "lerobot-eval",
        f"--policy.path={tuned_policy(budget, trained, seed)}",
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
    needs = (finetune_dir(budget, trained, seed).name,)
    return Stage(output.name, title, tuple(command), output, output / "eval_info.json", needs)


def cells(name: str) -> dict[str, tuple[str, str]]:
    """The comparison's cells for a reality: pairs (trained in, evaluated in) by what they are called."""
    real, model = f"real:{name}", f"diagnosed:{name}"
    return {
        "plain in reality": ("plain", real),
        "plain in its own simulator": ("plain", "plain"),
        "diagnosed in reality": (model, real),
        "diagnosed in its own simulator": (model, model),
    }


def evaluations(budget: Budget) -> list[tuple[str, str]]:
    """Pairs (trained in, evaluated in) of all realities."""
    return list(dict.fromkeys(pair for name in budget.realities for pair in cells(name).values()))


Lanes = dict[str, list[Stage]]
"""Stages that run one after the other, by name."""


def lanes(budget: Budget) -> tuple[Lanes, Lanes]:
    """What runs side by side: every simulator's preparation first, then its policies, by seed."""
    before, policies = {"plain": imitation_stages(budget, "plain")}, {}
    for name in budget.realities:
        world = f"diagnosed:{name}"
        before[folder_name(world)] = [*diagnosis_stages(budget, name), *imitation_stages(budget, world)]
    for world in ("plain", *(f"diagnosed:{name}" for name in budget.realities)):
        pairs = [pair for pair in evaluations(budget) if pair[0] == world]
        for seed in budget.seeds:
            judged = [evaluation_stage(budget, *pair, seed) for pair in pairs]
            lane = folder_name("policy", world, str(seed))
            policies[lane] = [*before[folder_name(world)], finetune_stage(budget, world, seed), *judged]
    return before, policies


def needed(before: Lanes, policies: Lanes) -> dict[str, list[str]]:
    """The preparations that every policy goes on from."""
    return {
        name: [world for world, stages in before.items() if stages[-1] in lane]
        for name, lane in policies.items()
    }


def write_worlds(budget: Budget) -> None:
    """The plain simulator's sensor model, and the files of the hidden realities."""
    (budget.output_dir / "plain").mkdir(parents=True, exist_ok=True)
    PLAIN.save(budget.output_dir / "plain" / "sensor_model.json")
    for name in budget.realities:
        folder = budget.output_dir / folder_name(name)
        folder.mkdir(parents=True, exist_ok=True)
        content = {"schema": SCHEMA} | REALITIES[name]()
        (folder / "reality.json").write_text(json.dumps(content, indent=2), encoding="utf-8")


def results_path(budget: Budget, trained: str, world: str, seed: int) -> Path:
    """What LeRobot's evaluation leaves."""
    return evaluation_dir(budget, trained, world, seed) / "eval_info.json"


def successes(budget: Budget, trained: str, world: str, seed: int) -> list[bool]:
    """Outcome of every evaluation episode."""
    info = json.loads(results_path(budget, trained, world, seed).read_text(encoding="utf-8"))
    return [bool(value) for value in info["per_task"][0]["metrics"]["successes"]]


def compare(budget: Budget) -> dict[str, Any]:
    """Every reality's comparison over the seeds whose evaluations are all there."""
    results = {}
    for name in budget.realities:
        pairs = cells(name).values()
        whole = [s for s in budget.seeds if all(results_path(budget, *pair, s).is_file() for pair in pairs)]
        if whole:
            results[name] = compare_one(budget, name, whole)
    return results


def compare_one(budget: Budget, name: str, seeds: list[int]) -> dict[str, Any]:
    """Success of every policy in every world over these seeds, and what the diagnosis said."""
    verdict = json.loads((budget.diagnosis(name) / "verdict.json").read_text(encoding="utf-8"))
    row: dict[str, Any] = {
        "verdict": {
            "status": verdict["status"],
            "causes": [cause["name"] for cause in verdict["causes"]],
            "heldout": verdict["heldout"],
        },
        "seeds": seeds,
    }
    for title, pair in cells(name).items():
        runs = [successes(budget, *pair, seed) for seed in seeds]
        pooled = proportion(sum(map(sum, runs)), sum(map(len, runs)))
        row[title] = pooled | {"per_seed": [round(float(np.mean(run)), 4) for run in runs]}
    row["reality_minus_simulator"] = difference(row, "plain in its own simulator", "plain in reality")
    row["diagnosed_minus_plain"] = difference(row, "plain in reality", "diagnosed in reality")
    return row


def reality_rows(
    folder: Path, origin: dict[str, str | None], task: str | None = None
) -> list[tuple[Run, Progress]]:
    """Rows of the results file from a comparison's folder: every policy in every world, by seed.

    ``task``: what --task was, if anything.
    """
    rows = []
    for name in REALITIES:
        verdict = read_json(folder / folder_name(name) / "diagnosis" / "verdict.json")
        if verdict is None:  # this reality was not among --realities
            continue
        causes = ", ".join(cause["name"] for cause in verdict["causes"]) or "nothing"
        for title, (trained, world) in cells(name).items():
            prefix = folder_name("eval", trained, "in", world, "")
            for path in sorted(folder.glob(f"{prefix}[0-9]*/eval_info.json")):
                seed = path.parent.name.removeprefix(prefix)
                tuning = folder_name("finetune", trained, seed)
                progress, stamp = (
                    read_progress(folder / tuning),
                    read_json(folder / "stages" / f"{tuning}.json"),
                )
                outcomes = read_json(path)["per_task"][0]["metrics"]["successes"]
                row = Run(
                    table="reality",
                    task=": ".join(filter(None, (task, name))),
                    policy="visuo_tactile",
                    variant=title,
                    seed=int(seed),
                    success=sum(map(bool, outcomes)) / len(outcomes),
                    episodes=len(outcomes),
                    iterations=int(progress[-1]["iteration"]) if progress else None,
                    env_steps=last_steps(progress),
                    extra={"diagnosis": causes},
                    **origin | {"commit": (stamp or {}).get("commit") or origin["commit"]},
                )
                rows.append((row, progress if title.endswith("simulator") else []))
    return rows


def parse() -> tuple[argparse.Namespace, Budget]:
    """Options, and the budget among them."""
    parser = CommandParser(description=__doc__)
    parser.add_argument(
        "--output_dir", type=Path, default=Path("outputs/compare_reality"), help="default: %(default)s"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0, 1, 2], help="of fine-tuning and its episodes"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="runs side by side, each on its share of the cores"
    )
    parser.add_argument(
        "--realities",
        nargs="+",
        choices=list(REALITIES),
        default=list(REALITIES),
        help="what is hidden (default: all)",
    )
    parser.add_argument("--device", default="cpu", help="of the networks: cpu or cuda")
    parser.add_argument("--env", type=json.loads, default={}, help="more flags of the environment, as JSON")
    for name, default in (
        ("num_demos", 80),
        ("pretrain_steps", 1000),
        ("iterations", 20),
        ("envs", 128),
        ("eval_episodes", 200),
        ("eval_envs", 50),
        ("presses", 16),
        ("motions", 12),
    ):
        parser.add_argument(f"--{name}", type=int, default=default, help=f"default {default}")
    parser.add_argument("--lane", help=argparse.SUPPRESS)
    parser.add_argument("--task", help="a file of configs/env (default: the demo's task)")
    parser.add_argument("--recipe", choices=list(RECIPES), default="cloud", help="as vtrefine-demo's")
    for name, words in (("policy", "policy"), ("dppo", "update")):
        parser.add_argument(f"--{name}", type=json.loads, default={}, help=f"flags of the {words}, as JSON")
    parser.add_argument(
        "--degradation",
        type=json.loads,
        default=default_degradation(),
        help="the expert's imperfections, as JSON; {} for none (default %(default)s)",
    )
    for name, default in (("encoder_episodes", 6144), ("encoder_steps", 3000)):
        parser.add_argument(f"--{name}", type=int, default=default, help=f"of recipe pads; default {default}")
    options = parser.parse_args()
    if options.jobs < 1:
        parser.error(f"--jobs must be at least 1, got {options.jobs}")
    if options.task:
        own = read_yaml(find("--config_path", options.task))["env"]
        options.env = {name: value for name, value in own.items() if name != "type"} | options.env
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
    failed = run_lanes(budget, before, policies, options.jobs)
    results = compare(budget)
    save(budget.output_dir, results, as_text(results))
    write_provenance(budget.output_dir)
    if failed is not None:
        raise failed


def run_lanes(
    budget: Budget, before: Lanes, policies: Lanes, jobs: int
) -> subprocess.CalledProcessError | None:
    """Run these lanes, as many side by side; one of the failures, if there was any."""
    folder, again = budget.output_dir, [sys.executable, str(Path(__file__)), *sys.argv[1:]]
    commands = {folder / name: [*again, f"--lane={name}"] for name in before | policies}
    needs = {
        folder / name: [folder / world for world in worlds]
        for name, worlds in needed(before, policies).items()
    }
    try:
        run_all(commands, jobs, needs)
    except subprocess.CalledProcessError as error:
        return error
    return None


if __name__ == "__main__":
    run_script(main)
