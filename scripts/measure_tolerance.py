"""How precisely must one know where things are? Rows of results/tolerance.json, task by task.

    python scripts/measure_tolerance.py round_grasped square_grasped_1mm cross_gentle --episodes=256
    make tables

The scripted expert knows the truth but for an error of a known size, as
lerobot_vtrefine/information/tolerance.py says. No sensors, no training: minutes on a CPU.
vtrefine-information draws the same as curves, and on them what the senses know.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_vtrefine.cli.arguments import CommandParser, at_least
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.cells import share
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Line
from lerobot_vtrefine.cli.results.store import check_results, save
from lerobot_vtrefine.finetune.pipeline import env_of
from lerobot_vtrefine.information.tolerance import LATERAL, SIZES, Tolerated, tolerance
from lerobot_vtrefine.shipped import find

RESULTS = Path(__file__).parents[1] / "results"
TABLE = "tolerance"


def row(task: str, found: list[Tolerated]) -> Line:
    """A line of the table: success with Wilson's interval at every size."""
    cells = {"expert's error, per axis": task}
    for item in found:
        size = f"{1e3 * item.size:g} mm" if item.error == LATERAL else f"{np.degrees(item.size):.0f}°"
        cells[size] = share(*item.success)
    return Line(table=TABLE, cells=cells, **provenance())


@run_cli
def main() -> None:
    """Task by task; each is a row as soon as it is measured."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("tasks", nargs="+", help="files of configs/env")
    parser.add_argument("--episodes", type=at_least(1), default=256, help="per size of an error")
    parser.add_argument("--num_envs", type=at_least(1), default=64, help="simulations side by side")
    parser.add_argument("--mesh_dir", type=Path, help="folder of the meshes, for pairs from meshes")
    parser.add_argument("--backend", choices=["batch", "warp"], default="batch", help="default: %(default)s")
    parser.add_argument("--results", type=Path, default=RESULTS / f"{TABLE}.json", help="file of the rows")
    options = parser.parse_args()
    check_results("--results", options.results)
    for task in options.tasks:
        env = env_of(find("--config_path", task))
        config = replace(env, backend=options.backend, mesh_dir=options.mesh_dir or env.mesh_dir)
        with tqdm(total=sum(map(len, SIZES.values())), desc=task) as bar:
            found = tolerance(config, options.episodes, options.num_envs, bar.update)
        save(options.results, [(row(task, found), [])], replace=False)


if __name__ == "__main__":
    raise SystemExit(main())
