#!/usr/bin/env python
"""Does touch pay? Train visuo-tactile and visual-only policies the same way on several seeds and compare.

    .venv/bin/python scripts/compare_touch.py --seeds 0 1 2 --settings demo tight occluded slip short_chunk
    .venv/bin/python scripts/compare_touch.py --seeds 1 2 3 --settings worlds_round worlds_square --jobs 4

The settings worlds_*, and the touch tasks of docs/task.md with their twins, are the recipe of
docs/learning.md and need GPUs. Their encoders come with the package, but for key_turned's, which is taken
from outputs/information_key_turned, where scripts/judge_tasks.py leaves it; a twin takes its task's.

Every run is one ``vtrefine-demo`` in one of the settings below; flags that this script does not know are
passed on to it, after the setting's, for example ``--num_demos=40``. On a machine with many cores ``--jobs``
runs several side by side, each on cores of its own, and on the GPUs by turns. Interrupted and started again,
it continues. The comparison is printed and saved as ``comparison.json`` and ``comparison.md``.
"""

import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.pipeline.demo_config import default_env
from lerobot_vtrefine.cli.report.statistics import mean_interval, proportion
from lerobot_vtrefine.shipped import PREFIX, encoders

MODALITIES = ("visuo_tactile", "visual")
POLICIES = {"pretrain": "imitation", "finetune": "after DPPO"}


FROM_ABOVE = {
    "width": 80,
    "height": 60,
    "fov_y_rad": 0.384,
    "position_m": [-0.05, 0.0, 0.6],
    "target_m": [0.0, 0.0, 0.145],
}
"""A camera from which the plug hides the hole."""

SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "demo": {},
    "tight": {"env": {"clearance_m": 0.001, "scene": {"timestep_s": 0.002, "rigid_time_constant_s": 0.004}}},
    "occluded": {"env": {"scene": {"camera": FROM_ABOVE}}},
    "slip": {"env": {"rules": {"grasped": {"slip_m": 0.004, "slip_rad": 0.1}}}},
    "short_chunk": {"policy": {"n_action_steps": 4}},
}
"""What differs from the demo: half the clearance, a hidden hole, twice the slip in the hand, or decisions
twice as often."""

FEW_WORLDS: dict[str, Any] = {"recipe": "cloud", "env": default_env(), "policy": {}}
"""The demo with the paper's cloud, on CPU threads."""
MANY_WORLDS: dict[str, Any] = {
    "env": {"start": "grasped", "backend": "warp"},
    "recipe": "pads",
    "policy": {},
    "dppo": {"type": "trust_region"},
    "num_demos": 100,
    "pretrain_steps": 2000,
    "finetune_iterations": 36,
    "finetune_envs": 1024,
    "eval_episodes": 1024,
    "eval_envs": 512,
    "ablation_episodes": 0,
    "videos": 0,
    "device": "cuda",
}
"""The demo on a GPU: 1024 worlds and a trust region."""
_TIGHT = {"clearance_m": 0.001, "scene": {"timestep_s": 0.002, "rigid_time_constant_s": 0.004}}
_ASKEW = {"rules": {"grasped": {"slip_m": 0.004, "slip_rad": 0.1}}}
WORLDS: dict[str, dict[str, dict[str, Any]]] = {
    "worlds_round": {"env": {"pair": "round", "clearance_m": 0.002}},
    "worlds_square": {
        "env": {"pair": "square", **_TIGHT, **_ASKEW},
        "policy": {"pretrained_encoder": "vtrefine:square_grasped_1mm"},
    },
    "worlds_key": {
        "env": {"pair": "key", **_TIGHT},
        "policy": {"pretrained_encoder": "vtrefine:key_grasped_1mm"},
    },
}
"""Tasks for MANY_WORLDS."""
TOUCH_TASKS = ("key_turned", "cross_gentle", "cross_limited", "d_occluded")
"""Files of configs/env; each has a twin ``TASK_twin``, whose parts lie in the hands as the hands expect."""
TASK_FILES = Path(__file__).parents[1] / "configs" / "env"


def touch_setting(task: str) -> dict[str, dict[str, Any]]:
    """A touch task or a twin for MANY_WORLDS, with the encoder of the task."""
    env = yaml.safe_load((TASK_FILES / f"{task}.yaml").read_text(encoding="utf-8"))["env"]
    name = task.removesuffix("_twin")
    encoder = f"{PREFIX}{name}" if name in encoders() else f"outputs/information_{name}"
    return {"env": env, "policy": {"pretrained_encoder": encoder}}


