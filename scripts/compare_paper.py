#!/usr/bin/env python
"""The paper's tables in simulation: AutoMate pairs from the table, with vision and with touch, by DPPO.

    python scripts/compare_paper.py --mesh_dir=MESHES --seeds 0 1 2 --jobs 12
    python scripts/compare_paper.py --mesh_dir=MESHES --pairs 00186 --demonstrations 10 30 50 --jobs 12
    make tables

MESHES holds ID_plug.obj and ID_socket.obj. Per pair an encoder learns to see and feel, from the table on; per
pair and seed demonstrations are recorded once. Policies with touch and with vision only learn from them (on
features that are computed once; where the encoder is trained, by stock lerobot-train) and are fine-tuned by
DPPO, once more from random weights (one step of imitation); stock lerobot-eval judges each, always from the
table, on episodes that are the same for all. Where DPPO practises is --tune_start: on whole episodes (table);
from states that the imitation reached with both parts in hand, or the expert where it reaches too few (bank);
or with parts that are put into the hands (grasped), where a pair can be. Random weights, which never get that
far, practise on whole episodes in place of a bank. On a GPU worlds wait for the one that runs out of time:
--tune_steps=120 ends episodes from a bank earlier, counted from the table. --tune_timestep_s=0.005 practises
in longer physics steps than those in which policies are judged.

Every policy becomes rows of results/paper.json, or of results/demonstrations.json, as soon as it is judged.
The same command again goes on where it was: finished stages are not repeated, nor policies whose rows are
there with these numbers of episodes and iterations, so that it may go on on another machine.
"""

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compare_touch import MODALITIES
from runs.side_by_side import run_all

from lerobot_vtrefine.cli.arguments import CommandParser, flags
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.demo_config import (
    EVAL_SEED_OFFSET,
    RECIPES,
    SEED_STRIDE,
    TRAIN_SEED_OFFSET,
    default_degradation,
)
from lerobot_vtrefine.cli.pipeline.stages import Stage, StageRunner
from lerobot_vtrefine.cli.report.results import load_evaluation
from lerobot_vtrefine.cli.results.collect import Progress, largest_fall, last_steps, save
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.published import (
    DEMONSTRATIONS,
    IMITATION,
    SCRATCH,
    TUNED,
    with_demonstrations,
)
from lerobot_vtrefine.cli.results.rows import Row, Run, read_rows
from lerobot_vtrefine.cli.results.tables import MEASURED
from lerobot_vtrefine.finetune.logger import read_progress
from lerobot_vtrefine.shipped import PREFIX

RESULTS = Path(__file__).parents[1] / "results"
CLONE = Path(__file__).with_name("clone_on_features.py")
TASKS = {
    "00081": "automate_00081",
    "00186": "automate_00186",
    "00007": "automate_00007",
    "00446": "automate_00446",
    "00581": "automate_00581_stands",
}
"""Files of configs/env. The shaft of 00581 stays on the table, as the paper's robot leaves it."""
BANK_SEED_OFFSET = EVAL_SEED_OFFSET + 1_000_000
"""Past the episodes of an evaluation, which no bank may have seen."""
NEVER_IN_HAND = ("00446", "00581")
"""Pairs that the hands cannot hold above each other at the start."""
NO_ROOM = "failed_overflow"
LOST = 0.01
"""Share of episodes without room above which what is left is no result."""


@dataclass(frozen=True)
class Trained:
    """One policy: pair, senses, seed, and how many demonstrations it learnt from; 0: random weights."""

    pair: str
    senses: str
    seed: int
    demonstrations: int

    @property
    def learnt_from(self) -> int:
        """Demonstrations in its dataset, from which random weights take the scale of actions alone."""
        return self.demonstrations or DEMONSTRATIONS

    @property
    def name(self) -> str:
        """For folders and stages."""
        return f"{self.pair}_{self.senses}_{self.seed}_{self.demonstrations}"


def chosen(options: argparse.Namespace) -> list[Trained]:
    """Every policy; seeds side by side share the GPUs by turns."""
    counts = [*options.demonstrations, *([] if options.no_scratch else [0])]
    return [
        Trained(pair, senses, seed, count)
        for pair in options.pairs
        for count in counts
        for seed in options.seeds
        for senses in MODALITIES
    ]


def task_flags(options: argparse.Namespace, pair: str) -> list[str]:
    """The pair's task, from the table."""
    meshes = [f"--env.mesh_dir={options.mesh_dir}"]
    return [f"--config_path={PREFIX}{TASKS[pair]}", *meshes, *flags("env", options.env)]


