"""Speed and memory of the warp backend, part by part, while the expert inserts.

Needs neither LeRobot nor Gymnasium.
"""

import gc
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from lerobot_vtrefine.sim.config import SceneConfig, WarpConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import InsertionSim

WHOLE_EPISODE = 40
"""Control steps by which the expert has inserted."""
REPEATS = 5
"""Each part alone is timed so often, in the middle of the insertion."""
GIB = 2.0**30


@dataclass(frozen=True)
class WorldsRow:
    """One number of worlds; times are medians per control step of all worlds [s], but for `mean_s`."""

    worlds: int
    step_s: float
    """One whole control step: commands in, task rules, state, pads and depth image out on the host."""
    mean_s: float
    """The same, averaged over the episode, of which a plug in its hole is the slowest part."""
    physics_s: float
    """The substeps of a control step."""
    tactile_s: float
    """Raw counts of all pads, on the host."""
    depth_s: float
    """Depth images of all worlds, on the host."""
    reset_s: float
    """New episodes in all worlds, settled."""
    start_s: float
    """From nothing to the first observation: build, compile or load kernels, settle."""
    memory_gib: float
    """On the GPU, as the driver counts it; of the process on the CPU."""
    success: float
    """Share of worlds in which the expert succeeded, NaN where it was not given the time."""
    substeps: int
    """Physics steps per control step."""
    taxels: int
    """Taxels of one world."""


def measure_worlds(warp: WarpConfig, worlds: Sequence[int], steps: int) -> Iterator[WorldsRow]:
    """A row per number of worlds, on `warp.device`.

    Raises:
        ValueError: no such device, or not one step.
    """
    if steps < 2:
        raise ValueError(f"steps must be at least 2, got {steps}")
    for count in worlds:
        yield _measure(warp, count, steps)


def table(rows: Sequence[WorldsRow]) -> str:
    """Aligned text for people: milliseconds, thousands and millions per second."""
    lines = [[f"{title} {unit}".strip() for title, unit, _ in COLUMNS]]
    lines += [[_cell(value(row)) for *_, value in COLUMNS] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines
    )


def _cell(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.4g}"


COLUMNS: tuple[tuple[str, str, Callable[[WorldsRow], float]], ...] = (
    ("worlds", "", lambda row: row.worlds),
    ("step", "[ms]", lambda row: 1e3 * row.step_s),
    ("mean step", "[ms]", lambda row: 1e3 * row.mean_s),
    ("env steps", "[k/s]", lambda row: 1e-3 * row.worlds / row.mean_s),
    ("physics", "[ms]", lambda row: 1e3 * row.physics_s),
    ("physics steps", "[M/s]", lambda row: 1e-6 * row.worlds * row.substeps / row.physics_s),
    ("tactile", "[ms]", lambda row: 1e3 * row.tactile_s),
    ("taxels", "[M/s]", lambda row: 1e-6 * row.worlds * row.taxels / row.tactile_s),
    ("depth", "[ms]", lambda row: 1e3 * row.depth_s),
    ("reset", "[ms]", lambda row: 1e3 * row.reset_s),
    ("start", "[s]", lambda row: row.start_s),
    ("memory", "[GiB]", lambda row: row.memory_gib),
    ("success", "[%]", lambda row: 100 * row.success),
)


def _measure(warp: WarpConfig, count: int, steps: int) -> WorldsRow:
    device = warp.device
    _give_back()
    before, ids = _memory_gib(device), np.arange(count)
    start = time.perf_counter()
    sim = InsertionSim(SceneConfig(start="grasped"), num_envs=count, backend="warp", warp=warp)
    sim.reset(ids, ids)
    observation = sim.observe()
    started = time.perf_counter() - start
    sim.step(sim.command_targets())
    reset_s = _seconds(lambda: sim.reset(ids, ids + count))
    expert = ScriptedExpert(sim)
    expert.reset(ids)
    times, parts = [], {}
    for step in range(steps):
        action = expert.act(ids)
        times.append(_seconds(lambda: (sim.step(action, images=ids), sim.observe())))  # noqa: B023  called at once
        if step == steps // 2:
            parts = _parts(sim)
    success = float(sim.metrics()["success"].mean()) if steps >= WHOLE_EPISODE else float("nan")
    memory = _memory_gib(device) - (before if sim.device != "cpu" else 0.0)
    return WorldsRow(
        worlds=count,
        step_s=float(np.median(times[1:])),
        mean_s=float(np.mean(times[1:])),
        reset_s=reset_s,
        start_s=started,
        memory_gib=memory,
        success=success,
        substeps=sim.substeps,
        taxels=observation["tactile"][0].size,
        **parts,
    )


def _parts(sim: InsertionSim) -> dict[str, float]:
    """Each part alone, at the worlds' present state, which holding the commands leaves about the same."""
    parts = {"physics_s": sim.hold, "tactile_s": sim.tactile, "depth_s": sim.depth_mm}
    return {
        name: float(np.median([_seconds(part) for _ in range(REPEATS + 1)][1:]))
        for name, part in parts.items()
    }


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()  # everything measured here ends on the host, and so waits for the device
    return time.perf_counter() - start


def _give_back() -> None:
    """Let the driver have back what the simulation before held: what it frees later would count as ours."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.synchronize()  # only then do the pools let go of what was freed
        torch.cuda.empty_cache()


def _memory_gib(device: str) -> float:
    if device == "cpu" or not torch.cuda.is_available():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / GIB
    free, total = torch.cuda.mem_get_info()
    return (total - free) / GIB
