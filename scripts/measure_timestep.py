"""What a longer physics step changes: rows of results/timestep.json, one a step.

    python scripts/measure_timestep.py --timesteps_s='[0.001, 0.0025, 0.005]' --episodes=256
    make tables

A trained policy plays the same held-out episodes of a task in every step. Minutes on a CPU.
"""

import time
from pathlib import Path

from tqdm import tqdm

from lerobot_vtrefine.cli.arguments import CommandParser, ListAction, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.cells import share
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Line
from lerobot_vtrefine.cli.results.store import check_results, save
from lerobot_vtrefine.finetune.config import TrustRegionDppo
from lerobot_vtrefine.finetune.evaluation import evaluate
from lerobot_vtrefine.finetune.pipeline import load_practice
from lerobot_vtrefine.shipped import find

ROOT = Path(__file__).parents[1]
TABLE = "timestep"
SHOWN = {
    "peak force [N]": ("eval_peak_force_n", 1.0, 1),
    "slid on the rim [mm]": ("eval_rim_slide_m", 1e3, 1),
    "shifted in the hands [mm]": ("eval_in_hand_shift_m", 1e3, 2),
}
"""Means over the episodes by the table's columns: name, factor and digits."""


def measure(policy: Path, task: Path, timestep_s: float, episodes: int, backend: str, device: str) -> Line:
    """Plays ``episodes`` held-out episodes, which are the same in every step."""
    dppo = TrustRegionDppo(num_envs=episodes, encoder="frozen")
    practice = load_practice(policy, task, dppo, device, backend, timestep_s)
    started = time.perf_counter()
    found = evaluate(practice.env, practice.agent, episodes)
    seconds = time.perf_counter() - started
    return Line(
        table=TABLE,
        cells={
            "task, physics step": f"{task.stem}, {1e3 * timestep_s:g} ms",
            "success": share(round(found["eval_success"] * episodes), episodes),
            **{title: f"{scale * found[name]:.{digits}f}" for title, (name, scale, digits) in SHOWN.items()},
            "an episode takes": f"{1e3 * seconds / episodes:.0f} ms",
        },
        **provenance(),
    )


@run_cli
def main() -> None:
    """Step by step; each is a row as soon as it is measured."""
    parser = CommandParser(description=__doc__)
    parser.add_argument(
        "--timesteps_s",
        action=ListAction,
        kind=float,
        default=[0.001, 0.002, 0.0025, 0.005],
        help="default: %(default)s",
    )
    parser.add_argument("--task", default="square_grasped_1mm", help="a name of configs/env")
    parser.add_argument("--policy", default="square_grasped_1mm", help="that comes with the package")
    parser.add_argument("--episodes", type=at_least(1), default=256, help="per step")
    parser.add_argument("--backend", choices=["batch", "warp"], default="batch", help="default: %(default)s")
    parser.add_argument("--device", default="cpu", help="of policy and, with warp, simulation: cpu or cuda")
    parser.add_argument(
        "--results", type=Path, default=ROOT / "results" / f"{TABLE}.json", help="file of the rows"
    )
    options = parser.parse_args()
    check_results("--results", options.results)
    task, policy = find("--config_path", options.task), find("--policy.path", options.policy)
    for timestep_s in tqdm(options.timesteps_s):
        row = measure(policy, task, timestep_s, options.episodes, options.backend, options.device)
        save(options.results, [(row, [])], replace=False)


if __name__ == "__main__":
    raise SystemExit(main())