def dataset(options: argparse.Namespace, policy: Trained) -> Path:
    """Demonstrations of a pair and seed; fewer are the first of more."""
    return options.output_dir / f"demos_{policy.pair}_{policy.seed}_{policy.learnt_from}"


def record_stage(options: argparse.Namespace, policy: Trained) -> Stage:
    """The demonstrations, which policies share."""
    root = dataset(options, policy)
    command = (
        "vtrefine-record-demos",
        *task_flags(options, policy.pair),
        f"--root={root}",
        f"--num_episodes={policy.learnt_from}",
        f"--num_envs={options.demo_envs}",
        f"--seed={policy.seed * SEED_STRIDE}",
        *flags("degradation", default_degradation()),
    )
    product = root / "meta" / "info.json"
    return Stage(root.name, f"Record {root.name}", command, root, product, resumable=True)


def trains_encoder(options: argparse.Namespace) -> bool:
    """Whether each pair's encoder is trained here."""
    return options.recipe == "pads" and not options.encoder and "pretrained_encoder" not in options.policy


def encoder_stage(options: argparse.Namespace, pair: str) -> Stage:
    """What a pair's policies see and feel with, from the table on."""
    out = options.output_dir / f"encoder_{pair}"
    command = (
        "vtrefine-information",
        *task_flags(options, pair),
        f"--env.backend={options.backend}",
        f"--senses=[{','.join(MODALITIES)}]",
        f"--effort.device={options.device}",
        f"--effort.episodes={options.encoder_episodes}",
        f"--effort.num_envs={min(options.eval_envs, options.encoder_episodes // 2)}",
        f"--effort.steps={options.encoder_steps}",
        "--effort.batch_size=1024",
        "--effort.history=[1]",
        "--effort.closed_loop_episodes=0",
        "--effort.tolerance_episodes=0",
        f"--output_dir={out}",
    )
    return Stage(out.name, f"Encoder of {pair}", command, out, out / "information.json")


def policy_settings(options: argparse.Namespace, policy: Trained) -> dict[str, Any]:
    """Of vt_dp3."""
    recipe: dict[str, Any] = RECIPES[options.recipe]["policy"] | options.policy
    if trains_encoder(options):
        return recipe | {"pretrained_encoder": str(encoder_stage(options, policy.pair).output)}
    if options.recipe == "pads" and options.encoder:
        recipe = {"pretrained_encoder": options.encoder.format(pair=policy.pair)} | recipe
    return recipe


def imitation_stage(options: argparse.Namespace, policy: Trained) -> Stage:
    """Imitation of the first demonstrations, or one step of it: random weights."""
    out = options.output_dir / f"imitation_{policy.name}"
    recipe = policy_settings(options, policy)
    steps = options.steps if policy.demonstrations else 1
    frozen = recipe.get("freeze_encoder", False)
    command = (clone_command if frozen else train_command)(options, policy, recipe, steps, out)
    encoder = [encoder_stage(options, policy.pair).name] if trains_encoder(options) else []
    needs = (dataset(options, policy).name, *encoder)
    return Stage(
        out.name, f"Imitation {policy.name}", command, out, checkpoint(out) / "model.safetensors", needs
    )


def clone_command(
    options: argparse.Namespace, policy: Trained, recipe: dict[str, Any], steps: int, out: Path
) -> tuple[str, ...]:
    """What a frozen encoder makes of a frame is computed once."""
    return (
        "python",
        str(CLONE),
        f"--dataset={dataset(options, policy)}",
        f"--policy={json.dumps(recipe | {'modalities': policy.senses})}",
        f"--device={options.device}",
        f"--output_dir={checkpoint(out).parent}",
        f"--steps={steps}",
        f"--batch_size={options.batch_size}",
        f"--seed={policy.seed}",
    )


def train_command(
    options: argparse.Namespace, policy: Trained, recipe: dict[str, Any], steps: int, out: Path
) -> tuple[str, ...]:
    """Stock lerobot-train."""
    return (
        "lerobot-train",
        "--dataset.repo_id=local/vtrefine_demos",
        f"--dataset.root={dataset(options, policy)}",
        *flags("policy", {"type": "vt_dp3"} | recipe),
        f"--policy.modalities={policy.senses}",
        f"--policy.device={options.device}",
        "--policy.push_to_hub=false",
        f"--output_dir={out}",
        f"--steps={steps}",
        f"--save_freq={steps}",
        f"--batch_size={options.batch_size}",
        f"--seed={policy.seed}",
        "--num_workers=0",  # items come from memory
        "--env_eval_freq=0",
    )