for _task in TOUCH_TASKS:
    WORLDS |= {name: touch_setting(name) for name in (_task, f"{_task}_twin")}

POLL_S = 0.5

Run = tuple[str, str, int]
"""Setting, modality and seed."""


def setting_flags(setting: str) -> list[str]:
    """The demo's flags that make a setting."""
    defaults = FEW_WORLDS if setting in SETTINGS else MANY_WORLDS
    changes = (SETTINGS | WORLDS)[setting]
    return [f"--{name}={_value(values, changes.get(name, {}))}" for name, values in defaults.items()]


def _value(default: Any, changes: dict[str, Any]) -> str:
    return json.dumps(default | changes) if isinstance(default, dict) else str(default)


def demo_command(folder: Path, run: Run, extra: list[str]) -> list[str]:
    """The command line of one pipeline."""
    setting, modality, seed = run
    command = shutil.which("vtrefine-demo", path=str(Path(sys.executable).parent)) or "vtrefine-demo"
    own = [f"--modalities={modality}", f"--seed={seed}", f"--output_dir={folder}"]
    return [command, *own, *setting_flags(setting), *extra]


@dataclass(frozen=True)
class Share:
    """What one of several runs side by side may use of the machine."""

    cores: list[int]
    """Empty where the cores cannot be chosen."""
    gpu: str | None
    """As ``CUDA_VISIBLE_DEVICES`` names it; None without a GPU."""


def run_all(commands: dict[Path, list[str]], jobs: int) -> None:
    """Run the pipelines, ``jobs`` side by side; finished stages are not repeated.

    Side by side, each prints to ``FOLDER.log`` and keeps to its own share of the machine. One that fails
    does not stop the others.

    Raises:
        subprocess.CalledProcessError: a pipeline failed.
    """
    failed: list[subprocess.CalledProcessError] = []
    if jobs == 1:
        for folder, command in commands.items():
            print(f"\n== {folder.name}", flush=True)
            status = subprocess.run(command, check=False).returncode
            failed += [subprocess.CalledProcessError(status, command)] if status else []
    else:
        failed = run_together(commands, jobs)
    if failed:
        raise failed[0]


def run_together(commands: dict[Path, list[str]], jobs: int) -> list[subprocess.CalledProcessError]:
    """Run the pipelines side by side; the failures."""
    free, waiting, running = shares(jobs), list(commands), {}
    failed: list[subprocess.CalledProcessError] = []
    try:
        while waiting or running:
            while waiting and free:
                folder, share = waiting.pop(0), free.pop(0)
                print(f"== {folder.name}: progress in {folder}.log", flush=True)
                running[folder] = (start(commands[folder], folder, share), share)
            for folder in [name for name, (child, _) in running.items() if child.poll() is not None]:
                child, share = running.pop(folder)
                free.append(share)
                if child.returncode:
                    failed.append(subprocess.CalledProcessError(child.returncode, commands[folder]))
                print(f"== {folder.name}: {'failed' if child.returncode else 'done'}", flush=True)
            time.sleep(POLL_S)
    finally:
        for child, _ in running.values():
            child.terminate()
    return failed


def shares(jobs: int) -> list[Share]:
    """The machine, dealt out to ``jobs`` runs: cores in equal parts, GPUs by turns."""
    cores, gpus = usable_cores(), visible_gpus()
    part = len(cores) // jobs
    return [
        Share(cores[job * part : (job + 1) * part], gpus[job % len(gpus)] if gpus else None)
        for job in range(jobs)
    ]


def usable_cores() -> list[int]:
    """The cores that this process may use; none where the system does not tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return named.split(",") if named else [str(index) for index in range(torch.cuda.device_count())]


def start(command: list[str], folder: Path, share: Share) -> subprocess.Popen:
    """One pipeline in the background, on its share of the machine."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    pin = partial(os.sched_setaffinity, 0, share.cores) if share.cores else None
    env = os.environ | ({"CUDA_VISIBLE_DEVICES": share.gpu} if share.gpu else {})
    with Path(f"{folder}.log").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, preexec_fn=pin, env=env)


