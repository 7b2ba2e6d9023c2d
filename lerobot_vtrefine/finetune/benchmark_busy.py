"""What another process costs a fine-tuning run that shares two cores with it; a row for ``vtrefine-bench``.

The other process computes without pause at the lowest priority, in a session of its own, as a program in
another terminal does. On Linux with scheduling groups it then takes half of a core whatever its priority.
"""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Generator
from dataclasses import dataclass

import torch
from lerobot.envs.utils import env_to_policy_features

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.decisions import LeRobotDecisionEnv, make_decision_env
from lerobot_vtrefine.finetune.agents import make_agent
from lerobot_vtrefine.finetune.config import SmallDppo
from lerobot_vtrefine.finetune.dppo import TrainState, collect, update
from lerobot_vtrefine.finetune.protocols import Agent
from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
from lerobot_vtrefine.policies.vt_dp3.modeling_vt_dp3 import VtDp3Policy
from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import make_vt_dp3_pre_post_processors

Row = tuple[str, float, str]

CORES = 2
LOWEST_PRIORITY = 19
SPIN = f"import os; os.nice({LOWEST_PRIORITY})\nwhile True: pass"
SETTLE_S = 0.5
"""What the scheduler gets to spread threads anew."""


@dataclass(frozen=True)
class Iteration:
    """Short iterations of fine-tuning: a few decisions in each environment, then the update."""

    cfg: SmallDppo
    env: LeRobotDecisionEnv
    agent: Agent
    state: TrainState

    @classmethod
    def create(cls, num_envs: int) -> "Iteration":
        """The demo's task and sizes, but for the numbers of environments and decisions; random weights."""
        cfg = SmallDppo(
            num_envs=num_envs, decisions=2, encoder="frozen", minibatch_decisions=num_envs, critic_warmup=0
        )
        policy = random_policy()
        agent = make_agent(policy, cfg)
        bounds = {"min": -torch.ones(policy.config.state_dim), "max": torch.ones(policy.config.state_dim)}
        stats = {STATE_KEY: bounds, ACTION_KEY: bounds}
        processors = make_vt_dp3_pre_post_processors(policy.config, stats)
        task = VtRefineEnvConfig(start="grasped")
        windows = policy.config.n_obs_steps, policy.config.n_action_steps
        env = make_decision_env(task, num_envs, *processors, *windows)
        return cls(cfg, env, agent, TrainState.create(agent, cfg, env.privileged_dim, seed=0))

    def seconds(self) -> float:
        """Wall time of one, always from the same starts, which are settled once."""
        started = time.perf_counter()
        seeds = range(self.cfg.num_envs)
        rollout = collect(self.env, self.agent, self.cfg, self.state.generator, seeds)
        update(rollout, self.agent, self.state, self.cfg)
        return time.perf_counter() - started


def run(num_envs: int = 64, rounds: int = 4) -> list[Row]:
    """(what, ratio, explanation): iterations beside a busy process over iterations alone, by turns."""
    with two_cores():
        iteration = Iteration.create(num_envs)
        iteration.seconds()  # settles and warms up
        alone, beside = [], []
        for _ in range(rounds):
            alone.append(iteration.seconds())
            with busy_process():
                beside.append(iteration.seconds())
    times = [sorted(part)[len(part) // 2] for part in (alone, beside)]
    explanation = (
        f"medians {times[1]:.2f} s against {times[0]:.2f} s, {num_envs} environments on {CORES} cores"
    )
    return [("DPPO iteration, beside a process at nice 19 / alone", times[1] / times[0], explanation)]


@contextlib.contextmanager
def two_cores() -> Generator[None]:
    """Keep this process, with the threads and processes that it starts, on two of its cores."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    usable = os.sched_getaffinity(0)
    os.sched_setaffinity(0, set(sorted(usable)[:CORES]))
    try:
        yield
    finally:
        os.sched_setaffinity(0, usable)


@contextlib.contextmanager
def busy_process() -> Generator[None]:
    """A process that never waits, at the lowest priority."""
    other = subprocess.Popen([sys.executable, "-c", SPIN], start_new_session=True)
    try:
        time.sleep(SETTLE_S)
        yield
    finally:
        other.kill()
        other.wait()


def random_policy() -> VtDp3Policy:
    """A policy of the preset ``small`` with random weights, as behaviour cloning would leave it."""
    config = VtDp3Config(preset="small", device="cpu")
    features = env_to_policy_features(VtRefineEnvConfig())
    config.input_features = {key: features[key] for key in config.required_keys}
    config.output_features = {ACTION_KEY: features[ACTION_KEY]}
    torch.manual_seed(0)
    return VtDp3Policy(config)