def uses_bank(options: argparse.Namespace, policy: Trained) -> bool:
    """Whether DPPO starts from states of a bank."""
    return options.tune_start == "bank" and policy.demonstrations > 0


def practice_flags(options: argparse.Namespace, *, bank: bool) -> list[str]:
    """How practice differs from the task that is judged: physics steps, and when episodes from a bank end.

    Grasps that come after that are none of the bank's states.
    """
    step = [f"--env.scene.timestep_s={options.tune_timestep_s}"] if options.tune_timestep_s else []
    end = [f"--env.episode_steps={options.tune_steps}"] if bank and options.tune_steps else []
    return [*step, *end]


def bank_stage(options: argparse.Namespace, policy: Trained) -> Stage:
    """States with both parts in hand: the imitation's own, then the expert's."""
    out = options.output_dir / f"starts_{policy.name}"
    start = options.output_dir / f"imitation_{policy.name}"
    product = out / "starts.npz"
    command = (
        "vtrefine-record-starts",
        *task_flags(options, policy.pair),
        f"--env.backend={options.backend}",
        *practice_flags(options, bank=True),
        f"--path={product}",
        f"--policy.path={checkpoint(start)}",
        f"--policy.device={options.device}",
        f"--num_starts={options.starts}",
        f"--num_envs={options.eval_envs}",
        f"--seed={policy.seed * SEED_STRIDE + BANK_SEED_OFFSET}",
        *flags("degradation", default_degradation()),
    )
    return Stage(out.name, f"Grasps of {policy.name}", command, out, product, (start.name,))


def finetune_stage(options: argparse.Namespace, policy: Trained) -> Stage:
    """DPPO, in a folder from which an interrupted run goes on."""
    out = options.output_dir / f"finetune_{policy.name}"
    grasped = options.tune_start == "grasped" and policy.pair not in NEVER_IN_HAND
    start = options.output_dir / f"imitation_{policy.name}"
    bank = [bank_stage(options, policy)] if uses_bank(options, policy) else []
    command = (
        "vtrefine-finetune",
        *task_flags(options, policy.pair),
        *(["--env.start=grasped"] if grasped else []),
        *(f"--env.start_bank={stage.product}" for stage in bank),
        *practice_flags(options, bank=bool(bank)),
        f"--env.backend={options.backend}",
        f"--policy.path={checkpoint(start)}",
        f"--policy.device={options.device}",
        *flags("dppo", dppo_settings(options)),
        f"--dppo.iterations={iterations_of(options, policy)}",
        f"--dppo.num_envs={options.worlds}",
        "--eval_freq=0",
        f"--seed={policy.seed * SEED_STRIDE + TRAIN_SEED_OFFSET}",
        f"--output_dir={out}",
        "--resume=true",
    )
    product = checkpoint(out) / "model.safetensors"
    needs = (start.name, *(stage.name for stage in bank))
    return Stage(out.name, f"DPPO {policy.name}", command, out, product, needs, resumable=True)


def dppo_settings(options: argparse.Namespace) -> dict[str, Any]:
    """The recipe's, with the preset for many worlds on a GPU."""
    preset = {"type": "trust_region"} if options.backend == "warp" else {}
    return RECIPES[options.recipe]["dppo"] | preset | options.dppo


def iterations_of(options: argparse.Namespace, policy: Trained) -> int:
    """DPPO iterations: what never succeeds learns nothing, and may be stopped earlier."""
    return options.iterations if policy.demonstrations else options.scratch_iterations


def evaluation_stage(options: argparse.Namespace, policy: Trained, stage: str) -> Stage:
    """Stock lerobot-eval of ``imitation`` or ``finetune``, from the table."""
    trained = options.output_dir / f"{stage}_{policy.name}"
    out = options.output_dir / f"eval_{trained.name}"
    command = (
        "lerobot-eval",
        *task_flags(options, policy.pair),
        f"--env.backend={options.backend}",
        f"--policy.path={checkpoint(trained)}",
        f"--policy.device={options.device}",
        "--env.video_episodes=0",
        f"--env.metrics_path={out / 'episodes.jsonl'}",
        f"--eval.n_episodes={options.episodes}",
        f"--eval.batch_size={min(options.eval_envs, options.episodes)}",
        f"--seed={first_seed(policy)}",
        f"--output_dir={out}",
    )
    return Stage(out.name, f"Evaluate {trained.name}", command, out, out / "eval_info.json", (trained.name,))