def compare(results: dict[str, dict[int, dict]]) -> dict:
    """Pooled success of each modality, and the difference that touch makes per seed, on the same episodes."""
    comparison = {}
    for policy in POLICIES:
        rows = {}
        for modality in MODALITIES:
            runs = [run[policy] for run in results[modality].values()]
            pooled = proportion(sum(run["success"] for run in runs), sum(run["episodes"] for run in runs))
            rows[modality] = pooled | {"per_seed": [run["rate"] for run in runs]}
        pairs = zip(*(rows[modality]["per_seed"] for modality in MODALITIES), strict=True)
        mean, low, high = mean_interval([touch - sight for touch, sight in pairs])
        rows["touch_minus_visual"] = {"mean": round(mean, 4), "ci95": [round(low, 4), round(high, 4)]}
        comparison[policy] = rows
    return comparison


def as_text(comparisons: dict[str, dict]) -> str:
    """The comparisons as a Markdown table, and one sentence per setting."""
    lines = [
        "| setting | policy | visuo-tactile | visual only | difference (per seed) |",
        "|---|---|---|---|---|",
    ]
    words = []
    for setting, comparison in comparisons.items():
        for policy, title in POLICIES.items():
            rows = comparison[policy]
            cells = [rate_text(rows[modality]) for modality in MODALITIES]
            cells.append(
                interval_text(rows["touch_minus_visual"]["mean"], rows["touch_minus_visual"]["ci95"])
            )
            lines.append(f"| {' | '.join([setting, title, *cells])} |")
        words.append(f"{setting}: after DPPO, touch {verdict(comparison['finetune'])}.")
    return "\n".join([*lines, "", *words])


def verdict(rows: dict) -> str:
    """What the interval of the difference allows to say."""
    low, high = rows["touch_minus_visual"]["ci95"]
    return "pays" if low > 0 else "costs" if high < 0 else "makes no difference that these seeds can show"


def rate_text(row: dict) -> str:
    """Pooled rate with its interval, and the seeds' rates."""
    seeds = ", ".join(f"{100 * rate:.0f}" for rate in row["per_seed"])
    return f"{interval_text(row['rate'], row['ci95'])} (seeds: {seeds})"


def interval_text(value: float, interval: list[float]) -> str:
    """For example ``36 % [29, 42]``; one seed has no interval."""
    if not all(map(math.isfinite, interval)):
        return f"{100 * value:.0f} % (one seed)"
    return f"{100 * value:.0f} % [{100 * interval[0]:.0f}, {100 * interval[1]:.0f}]"


def main() -> None:
    """Parse, run every pipeline, compare."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--settings", nargs="+", choices=[*SETTINGS, *WORLDS], default=["demo"])
    parser.add_argument("--output_dir", type=Path, default=Path("outputs/compare_touch"))
    parser.add_argument("--jobs", type=int, default=1, help="pipelines side by side (default 1)")
    options, extra = parser.parse_known_args()
    if options.jobs < 1:
        parser.error(f"--jobs must be at least 1, got {options.jobs}")
    folders = {
        (setting, modality, seed): options.output_dir / setting / f"{modality}_{seed}"
        for setting in options.settings
        for seed in options.seeds
        for modality in MODALITIES
    }
    run_all({folder: demo_command(folder, run, extra) for run, folder in folders.items()}, options.jobs)
    comparisons = {setting: compare(results_of(folders, setting)) for setting in options.settings}
    save(options.output_dir, comparisons, as_text(comparisons))


def results_of(folders: dict[Run, Path], setting: str) -> dict[str, dict[int, dict]]:
    """Results of the pipelines of one setting, by modality and seed."""
    results: dict[str, dict[int, dict]] = {modality: {} for modality in MODALITIES}
    for (name, modality, seed), folder in folders.items():
        if name == setting:
            content = (folder / "results.json").read_text(encoding="utf-8")
            results[modality][seed] = json.loads(content)
    return results


def save(folder: Path, comparison: dict[str, Any], text: str) -> None:
    """Keep a comparison as ``comparison.json`` and ``comparison.md``, and print it."""
    (folder / "comparison.json").write_text(json.dumps(comparison, indent=2) + "\n", encoding="utf-8")
    (folder / "comparison.md").write_text(text + "\n", encoding="utf-8")
    print(f"\n{text}")


def run_script(entry: Callable[[], None]) -> None:
    """Run a script's entry; it ends with the status of the pipeline that failed, or 130 when interrupted."""
    try:
        entry()
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    run_script(main)
