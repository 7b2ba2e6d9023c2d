"""Measure how often the scripted expert inserts, for every body, pair, clearance and start.

    python scripts/measure_expert.py --episodes=50
    python scripts/measure_expert.py --bodies kinova --pairs automate/00081 --mesh_dir=FOLDER
    make tables

Every setting that is done comes to results/expert.json at once, and the same command goes on where it was
stopped: it measures what has fewer episodes than asked for. To measure anew, remove that file. Mesh pairs
have a clearance of their own. Episode i has seed i.
"""

import itertools
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lerobot_vtrefine.cli.arguments import CommandParser
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.results.provenance import provenance
from lerobot_vtrefine.cli.results.rows import Run, read_rows
from lerobot_vtrefine.cli.results.store import check_results, save
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.embodiments.embodiment import STARTS
from lerobot_vtrefine.sim.config import MESH_PAIR_PREFIX, PROCEDURAL_PAIRS, SceneConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import InsertionSim
from lerobot_vtrefine.sim.task import FAILURES

TABLE = "expert"
RESULTS = Path(__file__).parents[1] / "results"
CLEARANCES_M = (0.002, 0.001)
TIGHT = {"timestep_s": 0.002, "rigid_time_constant_s": 0.004}
"""Of meshes and clearances of 1 mm, as SceneConfig asks for."""


@dataclass(frozen=True)
class Setting:
    """What one row measures."""

    body: str
    pair: str
    clearance_m: float | None
    """None for meshes, which have their own."""
    start: str
    socket: str = "held"

    @property
    def task(self) -> str:
        """The row's task."""
        words = self.pair if self.clearance_m is None else f"{self.pair}, {1e3 * self.clearance_m:g} mm"
        return words if self.socket == "held" else f"{words}, socket stands"

    def scene(self, mesh_dir: Path | None) -> SceneConfig:
        """The scene; raises ValueError for what cannot be."""
        scene = SceneConfig(
            pair=self.pair, start=self.start, socket=self.socket, embodiment=self.body, mesh_dir=mesh_dir
        )
        if self.clearance_m is not None:
            scene = replace(scene, clearance_m=self.clearance_m)
        is_tight = self.clearance_m is None or self.clearance_m < CLEARANCES_M[0]
        return replace(scene, **TIGHT) if is_tight else scene


def measure(setting: Setting, episodes: int, mesh_dir: Path | None) -> Run:
    """The clean expert's episodes of one setting."""
    sim = InsertionSim(setting.scene(mesh_dir), num_envs=episodes)
    everyone = ids = np.arange(episodes)
    sim.reset(ids, ids)
    expert = ScriptedExpert(sim)
    expert.reset(ids)
    while len(ids):
        result = sim.step(expert.act(ids), ids)
        ids = ids[~(result.terminated | result.truncated)]
    found = sim.metrics(everyone)
    success = found["success"].astype(bool)
    reasons = Counter(FAILURES[code] if code else "time_out" for code in found["failure"][~success])
    extra: dict[str, float | str] = {"failures": ", ".join(f"{n} {name}" for name, n in reasons.items())}
    if success.any():
        for name in ("time_to_success_s", "peak_force_n", "in_hand_shift_m"):
            extra[name] = round(float(np.median(found[name][success])), 5)
    return Run(
        table=TABLE,
        task=setting.task,
        policy=setting.body,
        variant=setting.start,
        seed=None,
        success=float(success.mean()),
        episodes=episodes,
        iterations=None,
        env_steps=None,
        extra={name: value for name, value in extra.items() if value != ""},
        **provenance(),
    )


def settings(bodies: list[str], pairs: list[str], starts: list[str], socket: str) -> list[Setting]:
    """All combinations, those of one pair together."""
    found = []
    for pair, start, body in itertools.product(pairs, starts, bodies):
        own = pair.startswith(MESH_PAIR_PREFIX)
        found += [Setting(body, pair, c, start, socket) for c in ((None,) if own else CLEARANCES_M)]
    return found


def is_done(setting: Setting, episodes: int, rows: list[Run]) -> bool:
    """Whether a row holds enough episodes."""
    known = (setting.task, setting.body, setting.start)
    return any((row.task, row.policy, row.variant) == known and row.episodes >= episodes for row in rows)


@run_cli
def main() -> None:
    """Measure what is missing."""
    parser = CommandParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=50, help="of each setting (default %(default)s)")
    parser.add_argument("--bodies", nargs="+", default=["aloha", "kinova"], help="default: %(default)s")
    parser.add_argument("--pairs", nargs="+", default=list(PROCEDURAL_PAIRS), help="or automate/ID")
    parser.add_argument("--starts", nargs="+", default=list(STARTS), choices=STARTS, help="default: all")
    parser.add_argument("--socket", default="held", help="held, or stands: it stays on the table")
    parser.add_argument("--mesh_dir", type=Path, help="folder of meshes for automate/ID")
    parser.add_argument("--results", type=Path, default=RESULTS / f"{TABLE}.json", help="file of the rows")
    options = parser.parse_args()
    check_results("--results", options.results)
    if options.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, got {options.episodes}")
    for body in options.bodies:
        get_embodiment(body)
    wanted = settings(options.bodies, options.pairs, options.starts, options.socket)
    rows = (
        [row for row in read_rows(options.results) if isinstance(row, Run)]
        if options.results.is_file()
        else []
    )
    for setting in tqdm([s for s in wanted if not is_done(s, options.episodes, rows)], unit="setting"):
        row = measure(setting, options.episodes, options.mesh_dir)
        save(options.results, [(row, [])], replace=True)
        tqdm.write(f"{row.policy:8} {row.task:24} {row.variant:8} {row.successes}/{row.episodes} {row.extra}")


if __name__ == "__main__":
    raise SystemExit(main())