def checkpoint(folder: Path) -> Path:
    """What --policy.path takes."""
    return folder / "checkpoints" / "last" / "pretrained_model"


def first_seed(policy: Trained) -> int:
    """Of the evaluation; the same for all policies of a seed."""
    return policy.seed * SEED_STRIDE + EVAL_SEED_OFFSET


def shared_stages(options: argparse.Namespace, policy: Trained) -> list[Stage]:
    """What several policies use."""
    encoder = [encoder_stage(options, policy.pair)] if trains_encoder(options) else []
    return [*encoder, record_stage(options, policy)]


def stages(options: argparse.Namespace, policy: Trained) -> list[Stage]:
    """All of one policy's. Random weights are not judged before DPPO."""
    before = [*shared_stages(options, policy), imitation_stage(options, policy)]
    if policy.demonstrations:
        before.append(evaluation_stage(options, policy, "imitation"))
    if uses_bank(options, policy):
        before.append(bank_stage(options, policy))
    return [*before, finetune_stage(options, policy), evaluation_stage(options, policy, "finetune")]


def variants(policy: Trained) -> dict[str, str]:
    """What its rows are called, by the stage that is judged."""
    if not policy.demonstrations:
        return {"finetune": SCRATCH}
    return {"imitation": IMITATION, "finetune": TUNED}


def tables(policy: Trained) -> list[str]:
    """Tables that it belongs to."""
    paper = ["paper"] if policy.demonstrations in (0, DEMONSTRATIONS) else []
    return [*paper, *(["demonstrations"] if policy.demonstrations else [])]


def rows(options: argparse.Namespace, policy: Trained, table: str) -> list[tuple[Row, Progress]]:
    """What was found, with the learning curve beside the tuned policy."""
    found: list[tuple[Row, Progress]] = []
    progress = read_progress(options.output_dir / f"finetune_{policy.name}")
    for stage, kind in variants(policy).items():
        tuned = stage == "finetune"
        judged = load_evaluation(options.output_dir / f"eval_{stage}_{policy.name}", first_seed(policy))
        medians = judged["metrics"]["successes"]
        extra = {key: medians[key]["median"] for key, *_ in MEASURED if medians.get(key)}
        extra |= failures(judged)
        tell_of_room(f"{stage} of {policy.name}", extra.get(NO_ROOM, 0.0))
        if tuned:
            extra |= {"largest_fall": largest_fall(progress)}
        row = Run(
            **key(policy, table, kind),
            success=judged["success"] / judged["episodes"],
            episodes=judged["episodes"],
            iterations=iterations_of(options, policy) if tuned else 0,
            env_steps=last_steps(progress) if tuned else 0,
            extra=extra,
            **provenance() | {"commit": provenance()["commit"] or options.commit},
        )
        found.append((row, progress if tuned else []))
    return found


def failures(judged: dict[str, Any]) -> dict[str, float]:
    """Shares of an evaluation's episodes: both parts picked up, and what ended those that failed."""
    shares = {
        f"failed_{name.replace(' ', '_').replace('-', '_')}": count / judged["episodes"]
        for name, count in judged["failures"].items()
    }
    if judged["picked_up"] is not None:
        shares["picked_up"] = judged["picked_up"]
    return {name: round(share, 4) for name, share in sorted(shares.items())}


def tell_of_room(name: str, share: float) -> None:
    """Warn where the simulation ended episodes by itself: worlds share their room, and whole batches end."""
    if share > LOST:
        print(
            f"warning: {name}: {share:.0%} of the episodes ended because the simulation had no room for more"
            " contacts; start anew with more, "
            """--env='{"warp": {"contacts_per_world": 512, "rows_per_world": 1024}}'""",
            file=sys.stderr,
        )


def key(policy: Trained, table: str, kind: str) -> dict[str, Any]:
    """Table, task, policy, variant and seed of a row."""
    named = with_demonstrations(policy.demonstrations, kind) if table == "demonstrations" else kind
    identity = {"table": table, "task": f"automate/{policy.pair}", "policy": policy.senses}
    return identity | {"variant": named, "seed": policy.seed}


def is_done(options: argparse.Namespace, policy: Trained) -> bool:
    """Whether all rows of a policy are there, with these numbers of episodes and iterations."""
    for table in tables(policy):
        path = options.results / f"{table}.json"
        there = {row.key: row for row in (read_rows(path) if path.is_file() else []) if isinstance(row, Run)}
        for stage, kind in variants(policy).items():
            row = there.get(tuple(key(policy, table, kind).values()))
            wanted = iterations_of(options, policy) if stage == "finetune" else 0
            if row is None or (row.episodes, row.iterations) != (options.episodes, wanted):
                return False
    return True


