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
from pathlib import Path
from typing import Any

from runs.comparison import difference, effect, interval_text, over_seeds, rate_text, save
from runs.side_by_side import run_all

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.pipeline.demo_config import default_env
from lerobot_vtrefine.cli.pipeline.stages import find_command
from lerobot_vtrefine.files import read_yaml
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
TIGHT: dict[str, Any] = {
    "clearance_m": 0.001,
    "scene": {"timestep_s": 0.002, "rigid_time_constant_s": 0.004},
}
"""Half the clearance, and the shorter physics steps that it needs."""
ASKEW: dict[str, Any] = {"rules": {"grasped": {"slip_m": 0.004, "slip_rad": 0.1}}}
"""Parts lie twice as far from where the hands expect them."""

SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "demo": {},
    "tight": {"env": TIGHT},
    "occluded": {"env": {"scene": {"camera": FROM_ABOVE}}},
    "slip": {"env": ASKEW},
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
WORLDS: dict[str, dict[str, dict[str, Any]]] = {
    "worlds_round": {"env": {"pair": "round", "clearance_m": 0.002}},
    "worlds_square": {
        "env": {"pair": "square", **TIGHT, **ASKEW},
        "policy": {"pretrained_encoder": "vtrefine:square_grasped_1mm"},
    },
    "worlds_key": {
        "env": {"pair": "key", **TIGHT},
        "policy": {"pretrained_encoder": "vtrefine:key_grasped_1mm"},
    },
}
"""Tasks for MANY_WORLDS."""
TOUCH_TASKS = ("key_turned", "cross_gentle", "cross_limited", "d_occluded")
"""Files of configs/env; each has a twin ``TASK_twin``, whose parts lie in the hands as the hands expect."""
TASK_FILES = Path(__file__).parents[1] / "configs" / "env"


def touch_setting(task: str) -> dict[str, dict[str, Any]]:
    """A touch task or a twin for MANY_WORLDS, with the encoder of the task."""
    env = read_yaml(TASK_FILES / f"{task}.yaml")["env"]
    name = task.removesuffix("_twin")
    encoder = f"{PREFIX}{name}" if name in encoders() else f"outputs/information_{name}"
    return {"env": env, "policy": {"pretrained_encoder": encoder}}


for _task in TOUCH_TASKS:
    WORLDS |= {name: touch_setting(name) for name in (_task, f"{_task}_twin")}

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
    own = [f"--modalities={modality}", f"--seed={seed}", f"--output_dir={folder}"]
    return [find_command("vtrefine-demo"), *own, *setting_flags(setting), *extra]


def compare(results: dict[str, dict[int, dict]]) -> dict:
    """Mean success of each modality, and the difference that touch makes per seed, on the same episodes."""
    comparison = {}
    for policy in POLICIES:
        rows = {}
        for modality in MODALITIES:
            runs = [run[policy] for run in results[modality].values()]
            rows[modality] = over_seeds(*([run[name] for run in runs] for name in ("success", "episodes")))
        rows["touch_minus_visual"] = difference(rows, "visual", "visuo_tactile")
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
            cells.append(interval_text(**rows["touch_minus_visual"]))
            lines.append(f"| {' | '.join([setting, title, *cells])} |")
        gain = comparison["finetune"]["touch_minus_visual"]
        words.append(f"{setting}: after DPPO, touch {effect(**gain)}.")
    return "\n".join([*lines, "", *words])


@run_cli
def main() -> None:
    """Parse, run every pipeline, compare."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="default: %(default)s")
    parser.add_argument(
        "--settings", nargs="+", choices=[*SETTINGS, *WORLDS], default=["demo"], help="default: %(default)s"
    )
    parser.add_argument(
        "--output_dir", type=Path, default=Path("outputs/compare_touch"), help="default: %(default)s"
    )
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


if __name__ == "__main__":
    raise SystemExit(main())
