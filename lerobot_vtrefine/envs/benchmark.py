"""Speed of the batched environment against its own physics, and its memory; rows for ``vtrefine-bench``."""

import multiprocessing as mp
import resource
import statistics
import sys
import time

import mujoco.batch
import numpy as np

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.vector_env import VtRefineVectorEnv

NUM_ENVS = 64
MEMORY_ENVS = 256
STEPS = 8
"""Control steps per timed block: one chunk of the policy."""
ROUNDS = 5
GIB = 2.0**30

Row = tuple[str, float, str]


def run() -> list[Row]:
    """(what, ratio, explanation) with sensors read as DPPO and as LeRobot read them, and GiB for memory."""
    rows = [_speed_row(window) for window in (2, STEPS)]
    return [*rows, _tactile_row(), _memory_row()]


def _speed_row(window: int) -> Row:
    """Whole environment steps, the last ``window`` of ``STEPS`` with observations, and physics alone.

    They take turns, so that the machine's load cancels.
    """
    env = VtRefineVectorEnv(VtRefineEnvConfig(start="grasped"), NUM_ENVS)
    sim = env.episodes.sim
    batch = mujoco.batch.Batch(sim.scene.model, nsim=NUM_ENVS, nthread=0)
    ratios = [_ratio(env, batch, seed * NUM_ENVS, window) for seed in range(ROUNDS + 1)]
    reads = "every step" if window == STEPS else f"{window} of {STEPS} steps"
    explanation = f"{NUM_ENVS} environments, tactile, depth and observations read at {reads}; target 0.75"
    return f"environment step / raw mujoco.batch, read {reads}", statistics.median(ratios[1:]), explanation


def _ratio(env: VtRefineVectorEnv, batch: mujoco.batch.Batch, seed: int, window: int) -> float:
    """Seconds of ``Batch.rollout`` over seconds of the environment: same scene, starts and commands."""
    sim = env.episodes.sim
    env.reset(seed=seed)
    states = [sim.get_state(index) for index in range(NUM_ENVS)]
    hold = sim.command_targets()
    start = time.perf_counter()
    for step in range(STEPS):
        if step < STEPS - window:
            env.episodes.step(hold, reads=False)
        else:
            env.step(hold)
    whole = time.perf_counter() - start
    substeps = round(sim.config.control_dt_s / sim.scene.config.timestep_s)
    commands = np.stack([state["episode"]["command"] for state in states])
    controls = np.repeat(commands[:, None], substeps, axis=1)
    for index, state in enumerate(states):
        batch.state[index] = state["row"]
    start = time.perf_counter()
    for _ in range(STEPS):
        batch.rollout(substeps, control=controls, record=())
    return (time.perf_counter() - start) / whole


def _tactile_row() -> Row:
    """Seconds of reading all pads over seconds of whole steps, by turns."""
    env = VtRefineVectorEnv(VtRefineEnvConfig(start="grasped"), NUM_ENVS)
    shares = []
    for seed in range(ROUNDS + 1):
        env.reset(seed=seed * NUM_ENVS)
        hold = env.episodes.sim.command_targets()
        start = time.perf_counter()
        for _ in range(STEPS):
            env.step(hold)
        middle = time.perf_counter()
        for _ in range(STEPS):
            env.episodes.sim.tactile()
        shares.append((time.perf_counter() - middle) / (middle - start))
    explanation = f"{NUM_ENVS} environments, everything read at every step; target below 0.15"
    return "tactile's share of an environment step", statistics.median(shares[1:]), explanation


def _memory_row() -> Row:
    """Peak resident memory of a fresh process that steps ``MEMORY_ENVS`` environments."""
    context = mp.get_context("spawn")
    with context.Pool(1) as pool:
        before, peak = pool.apply(_step_many)
    explanation = f"GiB peak of a process with {MEMORY_ENVS} environments ({before:.2f} before); target 2"
    return f"memory of {MEMORY_ENVS} environments [GiB]", peak, explanation


def _step_many() -> tuple[float, float]:
    before = _peak_gib()
    env = VtRefineVectorEnv(VtRefineEnvConfig(start="grasped"), MEMORY_ENVS)
    env.reset(seed=0)
    hold = env.episodes.sim.command_targets()
    for _ in range(2):
        env.step(hold)
    return before, _peak_gib()


def _peak_gib() -> float:
    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes, Linux KiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / GIB