def make_parser() -> CommandParser:
    """The command line."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--mesh_dir", type=Path, required=True, help="folder of the meshes")
    parser.add_argument("--pairs", nargs="+", choices=list(TASKS), default=list(TASKS), help="default: all")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: %(default)s")
    parser.add_argument(
        "--demonstrations",
        type=int,
        nargs="+",
        default=[DEMONSTRATIONS],
        help="numbers to imitate (default: %(default)s)",
    )
    parser.add_argument("--no_scratch", action="store_true", help="leave out DPPO without pre-training")
    parser.add_argument("--recipe", choices=list(RECIPES), default="pads", help="as vtrefine-demo's")
    parser.add_argument(
        "--encoder",
        help="of --recipe=pads, in place of one trained here; {pair} stands for the pair's number",
    )
    parser.add_argument("--encoder_episodes", type=int, default=4096, help="that an encoder learns from")
    parser.add_argument("--encoder_steps", type=int, default=4000, help="of an encoder's training")
    parser.add_argument("--steps", type=int, default=6000, help="of imitation")
    parser.add_argument("--batch_size", type=int, default=128, help="of imitation (default %(default)s)")
    parser.add_argument("--iterations", type=int, default=60, help="of DPPO")
    parser.add_argument("--scratch_iterations", type=int, default=20, help="of DPPO without pre-training")
    parser.add_argument("--worlds", type=int, default=512, help="of DPPO")
    parser.add_argument("--tune_start", choices=["table", "bank", "grasped"], default="table", help="of DPPO")
    parser.add_argument("--tune_steps", type=int, help="control step at which episodes from a bank end")
    parser.add_argument("--tune_timestep_s", type=float, help="longest physics step [s] of DPPO")
    parser.add_argument("--starts", type=int, default=512, help="states in a bank")
    parser.add_argument("--episodes", type=int, default=512, help="of an evaluation")
    parser.add_argument("--eval_envs", type=int, default=512, help="episodes evaluated at once")
    parser.add_argument("--demo_envs", type=int, default=16, help="episodes recorded at once")
    for name, words in (("env", "environment"), ("policy", "policy"), ("dppo", "update")):
        parser.add_argument(
            f"--{name}", type=json.loads, default={}, help=f"more flags of the {words}, as JSON"
        )
    parser.add_argument("--device", default="cuda", help="of the networks")
    parser.add_argument("--backend", choices=["batch", "warp"], help="default: warp on cuda, else batch")
    parser.add_argument("--jobs", type=int, default=1, help="policies side by side (default 1)")
    parser.add_argument("--commit", help="of the code, where no checkout tells it")
    parser.add_argument(
        "--output_dir",
        type=Path,
        default=Path("outputs/compare_paper"),
        help="of all runs (default: %(default)s)",
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of paper.json")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    return parser


def side_by_side(options: argparse.Namespace, names: list[str]) -> None:
    """This script again for each of these stages or policies."""
    again = [sys.executable, __file__, *sys.argv[1:]]
    commands = {options.output_dir / "runs" / name: [*again, f"--only={name}"] for name in names}
    if commands:
        run_all(commands, min(options.jobs, len(commands)))


@run_cli
def main() -> None:
    """Encoders and demonstrations first, then every policy that has no rows yet."""
    options = make_parser().parse_args()
    options.backend = options.backend or ("warp" if options.device == "cuda" else "batch")
    left = [policy for policy in chosen(options) if not is_done(options, policy)]
    shared = {stage.name: stage for policy in left for stage in shared_stages(options, policy)}
    if options.only in shared:
        StageRunner(options.output_dir, [shared[options.only]]).run()
    elif options.only is not None:
        (policy,) = (policy for policy in left if policy.name == options.only)
        finish(options, policy)
    elif options.jobs > 1:
        side_by_side(options, list(shared))
        side_by_side(options, [policy.name for policy in left])
    else:
        for policy in left:
            finish(options, policy)


def finish(options: argparse.Namespace, policy: Trained) -> None:
    """One policy's stages, and its rows."""
    StageRunner(options.output_dir, stages(options, policy)).run()
    for table in tables(policy):
        found = rows(options, policy, table)
        save(options.results / f"{table}.json", found, replace=False)


if __name__ == "__main__":
    raise SystemExit(main())
