"""Which tasks need touch? ``vtrefine-information`` on each, its verdict as a row of results/touch_tasks.json.

    python scripts/judge_tasks.py key_turned key_turned_twin --effort.device=cuda --env.backend=warp
    make tables

Regressors are the policy's own encoder and a larger network (--effort.networks='[policy]' leaves that one
out); what counts for each set of senses is the better one. Flags that this script does not know go to
``vtrefine-information``. A study lies in outputs/information_TASK, where scripts/compare_touch.py finds its
encoders; one that is there is not made again: remove the folder for that.
"""

import json
import sys
from pathlib import Path
from typing import Any

from runs.side_by_side import run_all

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.cells import percent, share
from lerobot_vtrefine.cli.results.collect import origin_of
from lerobot_vtrefine.cli.results.rows import Line
from lerobot_vtrefine.cli.results.store import check_results, save
from lerobot_vtrefine.information import estimator
from lerobot_vtrefine.information.contact import SIDE

TABLE = "touch_tasks"
RESULTS = Path(__file__).parents[1] / "results"
SENSES = {"vision and touch": "visuo_tactile", "vision": "visual", "joints alone": "joints"}
NETWORKS = f"[{', '.join(estimator.NETWORKS)}]"
TURN = "plug_in_hand_rx"
"""The plug's turn about the pads' normal."""


def study(task: str, folder: Path, extra: list[str]) -> None:
    """Run the study of one task."""
    command = [sys.executable, "-m", "lerobot_vtrefine.cli.information"]
    command += [f"--config_path=vtrefine:{task}", f"--output_dir={folder}", f"--effort.networks={NETWORKS}"]
    command += extra  # what is given twice counts the last time
    run_all({folder: command}, jobs=1)


def row(task: str, folder: Path) -> Line:
    """What a study found, as a line of the table."""
    found = json.loads((folder / "information.json").read_text(encoding="utf-8"))
    best = {words: best_finding(found, senses) for words, senses in SENSES.items()}
    compared = [best[words] for words in ("vision and touch", "vision") if best[words]]
    turns = [found["prior"][TURN], *(item["rms"][TURN]["rms"] for item in compared)]
    unseen = found["contact_unseen"].get(SIDE)
    sides = [] if unseen is None else [unseen, *(item["contact"][SIDE]["share"] for item in compared)]
    cells = {
        "task": task,
        "the expert knows the truth, %": counted(found["true_state"]),
        **{f"{words}, %": counted(item.get("expert")) for words, item in best.items()},
        "turn of the plug in its hand: nothing, vision and touch, vision, °": ", ".join(
            f"{value:.1f}" for value in turns
        ),
        "side of the contact told rightly: nothing, vision and touch, vision, %": ", ".join(
            map(percent, sides)
        ),
        "": found["judged"],
    }
    return Line(table=TABLE, cells=cells, **origin_of(folder))


def best_finding(found: dict[str, Any], senses: str) -> dict[str, Any]:
    """Of all networks and lengths of history the one on which the expert succeeds most; empty without any."""
    made = [item for item in found["findings"] if item["senses"] == senses]
    return max(made, key=lambda item: item["expert"]["success"] if item["expert"] else 0, default={})


def counted(proportion: dict[str, Any] | None) -> str:
    """Success in per cent with its interval; a dash where the expert did not act."""
    if proportion is None:
        return "-"
    return share(proportion["success"], proportion["episodes"])


@run_cli
def main() -> None:
    """Study what is missing, then keep all rows."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("tasks", nargs="+", metavar="TASK", help="name of a file of configs/env")
    parser.add_argument("--results", type=Path, default=RESULTS / f"{TABLE}.json", help="file of the rows")
    parser.add_argument(
        "--outputs", type=Path, default=Path("outputs"), help="folder of the studies (default: %(default)s)"
    )
    options, extra = parser.parse_known_args()
    check_results("--results", options.results)
    for task in options.tasks:
        folder = options.outputs / f"information_{task}"
        if not (folder / "information.json").is_file():
            study(task, folder, extra)
        line = row(task, folder)
        save(options.results, [(line, [])], replace=False)
        print(" | ".join(line.cells.values()))


if __name__ == "__main__":
    raise SystemExit(main())
